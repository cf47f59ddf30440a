"""The tests of Beadle, Hurlebaus, Stoebener and Gaul's parameter identification (section 3, Tables 1 and 2), as data.

A test drives some actuators of the Halcyonics table with one voltage, measures the displacement of one point in one
direction, and yields the parameters named in its row.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.halcyonics import Halcyonics, Load


@dataclass(frozen=True)
class TestCase:
    """A row of Table 1 or 2.

    Attributes
    ----------
    number : of the row; measured transfers go by it.
    plus, minus : actuators (1..8) driven in phase and in antiphase. The source measures the two sets one after the
        other and subtracts the transfer functions, which is the same for a linear table.
    point, direction : measured displacement, such as "M3" and "z" for z_3.
    parameters : that this row names.
    group : tests of one group are fitted together. Table 1 prints k_s and d_3 once beside tests 1-4, k_t and d_1
        once beside tests 8-11, one line of the cell beside each test; each of these four transfers holds them, and
        none of them is named for a single one, so the error of eq. 33 is summed over the four tests of the cell and
        minimised over the cell's six parameters. Empty: a group of its own.
    figure : of the source, where it draws the transfer function.
    """

    __test__: ClassVar[bool] = False  # pytest collects classes named so

    number: int
    plus: tuple[int, ...]
    minus: tuple[int, ...]
    point: str
    direction: str
    parameters: tuple[str, ...]
    group: str = ""
    figure: int | None = None

    def __post_init__(self) -> None:
        driven = (*self.plus, *self.minus)
        if not self.plus or len(set(driven)) != len(driven) or not set(driven) <= set(range(1, 9)):
            raise InputError(
                "expected different actuators out of 1..8, at least one in phase",
                field=f"test {self.number}: plus, minus",
                value=(self.plus, self.minus),
            )
        if self.direction not in ("x", "y", "z"):
            raise InputError("expected x, y or z", field=f"test {self.number}: direction", value=self.direction)
        if not self.parameters:
            raise InputError("expected at least one parameter", field=f"test {self.number}: parameters")

    @property
    def pattern(self) -> np.ndarray:
        """(8,) actuation vector A of eq. 26, with signs."""
        return _pattern(self.plus) - _pattern(self.minus)

    @property
    def drive_cases(self) -> tuple[tuple[float, np.ndarray], ...]:
        """Sign and 0/1 pattern (8,) of each run that is measured."""
        return tuple((sign, _pattern(driven)) for sign, driven in ((1.0, self.plus), (-1.0, self.minus)) if driven)

    @property
    def reference(self) -> int:
        """Actuator r of eq. 32, whose force the drawn transfer function is divided by: the first in the row."""
        return self.plus[0]

    @property
    def actuators(self) -> str:
        plus, minus = ("+".join(f"A{k}" for k in driven) for driven in (self.plus, self.minus))
        return f"({plus})-({minus})" if minus else plus

    @property
    def displacement(self) -> str:
        """Such as "z_3"."""
        return f"{self.direction}_{self.point.removeprefix('M')}"


def _pattern(driven: Iterable[int]) -> np.ndarray:
    pattern = np.zeros(8)
    pattern[[k - 1 for k in driven]] = 1.0
    return pattern


UNLOADED_TESTS = (
    TestCase(1, (1,), (), "M1", "z", ("e1",), "vertical"),
    TestCase(2, (2,), (), "M1", "z", ("e2", "k_s"), "vertical"),
    TestCase(3, (3,), (), "M1", "z", ("e3", "d3"), "vertical"),
    TestCase(4, (4,), (), "M1", "z", ("e4",), "vertical"),
    TestCase(5, (1, 2), (3, 4), "M3", "z", ("Ixx", "d4")),
    TestCase(6, (1, 4), (2, 3), "M2", "z", ("Iyy", "d5")),
    TestCase(7, (1, 4), (2, 3), "M1", "x", ("L6",)),
    TestCase(8, (5,), (), "M1", "x", ("e5",), "horizontal"),
    TestCase(9, (6,), (), "M1", "x", ("e6", "k_t"), "horizontal"),
    # Printed d_7; eq. 17 has no such entry: the horizontal damping d_1.
    TestCase(10, (7,), (), "M1", "x", ("e7", "d1"), "horizontal"),
    TestCase(11, (8,), (), "M1", "x", ("e8",), "horizontal"),
    TestCase(12, (5, 7), (), "M3", "x", ("Izz", "k_r", "d6")),
)

LOADED_TESTS = (
    TestCase(1, (1, 3), (), "M2", "z", ("L7",)),
    TestCase(2, (1, 3), (), "M3", "z", ("L8",)),
    TestCase(3, (1, 2, 3, 4), (), "M1", "z", ("k_s",), figure=8),
    TestCase(4, (1, 2), (3, 4), "M3", "z", ("Ixx_total",), figure=9),
    TestCase(5, (1, 4), (2, 3), "M2", "z", ("Iyy_total",), figure=10),
    TestCase(6, (1, 2), (), "M2", "z", ("Ixy_load",), figure=11),
    TestCase(7, (5, 7), (), "M3", "x", ("Izz_total", "k_r"), figure=12),
    TestCase(8, (5, 8), (), "M1", "x", ("k_t", "L9"), figure=13),
)

# Table 2 as printed: the start, and what the source found on its hardware after four iterations.
LOADED_START = {
    "L7": 0.0,
    "L8": 0.0,
    "k_s": 11300.0,
    "Ixx_total": 0.340,
    "Iyy_total": 0.259,
    "Ixy_load": 0.0,
    "Izz_total": 0.500,
    "k_r": 1590.0,
    "k_t": 37600.0,
    "L9": 0.08,
}
LOADED_SOURCE_FINAL = {
    "L7": -0.064,
    "L8": 0.048,
    "k_s": 12100.0,
    "Ixx_total": 0.433,
    "Iyy_total": 0.278,
    "Ixy_load": 0.092,
    "Izz_total": 0.752,
    "k_r": 1660.0,
    "k_t": 33300.0,
    "L9": 0.117,
}
SOURCE_ITERATIONS = 4

# Parameters of Table 2 that are not parameters of the rig by the same name. The totals are plate plus the load's own
# moment about its own centre of mass, without the terms m_e L^2 of eq. 16 (see `Load`).
_OF_LOAD = {
    "L7": "load.L7",
    "L8": "load.L8",
    "L9": "load.L9",
    "Ixy_load": "load.Ixy",
    "Ixx_total": "load.Ixx",
    "Iyy_total": "load.Iyy",
    "Izz_total": "load.Izz",
}
_PLATE = {"Ixx_total": "Ixx", "Iyy_total": "Iyy", "Izz_total": "Izz"}
# Parameters that may vanish or be negative, with the size below which a change counts for nothing.
SIGNED = {"L7": 1e-3, "L8": 1e-3, "L9": 1e-3, "L6": 1e-3, "Ixy_load": 1e-3}


def values_of(rig: Halcyonics, names: Sequence[str]) -> np.ndarray:
    """(len(names),) parameters of the tables, SI."""
    known = rig.parameters()
    found = []
    for name in names:
        own = _rig_name(rig, name)
        if own not in known:
            raise InputError("a parameter of the rig or of Table 2", field="parameter", value=name)
        found.append(known[own].value + (known[_PLATE[name]].value if name in _PLATE else 0.0))
    return np.array(found)


def with_values(rig: Halcyonics, values: Mapping[str, float]) -> Halcyonics:
    """The rig with parameters of the tables changed; totals change the load, not the plate.

    Raises InputError for an unknown name and where no positive definite mass matrix is left.
    """
    changes = {}
    for name, value in values.items():
        plate = values.get(_PLATE[name], getattr(rig, _PLATE[name])) if name in _PLATE else 0.0
        changes[_rig_name(rig, name)] = value - plate
    return rig.with_parameters(changes)


def unit_of(rig: Halcyonics, name: str) -> str:
    return rig.parameters()[_rig_name(rig, name)].unit


def _rig_name(rig: Halcyonics, name: str) -> str:
    own = _OF_LOAD.get(name, name)
    if own.startswith("load.") and rig.load is None:
        raise InputError(
            "this parameter belongs to a load and the rig carries none; start from loaded_start()",
            field="parameter",
            value=name,
        )
    return own


def place_of(rig: Halcyonics, test: TestCase) -> np.ndarray:
    """(3,) m, the measured point from the plate's centre of mass."""
    points = rig.points()
    if test.point not in points:
        raise InputError(f"expected one of {sorted(points)}", field=f"test {test.number}: point", value=test.point)
    return points[test.point].position


def parameters_of(tests: Sequence[TestCase]) -> tuple[str, ...]:
    """Parameters in the order of the rows."""
    names = [name for test in tests for name in test.parameters]
    if len(set(names)) != len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise InputError("each parameter in one test", field="tests", value=twice)
    return tuple(names)


def loaded_start(unloaded: Halcyonics, load_mass: float, L9: float = LOADED_START["L9"]) -> Halcyonics:
    """The identified bare table under a load of known mass [kg] of which nothing else is known, as in Table 2.

    L7 = L8 = Ixy = 0, the totals and the stiffnesses those of the bare table. With load_mass 0 the load could not be
    seen: InputError.
    """
    if not (np.isfinite(load_mass) and load_mass > 0):
        raise InputError("expected the load's mass in kg", field="load_mass", value=load_mass)
    return replace(unloaded, load=Load(load_mass, 0.0, 0.0, L9, 0.0, 0.0, 0.0))


def perturbed_start(
    rig: Halcyonics, tests: Sequence[TestCase], seed: int | np.random.Generator, least: float = 0.2, most: float = 0.3
) -> Halcyonics:
    """The rig with every parameter of the tests off by 20-30 %, up or down at random.

    The source does not print where its unloaded identification started; this start is ours.
    """
    rng = np.random.default_rng(seed)
    names = parameters_of(tests)
    off = rng.choice([-1.0, 1.0], len(names)) * rng.uniform(least, most, len(names))
    return with_values(rig, dict(zip(names, values_of(rig, names) * (1 + off), strict=True)))
