"""Design files in TOML: rig, controlled coordinates, weights, uncertainty, controllers and checks.

Every key has its unit in its name. Errors are one line that names file, field, value and what was expected; for a
misspelt key the message suggests the nearest one.
"""

from __future__ import annotations

import difflib
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_serializer, field_validator

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.file_errors import Section, read_toml, validated
from avis_ctrl.rigs.key_types import LIMITS, Band, NotNegative, Positive, Spectrum
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import SHIPPED, load_rig
from avis_ctrl.rigs.rig_sections import ElectronicsSection
from avis_ctrl.simulation.campaign_data import SETTINGS as CAMPAIGN
from avis_ctrl.study.uncertainty_file import UncertaintyFile, read_uncertainty
from avis_ctrl.uncertainty.uncertain_rig import UncertainParameter


def _different(axes: list[str]) -> list[str]:
    if len(set(axes)) != len(axes):
        raise ValueError("expected each name once")
    return axes


Percent = Annotated[float, Field(gt=0, lt=100)]
Decibel = Annotated[float, Field(ge=-200, le=200)]
Axis = Literal["x", "y", "z", "phi_x", "phi_y", "phi_z"]
Rival = Literal["hinf", "skyhook_classical", "skyhook", "loops"]


class LoopSection(Section):
    """Dynamics between the controller and the rig that the rig file does not contain."""

    amplifier_corner_Hz: Positive = CAMPAIGN.amplifier_corner_Hz
    integrator_corner_Hz: Positive = 0.1
    pade_order: Annotated[int, Field(ge=1, le=6)] = 2


class ChainUncertainty(Section):
    """Relative uncertainty of a chain (a sensor or drive channel): low, 100 % at the crossover, high above it."""

    low_percent: Percent
    crossover_Hz: Positive
    high_percent: Annotated[float, Field(gt=100, le=LIMITS.largest)]


class UncertaintySection(Section):
    """Ranges of parameters, neglected dynamics of the channels, and the uncertainty file of an identification."""

    parameters_percent: dict[str, Percent] = {}
    parameters_absolute: dict[str, Positive] = {}
    actuator_chains: ChainUncertainty | None = None
    sensor_chains: ChainUncertainty | None = None
    identified: str | UncertaintyFile | None = None
    confidence_percent: Percent = 95.0

    @field_validator("identified", mode="plain")
    @classmethod
    def _file_or_content(cls, identified: Any) -> str | UncertaintyFile | None:
        """In a design file this is the name of a file beside it; `read_study` replaces it by the file's content."""
        if identified is not None and not isinstance(identified, (str, UncertaintyFile)):
            raise ValueError("expected the name of an uncertainty file")
        return identified

    @field_serializer("identified")
    def _plain(self, identified: str | UncertaintyFile | None) -> Any:
        return identified.model_dump() if isinstance(identified, UncertaintyFile) else identified

    @property
    def identification(self) -> UncertaintyFile | None:
        """The content of the uncertainty file. Raises InputError if it has not been read yet."""
        if isinstance(self.identified, str):
            raise InputError(
                "expected the file's content: read_uncertainty(...), or a design that read_study read",
                field="uncertainty.identified",
                value=self.identified,
            )
        return self.identified

    def of(self, rig: Rig) -> list[UncertainParameter]:
        """The uncertain parameters; wildcards ("isolator*.k_z") are expanded over the rig's names."""
        known = list(rig.parameters())
        found: dict[str, UncertainParameter] = {}
        for section, absolute in ((self.parameters_percent, False), (self.parameters_absolute, True)):
            for pattern, spread in section.items():
                names = [name for name in known if fnmatchcase(name, pattern)]
                field = f"uncertainty.parameters_{'absolute' if absolute else 'percent'}"
                if not names:
                    near = difflib.get_close_matches(pattern, known, n=1)
                    hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(known)}"
                    raise InputError(
                        f"the rig {rig.name} has no parameter that matches; {hint}", field=field, value=pattern
                    )
                for name in names:
                    if name in found:
                        raise InputError(f"{name} is listed twice", field=field, value=pattern)
                    found[name] = UncertainParameter(name, spread if absolute else spread / 100, absolute)
        return list(found.values())


class TransmissibilitySection(Section):
    """The required bound on transmissibility: peak_dB at all frequencies, band_dB inside band_Hz."""

    peak_dB: Decibel
    band_dB: Decibel
    band_Hz: Band
    transition_octaves: Positive = 0.5
    tolerance_dB: Positive = 0.5

    @field_validator("band_dB")
    @classmethod
    def _below_peak(cls, band_dB: float, info: ValidationInfo) -> float:
        if band_dB >= info.data.get("peak_dB", band_dB + 1):
            raise ValueError(f"expected a bound below peak_dB = {info.data['peak_dB']:g}")
        return band_dB


class EffortSection(Section):
    """Floor velocity at which the drives may use their whole range up to the bandwidth; they roll off above it.

    offset_percent : percentage of the drive's range that the offset of the electronics may use.
    offset_corner_Hz : frequency up to which the offset may drift.
    """

    floor_velocity_m_per_s: Positive
    bandwidth_Hz: Positive
    reduction: Annotated[float, Field(gt=1, le=LIMITS.largest)] = 30.0
    offset_percent: Percent = 10.0
    offset_corner_Hz: Positive = 0.003


class ComplianceSection(Section):
    """Largest allowed displacement per force on the payload."""

    limit_m_per_N: Positive


class FloorSection(Section):
    """Floor motion of the site: a measured spectrum, scaled to an r.m.s. velocity in a band."""

    spectrum: Spectrum = "kamioka_quiet"
    velocity_rms_m_per_s: Positive | None = None
    band_Hz: Band = [0.5, 60.0]


class SynthesisSection(Section):
    """D-K iteration and its limits. They are all counts, so the result does not depend on the speed of the machine.

    max_iterations : maximum number of K-steps. target_mu : stop as soon as mu is proved below it; without a target,
        iterate while mu decreases.
    polish : minimise gamma over the scalings when the D-K iteration stalls; yes by default.
    time_limit_s : ignored; accepted because older files contain it.
    """

    max_iterations: Annotated[int, Field(ge=1, le=50)] = 8
    time_limit_s: Positive | None = None
    backoff_percent: Annotated[float, Field(ge=0, le=50)] = 1.0
    reduction_cost_percent: NotNegative = 1.0
    target_mu: Positive | None = None
    polish: bool | None = None


class SkyhookSection(Section):
    """Ranges of the corners of the tuned skyhook."""

    tilt_corner_Hz: Band = [0.005, 1.0]
    roll_off_Hz: Annotated[Band, Field(validate_default=True)] = [5.0, 400.0]

    @field_validator("roll_off_Hz")
    @classmethod
    def _above_tilt(cls, roll_off: list[float], info: ValidationInfo) -> list[float]:
        tilt = info.data.get("tilt_corner_Hz", [0.0])
        if roll_off[0] <= tilt[-1]:
            raise ValueError(f"expected frequencies above tilt_corner_Hz = {tilt}")
        return roll_off


class SimulationSection(Section):
    """Check on the nonlinear table: length of each run, and number of random plants of the uncertainty set."""

    duration_s: Annotated[float, Field(ge=15, le=3600)] = 60.0
    random_plants: Annotated[int, Field(ge=0, le=500)] = 20
    seed: Annotated[int, Field(ge=0)] = 1


Quantity = Literal[
    "mu_upper",
    "mu_gap_percent",
    "worst_case_peak_transmissibility_dB",
    "worst_case_band_transmissibility_dB",
    "passive_peak_transmissibility_dB",
    "advantage_over_skyhook_dB",
    "advantage_on_each_axis_dB",
    "fastest_controller_pole_Hz",
]
UNITS: dict[str, str] = {"mu_upper": "", "mu_gap_percent": "%", "fastest_controller_pole_Hz": "Hz"}


class RequirementSection(Section):
    """A row of the verdict table: a quantity of the mu controller and its limit."""

    quantity: Quantity
    at_most: float | None = None
    at_least: Annotated[float | None, Field(validate_default=True)] = None

    @field_validator("at_least")
    @classmethod
    def _one_limit(cls, at_least: float | None, info: ValidationInfo) -> float | None:
        if (info.data.get("at_most", 0.0) is None) == (at_least is None):
            raise ValueError("expected exactly one of at_most and at_least")
        return at_least

    @property
    def unit(self) -> str:
        """Unit of the limit."""
        return UNITS.get(self.quantity, "dB")


class Design(Section):
    """A complete design file.

    loaded : add the load of the rig file's [load] section. electronics : keys that replace those of the rig file.
    compare_with : controllers that the mu controller is compared with, besides the passive table.
    """

    title: str
    rig: str
    loaded: bool = False
    electronics: ElectronicsSection = ElectronicsSection()
    keep: Annotated[list[Axis], Field(min_length=1), AfterValidator(_different)]
    compare_with: Annotated[list[Rival], AfterValidator(_different)] = ["hinf", "skyhook_classical", "skyhook"]
    loop: LoopSection = LoopSection()
    uncertainty: UncertaintySection = UncertaintySection()
    transmissibility: TransmissibilitySection
    control_effort: EffortSection
    compliance: ComplianceSection | None = None
    floor: FloorSection = FloorSection()
    synthesis: SynthesisSection = SynthesisSection()
    skyhook: SkyhookSection = SkyhookSection()
    simulation: SimulationSection = SimulationSection()
    requirement: list[RequirementSection] = []

    @field_serializer("electronics")
    def _only_given(self, electronics: ElectronicsSection) -> dict[str, Any]:
        """The given keys only: a default that is written would replace the rig file's value."""
        return electronics.model_dump(exclude_unset=True)

    def upper_limits(self, quantity: Quantity) -> list[float]:
        """The upper limits that the requirements set for a quantity."""
        return [one.at_most for one in self.requirement if one.quantity == quantity and one.at_most is not None]

    def equipped(self, rig: Rig) -> Rig:
        """The rig with the electronics settings of the design file."""
        given = {name: getattr(self.electronics, name) for name in self.electronics.model_fields_set}
        return rig.with_electronics(replace(rig.electronics, **given)) if given else rig


def read_design(path: str | Path) -> Design:
    """Read and check a design file.

    Raises InputError: one line naming file, field, value and what was expected.
    """
    path = Path(path)
    return design_from_table(read_toml(path, "a design file such as designs/avis_z_phix.toml"), path)


def design_from_table(table: dict[str, Any], file: object = None) -> Design:
    """Check a design given as nested dictionaries."""
    if {"isolator", "suspension"} & set(table):
        raise InputError(
            "this is a rig file; expected a design file, which names it under rig (avis new design writes one)",
            file=file,
        )
    design = validated(Design, table, file)
    try:
        _require_band_below_crossovers(design)
        _require_rival(design)
    except InputError as complaint:
        raise (complaint.in_file(file) if file is not None else complaint) from None
    return design


def _require_rival(design: Design) -> None:
    """A requirement on the advantage over a skyhook needs this skyhook in compare_with."""
    wanted = [one.quantity for one in design.requirement if one.quantity.startswith("advantage")]
    if wanted and "skyhook" not in design.compare_with:
        raise InputError(
            f'expected "skyhook" among them: the requirement {wanted[0]} compares with it',
            field="compare_with",
            value=design.compare_with,
        )


def _require_band_below_crossovers(design: Design) -> None:
    """Above its crossover a chain is more than 100 % uncertain, so no controller can be effective there."""
    low = design.transmissibility.band_Hz[0]
    for name in ("actuator_chains", "sensor_chains"):
        chains: ChainUncertainty | None = getattr(design.uncertainty, name)
        if chains is not None and chains.crossover_Hz <= low:
            raise InputError(
                f"expected a crossover above {low:g} Hz, the lower end of transmissibility.band_Hz: above "
                "the crossover the chains are more than 100 % uncertain",
                field=f"uncertainty.{name}.crossover_Hz",
                value=chains.crossover_Hz,
            )


def read_study(path: str | Path) -> tuple[Design, Rig]:
    """Read a design file and its rig: a built-in rig, or a rig file relative to the design file.

    Raises InputError: as `read_design`; a rig that is missing or invalid, an uncertain parameter that it does not have.
    """
    return study_of(read_design(path), Path(path))


def study_of(design: Design, path: Path) -> tuple[Design, Rig]:
    """A design with the content of its uncertainty file, and its rig; paths are relative to the design file.

    Raises InputError as `read_study`.
    """
    beside = path.parent / design.rig
    if design.rig not in SHIPPED and not beside.is_file():
        raise InputError(
            f"expected one of {', '.join(SHIPPED)}, or the path of a rig file relative to the design file",
            file=path,
            field="rig",
            value=design.rig,
        )
    named = design.uncertainty.identified
    rig = design.equipped(load_rig(design.rig if design.rig in SHIPPED else beside, design.loaded, check=named is None))
    if isinstance(named, str):
        content = read_uncertainty(path.parent / named)
        design = design.model_copy(
            update={"uncertainty": design.uncertainty.model_copy(update={"identified": content})}
        )
    try:
        if (known := design.uncertainty.identification) is not None:
            known.check_rig(rig)
        for parameter in design.uncertainty.of(rig):
            parameter.half_range(rig.parameters()[parameter.name].value)
    except InputError as error:
        raise error.in_file(path) from None
    return design, rig
