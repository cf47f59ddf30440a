"""Files of a design study."""

from __future__ import annotations

import contextlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.files import write_together
from avis_ctrl.lti.norms import decibels
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.study.design_result import Bound, ControllerResult, DesignResult, FailedController, Simulated
from avis_ctrl.study.files import as_json, values_of
from avis_ctrl.study.study_file import STUDY, study_dict
from avis_ctrl.study.verdict import first_sentence

FILES = STUDY, "plant.json", "sampled_controller.json", "report.html", "report.pdf", "result.json"
FOLDERS = ("controllers",)


def controller_dict(name: str, K: StateSpace | None) -> dict[str, Any]:
    """A controller of the logical axes in the avis-controller format of the contract. Raises InputError for None."""
    if K is None:
        raise InputError("a passive rig has no controller", field="controller", value=name)
    return {
        "format": "avis-controller",
        "version": 1,
        "name": name,
        **values_of(K, "A", "B", "C", "D", "dt", "inputs", "outputs"),
        "input_units": ["m/s"] * K.ninputs,
        "output_units": ["N"] * K.noutputs,
    }


def result_dict(result: DesignResult) -> dict[str, Any]:
    """The result in the avis-design format of the contract, with provenance."""
    return {
        "format": "avis-design",
        "version": 1,
        "plant": "plant.json",
        "verdict": first_sentence(result),
        "stable": result.stable,
        "controllers": [
            *(_controller_row(c) for c in result.controllers),
            *(_failed_row(c) for c in result.failed or ()),
        ],
        "gamma_slicot": {c.name: c.gamma_slicot for c in result.controllers},
        "dk_history": [
            values_of(row, "iteration", "gamma", "mu_upper", "order", "d_fit_error", "seconds")
            for row in result.dk_history
        ],
        "requirements": [values_of(one, "name", "limit", "value", "unit", "met") for one in result.requirements],
        "by_axis": [
            {"axis": one.axis, "worst_case_band_dB": decibels(one.mu), "skyhook_dB": decibels(one.skyhook)}
            for one in result.by_axis or ()
        ],
        "simulation": result.simulation.as_dict() if result.simulation is not None else {},
        "all_axes": _all_axes(result.loop),
        "seconds": result.seconds,
        "provenance": result.provenance,
        "worst_cases": {
            c.name: {
                "mu": _worst_case(result, c.mu),
                "peak": _worst_case(result, c.worst_peak),
                "band": _worst_case(result, c.worst_band),
            }
            for c in result.controllers
        },
    }


def _worst_case(result: DesignResult, bound: Bound) -> dict[str, Any] | None:
    """A perturbation block by block, for its reconstruction: numbers as [real, imaginary]."""
    if bound.delta is None:
        return None
    blocks = result.plant.synthesis.blocks
    values = blocks.values(bound.delta[: blocks.n_w, : blocks.n_z])
    return {
        "lower": bound.lower,
        "upper": bound.upper,
        "frequency_Hz": bound.omega / (2 * np.pi),
        "delta": {
            block.name: [[np.real(v), np.imag(v)] for v in np.ravel(value)]
            for block, value in zip(blocks.blocks, values, strict=True)
        },
    }


def _controller_row(c: ControllerResult) -> dict[str, Any]:
    return {
        "name": c.name,
        "kind": c.kind,
        "file": f"controllers/{c.name}.json" if c.K is not None else None,
        "order": c.order,
        "gamma": c.gamma,
        "mu_upper": c.mu.upper,
        "mu_lower": c.mu.lower,
        "guaranteed": c.guaranteed,
        "mu_peak_Hz": c.mu.omega / (2 * np.pi),
        "stable": c.stable,
        "peak_transmissibility_dB": decibels(c.peak_transmissibility),
        "worst_case_peak_transmissibility_dB": decibels(c.worst_peak.upper),
        "note": "; ".join(c.notes),
        "at_rest": c.rest.as_dict() if c.rest is not None else None,
    }


def _failed_row(c: FailedController) -> dict[str, Any]:
    """Row of a controller that could not be analysed; the note has the reason."""
    figures = (
        "gamma mu_upper mu_lower guaranteed mu_peak_Hz peak_transmissibility_dB worst_case_peak_transmissibility_dB"
    )
    unknown = dict.fromkeys(["file", "order", *figures.split(), "at_rest"])
    return {"name": c.name, "kind": c.kind, "stable": False, **unknown, "note": c.reason}


def _all_axes(loop: Simulated | None) -> dict[str, Any]:
    """Loops of the axes that the design does not control, and the cause if the complete loop is unstable."""
    if loop is None:
        return {}
    culprit = None if loop.culprit is None else {**asdict(loop.culprit), "words": loop.culprit.words()}
    return {
        "companions": [asdict(one) for one in loop.companions.loops],
        "modulus_margin_asked": loop.companions.settings.modulus_margin,
        "passive": [{"axis": axis, "reason": why} for axis, why in loop.companions.passive],
        "notes": loop.companions.remarks(),
        "culprit": culprit,
        "at_rest": loop.rest.as_dict() if loop.rest is not None else None,
    }


def sampled_controller_dict(result: DesignResult, loop: Simulated) -> dict[str, Any]:
    """The controller of a processor, all axes: x+ = A x + B y, u = C x + D y from sensor volts to drive volts."""
    K, rig = loop.digital, result.rig
    sensors, drives = rig.sensor_rows()[0], rig.equations_of_motion().actuators
    return {
        "format": "avis-sampled-controller",
        "version": 1,
        "name": "mu",
        "sample_rate_Hz": rig.sample_rate_Hz,
        "arithmetic": "float64",
        **values_of(K, "A", "B", "C", "D"),
        "inputs": sensors,
        "outputs": drives,
        "input_units": ["V"] * len(sensors),
        "output_units": ["V"] * len(drives),
        "limits_V": rig.drive_limits_V(),
        "delay_samples": loop.delay_samples,
    }


def write_study(result: DesignResult, folder: Path, html: bytes | None = None, pdf: bytes | None = None) -> list[Path]:
    """Write all files of a study or none; result.json is last, so its presence shows that the others are complete."""
    contents = {
        f"controllers/{c.name}.json": as_json(controller_dict(c.name, c.K))
        for c in result.controllers
        if c.K is not None
    }
    if result.loop is not None:
        contents["sampled_controller.json"] = as_json(sampled_controller_dict(result, result.loop))
    contents["plant.json"] = as_json(result.plant.synthesis.as_dict())
    with contextlib.suppress(InputError):  # a rig of a user-defined class has no file format and cannot be exported
        contents[STUDY] = as_json(study_dict(result.design, result.rig))
    contents |= {name: content for name, content in (("report.html", html), ("report.pdf", pdf)) if content is not None}
    contents["result.json"] = as_json(result_dict(result))
    # Files of an earlier study are removed.
    return write_together(
        folder, contents, [*(folder / name for name in FILES), *(folder / "controllers").glob("*.json")]
    )
