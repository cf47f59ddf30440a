"""Laws of the library's effects in a cluttered table: richer than the one simplest law of a clean case.

An effect is drawn as in a clean case; one of its variants then changes the parameters p and details x in place. What
stays in p is an effective value: the mean over mounts or channels, or the equivalent that the variant states. Where an
effect has one variant, mechanics leaves no other law.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from .effect import Draw
from .library_mechanics import about_one
from .library_signals import soft_limit

Parameters, Details = dict[str, float], dict[str, Any]
Variant = Callable[[Draw, Parameters, Details], None]


def uneven(d: Draw, spread: float, count: int) -> list[float]:
    return about_one(d.rng.uniform(1 - spread, 1 + spread, count)).tolist()


def one_law(d: Draw, p: Parameters, x: Details) -> None:
    """As in a clean case."""


# --- sensors and converter


def softer_spring(d: Draw, p: Parameters, x: Details) -> None:
    """Same damper and coil mass: the damping ratio falls as the corner rises."""
    g = d.plant.rig.geophones
    x["damping_ratio"] = g.suspension_damping * g.suspension_Hz / p["corner_Hz"]


def other_coil_mass(d: Draw, p: Parameters, x: Details) -> None:
    """Same damper and spring: corner and damping ratio rise together as the mass falls."""
    g = d.plant.rig.geophones
    x["damping_ratio"] = g.suspension_damping * p["corner_Hz"] / g.suspension_Hz


def drifting(d: Draw, p: Parameters, x: Details) -> None:
    """The gain drifts over the campaign, about its mean, by up to a quarter of its departure."""
    x.update(drift=float((p["gain"] - 1) * d.rng.uniform(-0.25, 0.25)), span_s=d.span_s)


def weaker_magnet(d: Draw, p: Parameters, x: Details) -> None:
    """Of the damping, 20 to 60 % come from the coil's own current and go with the square of the gain."""
    x["electric_damping"] = float(d.rng.uniform(0.2, 0.6))


def turned_about_its_foot(d: Draw, p: Parameters, x: Details) -> None:
    """The coil sits 2 to 6 cm above the foot about which the sensor is tilted."""
    x["foot_m"] = float(d.rng.uniform(0.02, 0.06))


def local_gravity(d: Draw, p: Parameters, x: Details) -> None:
    """Between the equator and the poles."""
    p["gravity_m_per_s2"] = float(d.rng.uniform(9.78, 9.83))


def side_bands(d: Draw, p: Parameters, x: Details) -> None:
    """The amplitude swings with a load."""
    x.update(swing=float(d.rng.uniform(0.05, 0.3)), swing_Hz=d.between(0.05, 2.0))


def wandering(d: Draw, p: Parameters, x: Details) -> None:
    """The frequency swings by 1 to 10 mHz within a minute or so."""
    f = d.between(0.01, 0.05)
    x.update(wander_Hz=f, wander_rad=d.between(1e-3, 1e-2) / f)


def other_codes(d: Draw, p: Parameters, x: Details) -> None:
    """A coarse step has no code for zero; a short range has uneven ends (the mean is reported)."""
    x.update({"mid_riser": True} if "step_V" in p else {"uneven_rails": float(d.rng.uniform(-0.08, 0.08))})


# --- drives


def each_its_own_corner(d: Draw, p: Parameters, x: Details) -> None:
    """Corners about the effective one, which gives the mean delay of all channels at low frequency."""
    x["uneven"] = (1 / np.array(uneven(d, 0.2, 8))).tolist()


def second_order(d: Draw, p: Parameters, x: Details) -> None:
    """Two poles in each amplifier, not quite the same in all; the effective corner gives the mean delay of all channels
    at low frequency."""
    share = d.rng.uniform(0.55, 0.85) + d.rng.uniform(-0.04, 0.04, 8)  # of the delay, in the slower pole
    x.update(
        poles=[(1 / share).tolist(), (1 / (1 - share)).tolist()], uneven=(1 / np.array(uneven(d, 0.1, 8))).tolist()
    )


def each_its_own_limit(d: Draw, p: Parameters, x: Details) -> None:
    x["uneven"] = uneven(d, 0.08, 8)


def soft_knee(d: Draw, p: Parameters, x: Details) -> None:
    """Effective: the hard limit that leaves least of a Gaussian drive at the highest level."""
    limit, knee = p["limit_V"], float(d.rng.uniform(5.0, 12.0))
    u = d.high.level * norm.ppf((np.arange(4000) + 0.5) / 4000)
    soft = soft_limit(u, limit, knee)
    p["limit_V"] = float(
        minimize_scalar(
            lambda hard: float(np.mean((np.clip(u, -hard, hard) - soft) ** 2)),
            bounds=(0.5 * limit, 1.1 * limit),
            method="bounded",
        ).x
    )
    x.update(asymptote_V=limit, knee=knee)


def jitter(d: Draw, p: Parameters, x: Details) -> None:
    """Each sample is late by its own delay, evenly spread about the mean, within one sample interval."""
    acquisition = d.plant.rig.acquisition
    part = (acquisition.loop_delay_s + p["delay_s"]) * acquisition.sample_rate_Hz % 1.0
    x["jitter_s"] = float(d.rng.uniform(0.3, 0.9)) * min(part, 1 - part) / acquisition.sample_rate_Hz


# --- payload, mounts, chassis


def dahl(d: Draw, p: Parameters, x: Details) -> None:
    x.update(stiction=1.0, bristle_damping=0.0)


def lugre(d: Draw, p: Parameters, x: Details) -> None:
    """With stiction and a damping of the bristles."""
    x.update(stiction=float(d.rng.uniform(1.1, 1.4)), bristle_damping=0.02 * p["stiffness_N_per_m"] / 30)


def jenkins(d: Draw, p: Parameters, x: Details) -> None:
    """Three elements that are elastic until they slip; stiffness and force are those of all together."""
    elements = [about_one(d.rng.uniform(0.3, 1.7, 3)) / 3 for _ in range(2)]
    x.update(stiction=1.0, bristle_damping=0.0, jenkins=True, elements=np.transpose(elements).tolist())


def _modes(d: Draw, p: Parameters, x: Details, ratios: list[float]) -> None:
    """Modes at ratios of the first one's frequency; the first, whose values are reported, has the largest shape."""
    first = np.array(x["shapes"][0])
    shapes, zeta = [first], [p["damping_ratio"]]
    for _ in ratios[1:]:
        other = first * d.rng.permutation([1, 1, -1, -1])[:, None] + 0.2 * np.abs(first).max() * d.rng.standard_normal(
            (4, 3)
        )
        shapes.append(other * d.rng.uniform(0.3, 0.7) * np.linalg.norm(first) / np.linalg.norm(other))
        zeta.append(d.between(0.003, 0.03))
    x.update(
        frequencies_Hz=[p["frequency_Hz"] * ratio for ratio in ratios],
        damping_ratios=zeta,
        shapes=[shape.tolist() for shape in shapes],
    )


def one_mode(d: Draw, p: Parameters, x: Details) -> None:
    _modes(d, p, x, [1.0])


def two_modes(d: Draw, p: Parameters, x: Details) -> None:
    _modes(d, p, x, [1.0, float(d.rng.uniform(1.25, 1.9))])


def two_close_modes(d: Draw, p: Parameters, x: Details) -> None:
    _modes(d, p, x, [1.0, float(d.rng.uniform(1.03, 1.12))])


def _springs(d: Draw, p: Parameters, x: Details, axes: np.ndarray) -> None:
    """One frequency for each axis; the geometric mean is reported."""
    ratios = d.rng.uniform(0.6, 1.7, len(axes))
    ratios /= np.exp(np.mean(np.log(ratios)))
    x.update(axes=axes.tolist(), frequencies_Hz=(p["frequency_Hz"] * ratios).tolist())


def along_an_oblique_line(d: Draw, p: Parameters, x: Details) -> None:
    _springs(d, p, x, d.direction()[None, :])


def along_three_axes(d: Draw, p: Parameters, x: Details) -> None:
    _springs(d, p, x, np.eye(3))


def along_three_oblique_axes(d: Draw, p: Parameters, x: Details) -> None:
    _springs(d, p, x, np.linalg.qr(d.rng.standard_normal((3, 3)))[0])


def vertical_chassis(d: Draw, p: Parameters, x: Details) -> None:
    x.update(dof=3, free=[0, 0, 1, 0, 0, 0])


def rocking_chassis(d: Draw, p: Parameters, x: Details) -> None:
    """Up and down, and about both horizontal axes."""
    x.update(dof=6, height_m=0.0, free=[0, 0, 1, 1, 1, 0])


def translating_chassis(d: Draw, p: Parameters, x: Details) -> None:
    x.update(dof=3, free=[1, 1, 1, 0, 0, 0])


def six_degrees_of_freedom(d: Draw, p: Parameters, x: Details) -> None:
    x.update(dof=6, free=[1] * 6)


def one_branch(d: Draw, p: Parameters, x: Details) -> None:
    x["orifice"] = 0.0


def orifice(d: Draw, p: Parameters, x: Details) -> None:
    """The flow between two chambers also loses with its square."""
    x["orifice"] = d.between(0.02, 0.3)


def two_branches(d: Draw, p: Parameters, x: Details) -> None:
    """Different in each mount; shares add up to the ratio, corners have the effective one as their weighted mean."""
    x["orifice"] = 0.0
    share, apart = d.rng.uniform(0.3, 0.7, 4), d.between(2.0, 8.0)
    size, corner = np.array(uneven(d, 0.25, 4)), np.array(uneven(d, 0.25, 4))
    x.update(
        shares=[(size * share).tolist(), (size * (1 - share)).tolist()],
        corners=[(corner * apart ** -(1 - share)).tolist(), (corner * apart**share).tolist()],
    )


def viscous_left(d: Draw, p: Parameters, x: Details) -> None:
    """Constant, beside the viscous damping."""
    x["viscous_left"] = 1.0


def falling_or_rising(d: Draw, p: Parameters, x: Details) -> None:
    """The loss goes with a small power of the frequency; reported is that of 3 Hz."""
    x["exponent"] = d.sign() * float(d.rng.uniform(0.05, 0.25))


def each_mount_its_own_loss(d: Draw, p: Parameters, x: Details) -> None:
    x["uneven"] = uneven(d, 0.3, 4)


def alike(d: Draw, p: Parameters, x: Details) -> None:
    x["uneven"] = [1.0] * 4


def uneven_masses(d: Draw, p: Parameters, x: Details) -> None:
    x["uneven"] = uneven(d, 0.2, 4)


def off_the_middle(d: Draw, p: Parameters, x: Details) -> None:
    """The mass is not in the middle of the mount; it grows so that the frequency stays."""
    above = d.rng.uniform(0.3, 0.7, 4)
    stiffer = (1 / above + 1 / (1 - above)) / 4
    p["mass_kg"] *= float(np.mean(stiffer))
    x.update(share_above=above.tolist(), uneven=about_one(stiffer).tolist())


def cubic(d: Draw, p: Parameters, x: Details) -> None:
    x["uneven"] = uneven(d, 0.25, 4)


def with_a_quintic(d: Draw, p: Parameters, x: Details) -> None:
    """Statistical linearisation at the highest level gives the effective cubic stiffness: 3 k3 s^2 + 15 k5 s^4.

    The coefficients of the law are told beside it, for a model that has both.
    """
    share, stretch = float(d.rng.uniform(0.15, 0.5)), float(np.mean(d.high.stretch[:, 2]))
    x.update(cubic_left=1 - share, quintic_N_per_m5=share * p["cubic_N_per_m3"] / (5 * stretch**2))
    p.update(k3_beside_k5_N_per_m3=(1 - share) * p["cubic_N_per_m3"], k5_N_per_m5=x["quintic_N_per_m5"])


def a_little_asymmetric(d: Draw, p: Parameters, x: Details) -> None:
    """The quadratic force is 10 to 40 % of the cubic one at the highest level."""
    x["quadratic_N_per_m2"] = (
        d.sign() * float(d.rng.uniform(0.1, 0.4)) * p["cubic_N_per_m3"] * float(np.mean(d.high.stretch[:, 2]))
    )


def in_proportion_to_the_mounts(d: Draw, p: Parameters, x: Details) -> None:
    x["lag_s"] = 0.0


def alike_valves(d: Draw, p: Parameters, x: Details) -> None:
    """The same force per stretch and second in each; reported is the mean rate."""
    k = d.plant.k[:3, 2]
    x.update(lag_s=0.0, uneven=about_one(1 / k).tolist())


def each_valve_its_own(d: Draw, p: Parameters, x: Details) -> None:
    x.update(lag_s=0.0, uneven=uneven(d, 0.3, 3))


def lagging_valves(d: Draw, p: Parameters, x: Details) -> None:
    x["lag_s"] = d.between(0.05, 2.0)


def along_one_line(d: Draw, p: Parameters, x: Details) -> None:
    x.update(axes=[d.direction().tolist()], each=[p["stiffness_N_per_m"]])


def along_all_axes(d: Draw, p: Parameters, x: Details) -> None:
    """Stiffest along its own line, which is reported."""
    own = np.linalg.qr(d.rng.standard_normal((3, 3)))[0]
    x.update(axes=own.tolist(), each=[p["stiffness_N_per_m"] * ratio for ratio in (1.0, *d.rng.uniform(0.1, 0.6, 2))])


def two_cables(d: Draw, p: Parameters, x: Details) -> None:
    """Parallel, 5 to 20 cm apart; reported is the stiffness of both."""
    line, share = d.direction(), float(d.rng.uniform(0.3, 0.7))
    point = np.array(x["point_m"])
    x.update(
        axes=[line.tolist()] * 2,
        each=[p["stiffness_N_per_m"] * part for part in (share, 1 - share)],
        points_m=[point.tolist(), (point + d.direction() * d.rng.uniform(0.05, 0.2)).tolist()],
    )


# --- floor and drift


def alike_in_all_directions(d: Draw, p: Parameters, x: Details) -> None:
    x["uneven"] = [1.0] * 3


def each_direction_its_own(d: Draw, p: Parameters, x: Details) -> None:
    """Reported is the r.m.s. over directions."""
    factor = d.rng.uniform(0.4, 1.6, 3)
    x["uneven"] = (factor / np.sqrt(np.mean(factor**2))).tolist()


def steadily(d: Draw, p: Parameters, x: Details) -> None:
    x["time_constant_s"] = 0.0


def settling(d: Draw, p: Parameters, x: Details) -> None:
    x["time_constant_s"] = d.between(0.2, 1.0) * d.span_s


def with_the_air_conditioning(d: Draw, p: Parameters, x: Details) -> None:
    """A cycle of 10 to 40 minutes beside it, by 5 to 20 % of the change; reported is the steady part."""
    x.update(time_constant_s=0.0, swing=float(d.rng.uniform(0.05, 0.2)), cycle_s=d.between(600.0, 2400.0))


VARIANTS: dict[str, tuple[Variant, ...]] = {
    "geophone_corner": (softer_spring, other_coil_mass),
    "sensor_gain": (one_law, drifting, weaker_magnet),
    "sensor_misalignment": (one_law, turned_about_its_foot),
    "tilt_coupling": (local_gravity,),
    "mains_hum": (one_law, side_bands, wandering),
    "sensor_quantisation": (one_law, other_codes),
    "actuator_gain": (one_law, drifting),
    "actuator_lag": (one_law, each_its_own_corner, second_order),
    "actuator_saturation": (one_law, each_its_own_limit, soft_knee),
    "loop_delay": (one_law, jitter),
    "contact_friction": (dahl, lugre, jenkins),
    "com_offset": (one_law,),
    "product_of_inertia": (one_law,),
    "payload_flexible_mode": (one_mode, two_modes, two_close_modes),
    "attached_oscillator": (along_an_oblique_line, along_three_axes, along_three_oblique_axes),
    "base_compliance": (vertical_chassis, rocking_chassis, translating_chassis, six_degrees_of_freedom),
    "mount_relaxation": (one_branch, orifice, two_branches),
    "structural_damping": (viscous_left, falling_or_rising, each_mount_its_own_loss),
    "mount_surge": (alike, uneven_masses, off_the_middle),
    "cubic_stiffness": (cubic, with_a_quintic, a_little_asymmetric),
    "leveling_loop": (in_proportion_to_the_mounts, alike_valves, each_valve_its_own, lagging_valves),
    "cable_stiffness": (along_one_line, along_all_axes, two_cables),
    "ground_motion": (alike_in_all_directions, each_direction_its_own),
    "stiffness_drift": (steadily, settling, with_the_air_conditioning),
}


def vary(name: str, d: Draw, p: Parameters, x: Details, variant: str | None = None) -> None:
    """Draw one of the effect's variants, or take the one named, and say in the details which; others: no variant."""
    laws = {law.__name__: law for law in VARIANTS.get(name, ())}
    if laws:
        x["variant"] = variant or str(d.rng.choice(list(laws)))
        laws[x["variant"]](d, p, x)
