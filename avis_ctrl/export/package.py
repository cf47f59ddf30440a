"""The files of an export, and the check that they belong together."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.io

import avis_ctrl
from avis_ctrl.errors import AvisError, ComputationError, InputError
from avis_ctrl.export.anti_windup import Choice, choose_anti_windup
from avis_ctrl.export.c_source import HEADER, SOURCE, Provenance, c_files, constants_of
from avis_ctrl.export.certificate import Certificate, Progress, certify, shipped_loop
from avis_ctrl.export.compiled import compiler
from avis_ctrl.export.design_folder import Added, DesignFolder
from avis_ctrl.export.protection import protection
from avis_ctrl.export.replay import Replay, replay_worst_plant
from avis_ctrl.export.sampled_controller import Arithmetic, SampledController, parse_controller, read_controller
from avis_ctrl.export.vectors import agreement_V, as_csv, vectors
from avis_ctrl.rigs.file_errors import read_json
from avis_ctrl.study.files import as_json
from avis_ctrl.study.output import controller_form

CONTROLLER, CERTIFICATE, MAT, VECTORS = "controller.json", "certificate.json", "controller.mat", "test_vectors.csv"
# The controller of the logical axes from which the exported one was made, where the design's folder does not have it.
CONTINUOUS = "continuous_controller.json"
FILES = (CONTROLLER, CONTINUOUS, HEADER, SOURCE, MAT, VECTORS, CERTIFICATE)
FORMATS = ("c", "mat", "json")


@dataclass(frozen=True, eq=False)
class Package:
    """What an export writes: contents by file name, the certificate last. anti_windup : which, and why. replay : of the
    worst plant through the compiled code; None without gcc."""

    controller: SampledController
    certificate: Certificate
    contents: dict[str, bytes]
    anti_windup: Choice
    replay: Replay | None = None


def formats_of(text: str) -> tuple[str, ...]:
    """Of a list such as "c,mat". Raises InputError."""
    asked = tuple(dict.fromkeys(one.strip() for one in text.split(",")))
    if unknown := [one for one in asked if one not in FORMATS]:
        raise InputError(f"expected some of {','.join(FORMATS)}", field="--format", value=unknown[0])
    return asked


def make_package(folder: DesignFolder, name: str, arithmetic: Arithmetic = "float64", formats: Sequence[str] = FORMATS,
                 progress: Progress = lambda text: None, mu_at_most: float = np.inf) -> Package:
    """Everything that `avis export` writes; controller.json and certificate.json always.

    Raises
    ------
    InputError : a name that the folder does not have.
    ComputationError : a controller that is not stable by itself, or whose loop is not, or has a larger mu than allowed.
    """
    text = folder.sampled(name, arithmetic).as_bytes()
    controller = parse_controller(text)  # the numbers as the file has them
    progress("anti-windup: the table with its drives at their limits, with and without")
    choice = choose_anti_windup(shipped_loop(folder, controller), tuple(folder.design.keep))
    guard = protection(controller, folder.rig, choice.law)
    plain = c_files(controller, guard, Provenance(()))
    certificate = certify(folder, controller, plain, progress)
    if not certificate.content["stable"]:
        precise = "double precision (without --float32), or " if arithmetic == "float32" else ""
        further = "a larger --order" if name in folder.added else "another controller of the folder"
        raise ComputationError(f"the loop of the exported controller {name!r} is not proved stable; nothing was "
                               "written", measured="; ".join(dict.fromkeys(certificate.reasons)),
                               next_step=f"try {precise}{further}")
    if not (mu := certificate.content["mu_upper"]) <= mu_at_most:
        raise ComputationError(f"mu of the exported controller {name!r} is not proved to be at most {mu_at_most:g}; "
                               "nothing was written", measured=f"upper bound of mu {mu:.4g}",
                               next_step=f"ask for a larger --order, or accept it with --mu-at-most {mu + 0.005:.2f}")
    replay = None
    if compiler() is not None:
        progress("worst plant with the compiled code, on the nonlinear table")
        replay = replay_worst_plant(folder, certificate, controller, plain)
        if replay.record.diverged:
            raise ComputationError("the worst plant diverged under the compiled code; nothing was written")
    contents, content = {CONTROLLER: text}, dict(certificate.content)
    content["anti_windup"] = choice.as_dict()
    if name in folder.added:
        contents[CONTINUOUS] = as_json(controller_form(name, folder.added[name].K))
    if "c" in formats:
        files = c_files(controller, guard, _provenance(folder, controller, certificate))
        contents |= {key: value.encode() for key, value in files.items()}
        y, u = vectors(controller, guard)
        contents[VECTORS] = as_csv(controller, y, u).encode()
        content["test_vectors"] = {"samples": len(y), "tolerance_V": agreement_V(controller, guard, y, u)}
    if "mat" in formats:
        contents[MAT] = _mat(controller)
    content["files"] = {name: _sha256(data) for name, data in contents.items()}
    contents[CERTIFICATE] = as_json(content)
    return Package(controller, certificate, contents, choice, replay)


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _provenance(folder: DesignFolder, controller: SampledController, certificate: Certificate) -> Provenance:
    made = folder.result.get("provenance", {})
    return Provenance((
        f"Controller {controller.name!r} of the design {folder.design.title!r} for the rig {folder.rig.name!r},",
        f"{controller.sample_rate_Hz:g} Hz, {controller.arithmetic}; {controller.system.nstates} states.",
        f"Written by avis_ctrl {avis_ctrl.__version__}; the design was made by {made.get('avis_ctrl')}, "
        f"{made.get('date')}.",
        f"Inputs of the design, SHA-256: {made.get('inputs_sha256')}",
        f"controller.json, SHA-256: {controller.sha256}",
        f"Certificate: {certificate.one_line()}.",
        "Do not edit: a changed number is no longer what the certificate is for."))


def _mat(controller: SampledController) -> bytes:
    K, file = controller.system, io.BytesIO()
    cells = {name: np.array(values, dtype=object) for name, values in (("inputs", K.inputs), ("outputs", K.outputs))}
    scipy.io.savemat(file, {**controller.matrices(), **cells, "sample_rate_Hz": controller.sample_rate_Hz,
                            "limits_V": controller.limits_V, "delay_samples": controller.delay_samples,
                            "name": controller.name, "arithmetic": controller.arithmetic,
                            "input_units": np.array(["V"] * K.ninputs, dtype=object),
                            "output_units": np.array(["V"] * K.noutputs, dtype=object)}, format="5", oned_as="row")
    return file.getvalue()


@dataclass(frozen=True)
class CheckSettings:
    """Relative difference that a figure computed again may have from the one in the file.

    searched : of bounds that a search ends; its steps may fall differently with another numerical library.
    direct : of the rounding noise, a closed formula that every coefficient enters.
    """

    searched: float = 1e-4
    direct: float = 1e-7


def check_package(folder: DesignFolder, out: Path, progress: Progress = lambda text: None,
                  settings: CheckSettings = CheckSettings()) -> list[str]:
    """What does not agree in an exported folder, each as a line; empty if all does.

    First the files: those that are missing, the hashes, the numbers in the C and .mat files; each finding goes to
    `progress` at once. Then the certificate is computed again, unless controller.json is unchanged and another file is
    not.

    Raises
    ------
    InputError : files that are missing or cannot be read.
    """
    stored = read_json(out / CERTIFICATE, "avis-certificate")
    controller = read_controller(out / CONTROLLER)
    if (out / CONTINUOUS).exists():
        folder = replace(folder, added={controller.name: Added(folder.controller_in(out / CONTINUOUS))})
    found, changed = [], stored.get("controller_sha256") != controller.sha256
    if changed:
        found.append(f"{CONTROLLER} is not the file that the certificate names: its hash differs")
    found += _wrong_files(out, stored.get("files"))
    if (out / SOURCE).exists():
        found += _differences(SOURCE, controller, _numbers_in_c(out / SOURCE, controller))
    if (out / MAT).exists():
        found += _differences(MAT, controller, _numbers_in_mat(out / MAT))
    for line in found:
        progress(line)
    if found and not changed:
        return found
    try:
        content = certify(folder, controller, None, progress).content
    except AvisError as error:
        return [*found, f"no certificate can be computed from {CONTROLLER}: {error}"]
    for key, value in json.loads(as_json(content)).items():
        tolerance = settings.direct if key == "rounding_noise_m_per_s" else settings.searched
        if key not in ("controller_sha256", "step_time_us") and not _alike(stored.get(key), value, tolerance):
            found.append(f"{key}: {stored.get(key)} in {CERTIFICATE}, {value} computed from {CONTROLLER}")
    return found


def _wrong_files(out: Path, hashes: object) -> list[str]:
    """Files that the certificate lists and that are missing, or are not the ones that were exported."""
    found = []
    for name, digest in (hashes.items() if isinstance(hashes, dict) else ()):
        try:
            data = (out / Path(name).name).read_bytes()
        except OSError as error:
            found.append(f"{name} is missing" if not (out / name).exists() else f"{name}: {error.strerror}")
            continue
        if name != CONTROLLER and _sha256(data) != digest:
            found.append(f"{name} is not the file that was exported: its hash differs")
    return found


def _alike(stored: object, computed: object, tolerance: float) -> bool:
    if isinstance(stored, dict) and isinstance(computed, dict):
        return stored.keys() == computed.keys() and all(_alike(stored[key], computed[key], tolerance)
                                                        for key in stored)
    if isinstance(stored, float) and isinstance(computed, float):
        return abs(stored - computed) <= tolerance * max(abs(stored), abs(computed))
    return stored == computed


def _numbers_in_c(path: Path, controller: SampledController) -> dict[str, np.ndarray]:
    try:
        return constants_of(path.read_text(encoding="utf-8"), controller.dtype)
    except (OSError, ValueError) as error:
        raise InputError(f"expected the C source of a controller; {error}", file=path) from None


def _numbers_in_mat(path: Path) -> dict[str, np.ndarray]:
    try:
        return {key: np.atleast_2d(value) for key, value in scipy.io.loadmat(path).items() if key in "ABCD"}
    except Exception as error:  # scipy raises many kinds
        raise InputError(f"expected a MATLAB file; {error}", file=path) from None


def _differences(name: str, controller: SampledController, numbers: dict[str, np.ndarray]) -> list[str]:
    return [f"{key} in {name} differs from {CONTROLLER}" for key, matrix in controller.matrices().items()
            if matrix.size and not np.array_equal(numbers.get(key, np.zeros(0)), matrix)]
