"""Numbers of a rig file with the units of their keys, and the possible unit errors ("slips")."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from avis_ctrl.rigs.file_errors import dotted
from avis_ctrl.rigs.rigid_body import GRAVITY

G = GRAVITY
INCH = 0.0254
KILO = 1e3
# Unit suffix of a key, with the units used by mistake: (factor to the key's unit, mistaken unit), the most likely
# first. A key without a unit is a ratio.
UNITS: dict[str, tuple[tuple[float, str], ...]] = {
    "_kgm2": (
        (1e-4, "kg cm^2"),
        (1e-6, "kg mm^2"),
        (1e-9, "g mm^2"),
        (1e-7, "g cm^2"),
        (KILO, "t m^2"),
        (1e-3, "g m^2"),
    ),
    "_kg": ((1e-3, "g"), (KILO, "t"), (1e-6, "mg")),
    "_Nm_per_rad": ((KILO, "kN m/rad"), (1e-3, "N mm/rad"), (180 / np.pi, "N m/deg")),
    "_Nms_per_rad": ((KILO, "kN m s/rad"), (1e-3, "N mm s/rad"), (180 / np.pi, "N m s/deg")),
    "_Ns_per_m": ((KILO, "N s/mm"), (1e-3, "mN s/m"), (1e6, "N s/um")),
    "_N_per_m": ((KILO, "N/mm"), (1e-3, "mN/m"), (1e6, "N/um"), (175.127, "lbf/in")),
    "_N_per_V": ((KILO, "kN/V"), (1e-3, "mN/V"), (1e-6, "uN/V")),
    "_rms_m_per_s": ((1e-3, "mm/s"), (1e-6, "um/s"), (1e-9, "nm/s"), (INCH, "in/s")),
    "_m_per_s2_rtHz": ((1e-6 * G, "ug"), (1e-6, "um/s^2"), (1e-3, "mm/s^2"), (1e-9 * G, "ng"), (1e-9, "nm/s^2")),
    "_m_rtHz": ((1e-9, "nm"), (1e-12, "pm"), (1e-6, "um"), (1e-3, "mm")),
    "_Vs2_per_m": ((1e-3 / G, "mV/g"), (1e-3, "mV s^2/m"), (KILO, "V per mm/s^2"), (1 / G, "V/g")),
    "_Vs_per_m": ((KILO, "V per mm/s"), (1e-3, "mV s/m"), (1 / INCH, "V per in/s")),
    "_V_per_m": ((KILO, "V/mm"), (1e-3, "mV/m"), (1e6, "V/um")),
    "_V": ((1e-3, "mV"), (1e-6, "uV"), (KILO, "kV")),
    "_Hz": ((KILO, "kHz"), (1 / (2 * np.pi), "rad/s"), (1e-3, "mHz"), (1e6, "MHz")),
    "_s": ((1e-3, "ms"), (1e-6, "us"), (1e-9, "ns")),
    "_m": ((1e-3, "mm"), (1e-2, "cm"), (INCH, "inches"), (1e-6, "um")),
}
RATIOS = {
    "damping": ((1e-2, "per cent"),),
    "suspension_damping": ((1e-2, "per cent"),),
    "compensated_damping": ((1e-2, "per cent"),),
    "preamplifier_gain": ((1e-3, "a thousand times too large"), (KILO, "a thousand times too small")),
}
# Sections without properties of the table.
APART = ("tolerances",)

Place = tuple[str | int, ...]


@dataclass(frozen=True)
class Entry:
    """One number of a file: its place, key and value."""

    place: Place
    key: str
    value: float


@dataclass(frozen=True)
class UnitError:
    """Numbers that were all given in a unit other than that of their key.

    field, value : as in messages. factor : to the key's unit. unit : in which they were probably given. rank : position
    among the slips of the key, the likeliest first. scope : 0 one number, 1 a list, 2 a key or copies of a list,
    3 a unit in a section or a key in all sections, 4 a unit in the whole file.
    """

    field: str
    value: Any
    entries: tuple[Entry, ...]
    factor: float
    unit: str
    rank: int
    scope: int

    def mended(self, content: dict[str, Any]) -> dict[str, Any]:
        """A copy of the content with the slip corrected."""
        made = copy.deepcopy(content)
        for entry in self.entries:
            *parents, last = entry.place
            target: Any = made
            for part in parents:
                target = target[part]
            target[last] = entry.value * self.factor
        return made

    @property
    def one_of_list(self) -> bool:
        """Whether it changes a single number of a list."""
        return self.scope == 0 and isinstance(self.entries[0].place[-1], int)

    @property
    def words(self) -> str:
        """Such as "given in g" or "a thousand times too large"."""
        return self.unit if self.unit.startswith("a ") else f"given in {self.unit}"

    @property
    def meant(self) -> Any:
        """The value in the key's unit, to five digits."""
        if isinstance(self.value, list):
            return [float(f"{one * self.factor:.5g}") for one in self.value]
        return float(f"{self.value * self.factor:.5g}")


def entries(content: Any, place: Place = (), key: str = "") -> Iterator[Entry]:
    """Every number with a unit and every known ratio, in the order of the file."""
    if isinstance(content, dict):
        for name, part in content.items():
            if name not in APART:
                yield from entries(part, (*place, name), str(name))
    elif isinstance(content, list):
        for k, part in enumerate(content):
            yield from entries(part, (*place, k), key)
    elif isinstance(content, (int, float)) and not isinstance(content, bool) and unit_of(key):
        yield Entry(place, key, float(content))


@cache
def unit_of(key: str) -> str:
    """Unit suffix of a key, or the key itself for a known ratio; empty for neither."""
    if key in RATIOS:
        return key
    return next((ending for ending in UNITS if key.endswith(ending)), "")


def unit_errors(content: dict[str, Any]) -> Iterator[UnitError]:
    """All possible single unit errors: in one number, a list, copies of a list, a key, or a unit in a section or in the
    whole file.

    Single numbers of lists come last.
    """
    found = [entry for entry in entries(content) if entry.value]
    groups: dict[tuple[int, tuple[Any, ...]], list[Entry]] = {}
    for entry in found:
        plain, unit, together = _plain(entry.place), unit_of(entry.key), _list_place(entry.place)
        for scope, name in (
            (0, entry.place),
            (1, together),
            (2, plain),
            (2, (entry.key, str(_at(content, together)))),
            (3, (plain[0], unit)),
            (3, (entry.key,)),
            (4, (unit,)),
        ):
            groups.setdefault((scope, name), []).append(entry)
    seen: set[tuple[Place, ...]] = set()
    listed = {entry.place for entry in found if isinstance(entry.place[-1], int)}
    for (scope, name), members in sorted(groups.items(), key=lambda item: (item[0][1] in listed, item[0][0])):
        places = tuple(entry.place for entry in members)
        if places in seen:
            continue
        seen.add(places)
        ending = unit_of(members[0].key)
        # Copies of a list are named one by one, a key of all sections once.
        fields = [_list_place(place) if scope < 3 and name != _plain(place) else _plain(place) for place in places]
        field = _row(name if scope == 0 else place for place in fields)
        value = float(f"{members[0].value:.6g}") if scope == 0 else _first_value(content, members)
        for rank, (factor, unit) in enumerate(RATIOS.get(ending) or UNITS[ending]):
            yield UnitError(field, value, tuple(members), factor, unit, rank, scope)


def _plain(place: Place) -> Place:
    """The place without numbers of sections and of entries of lists."""
    return tuple(part for part in place if not isinstance(part, int))


def _list_place(place: Place) -> Place:
    """Place of the list to which a number belongs; of the number itself if it is not in a list."""
    return place[:-1] if isinstance(place[-1], int) else place


def _at(content: Any, place: Place) -> Any:
    for part in place:
        content = content[part]
    return content


def _row(places: Iterable[Place]) -> str:
    names = list(dict.fromkeys(dotted(place) for place in places))
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def _first_value(content: dict[str, Any], members: list[Entry]) -> Any:
    """The first list of a group, or its numbers if there is none; a single number if they are all equal."""
    first = _at(content, _list_place(members[0].place))
    if isinstance(first, list) and len({*first, *(entry.value for entry in members)}) > 1:
        return [float(f"{value:.6g}") for value in first]
    of_key = [entry.value for entry in members if _plain(entry.place) == _plain(members[0].place)]
    shown = [float(f"{value:.6g}") for value in of_key[:3]]
    return shown if len(set(of_key)) > 1 else shown[0]


def apart(slip: UnitError, mended: dict[str, Any]) -> float:
    """Mean squared distance, in decades, of the corrected numbers from the median of the others of their kind: of the
    same key anywhere, or of the same unit in the same section.
    """
    there = {entry.place for entry in slip.entries}
    first = slip.entries[0]
    others = [
        abs(entry.value)
        for entry in entries(mended)
        if entry.place not in there
        and entry.value
        and (entry.key == first.key or (entry.place[0], unit_of(entry.key)) == (first.place[0], unit_of(first.key)))
    ]
    if not others:
        return 0.0
    middle = np.median(others)
    return float(np.mean([np.log10(abs(entry.value * slip.factor) / middle) ** 2 for entry in slip.entries]))
