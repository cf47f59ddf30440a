"""Every tuning value of the search for missing effects, by the part it belongs to."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from avis_ctrl.gap import (
    additions,
    data,
    line_response,
    marching,
    motion,
    next_measurement,
    power_shares,
    record_motion,
    residual,
    score,
    simulate,
    starting_values,
    table_model,
)
from avis_ctrl.gap.effects import base
from avis_ctrl.gap.settings import SETTINGS, GapSettings
from avis_ctrl.gap.signals import converter, hum, leftover, noise_level, quiet_lines


def tuning_values(search: GapSettings = SETTINGS) -> dict[str, Any]:
    """Of the search by name, and of its parts under their own names, as the provenance of a result has them."""
    parts: dict[str, Any] = {
        "starting values": starting_values.SETTINGS, "score test": score.SETTINGS, "library": base.SETTINGS,
        "table model": table_model.SETTINGS, "silent lines": data.SETTINGS, "residual": residual.SETTINGS,
        "power": power_shares.SETTINGS, "next measurement": next_measurement.SETTINGS,
        "motion in a record": record_motion.SETTINGS, "spectra of motion": motion.SETTINGS,
        "lines of a record": line_response.SETTINGS, "marching": marching.SETTINGS, "simulation": simulate.SETTINGS,
        "realisation": additions.SETTINGS, "converter": converter.SETTINGS, "hum": hum.SETTINGS,
        "driven lines": leftover.SETTINGS, "noise level": noise_level.SETTINGS,
        "quiet lines": quiet_lines.SETTINGS}
    return {**asdict(search), "parts": {name: asdict(one) for name, one in parts.items()}}
