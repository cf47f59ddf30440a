"""The sections of a rig file and their keys: what docs/rig_file.md documents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator

from avis_ctrl.rigs.converter import bits_of
from avis_ctrl.rigs.equipment import Electronics
from avis_ctrl.rigs.file_errors import Section
from avis_ctrl.rigs.floor_spectrum import shipped_spectra
from avis_ctrl.rigs.instruments import Tolerances


@dataclass(frozen=True)
class RigLimits:
    """farthest_m : maximum distance of a point from the origin along each axis [m]. No table is larger, and for distant
        points the inertia is lost in the round-off of m r^2.
    largest : maximum size of any number [SI unit of its key]: no value of a table comes near it, and products of such
        numbers are finite.
    """

    farthest_m: float = 100.0
    largest: float = 1e12


LIMITS = RigLimits()
Number = Annotated[float, Field(ge=-LIMITS.largest, le=LIMITS.largest)]
Positive = Annotated[float, Field(gt=0, le=LIMITS.largest)]
NotNegative = Annotated[float, Field(ge=0, le=LIMITS.largest)]


def _not_far(length: float) -> float:
    if abs(length) > LIMITS.farthest_m:
        raise ValueError(f"expected a length in metres, at most {LIMITS.farthest_m:g}")
    return length


Length = Annotated[float, AfterValidator(_not_far)]
PositiveLength = Annotated[float, Field(gt=0), AfterValidator(_not_far)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
Point = Annotated[list[Length], Field(min_length=3, max_length=3)]
PositiveVector = Annotated[list[Positive], Field(min_length=3, max_length=3)]
DampingVector = Annotated[list[NotNegative], Field(min_length=3, max_length=3)]
Axis = Literal["x", "y", "z"]


def _with_a_length(direction: list[float]) -> list[float]:
    if not any(direction):
        raise ValueError("expected a vector that is not zero")
    return direction


Direction = Annotated[list[Number], Field(min_length=3, max_length=3), AfterValidator(_with_a_length)]
# Channel names become signal names of models: letters, digits, _ and -, a letter first.
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")]
Percent = Annotated[float, Field(ge=0, le=100)]


def _rising(band: list[float]) -> list[float]:
    if band[0] >= band[1]:
        raise ValueError("expected the lower limit first, then the upper one")
    return band


def _shipped(spectrum: str) -> str:
    if spectrum not in shipped_spectra():
        raise ValueError(f"expected one of {', '.join(shipped_spectra())}")
    return spectrum


# Also for other files: a frequency band [Hz], and the name of a shipped spectrum of floor motion.
Band = Annotated[list[Positive], Field(min_length=2, max_length=2), AfterValidator(_rising)]
Spectrum = Annotated[str, AfterValidator(_shipped)]


class AvisPayload(Section):
    """The payload; its inertia is about its centre of mass."""

    mass_kg: Positive
    inertia_kgm2: PositiveVector
    inertia_offdiagonal_kgm2: Vector = [0.0, 0.0, 0.0]
    centre_of_mass_m: Point


class IsolatorSection(Section):
    """Spring and damper along the earth axes; chassis_point_m : position_m by default."""

    position_m: Point
    stiffness_N_per_m: PositiveVector
    damping_Ns_per_m: DampingVector
    chassis_point_m: Point | None = None


class MotorSection(Section):
    """Motors in the isolators, along their axes; without motors, only the voltage limit of the [[drive]] tables."""

    names: list[str] = []
    isolator: list[int] = []
    axis: list[Axis] = []
    constant_N_per_V: list[Positive] = []
    limit_V: Positive


class PlacedSection(Section):
    """A drive or sensor at any position."""

    name: Name
    position_m: Point
    direction: Direction


class DriveSection(PlacedSection):
    """A drive at any position; limit_V : that of [actuators] by default."""

    constant_N_per_V: Positive
    limit_V: Positive | None = None


class GeophoneSection(Section):
    """Geophones in the isolators, along their axes."""

    names: list[str]
    isolator: list[int]
    axis: list[Axis]
    sensitivity_Vs_per_m: list[Positive]
    suspension_Hz: Positive
    suspension_damping: Positive
    compensated_Hz: Positive
    compensated_damping: Positive
    preamplifier_gain: Positive


class GeophoneAtSection(PlacedSection):
    """A geophone at any position."""

    sensitivity_Vs_per_m: Positive
    suspension_Hz: Positive
    suspension_damping: Positive
    compensated_Hz: Positive | None = None
    compensated_damping: Positive | None = None
    preamplifier_gain: Positive = 1.0
    noise_rms_V: NotNegative | None = None


class AccelerometerAtSection(PlacedSection):
    """An accelerometer at any position."""

    sensitivity_Vs2_per_m: Positive
    low_corner_Hz: Positive
    noise_m_per_s2_rtHz: NotNegative | None = None
    preamplifier_gain: Positive = 1.0
    noise_rms_V: NotNegative | None = None


class PositionSensorSection(PlacedSection):
    """A position sensor, payload relative to chassis, at any position."""

    sensitivity_V_per_m: Positive
    bandwidth_Hz: Positive | None = None
    noise_m_rtHz: NotNegative | None = None
    preamplifier_gain: Positive = 1.0
    noise_rms_V: NotNegative | None = None


class FloorSensorSection(Section):
    """A sensor of floor velocity along one axis."""

    name: Name
    axis: Axis
    noise_rms_m_per_s: NotNegative


class TolerancesSection(Section):
    """Standard deviations; omitted keys take the default."""

    place_m: NotNegative = Tolerances.place_m
    direction_rad: NotNegative = Tolerances.direction_rad
    actuator_gain_percent: Percent = Tolerances.actuator_gain_percent
    sensor_gain_percent: Percent = Tolerances.sensor_gain_percent
    sensor_corner_percent: Percent = Tolerances.sensor_corner_percent
    sensor_damping_percent: Percent = Tolerances.sensor_damping_percent
    centre_of_mass_m: NotNegative = Tolerances.centre_of_mass_m
    product_of_inertia_kgm2: NotNegative = Tolerances.product_of_inertia_kgm2


class ElectronicsSection(Section):
    """Offset, 1/f noise and anti-alias filter of the channels; omitted keys take the default."""

    sensor_offset_V: NotNegative | None = None
    sensor_flicker_corner_Hz: NotNegative | None = None
    converter_offset_V: NotNegative | None = None
    converter_flicker_corner_Hz: NotNegative = Electronics.converter_flicker_corner_Hz
    anti_alias_order: Annotated[int, Field(ge=0, le=8)] = Electronics.anti_alias_order
    anti_alias_corner_Hz: Annotated[Positive | None, Field(validate_default=True)] = None

    @field_validator("anti_alias_corner_Hz")
    @classmethod
    def _with_an_order(cls, corner: float | None, info: ValidationInfo) -> float | None:
        if (corner is None) != (info.data.get("anti_alias_order", 0) == 0):
            raise ValueError("expected anti_alias_order and anti_alias_corner_Hz, both or neither")
        return corner


class AcquisitionSection(Section):
    """Converter and timing of the controller."""

    sample_rate_Hz: Positive
    adc_bits: Annotated[int, BeforeValidator(bits_of)]
    adc_range_V: Positive
    loop_delay_s: NotNegative


class AmbientSection(Section):
    """R.m.s. of floor motion and sensor noise."""

    floor_velocity_rms_m_per_s: NotNegative
    sensor_noise_rms_V: NotNegative


class AvisFile(Section):
    """A rig file of a payload on isolators."""

    name: str
    payload: AvisPayload
    isolator: Annotated[list[IsolatorSection], Field(min_length=3)]
    actuators: MotorSection | None = None
    drive: list[DriveSection] = []
    geophones: GeophoneSection | None = None
    geophone: list[GeophoneAtSection] = []
    accelerometer: list[AccelerometerAtSection] = []
    position_sensor: list[PositionSensorSection] = []
    floor_sensor: Annotated[list[FloorSensorSection], Field(max_length=3)] = []
    acquisition: AcquisitionSection
    ambient: AmbientSection | None = None
    tolerances: TolerancesSection | None = None
    electronics: ElectronicsSection = ElectronicsSection()


class PlateSection(Section):
    """The plate of the Halcyonics table."""

    mass_kg: Positive
    inertia_kgm2: PositiveVector
    L1_m: PositiveLength
    L2_m: PositiveLength
    L3_m: PositiveLength
    L4_plus_L5_m: PositiveLength
    L6_m: Length
    M2_arm_m: Length = 0.2
    M3_arm_m: Length = 0.15


class SuspensionSection(Section):
    """k_s_each_N_per_m : of the springs at the corners of A1..A4, if they differ; k_s_N_per_m is then their mean."""

    k_s_N_per_m: Positive
    k_s_each_N_per_m: Annotated[list[Positive], Field(min_length=4, max_length=4)] | None = None
    k_a_N_per_m: Positive
    k_t_N_per_m: Positive
    k_r_Nm_per_rad: Positive
    d1_Ns_per_m: NotNegative
    d3_Ns_per_m: NotNegative
    d4_Nms_per_rad: NotNegative
    d5_Nms_per_rad: NotNegative
    d6_Nms_per_rad: NotNegative


class VoiceCoilSection(Section):
    """Voice-coil actuators A1..A8 of the Halcyonics table."""

    names: Annotated[list[str], Field(min_length=8, max_length=8)]
    constant_N_per_V: Annotated[list[Positive], Field(min_length=8, max_length=8)]
    reaction_mass_kg: Positive
    reaction_damping_Ns_per_m: NotNegative
    free_constant_N_per_V: Positive


class AccelerometerSection(Section):
    """Built-in accelerometers of the Halcyonics table, at these actuators."""

    at: Annotated[list[str], Field(min_length=1)]
    sensitivity_Vs2_per_m: Positive
    low_corner_Hz: Positive
    noise_m_per_s2_rtHz: NotNegative
    sample_rate_Hz: Positive
    loop_delay_s: NotNegative
    drive_limit_V: Positive


class LoadSection(Section):
    """A load on the plate; `_total` is the inertia of plate and load."""

    mass_kg: Positive
    L7_m: Length
    L8_m: Length
    L9_m: Length
    Ixx_total_kgm2: Positive
    Iyy_total_kgm2: Positive
    Izz_total_kgm2: Positive
    Ixy_load_kgm2: Number = 0.0
    Ixz_load_kgm2: Number = 0.0
    Iyz_load_kgm2: Number = 0.0


class HalcyonicsFile(Section):
    """A rig file of the Halcyonics table."""

    name: str
    payload: PlateSection
    suspension: SuspensionSection
    actuators: VoiceCoilSection
    accelerometers: AccelerometerSection
    load: LoadSection | None = None
    ambient: AmbientSection | None = None
    tolerances: TolerancesSection | None = None
    electronics: ElectronicsSection = ElectronicsSection()
