"""Checks of a campaign's records before any fit: units and levels against the rig, then the gates (signal tests)."""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates import Expectation, Finding, examine
from avis_ctrl.study.plausible_records import records_fit


def expectation(model: ResponseModel) -> Expectation:
    """What the gates compare the records with."""
    rig, volts = model.rig, model.sensors.unit == "V"
    converter = rig.converter if volts else None

    def response(omega: np.ndarray, inputs: tuple[str, ...]) -> np.ndarray:
        return model.response(omega)[:, :, [model.inputs.index(name) for name in inputs]]

    return Expectation(
        y_range_V=converter.limits_V if converter else None,
        y_lsb_V=converter.lsb_V if converter else None,
        drive_limits_V=dict(zip(model.actuators, rig.limits_of(model.actuators).tolist(), strict=True)),
        sensor_noise_rms_V=(rig.ambient.sensor_noise_rms_V or None) if converter and rig.ambient else None,
        y_names=model.sensors.names,
        response=response,
    )


def check_campaign(
    measured: Campaign,
    model: ResponseModel,
    despite_gates: bool,
    progress: Callable[[str], None],
    named_later: Collection[str] = (),
) -> tuple[Finding, ...]:
    """Findings of all checks; warnings and stops are reported to `progress`.

    despite_gates : continue if a check reports a stop. named_later : gates whose findings the caller's own analysis
        names; they neither stop it nor are they reported here.

    Raises InputError: units or levels that no such table produces; a gate that reports a stop.
    """
    findings = (*records_fit(measured, model, despite_gates, progress), *examine(measured, expectation(model)))
    grave = [one for one in findings if one.severity in ("warning", "stop") and one.gate not in named_later]
    stops = [one for one in grave if one.severity == "stop"]
    raised = stops[0] if stops and not despite_gates else None
    for one in grave:
        if one is not raised:
            progress(f"  {one.severity}: {one.sentence}")
    if raised is not None:
        more = f" (and {len(stops) - 1} more, above)" if len(stops) > 1 else ""
        raise InputError(
            f"{raised.sentence.rstrip('.')}{more}; --despite-gates continues anyway",
            field="measurement",
            value=raised.gate,
        )
    return findings
