"""Effects that a drive or oscillator model may lack: forces of the motion, inner dynamics, path from force to mass."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from avis_ctrl.gap.axis.model import Effect, Parameter
from avis_ctrl.gap.axis.records import Lines, Motion, Shape, splines

SLOW = "slow motion at several constant speeds"
SWEEP = "a sine swept slowly up and down at several levels"
DECAY = "free decays from several amplitudes"
AT_REST = "the force at rest in several positions"
FASTER = "faster motion: the phase of a delay stays proportional to frequency, that of a lag bends"
RELEASED = "the force at rest, released and unloaded: a constant force stays, friction does not"


@dataclass(frozen=True)
class Scale:
    """Scales of the data that the library needs: travel, largest speed, displacement and force, band of the lines [Hz],
    spatial frequencies at which a force may be periodic [1/{x}], and the travel from which a position may be an
    angle."""

    travel: float
    speed: float
    reach: float
    force: float
    low_Hz: float
    high_Hz: float
    pitches: tuple[float, ...] = ()
    least_angle: float = 1.0

    @staticmethod
    def of(lines: Lines, pitches: bool) -> Scale:
        """Scales of the records; pitches : whether to search for spatial frequencies."""

        def most(value: Callable[[Motion], float]) -> float:
            return max(float(value(m)) for m in lines.motion)

        high = float(lines.s.imag.max()) / (2 * np.pi)
        return Scale(
            most(lambda m: np.ptp(m.q)),
            most(lambda m: np.max(np.abs(m.v))),
            most(lambda m: np.max(np.abs(m.q))),
            most(lambda m: np.max(np.abs(m.u))),
            max(float(lines.s.imag.min()) / (2 * np.pi), high / 100),
            high,
            tuple(_pitches(lines)) if pitches else (),
            lines.settings.least_angle,
        )


def _force(
    name: str,
    title: str,
    separated_by: str,
    *columns: tuple[str, str, Shape],
    low: float = -np.inf,
    location: str = "",
    law: str = "",
    variable: str = "",
    shaped_by: Parameter | None = None,
    seeds: Sequence[float] | np.ndarray = (),
) -> Effect:
    """A force that is linear in all parameters except an optional one that shapes it, which has its own seeds."""
    linear = tuple(Parameter(symbol, unit, low) for symbol, unit, _ in columns)
    return Effect(
        name,
        location,
        title,
        linear if shaped_by is None else (*linear, shaped_by),
        separated_by,
        tuple(shape for *_, shape in columns),
        law=law,
        variable=variable,
        seeds=tuple((*(0.0,) * len(columns), seed) for seed in seeds),
    )


def _shape(name: str, unit: str, top: float, least: float = 1e-4, **more: float) -> Parameter:
    return Parameter(name, unit, least * top, top, linear=False, **more)


def _falling(top: float, count: int = 6) -> np.ndarray:
    return top * 2.0 ** -np.arange(1, count + 1)


def _attached(s: np.ndarray, p: np.ndarray) -> np.ndarray:
    """A sprung mass adds m s^2 (2 zeta w s + w^2)/(s^2 + 2 zeta w s + w^2) (Den Hartog, 1956)."""
    w = 2 * np.pi * p[1]
    inner = 2 * p[2] * w * s + w**2
    return p[0] * s**2 * inner / (s**2 + inner)


def _of_direction(
    scale: Scale, make: Callable[..., Effect], symbol: str, force: Callable[[np.ndarray], np.ndarray]
) -> list[Effect]:
    """A friction as function of the direction of motion, 1 or -1; rounded, for slow motion through rest, where no real
    friction jumps. make : the effect without its force."""
    speed, seeds = _shape("v_rounded", "{x}/s", scale.speed), _falling(scale.speed, 10)[1::2]
    rounded = (symbol, "{F}", lambda m, speed: force(np.tanh(m.v / speed)))
    return [make((symbol, "{F}", lambda m: force(m.sign))), make(rounded, law="rounded", shaped_by=speed, seeds=seeds)]


def _coulomb(scale: Scale, title: str, separated_by: str, location: str) -> list[Effect]:
    make = partial(_force, "coulomb_friction", title, separated_by, low=0.0, location=location, variable="velocity")
    return _of_direction(scale, make, "Fc", lambda direction: direction)


def _delay(s: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.exp(-s * p[0])


def _lag(s: np.ndarray, p: np.ndarray) -> np.ndarray:
    return 1 / (1 + s * p[0])


def _path(scale: Scale, location: str) -> list[Effect]:
    longest = 16 / scale.high_Hz
    return [
        Effect(
            "delay",
            location,
            "a pure delay between force and motion",
            (Parameter("delay_s", "s", -longest, longest),),
            FASTER,
            path=_delay,
        ),
        Effect(
            "actuator_lag",
            location,
            "a first-order lag of the actuator",
            (Parameter("time_constant_s", "s", 0.0, longest),),
            FASTER,
            path=_lag,
        ),
    ]


def _attached_to(scale: Scale, name: str, title: str, location: str) -> Effect:
    low, high = scale.low_Hz, scale.high_Hz
    seeds = tuple((0.0, f, 0.03) for f in np.geomspace(low * 1.05, high / 1.05, 24))
    return Effect(
        name,
        location,
        title,
        (
            Parameter("mass", "{F} s^2/{x}", 0.0),
            Parameter("frequency_Hz", "Hz", low / 2, 2 * high, linear=False),
            Parameter("damping", "1", 1e-4, 1.0, linear=False),
        ),
        "a finer resolution about the second resonance",
        dynamics=_attached,
        seeds=seeds,
    )


def _free(name: str, title: str, shapes: Sequence[Shape], variable: str = "") -> Effect:
    return Effect(
        name,
        "input" if variable == "input" else "unnamed",
        title,
        tuple(Parameter(f"c{k}", "{F}") for k in range(len(shapes))),
        shapes=tuple(shapes),
        outside=True,
        variable=variable,
    )


def _once(make: Callable[[Motion], list[np.ndarray]], count: int) -> list[Shape]:
    """Shapes of a function that computes all of them at once."""
    kept: dict[int, tuple[Motion, list[np.ndarray]]] = {}

    def one(k: int, m: Motion) -> np.ndarray:
        if id(m) not in kept:
            kept[id(m)] = m, make(m)
        return kept[id(m)][1][k]

    return [partial(one, k) for k in range(count)]


def unnamed_forces(lines: Lines) -> list[Effect]:
    """Free functions of the motion and, for an oscillator, of its input."""
    count = lines.settings.bumps
    # Common knots for all records, so that a shape is the same function in each.
    q, v, u = (np.concatenate([getattr(m, name) for m in lines.motion]) for name in ("q", "v", "u"))
    knots_q, knots_v, knots_u = (np.quantile(x, np.linspace(0, 1, 4096)) for x in (q, np.abs(v), u))

    def position(m: Motion) -> list[np.ndarray]:
        return _spline(m.q, knots_q, count)

    def velocity(m: Motion) -> list[np.ndarray]:
        half = _spline(np.abs(m.v), knots_v, count // 2)
        return [one * side for one in half for side in (m.v > 0, m.v < 0)]

    def force(m: Motion) -> list[np.ndarray]:
        return _spline(m.u, knots_u, count)

    powers = [(i, j) for i in range(5) for j in range(5) if i + j in (2, 3, 4, 5) and i * j]

    def both(m: Motion) -> list[np.ndarray]:
        x, w = (m.q - m.middle) / m.size, m.v / m.speed
        return [x**i * w**j for i, j in powers]

    found = [
        _free(
            "function_of_position",
            "a force that is another function of the position",
            _once(position, count),
            "position",
        ),
        _free(
            "function_of_velocity",
            "a force that is another function of the velocity",
            _once(velocity, count // 2 * 2),
            "velocity",
        ),
        _free("function_of_both", "a force of position and velocity together", _once(both, len(powers))),
    ]
    if lines.solves_for == "position":
        found.append(
            _free(
                "function_of_input",
                "a drive whose force is another function of its command",
                _once(force, count),
                "input",
            )
        )
    return found


def _spline(x: np.ndarray, knots: np.ndarray, count: int) -> list[np.ndarray]:
    table = splines(knots, count)
    return [np.interp(x, knots, one) for one in table]


def drive_effects(scale: Scale) -> list[Effect]:
    """Library of effects for a drive."""
    at = partial(_force, location="drive")
    spring, friction = partial(at, variable="position"), partial(at, low=0.0, variable="velocity")
    found = [
        *_coulomb(scale, "Coulomb friction, a force of constant size against the motion", SLOW, "drive"),
        at(
            "force_offset",
            "a constant force (weight on an inclined axis, or an offset of the current sensor)",
            RELEASED,
            ("offset", "{F}", lambda m: np.ones_like(m.v)),
        ),
        *_of_direction(
            scale,
            partial(at, "coulomb_asymmetry", "Coulomb friction that differs between the two directions", RELEASED),
            "Fc_ahead_less_back",
            lambda direction: np.abs(direction) / 2,
        ),
        at(
            "viscous_asymmetry",
            "viscous friction that differs between the two directions",
            "several constant speeds in each direction",
            ("Fv_ahead_less_back", "{F} s/{x}", lambda m: np.abs(m.v) / 2),
        ),
        friction(
            "quadratic_drag",
            "a drag that grows with the square of the speed",
            "several constant speeds",
            ("c2", "{F} s^2/{x}^2", lambda m: np.abs(m.v) * m.v),
        ),
        spring(
            "stiffness",
            "a spring to the ground (a cable, a hose)",
            AT_REST,
            ("k", "{F}/{x}", lambda m: m.q),
            ("force_at_zero", "{F}", lambda m: np.ones_like(m.q)),
        ),
        spring(
            "cubic_stiffness",
            "a spring that stiffens with the cube of the displacement from mid travel",
            AT_REST,
            ("k3", "{F}/{x}^3", lambda m: (m.q - m.middle) ** 3),
        ),
        friction(
            "stribeck_friction",
            "Stribeck friction, which falls as the drive starts to move",
            SLOW,
            ("Fs", "{F}", lambda m, speed: m.sign * np.exp(-((m.v / speed) ** 2))),
            shaped_by=_shape("v_s", "{x}/s", scale.speed / 2),
            seeds=_falling(scale.speed)[1:],
        ),
        at(
            "presliding",
            "presliding, friction that is a spring before it slips",
            "very small slow motion about one position",
            ("Fc_presliding", "{F}", lambda m, distance: m.dahl(distance) - m.sign),
            low=0.0,
            shaped_by=_shape("distance", "{x}", scale.travel / 4, 1e-6),
            seeds=scale.travel * 4.0 ** -np.arange(3, 8),
        ),
        *_stops(scale.travel / 2, "drive", lambda m: m.q - m.middle),
    ]
    if scale.travel >= scale.least_angle:
        found.append(
            at(
                "gravity",
                "gravity on a turning load, m g r sin(angle)",
                AT_REST,
                ("sine", "{F}", lambda m: np.sin(m.q)),
                ("cosine", "{F}", lambda m: np.cos(m.q)),
                variable="position",
            )
        )
    if scale.pitches:
        top = 100 / scale.travel
        found.append(
            at(
                "cogging",
                "a force that is periodic in the position (cogging, pitch of a screw)",
                "slow motion over the whole travel",
                ("sine", "{F}", partial(_wave, np.sin)),
                ("cosine", "{F}", partial(_wave, np.cos)),
                variable="position",
                # A derivative step of at most a thousandth of a period over the whole travel.
                shaped_by=_shape("periods", "1/{x}", top, 0.01, step=1e-5),
                seeds=scale.pitches,
            )
        )
    return [
        *found,
        *_path(scale, "drive"),
        _attached_to(scale, "two_mass_flexibility", "a second mass behind a flexible coupling", "drive"),
    ]


def _stops(reach: float, location: str, place: Shape) -> list[Effect]:
    """Springs that engage beyond a gap: on both sides, above, below."""

    def below(m: Motion, gap: float) -> np.ndarray:
        return np.minimum(place(m) + gap, 0.0)

    def above(m: Motion, gap: float) -> np.ndarray:
        return np.maximum(place(m) - gap, 0.0)

    def both(m: Motion, gap: float) -> np.ndarray:
        return below(m, gap) + above(m, gap)

    gap = _shape("gap", "{x}", reach, 0.01)
    return [
        _force(
            "end_stops",
            "end stops, a spring that begins behind a gap",
            "slow motion over the whole travel",
            ("k_stop", "{F}/{x}", shape),
            low=0.0,
            location=location,
            law=law,
            variable="position",
            shaped_by=gap,
            seeds=reach * np.linspace(0.15, 0.85, 5),
        )
        for law, shape in (("", both), ("above", above), ("below", below))
    ]


def _wave(function: Callable[[np.ndarray], np.ndarray], m: Motion, n: float) -> np.ndarray:
    return function(2 * np.pi * n * m.q)


def _pitches(lines: Lines, few: int = 2) -> list[float]:
    """Spatial frequencies [1/{x}] at which the residual of friction and inertia is strongest, from the time domain."""
    m, one = lines.motion[0], lines.records[0]
    step = lines.over * max(1, len(one.force) // 20_000)
    q, v = m.q[::step], m.v[::step]
    X = np.column_stack([np.ones_like(q), v, np.sign(v), np.gradient(v), q - m.middle])
    residual = m.u[::step] - X @ np.linalg.lstsq(X, m.u[::step], rcond=None)[0]
    tried = np.arange(2.0, 100.0, 0.25) / float(np.ptp(q))
    power = np.array([abs(np.sum(residual * np.exp(-2j * np.pi * n * q))) for n in tried])
    peaks = [k for k in np.argsort(-power) if power[k] == power[max(k - 3, 0) : k + 4].max()]
    return [float(tried[k]) for k in peaks[:few]]


def oscillator_effects(scale: Scale) -> list[Effect]:
    """Library of effects for an oscillator."""
    at, drive = partial(_force, location="oscillator"), partial(_force, location="input", variable="input")
    spring, damping = partial(at, variable="position"), partial(at, low=0.0, variable="velocity")
    far = "the response far above the resonance at several levels"
    level = _shape("level", "{F}", scale.force, 0.01)
    found = [
        spring(
            "cubic_stiffness", "cubic stiffness, a restoring force k3 y^3", SWEEP, ("k3", "{F}/{x}^3", lambda m: m.q**3)
        ),
        spring(
            "quadratic_stiffness",
            "quadratic stiffness, a restoring force k2 y^2",
            "the mean displacement under a sine at several levels",
            ("k2", "{F}/{x}^2", lambda m: m.q**2),
        ),
        *_stops(scale.reach, "oscillator", lambda m: m.q),
        damping(
            "quadratic_damping",
            "quadratic damping, a force d2 |y'| y'",
            DECAY,
            ("d2", "{F} s^2/{x}^2", lambda m: np.abs(m.v) * m.v),
        ),
        damping("cubic_damping", "cubic damping, a force d3 y'^3", DECAY, ("d3", "{F} s^3/{x}^3", lambda m: m.v**3)),
        *_coulomb(scale, "friction damping, a force of constant size against the motion", DECAY, "oscillator"),
        at(
            "position_damping",
            "damping that grows with the square of the position, a force c y^2 y'",
            DECAY,
            ("c", "{F} s/{x}^3", lambda m: m.q**2 * m.v),
            low=0.0,
        ),
        drive(
            "input_nonlinearity",
            "a drive whose gain changes with its level, u + g u^3",
            far,
            ("g", "1/{F}^2", lambda m: -(m.u**3)),
        ),
        drive(
            "input_nonlinearity_even",
            "a drive whose gain differs between the two directions, u + g u^2",
            far,
            ("g", "1/{F}", lambda m: -(m.u**2)),
        ),
        drive(
            "input_saturation",
            "a drive that saturates",
            far,
            ("gain_lost", "1", lambda m, level: m.u - level * np.tanh(m.u / level)),
            low=0.0,
            shaped_by=level,
            seeds=_falling(scale.force, 4),
        ),
        drive(
            "input_dead_zone",
            "a drive with a dead zone (play, crossover)",
            far,
            ("gain_lost", "1", lambda m, level: level * np.tanh(m.u / level)),
            low=0.0,
            shaped_by=level,
            seeds=_falling(scale.force),
        ),
        at(
            "hysteresis",
            "hysteresis, joints that stick at small amplitude and slip at large",
            DECAY,
            ("F_slip", "{F}", Motion.dahl),
            low=0.0,
            shaped_by=_shape("distance", "{x}", 4 * scale.reach, 1e-3),
            seeds=2 * _falling(scale.reach),
        ),
    ]
    return [
        *found,
        *_path(scale, "input"),
        _attached_to(scale, "attached_oscillator", "a second mode, a sprung mass on the oscillator", "oscillator"),
    ]
