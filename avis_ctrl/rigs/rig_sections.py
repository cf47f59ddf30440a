"""The sections of a rig file and their keys: what docs/rig_file.md documents."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator

from avis_ctrl.rigs.equipment import Accelerometers, Acquisition, Ambient, Electronics, Geophones
from avis_ctrl.rigs.file_errors import Section
from avis_ctrl.rigs.instruments import AccelerometerAt, Drive, FloorSensor, GeophoneAt, PositionSensorAt, Tolerances
from avis_ctrl.rigs.isolator_table import Isolator
from avis_ctrl.rigs.key_types import (
    Axis,
    Length,
    NotNegative,
    Number,
    Point,
    Positive,
    PositiveLength,
    PositiveVector,
    Vector,
)


def symbol_of(key: str) -> str:
    """The symbol of the source in a key of the Halcyonics table: the key without the unit of a length, a stiffness or a
    damping ("k_a_N_per_m" is k_a)."""
    return re.sub("_(m|N.*)$", "", key)


class AvisPayload(Section):
    """The payload; its inertia is about its centre of mass."""

    mass_kg: Positive
    inertia_kgm2: PositiveVector
    inertia_offdiagonal_kgm2: Vector = (0.0, 0.0, 0.0)
    centre_of_mass_m: Point


class MotorSection(Section):
    """Motors in the isolators, along their axes; without motors, only the voltage limit of the [[drive]] tables."""

    names: list[str] = []
    isolator: list[int] = []
    axis: list[Axis] = []
    constant_N_per_V: list[Positive] = []
    limit_V: Positive


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


class AvisFile(Section):
    """A rig file of a payload on isolators."""

    name: str
    payload: AvisPayload
    isolator: Annotated[list[Isolator], Field(min_length=3)]
    actuators: MotorSection | None = None
    drive: list[Drive] = []
    geophones: Geophones | None = None
    geophone: list[GeophoneAt] = []
    accelerometer: list[AccelerometerAt] = []
    position_sensor: list[PositionSensorAt] = []
    floor_sensor: Annotated[list[FloorSensor], Field(max_length=3)] = []
    acquisition: Acquisition
    ambient: Ambient | None = None
    tolerances: Tolerances | None = None
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
    accelerometers: Accelerometers
    load: LoadSection | None = None
    ambient: Ambient | None = None
    tolerances: Tolerances | None = None
    electronics: ElectronicsSection = ElectronicsSection()
