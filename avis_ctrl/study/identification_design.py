"""Design files of an identification: uncertainty.json and design.toml, for use with rig.toml by `avis design`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import gmean

from avis_ctrl.errors import InputError
from avis_ctrl.identification.campaign_fit import SETTINGS, driven_inputs, excited_band
from avis_ctrl.identification.model_error import measured_response
from avis_ctrl.identification.response_error import FrfSpread, frf_spread
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.rigs.halcyonics import Halcyonics
from avis_ctrl.rigs.isolator_table import IsolatorTable
from avis_ctrl.rigs.logical_axes import drivable, sensed
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.rigs.toml_text import toml_text, toml_value
from avis_ctrl.study.design_file import ChainUncertainty, Design, design_from_table, read_design
from avis_ctrl.study.file_names import DESIGN_FILE, RIG_FILE, UNCERTAINTY_FILE
from avis_ctrl.study.identification_output import require_readable
from avis_ctrl.study.identified_uncertainty import InDesign, in_design
from avis_ctrl.study.uncertainty_file import UncertaintyFile, uncertainty_content, uncertainty_json

if TYPE_CHECKING:
    from avis_ctrl.study.identification import Identification


@dataclass(frozen=True)
class DriveUncertaintySettings:
    """low_percent : minimum uncertainty of the drives at low frequency [%]: changes between a campaign and the use of
    its model are not in the measurement.
    """

    low_percent: float = 1.0


DRIVES = DriveUncertaintySettings()
# Designs for z and phi_x by kind of rig, as in designs/*.toml; rig and uncertainty are filled in.
_COMMON: dict[str, Any] = {
    "keep": ["z", "phi_x"],
    "simulation": {"duration_s": 40.0},
    "requirement": [
        {"quantity": "mu_upper", "at_most": 1.0},
        {"quantity": "mu_gap_percent", "at_most": 5.0},
        {"quantity": "worst_case_peak_transmissibility_dB", "at_most": 4.0},
        {"quantity": "worst_case_band_transmissibility_dB", "at_most": -6.0},
    ],
}
_CHAINS = {"low_percent": 10.0, "high_percent": 400.0}
_EDGES = {"peak_dB": 3.5, "transition_octaves": 0.8, "tolerance_dB": 1.0}
_AVIS: dict[str, Any] = _COMMON | {
    "uncertainty": {"actuator_chains": _CHAINS | {"crossover_Hz": 80.0}},
    "transmissibility": _EDGES | {"band_dB": -7.0, "band_Hz": [1.0, 10.0]},
    "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0},
    "synthesis": {"target_mu": 0.9},
}
_HALCYONICS: dict[str, Any] = _COMMON | {
    "uncertainty": {"actuator_chains": _CHAINS | {"crossover_Hz": 150.0}},
    "transmissibility": _EDGES | {"band_dB": -12.0, "band_Hz": [4.0, 16.0]},
    "control_effort": {"floor_velocity_m_per_s": 1e-4, "bandwidth_Hz": 150.0, "reduction": 300.0},
    "floor": {"velocity_rms_m_per_s": 2e-5},
    "synthesis": {"target_mu": 0.95},
}


def design_start(found: Identification, template: Path | Design | None = None) -> tuple[dict[str, str], InDesign]:
    """Contents of uncertainty.json and design.toml by name, and the uncertainty of the design, for the report.

    `avis design` reads the files with rig.toml in the same folder. The filter of the uncertainty covers what was
    measured; a design adds its declared uncertainty of the drives where nothing was measured.

    Parameters
    ----------
    template : design whose rig and uncertainty are replaced; by default z and phi_x as in designs/*.toml. In this case
        the first lines of design.toml state for which table the weights were chosen.

    Raises
    ------
    InputError : an invalid template; coordinates that the measured channels cannot drive or distinguish; identified
        values that are not a valid rig.
    ComputationError : records in which the actuators cannot be separated, so that no spread can be measured.
    """
    require_readable(found)
    design = _template(found, template)
    spread = measured_spread(found, tuple(design.keep))
    content = uncertainty_content(found.rig, found.information, [spread], found.provenance)
    made = in_design(content, found.rig, design.keep, design.uncertainty.confidence_percent / 100)
    text = identification_design(content, design, found.rig)
    if template is None:
        text = assumed_weights(found.rig) + text
    return {UNCERTAINTY_FILE: uncertainty_json(content), DESIGN_FILE: text}, made


def measured_spread(found: Identification, keep: tuple[str, ...]) -> FrfSpread:
    """Difference between the measured response and that of the identified model, in some coordinates.

    It is restricted to the band that the actuators excite: floor motion below it gives no information on their
    response.
    """
    measured, band, model = found.measured, found.campaign_fit.band_Hz, found.model
    # As a rig file has it: the filter of a geophone matches its suspension; the spread covers the rest.
    model = replace(model, sensors=replace(model.sensors, suspensions=model.sensors.assumed))
    if isinstance(measured, FrequencyResponse):
        return frf_spread(measured.between(*band), model, keep)
    driven = measured.only(tuple(record.header.name for record in measured.records if driven_inputs(record)))
    low, high = excited_band(driven)
    band = max(band[0], low), min(band[1], high)
    return frf_spread(measured_response(driven, model, band, SETTINGS.longest_piece), model, keep)


def identification_design(content: UncertaintyFile, template: Design, rig: Rig) -> str:
    """The text of a design file for an identified rig, from a design with uncertainty set by hand.

    The identification replaces the ranges of identified parameters. The actuator chains keep their frequency of 100 %
    and the value above it, because nothing was measured there. Their value at low frequency becomes the median of the
    measured spread, rounded up, but at least 1 % and at most the value of the template.
    """
    asked = template.uncertainty
    uncertainty: dict[str, Any] = {
        "parameters_percent": _not_identified(asked.parameters_percent, content, rig.parameters()),
        "parameters_absolute": _not_identified(asked.parameters_absolute, content, rig.parameters()),
    }
    if asked.actuator_chains is not None:
        uncertainty["actuator_chains"] = _chains(asked.actuator_chains, content, template).model_dump()
    if asked.sensor_chains is not None:
        uncertainty["sensor_chains"] = asked.sensor_chains.model_dump()
    uncertainty |= {"identified": UNCERTAINTY_FILE, "confidence_percent": asked.confidence_percent}
    # The identified rig already has the electronics of the measurement.
    table = template.model_dump(exclude_none=True) | {"rig": RIG_FILE, "uncertainty": uncertainty, "electronics": {}}
    if isinstance(rig, Halcyonics) and rig.load is not None:
        table["loaded"] = True
    return design_toml(design_from_table(table))


def design_toml(design: Design) -> str:
    """A design as a file that `read_design` reads back."""
    return toml_text(design.model_dump(exclude_none=True))


def _template(found: Identification, template: Path | Design | None) -> Design:
    if isinstance(template, Design):
        return template
    if template is not None:
        return read_design(template)
    keep = " and ".join(default_keep(found.rig))
    design = default_design(found.rig, f"{found.rig.name}, identified: {keep} under one controller")
    if found.model.amplifier_corner_Hz is None:
        return design
    # A faster pole makes the synthesis stiff. At a hundredth of this limit the difference is 1 %.
    corner = float(f"{min(found.model.amplifier_corner_Hz, 10 * found.rig.sample_rate_Hz):.4g}")
    return design.model_copy(update={"loop": design.loop.model_copy(update={"amplifier_corner_Hz": corner})})


def default_keep(rig: Rig) -> list[str]:
    """z and phi_x, if the drives can move and the sensors can measure them; otherwise the first such coordinate.

    Raises InputError if there is none.
    """
    reached = [name for name in COORDINATES if name in drivable(rig) and name in sensed(rig)]
    keep = [name for name in _COMMON["keep"] if name in reached] or reached[:1]
    if not keep:
        raise InputError(
            "expected a coordinate that the drives can move and the sensors can measure", field="keep", value=rig.name
        )
    return keep


def default_design(rig: Rig, title: str, parameters_percent: Mapping[str, float] | None = None) -> Design:
    """A design for the coordinates of `default_keep`, as in designs/*.toml for this kind of rig; its rig is rig.toml.

    parameters_percent : ranges of the rig's parameters; by default none, because an identification provides them.
    """
    shape = _shape(rig)
    uncertainty = shape["uncertainty"] | {"parameters_percent": dict(parameters_percent or {})}
    # A quarter of the sample rate: the hold distorts faster poles.
    fastest = {"quantity": "fastest_controller_pole_Hz", "at_most": rig.sample_rate_Hz / 4}
    own = {"title": title, "rig": RIG_FILE, "keep": default_keep(rig), "uncertainty": uncertainty}
    return design_from_table(shape | own | {"requirement": [*shape["requirement"], fastest]})


def _shape(rig: Rig) -> dict[str, Any]:
    """Keys of the shipped design for this kind of table."""
    return _AVIS if isinstance(rig, IsolatorTable) else _HALCYONICS


def _shipped(rig: Rig) -> Rig:
    """The table of the same kind for which the weights of `default_design` were chosen."""
    return load_rig("avis" if isinstance(rig, IsolatorTable) else "halcyonics_loaded")


def default_band(rig: Rig) -> tuple[float, float]:
    """Band of isolation [Hz] of the shipped design, scaled by the geometric mean of the natural frequencies."""
    shipped, own = (
        gmean(one.equations_of_motion().natural_frequencies().frequencies_Hz) for one in (_shipped(rig), rig)
    )
    low, high = (float(f"{f * own / shipped:.2g}") for f in _shape(rig)["transmissibility"]["band_Hz"])
    return low, high


def assumed_weights(rig: Rig) -> str:
    """Comment lines above a `default_design`: the table for which its weights were chosen, compared with this one."""
    shipped = _shipped(rig)
    lines = [
        "No weights were specified for this table. [loop], [uncertainty.actuator_chains], [transmissibility],",
        "[control_effort] and [[requirement]] are those of the shipped design for the first of these two tables:",
    ]
    for what, one in (("shipped", shipped), ("this table", rig)):
        eom = one.equations_of_motion()
        modes = eom.natural_frequencies().frequencies_Hz
        lines.append(
            f"  {what}: {toml_value(one.name)}, {eom.M[0, 0]:.4g} kg, modes from {modes.min():.3g} to "
            f"{modes.max():.3g} Hz"
        )
    lines.append("Before you design, change them, and add [floor] if needed, to suit this table.")
    return "".join(f"# {line}\n" for line in lines)


def _not_identified(ranges: dict[str, float], content: UncertaintyFile, known: Collection[str]) -> dict[str, float]:
    """Ranges of the parameters that this rig has and that were not identified."""
    return {
        pattern: value
        for pattern, value in ranges.items()
        if not any(fnmatchcase(name, pattern) for name in content.names)
        and any(fnmatchcase(name, pattern) for name in known)
    }


def _chains(asked: ChainUncertainty, content: UncertaintyFile, template: Design) -> ChainUncertainty:
    keep = sorted(template.keep)
    spread = next(one for one in content.spread if sorted(one.keep) == keep).values()
    median = 100 * float(np.median(spread.bound(template.uncertainty.confidence_percent / 100)))
    digit = 10 ** np.floor(np.log10(max(median, 1e-9)))
    low = float(max(np.ceil(median / digit - 1e-9) * digit, DRIVES.low_percent))
    return asked.model_copy(update={"low_percent": round(min(low, asked.low_percent), 12)})
