"""What a real table differs in everywhere: tolerances of what its rig file says, and traces of effects always there.

A trace is sized by what it leaves unexplained: of the change that it makes in the response, the part that no small
change of mass, inertia, stiffness and damping takes away, over the response, both r.m.s. (mean square over channels,
each in units of its own r.m.s.). The other part is taken from mass, inertia, stiffness and damping when the trace is
added, so that the table without its traces is the best model of it that knows nothing of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from avis_ctrl.rigs import IsolatorTable

from .effect import Draw, Effect, Hidden
from .library_mechanics import about_one
from .signals import multisine
from .table import Plant

# One standard deviation each, where the rig file says nothing (the contract's section "Tolerances").
DEFAULTS = {
    "place_m": 0.001,
    "direction_rad": 0.005,
    "actuator_gain_percent": 1.0,
    "sensor_gain_percent": 1.0,
    "sensor_corner_percent": 1.0,
    "sensor_damping_percent": 3.0,
    "centre_of_mass_m": 0.001,
    "product_of_inertia_kgm2": 0.2,
}
UNEXPLAINED = 0.003, 0.01  # by all traces together
PILOT_S = 16.0  # at each level


def tolerances(rig: IsolatorTable) -> dict[str, float]:
    """Of the rig file, or the defaults; per cent as parts of one under the same names."""
    own = {name: float(getattr(rig.tolerances, name, default)) for name, default in DEFAULTS.items()}
    return {name: value / 100 if name.endswith("percent") else value for name, value in own.items()}


def turned(axes: np.ndarray, angle_rad: float, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) unit vectors, each turned about both of its normals by normal angles of that standard deviation."""
    out = []
    for axis in axes:
        first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        first /= np.linalg.norm(first)
        a, b = np.tan(angle_rad * rng.standard_normal(2))
        off = axis + a * first + b * np.cross(axis, first)
        out.append(off / np.linalg.norm(off))
    return np.array(out)


def disturb(plant: Plant, limits: dict[str, float], rng: np.random.Generator) -> None:
    """Draw all that the rig file states within its tolerance; both ends of a mount have errors of their own."""

    def errors(name: str, *shape: int) -> np.ndarray:
        return limits[name] * rng.standard_normal(shape)

    for name in ("points", "chassis_points", "motor_p", "sensor_p"):
        places = getattr(plant, name)
        setattr(plant, name, places + errors("place_m", *places.shape))
    plant.motor_d, plant.sensor_n = (
        turned(axes, limits["direction_rad"], rng) for axes in (plant.motor_d, plant.sensor_n)
    )
    plant.motor = plant.motor * (1 + errors("actuator_gain_percent", 8))
    plant.S = plant.S * (1 + errors("sensor_gain_percent", 6))
    plant.wn = plant.wn * (1 + errors("sensor_corner_percent", 6))
    plant.zn = plant.zn * (1 + errors("sensor_damping_percent", 6))
    plant.com = plant.com + errors("centre_of_mass_m", 3)
    for (a, b), product in zip(((0, 1), (0, 2), (1, 2)), errors("product_of_inertia_kgm2", 3), strict=True):
        plant.J[a, b] = plant.J[b, a] = plant.J[a, b] + product


def far(before: Plant, after: Plant, limits: dict[str, float], times: float) -> list[tuple[str, str]]:
    """(effect, place) of every value that differs by more than so many tolerances: a table drawn within tolerances has
    some of them, and to name one is not wrong."""

    def relative(name: str) -> np.ndarray:
        return np.abs(getattr(after, name) / getattr(before, name) - 1)

    angle = np.arccos(np.clip(np.sum(after.sensor_n * before.sensor_n, axis=1), -1, 1))
    corner = np.maximum(
        relative("wn") / limits["sensor_corner_percent"], relative("zn") / limits["sensor_damping_percent"]
    )
    by_place = {
        "sensor_gain": (after.sensors, relative("S") / limits["sensor_gain_percent"]),
        "geophone_corner": (after.sensors, corner),
        "sensor_misalignment": (after.sensors, angle / limits["direction_rad"]),
        "actuator_gain": (after.motors, relative("motor") / limits["actuator_gain_percent"]),
        "product_of_inertia": (
            ("Jxy", "Jxz", "Jyz"),
            np.abs(after.J - before.J)[[0, 0, 1], [1, 2, 2]] / limits["product_of_inertia_kgm2"],
        ),
        "com_offset": (("payload",), [np.max(np.abs(after.com - before.com)) / limits["centre_of_mass_m"]]),
    }
    return [
        (effect, place)
        for effect, (places, tolerances) in by_place.items()
        for place, away in zip(places, tolerances, strict=True)
        if away > times
    ]


class Pilot:
    """The response of a table to a short record at three levels, and what refitting the table could change in it.

    build : () -> the table, without traces and hidden effects. run : (plant, u) -> sensor voltages.
    """

    def __init__(
        self,
        build: Callable[[], Plant],
        run: Callable[[Plant, np.ndarray], np.ndarray],
        band_Hz: tuple[float, float],
        levels_V: tuple[float, ...],
        rng: np.random.Generator,
    ):
        self.build, self.run = build, run
        rate, ordered = build().rig.sample_rate_Hz, sorted(levels_V)
        n = round(PILOT_S * rate)
        self.levels = np.array([ordered[i] for i in (0, len(ordered) // 2, -1)])
        self.u = multisine(rng, n, 8, n, band_Hz, rate, 1.0)
        self.y = self._responses(build(), self.levels)
        # The table alone is linear in the level, so that one level tells what refitting changes at all of them.
        changes = [
            np.outer(
                self.levels / self.levels[1],
                self._changed(lambda plant, one=one: nudge(plant, one, NUDGE), slice(1, 2)),
            )
            for one in RIGID
        ]
        self.refit, self.size = np.linalg.qr(np.stack(changes, axis=-1).reshape(-1, len(RIGID)))

    def _responses(self, plant: Plant, levels: np.ndarray) -> np.ndarray:
        return np.array([self.run(plant, level * self.u) for level in levels])

    def _changed(self, apply: Callable[[Plant], None], levels: slice) -> np.ndarray:
        """What apply(plant) makes in the response, each channel in units of its r.m.s."""
        plant = self.build()
        apply(plant)
        return (self._responses(plant, self.levels[levels]) - self.y[levels]) / self.y.std(axis=(0, 1))

    def after_refit(self, apply: Callable[[Plant], None]) -> tuple[float, np.ndarray]:
        """The r.m.s. of the part of that change that no refit takes away, and the refit (relative, as RIGID)."""
        change = self._changed(apply, slice(None)).ravel()
        parts = self.refit.T @ change
        return float(np.sqrt(np.mean((change - self.refit @ parts) ** 2))), NUDGE * np.linalg.solve(self.size, parts)


# Mass, moments of inertia, and the 8 stiffnesses and 8 dampings that payload motion tells apart: attribute, index.
RIGID = (
    ("m", ()),
    *(("J", (a, a)) for a in range(3)),
    *((name, at) for name in "kc" for at in ((0, 0), (2, 0), (0, 1), (1, 1), *((i, 2) for i in range(4)))),
)
NUDGE = 1e-3


def nudge(plant: Plant, which: tuple[str, tuple[int, ...]], relative: float) -> None:
    """One of RIGID larger by a relative amount."""
    value = np.array(getattr(plant, which[0]))
    value[which[1]] *= 1 + relative
    setattr(plant, which[0], value if which[1] else float(value))


def add_trace(plant: Plant, trace: Hidden, library: dict[str, Effect]) -> None:
    """The effect, and out of the table what a refit would put it down to."""
    library[trace.name].apply(plant, trace)
    for which, relative in zip(RIGID, trace.details["refit"], strict=True):
        nudge(plant, which, -relative)


def _friction(d: Draw) -> tuple[str, dict[str, float], dict[str, Any]]:
    stiffness = 100.0
    coulomb = stiffness * float(np.mean(d.middle.stretch)) * d.between(0.2, 1.0)
    each = about_one(d.rng.uniform(0.8, 1.2, 8))
    return (
        "actuators",
        {"coulomb_N": coulomb, "stiffness_N_per_m": stiffness},
        {
            "coulomb_each_N": (coulomb * each).tolist(),
            "stiffness_each": (stiffness * each).tolist(),
            "stiction": 1.0,
            "bristle_damping": 0.0,
            "stribeck_m_per_s": 1.0,
        },
    )


def _stiffening(d: Draw) -> tuple[str, dict[str, float], dict[str, Any]]:
    cubic = 0.02 * float(np.mean(d.plant.k[:, 2])) / (3 * float(np.mean(d.high.stretch[:, 2])) ** 2)
    return "isolators z", {"cubic_N_per_m3": cubic}, {"uneven": about_one(d.rng.uniform(0.9, 1.1, 4)).tolist()}


def _hum(d: Draw) -> tuple[str, dict[str, float], dict[str, Any]]:
    harmonics = [1, 2, 3, *(n for n in (5, 7) if d.rng.random() < 0.5)]
    fundamental = d.between(0.3, 1.0, 6)
    largest, fall = 1e-3, [1.0, *d.between(0.05, 0.5, len(harmonics) - 1)]
    return (
        "geophones",
        {"frequency_Hz": float(d.rng.choice([50.0, 60.0]) + d.rng.uniform(-0.1, 0.1)), "amplitude_V": largest},
        {
            "harmonics": harmonics,
            "phases": d.rng.uniform(0, 2 * np.pi, (6, len(harmonics))).tolist(),
            "amplitudes_V": (largest * np.outer(fundamental / fundamental.max(), fall)).tolist(),
        },
    )


def _loss(d: Draw) -> tuple[str, dict[str, float], dict[str, Any]]:
    return "isolators", {"loss_factor": 0.01}, {"viscous_left": 1.0}


# How each trace is drawn at some small size, and the parameters and details that grow with it.
TRACES = {
    "contact_friction": (_friction, ("coulomb_N", "stiffness_N_per_m", "coulomb_each_N", "stiffness_each")),
    "cubic_stiffness": (_stiffening, ("cubic_N_per_m3",)),
    "mains_hum": (_hum, ("amplitude_V", "amplitudes_V")),
    "structural_damping": (_loss, ("loss_factor",)),
}


def scaled(trace: Hidden, factor: float) -> Hidden:
    """With its size times factor."""
    grows = TRACES[trace.name][1]

    def grown(values: dict[str, Any]) -> dict[str, Any]:
        return {key: (factor * np.array(value)).tolist() if key in grows else value for key, value in values.items()}

    return replace(trace, parameters=grown(trace.parameters), details=grown(trace.details))


def draw_traces(d: Draw, pilot: Pilot, library: dict[str, Effect], leave_out: tuple[str, ...]) -> tuple[Hidden, ...]:
    """All traces but those of the names left out; each says in its details what it leaves unexplained."""
    names = [name for name in TRACES if name not in leave_out]
    share = d.rng.uniform(0.3, 1.0, len(names))
    each = d.between(*UNEXPLAINED) * np.sqrt(share / share.sum())
    found = []
    for name, fraction in zip(names, each, strict=True):
        trace = Hidden(name, *(drawn := TRACES[name][0](d))[:2], "trace", drawn[2])
        for _ in range(2):  # nearly linear in its size: the second step is small already
            left, refit = pilot.after_refit(lambda plant, trace=trace: library[trace.name].apply(plant, trace))
            trace = scaled(trace, float(fraction) / left)
        refit *= fraction / left
        found.append(replace(trace, details=trace.details | {"unexplained": float(fraction), "refit": refit.tolist()}))
    return tuple(found)
