"""All tuning values of the search for missing effects, by part."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from avis_ctrl.gap import (
    campaign_spectra,
    line_response,
    next_measurement,
    power_fractions,
    record_motion,
    residual,
    score,
    settings,
    starting_values,
    state_space,
    table_model,
)
from avis_ctrl.gap.axis import settings as axis
from avis_ctrl.gap.effects import base
from avis_ctrl.gap.signals import converter, hum, noise_level, noise_lines
from avis_ctrl.identification import campaign_fit
from avis_ctrl.measurement.gates import sample_clock

PARTS = (
    settings,
    starting_values,
    score,
    base,
    table_model,
    campaign_spectra,
    residual,
    power_fractions,
    next_measurement,
    record_motion,
    line_response,
    state_space,
    converter,
    hum,
    noise_level,
    noise_lines,
    sample_clock,
    axis,
    campaign_fit,
)


def tuning_values() -> dict[str, dict[str, Any]]:
    """Tuning values by module and name, for the provenance of a result."""
    return {module.__name__.removeprefix("avis_ctrl."): asdict(module.SETTINGS) for module in PARTS}
