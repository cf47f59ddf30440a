"""Writing of rig files: TOML that `load_rig` reads back, with all digits of every value."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.equipment import Ambient, Electronics
from avis_ctrl.rigs.file_errors import Section
from avis_ctrl.rigs.halcyonics import Halcyonics
from avis_ctrl.rigs.instruments import AccelerometerAt, Drive, GeophoneAt, Instrument, PositionSensorAt
from avis_ctrl.rigs.isolator_table import AXES, INERTIA, IsolatorTable
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_sections import LoadSection, PlateSection, SuspensionSection, symbol_of
from avis_ctrl.rigs.toml_text import toml_value


@dataclass(frozen=True)
class _Line:
    """One key of a file, and the rig parameters (flat names) that its value contains."""

    key: str
    value: Any
    parameters: tuple[str, ...] = ()


# Title as written in the file, name used in comments and messages, and lines.
_Section = tuple[str, str, list[_Line]]
_adapter = cache(TypeAdapter)
_KINDS = {GeophoneAt: "geophone", AccelerometerAt: "accelerometer", PositionSensorAt: "position_sensor"}


def rig_toml(rig: Rig, comments: Mapping[str, str] | None = None, header: str = "") -> str:
    """The text of a rig file.

    A loaded Halcyonics table is read back with `load_rig(path, loaded=True)`. Two quantities are stored as sums, as the
    file format requires (total inertia of plate and load, chassis points of isolators); they are recovered to the last
    digit of the sum.

    Parameters
    ----------
    comments : by key, written at the end of the key's line. A key is a parameter's flat name ("isolator1.k_x"; several
        comments on one line are joined) or the key in the file as named in messages ("payload.mass_kg",
        "isolator[1].damping_Ns_per_m"). header : comment lines at the top.

    Raises
    ------
    InputError : a rig of another kind, a comment for a line that does not exist, a comment of several lines.
    """
    sections = _sections(rig)
    if not sections:
        raise InputError("expected an IsolatorTable or a Halcyonics rig", field="rig", value=type(rig).__name__)
    left = dict(comments or {})
    text = "".join(_comment(line) + "\n" for line in header.splitlines())
    for title, name, lines in sections:
        text += f"\n{title}\n" if title else ""
        for line in lines:
            dotted = f"{name}.{line.key}" if name else line.key
            own = [left.pop(known) for known in (dotted, *line.parameters) if known in left]
            text += f"{line.key} = {toml_value(line.value)}" + (f"  {_comment('; '.join(own))}" if own else "") + "\n"
    if left:
        raise InputError(
            f"the file of the rig {rig.name} has no such line or parameter", field="comments", value=next(iter(left))
        )
    return text


def file_keys(rig: Rig) -> dict[str, str]:
    """Key of the rig file by parameter, such as "isolator.stiffness_N_per_m"; empty for a rig of another kind."""
    return {
        parameter: f"{name.partition('[')[0]}.{line.key}"
        for _, name, lines in _sections(rig)
        for line in lines
        for parameter in line.parameters
    }


def _sections(rig: Rig) -> list[_Section]:
    if isinstance(rig, IsolatorTable):
        return _avis_sections(rig)
    return _halcyonics_sections(rig) if isinstance(rig, Halcyonics) else []


def _comment(text: str) -> str:
    if any(not (character.isprintable() or character == "\t") for character in text):
        raise InputError("expected one line of printable characters", field="comments", value=text)
    return f"# {text}".rstrip()


def _ambient(ambient: Ambient | None) -> list[_Section]:
    return [("[ambient]", "ambient", _all(ambient))] if ambient else []


def _sum_for(parts: Iterable[float], bases: Iterable[float]) -> list[float]:
    """base + part, changed in its last digit if sum - base is then closer to part."""
    sums = []
    for part, base in zip(parts, bases, strict=True):
        total = base + part
        near = (total, np.nextafter(total, np.inf), np.nextafter(total, -np.inf))
        sums.append(float(min(near, key=lambda one: abs((one - base) - part))))
    return sums


def _avis_sections(rig: IsolatorTable) -> list[_Section]:
    sections: list[_Section] = [
        ("", "", [_Line("name", rig.name)]),
        (
            "[payload]",
            "payload",
            [
                _Line("mass_kg", rig.mass, ("mass",)),
                _Line("inertia_kgm2", rig.inertia[:3], INERTIA[:3]),
                _Line("inertia_offdiagonal_kgm2", rig.inertia[3:], INERTIA[3:]),
                _Line("centre_of_mass_m", rig.centre_of_mass, tuple(f"com_{axis}" for axis in AXES)),
            ],
        ),
    ]
    for number, one in enumerate(rig.isolators, 1):
        kinds = {"position_m": "p", "stiffness_N_per_m": "k", "damping_Ns_per_m": "c"}
        lines = _all(one, {key: [f"isolator{number}.{kind}_{axis}" for axis in AXES] for key, kind in kinds.items()})
        del lines[3:]  # the file has the point on the chassis, not relative to the attachment
        if any(one.chassis_offset):
            lines.append(_Line("chassis_point_m", _sum_for(one.chassis_offset, one.position)))
        sections.append(("[[isolator]]", f"isolator[{number}]", lines))
    motors = rig.motors
    lines = [
        _Line("names", [m.name for m in motors]),
        _Line("isolator", [m.isolator for m in motors]),
        _Line("axis", [m.axis for m in motors]),
        _Line("constant_N_per_V", [m.constant_N_per_V for m in motors], tuple(f"actuator.{m.name}" for m in motors)),
    ]
    sections.append(("[actuators]", "actuators", [*(lines if motors else []), _Line("limit_V", rig.limit_V)]))
    sections += [("[[drive]]", f"drive[{k}]", _at_place(one)) for k, one in enumerate(rig.drives, 1)]
    if rig.geophones is not None:
        sections.append(("[geophones]", "geophones", _all(rig.geophones)))
    counted: dict[str, int] = {}
    for instrument in rig.instruments:
        kind = _KINDS[type(instrument)]
        counted[kind] = counted.get(kind, 0) + 1
        sections.append((f"[[{kind}]]", f"{kind}[{counted[kind]}]", _at_place(instrument)))
    sections += [("[[floor_sensor]]", f"floor_sensor[{k}]", _all(one)) for k, one in enumerate(rig.floor_sensors, 1)]
    sections.append(("[acquisition]", "acquisition", _all(rig.acquisition)))
    return sections + _ambient(rig.ambient) + _tolerances(rig)


def _all(thing: Any, parameters: Mapping[str, Sequence[str]] = {}) -> list[_Line]:
    """Lines of all fields that have a value; parameters : that the values contain, by key."""
    adapter = _adapter(type(thing))  # type: ignore[arg-type]  # a type is hashable
    content = adapter.dump_python(thing, by_alias=True, exclude_none=True)
    last = {one.name for one in fields(thing) if one.kw_only}  # what all sensors have follows what each kind has
    keys = sorted(content, key=lambda key: key in last)
    return [_Line(key, content[key], tuple(parameters.get(key, ()))) for key in keys]


def _at_place(one: Drive | Instrument) -> list[_Line]:
    place, direction = ([f"{kind}.{one.name}.{axis}" for axis in AXES] for kind in ("place", "direction"))
    force = [f"actuator.{one.name}"]
    return _all(one, {"constant_N_per_V": force, "position_m": place, "direction": direction})


def _tolerances(rig: Rig) -> list[_Section]:
    found = [("[tolerances]", "tolerances", _all(rig.tolerances))] if rig.tolerances else []
    if rig.electronics != Electronics():
        found.append(("[electronics]", "electronics", _all(rig.electronics)))
    return found


def _halcyonics_sections(rig: Halcyonics) -> list[_Section]:
    def of(model: type[Section], start: int) -> list[_Line]:
        """Lines of the values that a section has as the table has them, from its key number `start` on."""
        return [_Line(key, getattr(rig, symbol_of(key)), (symbol_of(key),)) for key in list(model.model_fields)[start:]]

    springs = [_Line("k_s_N_per_m", float(np.mean(rig.k_s)), ("k_s",))]
    if len(set(rig.k_s)) > 1:
        springs.append(_Line("k_s_each_N_per_m", rig.k_s, tuple(f"k_s{k}" for k in range(1, 5))))
    else:
        springs = [_Line("k_s_N_per_m", rig.k_s[0], ("k_s", "k_s1", "k_s2", "k_s3", "k_s4"))]
    sections: list[_Section] = [
        ("", "", [_Line("name", rig.name)]),
        (
            "[payload]",
            "payload",
            [
                _Line("mass_kg", rig.mass, ("mass",)),
                _Line("inertia_kgm2", (rig.Ixx, rig.Iyy, rig.Izz), ("Ixx", "Iyy", "Izz")),
                *of(PlateSection, 2),
            ],
        ),
        ("[suspension]", "suspension", springs + of(SuspensionSection, 2)),
        (
            "[actuators]",
            "actuators",
            [
                _Line("names", rig.actuator_names),
                _Line("constant_N_per_V", rig.e, tuple(f"e{k}" for k in range(1, 9))),
                _Line("reaction_mass_kg", rig.reaction.mass),
                _Line("reaction_damping_Ns_per_m", rig.reaction.damping),
                _Line("free_constant_N_per_V", rig.reaction.constant_N_per_V),
            ],
        ),
        ("[accelerometers]", "accelerometers", _all(rig.accelerometers)),
    ]
    if (load := rig.load) is not None:
        totals = _sum_for((load.Ixx, load.Iyy, load.Izz), (rig.Ixx, rig.Iyy, rig.Izz))
        stated = replace(load, Ixx=totals[0], Iyy=totals[1], Izz=totals[2])
        # The keys are in the order of the fields.
        lines = zip(LoadSection.model_fields, fields(load), strict=True)
        held = [_Line(key, getattr(stated, one.name), (f"load.{one.name}",)) for key, one in lines]
        sections.append(("[load]", "load", held))
    return sections + _ambient(rig.ambient) + _tolerances(rig)
