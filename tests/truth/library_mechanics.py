"""Effects of the library in the payload, the mounts, the chassis and at the motors' contact points."""

from __future__ import annotations

from typing import Any

import numpy as np

from .effect import Draw, Effect, Hidden
from .table import Plant

Drawn = tuple[str, dict[str, float], dict[str, Any]]
LADDER_HZ = np.geomspace(0.04, 400.0, 7)  # corners of the Maxwell rungs


def about_one(uneven: np.ndarray) -> np.ndarray:
    """Factors of single mounts with mean one, so that the hidden parameter is the mean that one number can report."""
    return uneven / uneven.mean()


def _contact_friction(d: Draw) -> Drawn:
    stretch = float(np.mean(d.middle.stretch))
    sliding = stretch * d.between(0.1, 1.0)  # displacement after which a contact slips
    stuck = 3.3e4 * d.size(0.001, 0.5)  # N/m, against 2e4-5e4 of a mount
    coulomb = stuck * sliding
    uneven = about_one(d.rng.uniform(0.8, 1.2, 8))
    lugre = d.rng.random() < 0.35
    return (
        "actuators",
        {"coulomb_N": coulomb, "stiffness_N_per_m": stuck},
        {
            "coulomb_each_N": (coulomb * uneven).tolist(),
            "stiffness_each": (stuck * uneven).tolist(),
            "stiction": float(d.rng.uniform(1.0, 1.4)) if lugre else 1.0,
            "bristle_damping": 0.02 * stuck / 30 * lugre,
            "stribeck_m_per_s": float(np.mean(d.middle.speed)) * 0.5,
        },
    )


def _apply_contact_friction(plant: Plant, h: Hidden) -> None:
    # Elements in parallel at each contact, each with its share of the stiffness and of the force.
    stiff, slip = np.array(h.details.get("elements", [[1.0, 1.0]])).T
    Fc = np.outer(slip, h.details["coulomb_each_N"])
    plant.extra.update(
        fric_s0=np.outer(stiff, h.details["stiffness_each"]),
        fric_Fc=Fc,
        fric_Fs=Fc * h.details["stiction"],
        fric_s1=h.details["bristle_damping"],
        fric_vs=h.details["stribeck_m_per_s"],
        fric_jenkins=int(h.details.get("jenkins", False)),
    )


def _com_offset(d: Draw) -> Drawn:
    direction = np.eye(3)[d.rng.integers(3)] * d.sign() if d.rng.random() < 0.5 else d.direction()
    size = d.size(2e-4, 0.03, d.beyond("centre_of_mass_m"))
    x, y, z = d.plant.com + direction * (size - direction @ d.plant.com)  # in all, along the direction drawn
    return "payload", {"x_m": float(x), "y_m": float(y), "z_m": float(z)}, {}


def _apply_com_offset(plant: Plant, h: Hidden) -> None:
    plant.com = np.array([h.parameters[name] for name in ("x_m", "y_m", "z_m")])


def _product_of_inertia(d: Draw) -> Drawn:
    return (
        d.one(("Jxy", "Jxz", "Jyz")),
        {"product_kgm2": d.sign() * d.size(0.04, 6.0, d.beyond("product_of_inertia_kgm2"))},
        {},
    )


def _apply_product_of_inertia(plant: Plant, h: Hidden) -> None:
    a, b = ("xyz".index(letter) for letter in h.location[1:])
    plant.J[a, b] = plant.J[b, a] = h.parameters["product_kgm2"]  # entry of the inertia tensor


_PATTERNS = np.array([[1, -1, 1, -1], [1, 1, 1, 1], [1, -1, -1, 1], [1, 1, -1, -1]], float)  # z over the corners


def _payload_flexible_mode(d: Draw) -> Drawn:
    count = int(d.rng.choice([1, 2, 3], p=[0.5, 0.3, 0.2]))
    f = float(d.between(14.0, 0.8 * d.band_Hz[1])) * np.cumprod([1.0, *d.rng.uniform(1.25, 1.9, count - 1)])
    size = d.size(0.03, 1.0) / np.sqrt(d.plant.m)  # of a mass-normalised shape at the mounts
    shapes = []
    for pattern in d.rng.permutation(4)[:count]:
        shape = np.zeros((4, 3))
        shape[:, 2] = _PATTERNS[pattern] + 0.25 * d.rng.standard_normal(4)
        shape[:, :2] = 0.35 * d.rng.standard_normal((4, 2))
        shapes.append((shape * size * d.rng.uniform(0.7, 1.0)).tolist())
    zeta = d.between(0.003, 0.03, count)
    return (
        "payload",
        {"frequency_Hz": float(f[0]), "damping_ratio": float(zeta[0])},
        {"frequencies_Hz": f.tolist(), "damping_ratios": zeta.tolist(), "shapes": shapes},
    )


def _apply_payload_flexible_mode(plant: Plant, h: Hidden) -> None:
    plant.extra.update(
        mode_shape=np.array(h.details["shapes"]),
        mode_z=np.array(h.details["damping_ratios"]),
        mode_w=2 * np.pi * np.array(h.details["frequencies_Hz"]),
    )


def _attached_oscillator(d: Draw) -> Drawn:
    mass, f, zeta = d.size(0.08, 25.0), d.between(5.0, 45.0), d.between(0.005, 0.08)
    if d.rng.random() < 0.5:
        axes, ratios = [d.direction() if d.rng.random() < 0.5 else np.eye(3)[d.rng.integers(3)]], [1.0]
    else:
        axes, ratios = list(np.eye(3)), [1.0, *d.rng.uniform(0.6, 1.7, 2)]
        ratios = list(d.rng.permutation(ratios))
    return (
        "payload",
        {"mass_kg": mass, "frequency_Hz": f, "damping_ratio": zeta},
        {
            "point_m": d.point().tolist(),
            "axes": [list(map(float, axis)) for axis in axes],
            "frequencies_Hz": [f * float(ratio) for ratio in ratios],
        },
    )


def _apply_attached_oscillator(plant: Plant, h: Hidden) -> None:
    n, mass = len(h.details["axes"]), h.parameters["mass_kg"]
    w = 2 * np.pi * np.array(h.details["frequencies_Hz"])
    plant.extra.update(
        osc_r=np.tile(h.details["point_m"], (n, 1)),
        osc_d=np.array(h.details["axes"]),
        osc_m=np.full(n, mass),
        osc_k=mass * w**2,
        osc_c=2 * h.parameters["damping_ratio"] * mass * w,
    )


def _base_compliance(d: Draw) -> Drawn:
    mass, f, zeta = d.between(400.0, 3000.0), d.size(120.0, 7.0), d.between(0.01, 0.10)
    ratios = [*d.rng.uniform(0.6, 1.3, 2), 1.0, *d.rng.uniform(0.8, 1.5, 3)]
    return (
        "chassis",
        {"mass_kg": mass, "frequency_Hz": f, "damping_ratio": zeta},
        {
            "dof": int(d.rng.choice([3, 6])),
            "frequencies_Hz": [f * float(ratio) for ratio in ratios],
            "centre_m": [0.0, 0.0, float(d.rng.uniform(-0.6, -0.3))],
            "radii_m": d.rng.uniform(0.35, 0.6, 3).tolist(),
            "height_m": float(d.rng.uniform(0.0, 0.3)),
        },
    )


def _apply_base_compliance(plant: Plant, h: Hidden) -> None:
    mass, p = h.parameters["mass_kg"], h.details
    M = mass * np.array([1, 1, 1, *np.square(p["radii_m"])])
    w = 2 * np.pi * np.array(p["frequencies_Hz"])
    K, C = np.diag(M * w**2), np.diag(2 * h.parameters["damping_ratio"] * M * w)
    free = p.get("free", [1] * p["dof"] + [0] * (6 - p["dof"]))
    if p["dof"] == 6:  # the soft base lies below the centre of mass: rocking couples with sliding
        L = np.eye(6)
        L[0, 4], L[1, 3] = -p["height_m"], p["height_m"]
        K, C = L.T @ K @ L, L.T @ C @ L
    plant.extra.update(
        base_free=np.array(free),
        base_Mi=1 / M,
        base_K=K,
        base_C=C,
        base_r=plant.chassis_points - p["centre_m"],
        base_motor_r=plant.motor_p - p["centre_m"],
    )


def _mount_relaxation(d: Draw) -> Drawn:
    ratio, corner = d.size(0.002, 1.0), d.between(0.4, 20.0)
    orifice = d.rng.random() < 0.4
    return (
        "isolators z",
        {"stiffness_ratio": ratio, "corner_Hz": corner},
        {"orifice": d.between(0.02, 0.3) * orifice, "stretch_m": float(np.mean(d.high.stretch[:, 2]))},
    )


def _apply_mount_relaxation(plant: Plant, h: Hidden) -> None:
    # Branches by mounts: share of the stiffness, and corner over the effective one.
    share, corner = (np.array(h.details.get(name, np.ones((1, 4)))) for name in ("shares", "corners"))
    branch = h.parameters["stiffness_ratio"] * plant.k[:, 2] * share
    damper = branch / (2 * np.pi * h.parameters["corner_Hz"] * corner)
    plant.extra.update(
        max_k=branch, max_c=damper, max_q=h.details["orifice"] * damper**2 / (branch * h.details["stretch_m"])
    )


def _structural_damping(d: Draw) -> Drawn:
    share = d.size(0.01, 1.5)
    eta = share * 2 * 0.033 * d.rng.uniform(0.8, 1.2)
    viscous = float(max(1 - share * d.rng.uniform(0.7, 1.0), 0.1)) if d.rng.random() < 0.6 else 1.0
    return "isolators", {"loss_factor": eta}, {"viscous_left": viscous}


def _apply_structural_damping(plant: Plant, h: Hidden) -> None:
    spacing = np.log(LADDER_HZ[1] / LADDER_HZ[0])
    rung = 2 * spacing * h.parameters["loss_factor"] / np.pi  # loss modulus eta k in the middle of a long ladder
    ratio = 3.0 / LADDER_HZ
    rungs = rung * np.outer(ratio ** -h.details.get("exponent", 0.0), h.details.get("uneven", np.ones(4)))
    softer = 1 + (ratio**2 / (1 + ratio**2)) @ rungs  # so that the stiffness at 3 Hz stays
    plant.k = plant.k / softer[:, None]
    plant.c = plant.c * h.details["viscous_left"]
    plant.extra.update(ladder_k=rungs * softer, ladder_w=2 * np.pi * LADDER_HZ)


def _mount_surge(d: Draw) -> Drawn:
    f, zeta = d.size(150.0, 15.0), d.between(0.01, 0.1)
    mass = 4 * float(np.mean(d.plant.k[:, 2])) / (2 * np.pi * f) ** 2
    return (
        "isolators z",
        {"frequency_Hz": f, "mass_kg": mass, "damping_ratio": zeta},
        {"uneven": about_one(d.rng.uniform(0.97, 1.03, 4)).tolist()},
    )


def _apply_mount_surge(plant: Plant, h: Hidden) -> None:
    mass = h.parameters["mass_kg"] * np.array(h.details["uneven"])
    plant.extra.update(
        surge_share=np.array(h.details.get("share_above", np.full(4, 0.5))),
        surge_m=mass,
        surge_c=h.parameters["damping_ratio"] * np.sqrt(4 * plant.k[:, 2] * mass),
    )


def _cubic_stiffness(d: Draw) -> Drawn:
    relative = d.size(0.0005, 0.3)  # stiffening by statistical linearisation at the highest level
    cubic = relative * float(np.mean(d.plant.k[:, 2])) / (3 * float(np.mean(d.high.stretch[:, 2])) ** 2)
    return "isolators z", {"cubic_N_per_m3": cubic}, {"uneven": about_one(d.rng.uniform(0.9, 1.1, 4)).tolist()}


def _apply_cubic_stiffness(plant: Plant, h: Hidden) -> None:
    uneven = np.array(h.details["uneven"])
    cubic = h.details.get("cubic_left", 1.0) * h.parameters["cubic_N_per_m3"]
    plant.extra.update(k3=cubic * uneven, k5=h.details.get("quintic_N_per_m5", 0.0) * uneven)
    if "quadratic_N_per_m2" in h.details:
        plant.extra["k2"] = h.details["quadratic_N_per_m2"] * uneven


def _leveling_loop(d: Draw) -> Drawn:
    stable = float(-2 * d.middle.poles.real.max())  # an integral of that rate would undo the least damping
    rate = stable * d.size(0.02, 0.7)
    return "isolators 1-3 z", {"rate_Hz": rate / (2 * np.pi)}, {"lag_s": d.between(0.05, 2.0) * (d.rng.random() < 0.4)}


def _apply_leveling_loop(plant: Plant, h: Hidden) -> None:
    uneven = np.array(h.details.get("uneven", np.ones(3)))
    plant.extra.update(level_w=2 * np.pi * h.parameters["rate_Hz"] * uneven, level_tau=float(h.details["lag_s"]))


def _cable_stiffness(d: Draw) -> Drawn:
    axes = [d.direction()] if d.rng.random() < 0.5 else list(np.eye(3))
    k = d.size(50.0, 8000.0)
    each = k * np.array([1.0, *d.rng.uniform(0.3, 1.0, len(axes) - 1)])
    return (
        "payload",
        {"stiffness_N_per_m": k},
        {
            "point_m": d.point().tolist(),
            "axes": [list(map(float, axis)) for axis in axes],
            "each": each.tolist(),
            "damping_s": d.between(1e-4, 5e-3),
        },
    )


def _apply_cable_stiffness(plant: Plant, h: Hidden) -> None:
    k = np.array(h.details["each"])
    points = h.details.get("points_m", [h.details["point_m"]] * len(k))
    plant.extra.update(
        cable_r=np.array(points), cable_d=np.array(h.details["axes"]), cable_k=k, cable_c=k * h.details["damping_s"]
    )


def _stiffness_drift(d: Draw) -> Drawn:
    exponential = d.rng.random() < 0.5
    return (
        "isolators",
        {"change": d.sign() * d.size(0.0005, 0.05)},
        {"span_s": d.span_s, "time_constant_s": d.between(0.2, 1.0) * d.span_s * exponential},
    )


def _apply_stiffness_drift(plant: Plant, h: Hidden) -> None:
    change, span, tau = h.parameters["change"], h.details["span_s"], h.details["time_constant_s"]
    swing, cycle = h.details.get("swing", 0.0), h.details.get("cycle_s", 1.0)

    def factor(t: np.ndarray) -> np.ndarray:
        rise = (1 - np.exp(-t / tau)) / (1 - np.exp(-span / tau)) if tau > 0 else t / span
        return 1 + change * (rise + swing * np.sin(2 * np.pi * t / cycle))

    plant.stiffness = factor


MECHANICS = tuple(
    Effect(name, family, draw, apply)
    for name, family, draw, apply in (
        ("contact_friction", "contact", _contact_friction, _apply_contact_friction),
        ("com_offset", "inertia", _com_offset, _apply_com_offset),
        ("product_of_inertia", "inertia", _product_of_inertia, _apply_product_of_inertia),
        ("payload_flexible_mode", "structure", _payload_flexible_mode, _apply_payload_flexible_mode),
        ("attached_oscillator", "structure", _attached_oscillator, _apply_attached_oscillator),
        ("base_compliance", "structure", _base_compliance, _apply_base_compliance),
        ("mount_relaxation", "mount dynamics", _mount_relaxation, _apply_mount_relaxation),
        ("structural_damping", "mount dynamics", _structural_damping, _apply_structural_damping),
        ("mount_surge", "structure", _mount_surge, _apply_mount_surge),
        ("cubic_stiffness", "mount statics", _cubic_stiffness, _apply_cubic_stiffness),
        ("leveling_loop", "mount dynamics", _leveling_loop, _apply_leveling_loop),
        ("cable_stiffness", "mount statics", _cable_stiffness, _apply_cable_stiffness),
        ("stiffness_drift", "drift", _stiffness_drift, _apply_stiffness_drift),
    )
)
