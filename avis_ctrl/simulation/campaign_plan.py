"""Plan of a simulated measurement campaign. Read from a file by `avis_ctrl.study.plan_file`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from avis_ctrl.rigs.file_errors import Section
from avis_ctrl.rigs.key_types import Band, NotNegative, Positive, Spectrum

Duration = Annotated[float, Field(gt=0, le=36000)]
Percent = Annotated[float, Field(gt=0, le=100)]
Spread = Annotated[float, Field(ge=0, lt=100)]


class RecordPlan(Section):
    """One record, or a set of records at one level.

    level_V : r.m.s. of every drive. level_percent : instead, percentage of the largest level at which neither drives
        nor converter clip on the rig as specified in its file; 50 if neither is given. The level depends on the peak of
        each random signal, so levels of several records are not exactly in the ratio of their percentages.
    records : number of records with different random draws; for an orthogonal multisine, multiplied by the number of
        drives.
    floor_rms_m_per_s : r.m.s. velocity of the shaken floor along each of x, y, z, added to the ambient motion.
    duration_s, band_Hz : the campaign plan's by default.
    """

    excitation: Literal["multisine", "noise", "rest", "floor"]
    level_V: Positive | None = None
    level_percent: Percent | None = None
    floor_rms_m_per_s: Annotated[Positive | None, Field(validate_default=True)] = None
    records: Annotated[int, Field(ge=1, le=200)] = 1
    duration_s: Duration | None = None
    band_Hz: Band | None = None

    @field_validator("level_V", "level_percent")
    @classmethod
    def _driven(cls, level: float | None, info: ValidationInfo) -> float | None:
        if level is not None and info.data.get("excitation") in ("rest", "floor"):
            raise ValueError(f"expected no level: in a {info.data['excitation']} record the drives are silent")
        if level is not None and info.field_name == "level_percent" and info.data.get("level_V") is not None:
            raise ValueError("expected one of level_V and level_percent, not both")
        return level

    @field_validator("floor_rms_m_per_s")
    @classmethod
    def _shaken(cls, rms: float | None, info: ValidationInfo) -> float | None:
        shaken = info.data.get("excitation") == "floor"
        if shaken and rms is None:
            raise ValueError("expected the r.m.s. velocity of the shaken floor in m/s")
        if not shaken and rms is not None:
            raise ValueError('expected only in records with excitation = "floor"')
        return rms


class MultisinePlan(Section):
    """Fields as in `avis_ctrl.measurement.excitation.MultisineSettings`."""

    period_s: Duration = 10.0
    lines: Literal["full", "odd", "odd_detection"] = "full"
    spacing: Annotated[int, Field(ge=1, le=10000)] = 1
    group: Annotated[int, Field(ge=2, le=10000)] = 4
    scheme: Literal["orthogonal", "zippered"] = "zippered"
    compensate_hold: bool = False
    low_crest: bool = True


class AmbientPlan(Section):
    """Ambient floor motion, independent along x, y and z: a measured spectral shape scaled to the level of the site.

    velocity_rms_m_per_s : in band_Hz; from the rig's file by default, 0 for a floor at rest.
    """

    spectrum: Spectrum = "kamioka_quiet"
    velocity_rms_m_per_s: NotNegative | None = None
    band_Hz: Band = [0.5, 60.0]


class FloorSensorPlan(Section):
    """Whether the floor's velocity is recorded, and the white noise per sample of that measurement."""

    recorded: bool = True
    noise_rms_m_per_s: NotNegative = 0.0


class SensorPlan(Section):
    """Switches for the sensor noise and the quantiser specified in the rig's file."""

    noise: bool = True
    quantiser: bool = True


class TruthPlan(Section):
    """How far the simulated table differs from the rig's file: each parameter is drawn uniformly within these
    percentages.

    perturb_percent : stiffness, mass and inertia. perturb_damping_percent : damping.
    nonlinear : False for the table linearised about rest.
    """

    perturb_percent: Spread = 0.0
    perturb_damping_percent: Spread = 0.0
    nonlinear: bool = True


class EffectPlan(Section):
    """An effect of the table that its rig file does not contain, from the library of `avis gap` or defined by the user.

    place : where it acts; optional if only one place is possible. values : its parameters by name, in their units.
    """

    name: str
    place: str = ""
    values: dict[str, float] = {}


class CampaignPlan(Section):
    """A whole campaign.

    settle_s : time with the drives at zero before each record, on the ambient floor.
    amplifier_corner_Hz : first-order lag of the amplifiers. Default: none, or 300 Hz for rigs with accelerometers,
        which cannot be simulated without a lag.
    """

    title: str = ""
    duration_s: Duration = 60.0
    settle_s: Annotated[float, Field(ge=0, le=3600)] = 10.0
    band_Hz: Band = [0.5, 100.0]
    amplifier_corner_Hz: Positive | None = None
    multisine: MultisinePlan = MultisinePlan()
    ambient: AmbientPlan = AmbientPlan()
    floor_sensor: FloorSensorPlan = FloorSensorPlan()
    sensors: SensorPlan = SensorPlan()
    truth: TruthPlan = TruthPlan()
    effect: list[EffectPlan] = []
    record: Annotated[list[RecordPlan], Field(min_length=1)]
