"""Files of a study: each is whole or absent, also when the disk fills or the process is killed."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.study.model import Bound, ControllerResult, DesignResult

FILES = ("plant.json", "report.html", "report.pdf", "result.json")


FILES = ("result.json", "report.html", "report.pdf", "plant.json")


def open_folder(folder: str | Path) -> Path:
    """Create the output folder and make sure, before hours of computing, that it can be written.

    Raises InputError where it is a file, read-only, below something that is, or holds a folder in place of a file.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise InputError(f"expected a folder that can be written ({error.strerror or error})", field="--out",
                         value=str(path)) from None
    for name, is_folder in (("controllers", True), *((name, False) for name in FILES)):
        if (path / name).exists() and (path / name).is_dir() != is_folder:
            raise InputError(f"expected a {'folder' if is_folder else 'file'} at {path / name}, or nothing",
                             field="--out", value=str(path))
    return path


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that nobody ever sees half of it.

    The bytes go into a file without a name in the same folder (it vanishes with the process), are synced, and only
    then get the name. Raises ComputationError where the disk refuses.
    """
    try:
        if hasattr(os, "O_TMPFILE"):
            with contextlib.suppress(OSError):
                _write_nameless(path, content)
                return
        _write_renamed(path, content)
    except OSError as error:
        raise _not_written(path, error) from None


def _not_written(path: Path, error: OSError) -> ComputationError:
    return ComputationError(f"{path} was not written; what was there before is untouched",
                            cause=str(error.strerror or error),
                            next_step="free some space or choose another --out folder")


def _write_nameless(path: Path, content: bytes) -> None:
    with open(os.open(path.parent, os.O_TMPFILE | os.O_WRONLY, 0o644), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".") as private:
            named = Path(private) / path.name
            os.link(f"/proc/self/fd/{file.fileno()}", named, follow_symlinks=True)
            os.replace(named, path)


def _write_renamed(path: Path, content: bytes) -> None:
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with open(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise


def write_json(path: Path, value: dict[str, Any]) -> None:
    """JSON, floats as they are, infinities and nan as null (JSON has neither)."""
    write_whole(path, json.dumps(_plain(value), indent=1, allow_nan=False).encode())


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def controller_dict(result: ControllerResult, units_in: str = "m/s", units_out: str = "N") -> dict[str, Any]:
    """The contract's avis-controller form."""
    K = result.K
    if K is None:
        raise InputError("a passive rig has no controller", field="controller", value=result.name)
    return {"format": "avis-controller", "version": 1, "name": result.name, "A": K.A, "B": K.B, "C": K.C, "D": K.D,
            "dt": K.dt, "inputs": K.inputs, "outputs": K.outputs, "input_units": [units_in] * K.ninputs,
            "output_units": [units_out] * K.noutputs}


def result_dict(result: DesignResult) -> dict[str, Any]:
    """The contract's avis-design form, with provenance."""
    return {
        "format": "avis-design", "version": 1, "plant": "plant.json",
        "controllers": [_controller_row(c) for c in result.controllers],
        "dk_history": [{"iteration": row.iteration, "gamma": row.gamma, "mu_upper": row.mu_upper, "order": row.order,
                        "d_fit_error": row.d_fit_error, "seconds": row.seconds} for row in result.dk_history],
        "requirements": [{"name": r.name, "limit": r.limit, "value": r.value, "unit": r.unit, "met": r.met}
                         for r in result.requirements],
        "simulation": result.simulation.as_dict() if result.simulation is not None else {},
        "seconds": result.seconds, "provenance": result.provenance,
        "worst_cases": {c.name: {"mu": _worst_case(result, c.mu), "peak": _worst_case(result, c.worst_peak),
                                 "band": _worst_case(result, c.worst_band)} for c in result.controllers}}


def _worst_case(result: DesignResult, bound: Bound) -> dict[str, Any] | None:
    """A perturbation block by block, so that it can be rebuilt: numbers as [real, imaginary]."""
    if bound.delta is None:
        return None
    blocks = result.plant.synthesis.blocks
    values = blocks.values(bound.delta[:blocks.n_w, :blocks.n_z])
    return {"lower": bound.lower, "upper": bound.upper, "frequency_Hz": bound.omega / (2 * np.pi),
            "delta": {block.name: [[np.real(v), np.imag(v)] for v in np.ravel(value)]
                      for block, value in zip(blocks.blocks, values, strict=True)}}


def _controller_row(c: ControllerResult) -> dict[str, Any]:
    def dB(value: float) -> float:
        return 20 * float(np.log10(value)) if value > 0 else -np.inf
    return {"name": c.name, "kind": c.kind, "file": f"controllers/{c.name}.json" if c.K is not None else None,
            "order": c.order, "gamma": c.gamma, "mu_upper": c.mu.upper, "mu_lower": c.mu.lower,
            "mu_peak_Hz": c.mu.omega / (2 * np.pi), "stable": c.stable,
            "peak_transmissibility_dB": dB(c.peak_transmissibility),
            "worst_case_peak_transmissibility_dB": dB(c.worst_peak.upper)}


def write_study(result: DesignResult, folder: Path, html: bytes | None = None, pdf: bytes | None = None) -> list[Path]:
    """All files of a study; result.json last, so that its presence says that the others are complete."""
    try:
        (folder / "controllers").mkdir(exist_ok=True)
        # Of an earlier study nothing stays: an old report beside new controllers would lie.
        for old in (*(folder / name for name in FILES), *(folder / "controllers").glob("*.json")):
            old.unlink(missing_ok=True)
    except OSError as error:
        raise _not_written(folder, error) from None
    written = []
    for c in result.controllers:
        if c.K is not None:
            write_json(path := folder / "controllers" / f"{c.name}.json", controller_dict(c))
            written.append(path)
    write_json(folder / "plant.json", result.plant.synthesis.as_dict())
    written.append(folder / "plant.json")
    for name, content in (("report.html", html), ("report.pdf", pdf)):
        if content is not None:
            write_whole(folder / name, content)
            written.append(folder / name)
    write_json(folder / "result.json", result_dict(result))
    return [*written, folder / "result.json"]
