"""The files of an export, and the check that they are consistent."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

import avis_ctrl
from avis_ctrl.errors import AvisError, ComputationError, InputError
from avis_ctrl.export.anti_windup import Choice, choose_anti_windup
from avis_ctrl.export.bounds import StabilityNotProvedError
from avis_ctrl.export.c_source import HEADER, SOURCE, Provenance, c_files, constants_of
from avis_ctrl.export.certificate import Certificate, Progress, certify, shipped_loop
from avis_ctrl.export.compiled import compiler, step_time_us
from avis_ctrl.export.compiled_simulation import CompiledSimulation, simulate_worst_plant
from avis_ctrl.export.design_folder import Added, DesignFolder
from avis_ctrl.export.protection import Protection, protection
from avis_ctrl.export.sampled_controller import Arithmetic, SampledController, parse_controller, read_controller
from avis_ctrl.export.vectors import agreement_V, as_csv, expected_V, read_csv, restarts, vectors
from avis_ctrl.rigs.file_errors import read_json
from avis_ctrl.simulation.sampled_loop import NO_ANTI_WINDUP, AntiWindup
from avis_ctrl.study.files import as_json
from avis_ctrl.study.output import controller_dict

CONTROLLER, CERTIFICATE, MAT = "controller.json", "certificate.json", "controller.mat"
VECTORS, RESTARTS = "test_vectors.csv", "restart_vectors.csv"
# Key of the certificate that describes each of them.
TESTS = {VECTORS: "test_vectors", RESTARTS: "restart_vectors"}
# The controller of the logical axes from which the exported one was derived, if the design's folder does not have it.
CONTINUOUS = "continuous_controller.json"
FILES = (CONTROLLER, CONTINUOUS, HEADER, SOURCE, MAT, VECTORS, RESTARTS, CERTIFICATE)
ORDERS = "orders.png"  # written by the command beside these files, with --order; it has no hash
FORMATS = ("c", "mat", "json")


@dataclass(frozen=True, eq=False)
class Package:
    """Contents of an export by file name, the certificate last. anti_windup : the chosen law with its figures. replay :
    of the worst plant with the compiled code; None without gcc."""

    controller: SampledController
    certificate: Certificate
    contents: dict[str, bytes]
    anti_windup: Choice
    replay: CompiledSimulation | None = None


def formats_of(text: str) -> tuple[str, ...]:
    """Formats in a list such as "c,mat". Raises InputError."""
    asked = tuple(dict.fromkeys(one.strip() for one in text.split(",")))
    if unknown := [one for one in asked if one not in FORMATS]:
        raise InputError(f"expected some of {','.join(FORMATS)}", field="--format", value=unknown[0])
    return asked


def make_package(
    folder: DesignFolder,
    name: str,
    arithmetic: Arithmetic = "float64",
    formats: Sequence[str] = FORMATS,
    progress: Progress = lambda text: None,
    mu_at_most: float = np.inf,
) -> Package:
    """Everything that `avis export` writes; controller.json and certificate.json are always included.

    Raises
    ------
    InputError : a controller name that the folder does not have.
    ComputationError : a controller that is unstable by itself, not proved stable in its loop, or of too large mu.
    """
    text = folder.sampled(name, arithmetic).as_bytes()
    controller = parse_controller(text)  # the numbers as in the file
    try:  # first, because it is the quickest test of whether a controller can be exported
        certificate = certify(folder, controller, progress, True)
    except StabilityNotProvedError as error:
        raise _not_proved(folder, name, arithmetic, error.reason) from None
    if not certificate.content["stable"]:
        raise _not_proved(folder, name, arithmetic, "; ".join(dict.fromkeys(certificate.reasons)))
    if not (mu := certificate.content["mu_upper"]) <= mu_at_most:
        raise ComputationError(
            f"mu of the exported controller {name!r} is not proved to be at most {mu_at_most:g}; nothing was written",
            measured=f"upper bound of mu {mu:.4g}",
            next_step=f"ask for a larger --order, or accept it with --mu-at-most {mu + 0.005:.2f}",
        )
    progress("anti-windup: the table with its drives at their limits, with and without")
    choice = choose_anti_windup(shipped_loop(folder, controller), tuple(folder.design.keep))
    guard, replay = protection(controller, folder.rig, choice.law), None
    if compiler() is not None:
        progress("worst plant with the compiled code, on the nonlinear table")
        plain = c_files(controller, guard, Provenance(()))
        certificate = replace(
            certificate, content={**certificate.content, "step_time_us": step_time_us(plain, controller)}
        )
        replay = simulate_worst_plant(folder, certificate, controller, plain)
        if replay.record.diverged:
            raise ComputationError("the worst plant diverged under the compiled code; nothing was written")
    contents, content = {CONTROLLER: text}, dict(certificate.content)
    content["anti_windup"] = choice.as_dict()
    content["design_inputs_sha256"] = folder.inputs_sha256
    if name in folder.added:
        contents[CONTINUOUS] = as_json(controller_dict(name, folder.added[name].K))
    if "c" in formats:
        files = c_files(controller, guard, _provenance(folder, controller, certificate))
        contents |= {key: value.encode() for key, value in files.items()}
        for file, (y, u) in ((VECTORS, vectors(controller, guard)), (RESTARTS, restarts(controller, guard))):
            contents[file] = as_csv(controller, y, u).encode()
            content[TESTS[file]] = {"samples": len(y), "tolerance_V": agreement_V(controller, guard, y, u)}
    if "mat" in formats:
        contents[MAT] = _mat(controller)
    content["files"] = {name: _sha256(data) for name, data in contents.items()}
    contents[CERTIFICATE] = as_json(content | {"content_sha256": _content_sha256(content)})
    return Package(controller, certificate, contents, choice, replay)


def _not_proved(folder: DesignFolder, name: str, arithmetic: Arithmetic, reasons: str) -> ComputationError:
    precise = "double precision (without --float32), or " if arithmetic == "float32" else ""
    further = "a larger --order" if name in folder.added else "another controller of the folder"
    return ComputationError(
        f"the loop of the exported controller {name!r} is not proved stable; nothing was written",
        measured=reasons,
        next_step=f"try {precise}{further}; or design with a larger control_effort.reduction, so that the voltages "
        "fall off before half the sample rate",
    )


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _content_sha256(content: Mapping[str, Any]) -> str:
    """Hash of the certificate without the hash itself; it reveals accidental changes."""
    return _sha256(as_json({key: value for key, value in content.items() if key != "content_sha256"}))


def _provenance(folder: DesignFolder, controller: SampledController, certificate: Certificate) -> Provenance:
    made = folder.result.get("provenance", {})
    return Provenance(
        (
            f"Controller {controller.name!r} of the design {folder.design.title!r} for the rig {folder.rig.name!r},",
            f"{controller.sample_rate_Hz:g} Hz, {controller.arithmetic}; {controller.system.nstates} states.",
            f"Written by avis_ctrl {avis_ctrl.__version__}; the design was made by {made.get('avis_ctrl')}, "
            f"{made.get('date')}.",
            f"Inputs of the design, SHA-256: {folder.inputs_sha256}",
            f"controller.json, SHA-256: {controller.sha256}",
            f"Certificate: {certificate.one_line()}.",
            "Do not edit: a changed number is no longer what the certificate is for.",
        )
    )


def _mat(controller: SampledController) -> bytes:
    K, file = controller.system, io.BytesIO()
    cells = {name: np.array(values, dtype=object) for name, values in (("inputs", K.inputs), ("outputs", K.outputs))}
    scipy.io.savemat(
        file,
        {
            **controller.matrices(),
            **cells,
            "sample_rate_Hz": controller.sample_rate_Hz,
            "limits_V": controller.limits_V,
            "delay_samples": controller.delay_samples,
            "name": controller.name,
            "arithmetic": controller.arithmetic,
            "input_units": np.array(["V"] * K.ninputs, dtype=object),
            "output_units": np.array(["V"] * K.noutputs, dtype=object),
        },
        format="5",
        oned_as="row",
    )
    return file.getvalue()


@dataclass(frozen=True)
class CheckSettings:
    """Relative tolerance of a recomputed figure compared with the one in the file.

    searched : for bounds that result from a search; its steps may differ with another numerical library.
    direct : for the rounding noise, a closed formula that depends on every coefficient.
    rounding : factor by which a tolerance may differ from the recomputed one: another processor may add in another
        order.
    """

    searched: float = 1e-4
    direct: float = 1e-7
    rounding: float = 3.0


def check_package(
    folder: DesignFolder,
    out: Path,
    progress: Progress = lambda text: None,
    name: str | None = None,
    settings: CheckSettings = CheckSettings(),
) -> list[str]:
    """Inconsistencies in an exported folder, one line each; empty if there are none.

    First the files are checked: missing or unlisted files, the hashes, the numbers in the C and .mat files, the test
    vectors; each finding goes to `progress` at once. Files that no export writes are not checked; `progress`
    gets a note of them. Then the certificate is recomputed, unless only files other than controller.json have changed,
    or the design is another one.

    Parameters
    ----------
    name : controller expected in the folder; None accepts any.

    Raises
    ------
    InputError : a folder that is not an export, unreadable files, another controller.
    """

    def reported(lines: list[str]) -> list[str]:
        for line in lines:
            progress(line)
        return lines

    _require_export(out)
    stored = read_json(out / CERTIFICATE, "avis-certificate", "the certificate of avis export")
    if (inputs := stored.get("design_inputs_sha256")) not in (None, (own := folder.inputs_sha256)):
        return reported(
            [f"this code was exported from another design: SHA-256 of its inputs {inputs}, {own} in {folder.path}"]
        )
    found = (
        [f"{CERTIFICATE} is not as it was written: its content_sha256 differs"]
        if stored.get("content_sha256") != _content_sha256(stored)
        else []
    )
    wrong = _wrong_files(out, stored)
    if foreign := _foreign_files(out, stored):
        progress(f"Note: {CERTIFICATE} does not list {', '.join(foreign)}; not checked")
    try:
        controller = read_controller(out / CONTROLLER)
    except InputError as error:
        if found or wrong:
            return reported([*found, *wrong, str(error)])
        raise
    if name is not None and name != controller.name:
        raise InputError(f"expected {controller.name!r}, the controller in {out}", field="--controller", value=name)
    if (out / CONTINUOUS).exists():
        folder = replace(folder, added={controller.name: Added(folder.controller_in(out / CONTINUOUS))})
    if (out / SOURCE).exists():
        wrong += _differences(SOURCE, controller, _numbers_in_c(out / SOURCE, controller))
    if (out / MAT).exists():
        wrong += _differences(MAT, controller, _numbers_in_mat(out / MAT))
    if not any(line.startswith(tuple(TESTS)) for line in wrong):
        wrong += _wrong_vectors(folder, controller, out, stored, settings)
    found = reported([*found, *wrong])
    if wrong and stored.get("controller_sha256") == controller.sha256:
        return found
    try:
        content = certify(folder, controller, progress).content
    except AvisError as error:
        return [*found, *reported([f"no certificate can be computed from {CONTROLLER}: {error}"])]
    for key, value in json.loads(as_json(content)).items():
        tolerance = settings.direct if key == "rounding_noise_m_per_s" else settings.searched
        if key not in ("controller_sha256", "step_time_us"):
            found += reported(_unlike(key, stored.get(key), value, tolerance))
    return found


def _unlike(key: str, stored: object, computed: object, tolerance: float) -> list[str]:
    """One line for each figure that differs; a figure within a table by its path."""
    if isinstance(stored, dict) and isinstance(computed, dict) and stored.keys() == computed.keys():
        return [line for name in stored for line in _unlike(f"{key}.{name}", stored[name], computed[name], tolerance)]
    if isinstance(stored, float) and isinstance(computed, float):
        alike = abs(stored - computed) <= tolerance * max(abs(stored), abs(computed))
    else:
        alike = stored == computed
    before, now = (f"{one:.6g}" if isinstance(one, float) else str(one) for one in (stored, computed))
    return [] if alike else [f"{key}: {before} in {CERTIFICATE}, {now} computed from {CONTROLLER}"]


def _require_export(out: Path) -> None:
    """Raise InputError, with what is missing, if the folder was not written by `avis export`."""
    if not (out / CERTIFICATE).exists():
        lacks = f"{CERTIFICATE} is missing in it" if out.is_dir() else "there is no such folder"
        if (out / "result.json").exists():
            lacks += "; this is a folder of avis design: are DESIGN_DIR and --out swapped?"
        raise InputError(f"expected a folder that avis export wrote; {lacks}", field="--out", value=str(out))


def _hashes(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Hash of each file of the certificate, by name."""
    hashes = stored.get("files")
    return hashes if isinstance(hashes, dict) else {}


def _foreign_files(out: Path, stored: Mapping[str, Any]) -> list[str]:
    """Names in the folder that no export writes."""
    known = {*FILES, ORDERS, *_hashes(stored)}
    return sorted(one.name for one in out.iterdir() if one.name not in known)


def _wrong_files(out: Path, stored: Mapping[str, Any]) -> list[str]:
    """Files that the certificate lists but that are missing or differ from the exported ones; and files of an export
    that it does not list."""
    hashes, found = _hashes(stored), []
    for name, digest in ({CONTROLLER: stored.get("controller_sha256")} | hashes).items():
        try:
            data = (out / Path(name).name).read_bytes()
        except OSError as error:
            found.append(f"{name} is missing" if not (out / name).exists() else f"{name}: {error.strerror}")
            continue
        if name == CONTROLLER and _sha256(data) != stored.get("controller_sha256"):
            found.append(f"{CONTROLLER} is not the file that the certificate names: its hash differs")
        elif _sha256(data) != digest:
            found.append(f"{name} is not the file that was exported: its hash differs")
    return found + [
        f"{name} is not listed in {CERTIFICATE}"
        for name in FILES
        if name not in hashes and name != CERTIFICATE and (out / name).exists()
    ]


def _wrong_vectors(
    folder: DesignFolder, controller: SampledController, out: Path, stored: Mapping[str, Any], settings: CheckSettings
) -> list[str]:
    """Test vectors that differ from the response of controller.json with the certificate's anti-windup; wrong
    tolerances."""
    found = []
    for file, key in TESTS.items():
        if not (out / file).exists():
            continue
        try:
            y, u = read_csv(out / file, controller)
            guard = _guard(folder, controller, stored)
            stated = float(stored[key]["tolerance_V"])
            samples = int(stored[key]["samples"])
        except InputError as error:
            found.append(str(error))
            continue
        except (KeyError, TypeError, ValueError):
            found.append(f"{CERTIFICATE} has no samples and tolerance_V of {file}, or no anti_windup")
            continue
        if samples != len(y):
            found.append(f"{key}.samples: {samples} in {CERTIFICATE}, {len(y)} rows in {file}")
        if not np.max(np.abs(expected_V(controller, guard, y) - u)) <= stated:
            found.append(
                f"the outputs in {file} are not those that {CONTROLLER} gives for its inputs with the "
                f"anti-windup of {CERTIFICATE}"
            )
        else:
            tolerance = agreement_V(controller, guard, y, u)
            if not tolerance / settings.rounding <= stated <= tolerance * settings.rounding:
                found.append(
                    f"{key}.tolerance_V: {stated:g} in {CERTIFICATE}, {tolerance:g} computed from {CONTROLLER}"
                )
    return found


def _guard(folder: DesignFolder, controller: SampledController, stored: Mapping[str, Any]) -> Protection:
    """Protection with the anti-windup of the certificate."""
    corner, gain = stored["anti_windup"]["corner_Hz"], stored["anti_windup"]["gain"]
    law = NO_ANTI_WINDUP if corner is None else AntiWindup.of(float(corner), float(gain), controller.system.dt)
    return protection(controller, folder.rig, law)


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
    return [
        f"{key} in {name} differs from {CONTROLLER}"
        for key, matrix in controller.matrices().items()
        if matrix.size and not np.array_equal(numbers.get(key, np.zeros(0)), matrix)
    ]
