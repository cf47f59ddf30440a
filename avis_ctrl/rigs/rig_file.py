"""Rig files: TOML with the numbers of a rig, checked entry by entry.

Two kinds, told apart by their sections: [[isolator]] makes an `AvisTable`, [suspension] a `Halcyonics`.
Whatever is wrong is one `InputError` line that names file, field, value and what was expected.
"""

from __future__ import annotations

import tomllib
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.avis import AvisTable, Isolator, LinearMotor
from avis_ctrl.rigs.equipment import Accelerometers, Acquisition, Ambient, Geophones
from avis_ctrl.rigs.file_errors import first_complaint
from avis_ctrl.rigs.floor_spectrum import shipped_spectra
from avis_ctrl.rigs.halcyonics import Halcyonics, Load, ReactionMass
from avis_ctrl.rigs.plausibility import UnusualRig, plausible
from avis_ctrl.rigs.rigid_body import COORDINATES

SHIPPED = {"avis": ("avis.toml", False), "halcyonics": ("halcyonics.toml", False),
           "halcyonics_loaded": ("halcyonics.toml", True)}

# In SI units nothing on a table comes near the limit; it keeps the products of such numbers finite.
LIMIT = 1e12
Number = Annotated[float, Field(ge=-LIMIT, le=LIMIT)]
Positive = Annotated[float, Field(gt=0, le=LIMIT)]
NotNegative = Annotated[float, Field(ge=0, le=LIMIT)]
# No table is larger: far points leave no digits for the inertia beside m r^2.
Length = Annotated[float, Field(ge=-100.0, le=100.0)]
PositiveLength = Annotated[float, Field(gt=0, le=100.0)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
Point = Annotated[list[Length], Field(min_length=3, max_length=3)]
PositiveVector = Annotated[list[Positive], Field(min_length=3, max_length=3)]
DampingVector = Annotated[list[NotNegative], Field(min_length=3, max_length=3)]
Axis = Literal["x", "y", "z"]


def _rising(band: list[float]) -> list[float]:
    if band[0] >= band[1]:
        raise ValueError("expected the lower end first, the upper one after it")
    return band


def _shipped(spectrum: str) -> str:
    if spectrum not in shipped_spectra():
        raise ValueError(f"expected one of {', '.join(shipped_spectra())}")
    return spectrum


# What other files share: a frequency band [Hz], and the name of a shipped spectrum of floor motion.
Band = Annotated[list[Positive], Field(min_length=2, max_length=2), AfterValidator(_rising)]
Spectrum = Annotated[str, AfterValidator(_shipped)]


File = TypeVar("File", bound=BaseModel)


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class AvisPayload(_Section):
    mass_kg: Positive
    inertia_kgm2: PositiveVector
    inertia_offdiagonal_kgm2: Vector = [0.0, 0.0, 0.0]
    centre_of_mass_m: Point


class IsolatorSection(_Section):
    position_m: Point
    stiffness_N_per_m: PositiveVector
    damping_Ns_per_m: DampingVector
    chassis_point_m: Point | None = None


class MotorSection(_Section):
    names: list[str]
    isolator: list[int]
    axis: list[Axis]
    constant_N_per_V: list[Positive]
    limit_V: Positive


class GeophoneSection(_Section):
    names: list[str]
    isolator: list[int]
    axis: list[Axis]
    sensitivity_Vs_per_m: list[Positive]
    suspension_Hz: Positive
    suspension_damping: Positive
    compensated_Hz: Positive
    compensated_damping: Positive
    preamplifier_gain: Positive


class AcquisitionSection(_Section):
    sample_rate_Hz: Positive
    adc_bits: Annotated[int, Field(ge=1, le=64)]
    adc_range_V: Positive
    loop_delay_s: NotNegative


class AmbientSection(_Section):
    floor_velocity_rms_m_per_s: NotNegative
    sensor_noise_rms_V: NotNegative


class AvisFile(_Section):
    name: str
    payload: AvisPayload
    isolator: Annotated[list[IsolatorSection], Field(min_length=3)]
    actuators: MotorSection
    geophones: GeophoneSection
    acquisition: AcquisitionSection
    ambient: AmbientSection | None = None


class PlateSection(_Section):
    mass_kg: Positive
    inertia_kgm2: PositiveVector
    L1_m: PositiveLength
    L2_m: PositiveLength
    L3_m: PositiveLength
    L4_plus_L5_m: PositiveLength
    L6_m: Length
    M2_arm_m: Length = 0.2
    M3_arm_m: Length = 0.15


class SuspensionSection(_Section):
    """k_s_each_N_per_m : the springs at the corners of A1..A4, where they differ; k_s_N_per_m is then their mean."""

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


class VoiceCoilSection(_Section):
    names: Annotated[list[str], Field(min_length=8, max_length=8)]
    constant_N_per_V: Annotated[list[Positive], Field(min_length=8, max_length=8)]
    reaction_mass_kg: Positive
    reaction_damping_Ns_per_m: NotNegative
    free_constant_N_per_V: Positive


class AccelerometerSection(_Section):
    at: Annotated[list[str], Field(min_length=1)]
    sensitivity_Vs2_per_m: Positive
    low_corner_Hz: Positive
    noise_m_per_s2_rtHz: NotNegative
    sample_rate_Hz: Positive
    loop_delay_s: NotNegative
    drive_limit_V: Positive


class LoadSection(_Section):
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


class HalcyonicsFile(_Section):
    name: str
    payload: PlateSection
    suspension: SuspensionSection
    actuators: VoiceCoilSection
    accelerometers: AccelerometerSection
    load: LoadSection | None = None
    ambient: AmbientSection | None = None


def load_rig(path_or_name: str | Path, loaded: bool = False, check: bool = True) -> AvisTable | Halcyonics:
    """The rig of a file, or a shipped one: "avis", "halcyonics", "halcyonics_loaded".

    `loaded` puts the load of the file's [load] section on the table. `check` holds a file against what tables can be
    (`plausibility`), a warning `UnusualRig` saying what is rare; not for files that an identification wrote.

    Raises
    ------
    InputError : no such file, not TOML, a key that is unknown, missing, of a wrong unit or value,
        an inertia that no body can have, a load asked for that the file does not have, values that no table has.
    """
    if str(path_or_name) in SHIPPED:
        filename, with_load = SHIPPED[str(path_or_name)]
        path = Path(__file__).parent / "data" / filename
        loaded, check = loaded or with_load, False
    else:
        path = Path(path_or_name)
    content = _read_toml(path)
    try:
        if check and (unusual := plausible(content, lambda one: rig_from(one, loaded))):
            warnings.warn(UnusualRig(f"{path}: {unusual}"), stacklevel=2)
        return rig_from(content, loaded)
    except InputError as error:
        raise error.in_file(path) from None


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"expected a rig file or one of {sorted(SHIPPED)}; {error.strerror or error}",
                         file=path) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected a TOML file in UTF-8; {' '.join(str(error).split())}", file=path) from None


def rig_from(content: dict[str, Any], loaded: bool = False) -> AvisTable | Halcyonics:
    """The rig of a file's content; raises as `load_rig` does, without the file's name."""
    rig: AvisTable | Halcyonics
    if "isolator" in content:
        if loaded:
            raise InputError("a rig with isolators has no [load] section to put on it", field="load")
        rig = _avis(_checked(AvisFile, content))
    elif "suspension" in content:
        rig = _halcyonics(_checked(HalcyonicsFile, content), loaded)
    else:
        raise InputError("expected the sections of a rig: [[isolator]] (air mounts) or [suspension] (springs)",
                         field="top level", value=sorted(content))
    _check_mass(rig)
    _check_support(rig)
    return rig


def _check_mass(rig: AvisTable | Halcyonics) -> None:
    """Every motion of the payload has inertia, also in the arithmetic at hand."""
    M = rig.equations_of_motion().M
    if not (np.all(np.isfinite(M)) and np.linalg.eigvalsh(M)[0] > 0):
        raise InputError("expected mass, inertia and centre of mass that make a positive definite mass matrix",
                         field="payload")


def _check_support(rig: AvisTable | Halcyonics) -> None:
    """Every motion of the payload stretches a spring: the stiffness, its diagonal scaled to one, is definite."""
    K = rig.equations_of_motion().K
    size = np.sqrt(np.maximum(np.diag(K), np.finfo(float).tiny))
    softest, motion = (part[..., 0] for part in np.linalg.eigh(K / np.outer(size, size)))
    if softest < 1e-9:
        most = COORDINATES[int(np.argmax(np.abs(motion)))]
        raise InputError(f"expected springs that hold every motion; nothing resists one that is mostly {most}",
                         field="isolator" if isinstance(rig, AvisTable) else "suspension")


def _checked(model: type[File], content: dict[str, Any]) -> File:
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise first_complaint(error, model) from None


def _avis(file: AvisFile) -> AvisTable:
    payload, motors, geophones = file.payload, file.actuators, file.geophones
    _same_length("actuators", motors.model_dump(), ("names", "isolator", "axis", "constant_N_per_V"))
    _same_length("geophones", geophones.model_dump(), ("names", "isolator", "axis", "sensitivity_Vs_per_m"))
    for section, numbers in (("actuators", motors.isolator), ("geophones", geophones.isolator)):
        if bad := [number for number in numbers if not 1 <= number <= len(file.isolator)]:
            raise InputError(f"expected isolators from 1 to {len(file.isolator)}", field=f"{section}.isolator",
                             value=bad[0])
    J = np.diag(payload.inertia_kgm2)
    J[0, 1], J[0, 2], J[1, 2] = payload.inertia_offdiagonal_kgm2
    _check_inertia(J + np.triu(J, 1).T, "payload.inertia_kgm2", payload.inertia_kgm2)
    isolators = tuple(_isolator(one) for one in file.isolator)
    inertia = (*_triple(payload.inertia_kgm2), *_triple(payload.inertia_offdiagonal_kgm2))
    rows = zip(motors.names, motors.isolator, motors.axis, motors.constant_N_per_V, strict=True)
    return AvisTable(file.name, payload.mass_kg, inertia, _triple(payload.centre_of_mass_m), isolators,
                     tuple(LinearMotor(*row) for row in rows), motors.limit_V, Geophones(**_tuples(geophones)),
                     Acquisition(**_tuples(file.acquisition)), _ambient(file.ambient))


def _isolator(section: IsolatorSection) -> Isolator:
    offset = np.subtract(section.chassis_point_m or section.position_m, section.position_m)
    return Isolator(_triple(section.position_m), _triple(section.stiffness_N_per_m), _triple(section.damping_Ns_per_m),
                    _triple(offset.tolist()))


def _halcyonics(file: HalcyonicsFile, loaded: bool) -> Halcyonics:
    plate, suspension, actuators = file.payload, file.suspension, file.actuators
    _same_length("actuators", actuators.model_dump(), ("names",))
    _same_length("accelerometers", file.accelerometers.model_dump(), ("at",))
    if absent := [name for name in file.accelerometers.at if name not in actuators.names]:
        raise InputError(f"expected actuators out of {actuators.names}", field="accelerometers.at", value=absent[0])
    _check_inertia(np.diag(plate.inertia_kgm2), "payload.inertia_kgm2", plate.inertia_kgm2)
    load = _load(file.load, plate) if file.load else None
    if loaded and load is None:
        raise InputError("the loaded table was asked for, but the file has no [load] section", field="load")
    stiffness = {name.partition("_N")[0]: value for name, value in suspension.model_dump().items()}
    k_s, each = stiffness.pop("k_s"), stiffness.pop("k_s_each")
    lengths = {name.removesuffix("_m"): getattr(plate, name) for name in ("L1_m", "L2_m", "L3_m", "L4_plus_L5_m",
                                                                          "L6_m", "M2_arm_m", "M3_arm_m")}
    Ixx, Iyy, Izz = plate.inertia_kgm2
    return Halcyonics(file.name, plate.mass_kg, Ixx, Iyy, Izz, **lengths, **stiffness, k_s=tuple(each or (k_s,) * 4),
                      e=tuple(actuators.constant_N_per_V), actuator_names=tuple(actuators.names),
                      reaction=ReactionMass(actuators.reaction_mass_kg, actuators.reaction_damping_Ns_per_m,
                                            actuators.free_constant_N_per_V),
                      accelerometers=Accelerometers(**_tuples(file.accelerometers)),
                      ambient=_ambient(file.ambient), load=load if loaded else None)


def _ambient(section: AmbientSection | None) -> Ambient | None:
    return Ambient(**_tuples(section)) if section else None


def _load(section: LoadSection, plate: PlateSection) -> Load:
    """Table 2 prints plate plus load (I_xx + I^e_xx), without the terms m_e L^2: see `Load`."""
    totals = np.array([section.Ixx_total_kgm2, section.Iyy_total_kgm2, section.Izz_total_kgm2])
    Ixx, Iyy, Izz = (float(value) for value in totals - plate.inertia_kgm2)
    load = Load(section.mass_kg, section.L7_m, section.L8_m, section.L9_m, Ixx, Iyy, Izz, section.Ixy_load_kgm2,
                section.Ixz_load_kgm2, section.Iyz_load_kgm2)
    _check_inertia(load.inertia(), "load.Ixx_total_kgm2 .. Iyz_load_kgm2",
                   [*totals, section.Ixy_load_kgm2, section.Ixz_load_kgm2, section.Iyz_load_kgm2], slender=True)
    return load


def _check_inertia(J: np.ndarray, field: str, value: Any, slender: bool = False) -> None:
    """A body's principal moments are positive and none exceeds the sum of the others.

    A slender rod (one moment zero) is on the edge of both and allowed for a load, up to what a measurement of it
    scatters about the edge.
    """
    moments = np.linalg.eigvalsh(J)
    slack = (1e-3 if slender else 1e-9) * moments[-1]
    if moments[0] < (-slack if slender else slack) or moments[2] > moments[0] + moments[1] + slack:
        raise InputError("expected an inertia that a body can have (principal moments positive, none above the sum "
                         f"of the other two); they are {np.round(moments, 6).tolist()} kg m^2", field=field,
                         value=[float(entry) for entry in value])


def _same_length(section: str, content: dict[str, Any], keys: tuple[str, ...]) -> None:
    names = content[keys[0]]
    if len(set(names)) != len(names):
        raise InputError("expected different names", field=f"{section}.{keys[0]}", value=names)
    for key in keys[1:]:
        if len(content[key]) != len(names):
            raise InputError(f"expected {len(names)} entries, one for each of {section}.{keys[0]}",
                             field=f"{section}.{key}", value=content[key])


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return float(x), float(y), float(z)


def _tuples(section: BaseModel) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in section.model_dump().items()}
