"""Rig files: TOML with the data of a rig, checked entry by entry.

There are two kinds: files with [[isolator]] sections give an `IsolatorTable`, files with [suspension] a `Halcyonics`.
The keys are documented in docs/rig_file.md.
Each error is one `InputError` line that names file, field, value and what was expected.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.equipment import Electronics
from avis_ctrl.rigs.file_errors import read_toml, validated
from avis_ctrl.rigs.halcyonics import Halcyonics, Load, ReactionMass
from avis_ctrl.rigs.isolator_table import IsolatorTable, LinearMotor
from avis_ctrl.rigs.plausibility import UnusualRig, plausible
from avis_ctrl.rigs.rig_sections import AvisFile, HalcyonicsFile, LoadSection, PlateSection, symbol_of
from avis_ctrl.rigs.rigid_body import COORDINATES

SHIPPED = {
    "avis": ("avis.toml", False),
    "halcyonics": ("halcyonics.toml", False),
    "halcyonics_loaded": ("halcyonics.toml", True),
}


def load_rig(path_or_name: str | Path, loaded: bool = False, check: bool = True) -> IsolatorTable | Halcyonics:
    """The rig of a file, or a shipped rig: "avis", "halcyonics", "halcyonics_loaded".

    `loaded` puts the load of the file's [load] section on the table. `check` compares the values with those of real
    tables (`plausibility`) and warns of unusual ones (`UnusualRig`); disable it for files written by an identification.

    Raises
    ------
    InputError : no such file, not TOML, a key that is unknown, missing, of a wrong unit or value, an inertia that no
        body can have, a load that is requested but not in the file, values that no real table has.
    """
    if str(path_or_name) in SHIPPED:
        filename, with_load = SHIPPED[str(path_or_name)]
        path = Path(__file__).parent / "data" / filename
        loaded, check = loaded or with_load, False
    else:
        path = Path(path_or_name)
    content = read_toml(path, f"a rig file or one of {', '.join(sorted(SHIPPED))}")
    try:
        if check and (unusual := plausible(content, lambda one: rig_from(one, loaded))):
            warnings.warn(UnusualRig(f"{path}: {unusual}"), stacklevel=2)
        return rig_from(content, loaded)
    except InputError as error:
        raise error.in_file(path) from None


def rig_from(content: dict[str, Any], loaded: bool = False) -> IsolatorTable | Halcyonics:
    """The rig of a file's content; errors as in `load_rig`, without the file's name."""
    rig: IsolatorTable | Halcyonics
    if "isolator" in content:
        if loaded:
            raise InputError("a table on isolators has no [load] section; use loaded = false", field="load")
        rig = _avis(validated(AvisFile, content))
    elif "suspension" in content:
        rig = _halcyonics(validated(HalcyonicsFile, content), loaded)
    elif {"rig", "keep"} <= set(content):
        raise InputError("this is a design file; expected a rig file, such as the one that it names under rig")
    else:
        raise InputError(
            "expected the sections of a rig: [[isolator]] (air mounts) or [suspension] (springs)",
            field="top level",
            value=sorted(content),
        )
    _check_mass(rig)
    _check_support(rig)
    return rig


def _check_mass(rig: IsolatorTable | Halcyonics) -> None:
    """Check that the mass matrix is finite and numerically positive definite."""
    M = rig.equations_of_motion().M
    if not (np.all(np.isfinite(M)) and np.linalg.eigvalsh(M)[0] > 0):
        raise InputError(
            "expected mass, inertia and centre of mass that make a positive definite mass matrix", field="payload"
        )


def _check_support(rig: IsolatorTable | Halcyonics) -> None:
    """Check that every motion of the payload stretches a spring: stiffness scaled to unit diagonal is definite."""
    K = rig.equations_of_motion().K
    size = np.sqrt(np.maximum(np.diag(K), np.finfo(float).tiny))
    softest, motion = (part[..., 0] for part in np.linalg.eigh(K / np.outer(size, size)))
    if softest < 1e-9:
        most = COORDINATES[int(np.argmax(np.abs(motion)))]
        raise InputError(
            f"expected a positive definite stiffness; no spring resists motion mainly along {most}",
            field="isolator" if isinstance(rig, IsolatorTable) else "suspension",
        )


def _avis(file: AvisFile) -> IsolatorTable:
    payload, motors, geophones = file.payload, file.actuators, file.geophones
    lists = {"actuators": (motors, "constant_N_per_V"), "geophones": (geophones, "sensitivity_Vs_per_m")}
    for name, (section, own) in lists.items():
        if section is None:
            continue
        _same_length(name, vars(section), ("names", "isolator", "axis", own))
        if bad := [number for number in section.isolator if not 1 <= number <= len(file.isolator)]:
            raise InputError(
                f"expected isolators from 1 to {len(file.isolator)}", field=f"{name}.isolator", value=bad[0]
            )
    J = np.diag(payload.inertia_kgm2)
    J[0, 1], J[0, 2], J[1, 2] = payload.inertia_offdiagonal_kgm2
    _check_inertia(J + np.triu(J, 1).T, "payload.inertia_kgm2", payload.inertia_kgm2)
    rows = zip(motors.names, motors.isolator, motors.axis, motors.constant_N_per_V, strict=True) if motors else ()
    table = IsolatorTable(
        file.name,
        payload.mass_kg,
        (*payload.inertia_kgm2, *payload.inertia_offdiagonal_kgm2),
        payload.centre_of_mass_m,
        tuple(file.isolator),
        tuple(LinearMotor(*row) for row in rows),
        _common_limit(file),
        geophones,
        file.acquisition,
        file.ambient,
        drives=tuple(file.drive),
        instruments=(*file.geophone, *file.accelerometer, *file.position_sensor),
        floor_sensors=tuple(file.floor_sensor),
        tolerances=file.tolerances,
        electronics=Electronics(**file.electronics.model_dump()),
    )
    _distinct("drive", [one.name for one in table.all_drives])
    _distinct("geophone, accelerometer, position_sensor", [one.name for one in table.sensors()])
    _distinct("floor_sensor.axis", [one.axis for one in table.floor_sensors], some=False)
    return table


def _common_limit(file: AvisFile) -> float:
    """Limit of drives without an individual limit: that of [actuators], or the largest if all drives have one."""
    if file.actuators is not None:
        return file.actuators.limit_V
    for k, one in enumerate(file.drive, 1):
        if one.limit_V is None:
            raise InputError(
                "this key is missing, and [actuators] has no limit_V for all drives", field=f"drive[{k}].limit_V"
            )
    return max((one.limit_V for one in file.drive if one.limit_V is not None), default=1.0)


def _distinct(field: str, names: list[str], some: bool = True) -> None:
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError("expected different names", field=field, value=twice)
    if some and not names:
        raise InputError(f"expected at least one {field.split(',')[0]}", field=field)


def _halcyonics(file: HalcyonicsFile, loaded: bool) -> Halcyonics:
    plate, suspension, actuators = file.payload, file.suspension, file.actuators
    _same_length("actuators", vars(actuators), ("names",))
    _same_length("accelerometers", vars(file.accelerometers), ("at",))
    if absent := [name for name in file.accelerometers.at if name not in actuators.names]:
        raise InputError(f"expected actuators out of {actuators.names}", field="accelerometers.at", value=absent[0])
    _check_inertia(np.diag(plate.inertia_kgm2), "payload.inertia_kgm2", plate.inertia_kgm2)
    load = _load(file.load, plate) if file.load else None
    if loaded and load is None:
        raise InputError("the loaded table was requested, but the rig file has no [load] section", field="load")
    stiffness = {symbol_of(key): value for key, value in suspension}
    k_s, each = stiffness.pop("k_s"), stiffness.pop("k_s_each")
    lengths = {symbol_of(key): value for key, value in plate if key.endswith("_m")}
    Ixx, Iyy, Izz = plate.inertia_kgm2
    return Halcyonics(
        file.name,
        plate.mass_kg,
        Ixx,
        Iyy,
        Izz,
        **lengths,
        **stiffness,
        k_s=tuple(each or (k_s,) * 4),
        e=tuple(actuators.constant_N_per_V),
        actuator_names=tuple(actuators.names),
        reaction=ReactionMass(
            actuators.reaction_mass_kg, actuators.reaction_damping_Ns_per_m, actuators.free_constant_N_per_V
        ),
        accelerometers=file.accelerometers,
        ambient=file.ambient,
        load=load if loaded else None,
        tolerances=file.tolerances,
        electronics=Electronics(**file.electronics.model_dump()),
    )


def _load(section: LoadSection, plate: PlateSection) -> Load:
    """Load from the totals of table 2, plate plus load (I_xx + I^e_xx) without the terms m_e L^2: see `Load`."""
    totals = np.array([section.Ixx_total_kgm2, section.Iyy_total_kgm2, section.Izz_total_kgm2])
    Ixx, Iyy, Izz = (totals - plate.inertia_kgm2).tolist()
    products = (section.Ixy_load_kgm2, section.Ixz_load_kgm2, section.Iyz_load_kgm2)
    load = Load(section.mass_kg, section.L7_m, section.L8_m, section.L9_m, Ixx, Iyy, Izz, *products)
    field = "load.Ixx_total_kgm2 .. Iyz_load_kgm2"
    _check_inertia(load.inertia(), field, [*totals, *products], slender=True)
    return load


def _check_inertia(J: np.ndarray, field: str, value: Any, slender: bool = False) -> None:
    """Check that the principal moments are positive and that none exceeds the sum of the other two.

    A slender rod (one moment zero) is the limiting case of both. It is allowed for a load, within the scatter of a
    measurement.
    """
    moments = np.linalg.eigvalsh(J)
    slack = (1e-3 if slender else 1e-9) * moments[-1]
    if moments[0] < (-slack if slender else slack) or moments[2] > moments[0] + moments[1] + slack:
        raise InputError(
            "expected an inertia that a body can have (principal moments positive, none above the sum "
            f"of the other two); they are {np.round(moments, 6).tolist()} kg m^2",
            field=field,
            value=[float(entry) for entry in value],
        )


def _same_length(section: str, content: dict[str, Any], keys: tuple[str, ...]) -> None:
    names = content[keys[0]]
    if len(set(names)) != len(names):
        raise InputError("expected different names", field=f"{section}.{keys[0]}", value=names)
    for key in keys[1:]:
        if len(content[key]) != len(names):
            raise InputError(
                f"expected as many entries as {section}.{keys[0]} has, which is {len(names)}; there are "
                f"{len(content[key])}",
                field=f"{section}.{key}",
                value=content[key],
            )
