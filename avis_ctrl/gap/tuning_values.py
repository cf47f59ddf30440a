"""All tuning values of the search for missing effects, by part."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from avis_ctrl.gap import (
    campaign_spectra,
    line_response,
    motion_estimate,
    next_measurement,
    power_shares,
    record_motion,
    residual,
    score,
    settings,
    simulation,
    starting_values,
    state_space,
    table_model,
    time_stepping,
)
from avis_ctrl.gap.axis import settings as axis
from avis_ctrl.gap.effects import base, chassis
from avis_ctrl.gap.signals import converter, hum, noise_level, quiet_lines
from avis_ctrl.identification import campaign_fit


def tuning_values() -> dict[str, dict[str, Any]]:
    """Tuning values by part and name, for the provenance of a result."""
    parts: dict[str, Any] = {
        "search": settings.SETTINGS,
        "starting values": starting_values.SETTINGS,
        "score test": score.SETTINGS,
        "library": base.SETTINGS,
        "table model": table_model.SETTINGS,
        "silent lines": campaign_spectra.SETTINGS,
        "residual": residual.SETTINGS,
        "power": power_shares.SETTINGS,
        "next measurement": next_measurement.SETTINGS,
        "motion in a record": motion_estimate.SETTINGS,
        "spectra of motion": record_motion.SETTINGS,
        "lines of a record": line_response.SETTINGS,
        "time stepping": time_stepping.SETTINGS,
        "simulation": simulation.SETTINGS,
        "realisation": state_space.SETTINGS,
        "converter": converter.SETTINGS,
        "hum": hum.SETTINGS,
        "records": campaign_fit.SETTINGS,
        "noise level": noise_level.SETTINGS,
        "quiet lines": quiet_lines.SETTINGS,
        "chassis": chassis.SETTINGS,
        "single axis": axis.SETTINGS,
    }
    return {name: asdict(one) for name, one in parts.items()}
