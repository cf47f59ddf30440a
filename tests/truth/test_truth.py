"""The truth against mechanics on paper: conservation laws, statics, frequency responses in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from .cases import LIBRARY, OUTSIDE_LIBRARY, build_plant, convert, draw_case, held_voltage, rig, run, simulate_case
from .closed_form import carry, sampled_response
from .kernel import FIRST_EFFECT_STATE
from .signals import floor_motion, multisine
from .table import Plant, draw_plant, matrices, pilot

pytestmark = pytest.mark.filterwarnings("ignore::numba.NumbaPerformanceWarning")
RATE = 1000.0


@pytest.fixture(autouse=True)
def _needs_rig(shared: Path) -> None:
    """The rig file lies in the shared folder."""


def plant_with(effect: str | None, seed: int = 5, strength: str = "gross", damping: float = 1.0) -> Plant:
    case = draw_case(seed, kind="none") if effect is None else draw_case(seed, effect=effect, strength=strength)
    plant = build_plant(case)
    plant.c = plant.c * damping
    return plant


def still(samples: int) -> np.ndarray:
    return np.zeros((samples + 1, 9))


def response_to(plant: Plant, u: np.ndarray, states: bool = False) -> tuple[np.ndarray, np.ndarray]:
    return run(plant, u, still(len(u)), 0, 0.0, np.random.default_rng(0), states)


def stretches(plant: Plant, trace: np.ndarray) -> np.ndarray:
    """(samples, 4, 3) over the mounts, with the rotation by another library."""
    R = Rotation.from_quat(trace[:, [4, 5, 6, 3]]).as_matrix()
    r = plant.points - plant.com
    return trace[:, None, 0:3] + np.einsum("tab,ib->tia", R, r) - r


def integrate_freely(plant: Plant, position: list[float], spin: list[float], samples: int) -> np.ndarray:
    """States of the table let go from a position and spin, by marching from a given state."""
    from .kernel import integrate, state_size

    P = plant.physics()
    x = np.zeros(state_size(P))
    x[0:3], x[3], x[10:13] = position, 1.0, spin
    trace, y = np.empty((samples, len(x))), np.empty((samples, 6))
    integrate(
        P,
        x,
        np.zeros((1, 8)),
        np.full(samples, -2),
        np.zeros(samples),
        still(samples),
        np.ones(samples),
        1e-3,
        y,
        trace,
    )
    return trace


def kinetic(plant: Plant, trace: np.ndarray) -> np.ndarray:
    w = trace[:, 10:13]
    return 0.5 * plant.m * (trace[:, 7:10] ** 2).sum(axis=1) + 0.5 * np.einsum("ta,ab,tb->t", w, plant.J, w)


@pytest.mark.parametrize(("k2", "k3"), [(0.0, 0.0), (4e5, 3e7)])
def test_energy_is_conserved_without_damping(rng, k2, k3):
    plant = draw_plant(rig(), rng)
    plant.c, plant.J = np.zeros((4, 3)), plant.J + np.array([[0, 2, -1], [2, 0, 3], [-1, 3, 0]])
    plant.extra.update(k2=np.full(4, k2), k3=np.full(4, k3))
    trace = integrate_freely(plant, [0.01, -0.02, 0.015], [0.8, -1.1, 0.9], 4000)  # rotations of several degrees
    e = stretches(plant, trace)
    potential = 0.5 * (plant.k * e**2).sum(axis=(1, 2)) + (k2 * e[:, :, 2] ** 3 / 3 + k3 * e[:, :, 2] ** 4 / 4).sum(1)
    energy = kinetic(plant, trace) + potential
    assert np.ptp(kinetic(plant, trace)) > 0.5 * energy[0]
    assert np.ptp(Rotation.from_quat(trace[:, [4, 5, 6, 3]]).as_rotvec(), axis=0).min() > 0.05
    assert np.ptp(energy) < 1e-6 * energy[0]


def test_free_spinning_body_keeps_its_angular_momentum(rng):
    plant = draw_plant(rig(), rng)
    plant.k, plant.c = np.zeros((4, 3)), np.zeros((4, 3))
    plant.extra["rotor"] = np.array([3.0, -1.0, 7.0])
    trace = integrate_freely(plant, [0, 0, 0], [2.0, 1.5, -1.0], 5000)
    R = Rotation.from_quat(trace[:, [4, 5, 6, 3]]).as_matrix()
    L = np.einsum("tab,tb->ta", R, trace[:, 10:13] @ plant.J + plant.extra["rotor"])
    assert np.ptp(trace[:, 10]) > 1.0  # it tumbles
    assert np.abs(L - L[0]).max() < 1e-8 * np.linalg.norm(L[0])


def test_held_voltage_deflects_the_table_by_its_stiffness(rng):
    plant = draw_plant(rig(), rng)
    plant.c = plant.c * 12
    u = rng.uniform(-3, 3, 8)
    _, trace = response_to(plant, np.tile(u, (6000, 1)), states=True)
    _, _, K, T = matrices(plant)
    q = np.linalg.solve(K, T @ u)
    rotation = Rotation.from_quat(trace[-1, [4, 5, 6, 3]]).as_rotvec()
    np.testing.assert_allclose([*trace[-1, :3], *rotation], q, rtol=0, atol=2e-3 * np.abs(q).max())


def test_matrices_are_those_of_the_package():
    plant = draw_plant(rig(), np.random.default_rng(0), spread=0.0)
    M, C, K, T = matrices(plant)
    motion = rig().equations_of_motion()
    for ours, theirs in ((M, motion.M), (C, motion.C), (K, motion.K), (T, motion.T)):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-9)


LINEAR = (
    "none",
    "geophone_corner",
    "sensor_gain",
    "sensor_misalignment",
    "tilt_coupling",
    "actuator_gain",
    "actuator_lag",
    "loop_delay",
    "com_offset",
    "product_of_inertia",
    "payload_flexible_mode",
    "attached_oscillator",
    "base_compliance",
    "structural_damping",
    "mount_surge",
    "leveling_loop",
    "cable_stiffness",
    "gyroscope",
    "one_amplifier_lag",
)


def steady_lines(plant: Plant, level: float, period: int = 4000, periods: int = 7) -> tuple[np.ndarray, ...]:
    """(f, U, Y) of the last period under a multisine."""
    u = multisine(np.random.default_rng(3), period * periods, 8, period, (0.5, 80.0), RATE, level)
    y, _ = response_to(plant, u)
    f = np.fft.rfftfreq(period, 1 / RATE)
    keep = np.flatnonzero((f >= 0.5) & (f <= 80.0))[::9]
    U, Y = (np.fft.rfft(one[-period:], axis=0)[keep] for one in (u, y))
    return f[keep], U, Y


def misfit(simulated: Plant, formula: Plant) -> np.ndarray:
    """(6,) largest distance of simulated lines from the closed form, over the channel's r.m.s. line."""
    f, U, Y = steady_lines(simulated, 0.01)  # small, so that rotations stay linear to 1e-5
    P = formula.physics()
    expected = np.array([sampled_response(P, one, RATE, formula.delay_s) @ row for one, row in zip(f, U, strict=True)])
    return np.abs(Y - expected).max(axis=0) / np.sqrt(np.mean(np.abs(Y) ** 2, axis=0))


@pytest.mark.parametrize("effect", LINEAR)
def test_frequency_response_in_closed_form(effect):
    plant = plant_with(None if effect == "none" else effect, damping=5.0)  # so that transients die within 24 s
    assert misfit(plant, plant).max() < 1.5e-4


@pytest.mark.parametrize("effect", [name for name in LINEAR if name != "none"])
def test_the_closed_form_tells_the_effect_from_its_absence(effect):
    """Otherwise the test before could pass with the effect left out on both sides."""
    assert misfit(plant_with(effect, damping=5.0), plant_with(None, damping=5.0)).max() > 5e-3


def test_a_lag_of_half_a_step_in_closed_form():
    """The stages of a step must hold the mean of an exponential that is over within it, not Simpson's guess of it."""
    plant = plant_with(None, damping=5.0)
    plant.extra["lag"] = np.full(8, 2 * np.pi * 600.0)
    assert misfit(plant, plant).max() < 1.5e-4


def test_maxwell_branch_in_closed_form():
    seed = next(s for s in range(50) if draw_case(s, effect="mount_relaxation").effects[0].details["orifice"] == 0)
    plant = plant_with("mount_relaxation", seed, damping=5.0)
    assert misfit(plant, plant).max() < 1.5e-4
    assert misfit(plant, plant_with(None, seed, damping=5.0)).max() > 5e-3


def test_orifice_obeys_its_law():
    plant = plant_with(
        "mount_relaxation",
        seed=next(s for s in range(50) if draw_case(s, effect="mount_relaxation").effects[0].details["orifice"] > 0.1),
    )
    u = multisine(np.random.default_rng(1), 8000, 8, 4000, (0.5, 20.0), RATE, 0.5)
    _, trace = response_to(plant, u, states=True)
    P, z = plant.physics(), stretches(plant, trace)[:, :, 2]
    s = trace[:, FIRST_EFFECT_STATE : FIRST_EFFECT_STATE + 4]
    v = (s[2:] - s[:-2]) * RATE / 2
    force = P.max_k * (z - s)[1:-1]
    law = P.max_c * v + P.max_q * v * np.abs(v)
    assert np.abs(force - law).max() < 2e-3 * np.abs(force).max()
    assert np.abs(P.max_q * v * np.abs(v)).max() > 0.02 * np.abs(force).max()


def test_structural_loss_is_nearly_constant():
    case = draw_case(5, effect="structural_damping", strength="clear")
    P, eta = build_plant(case).physics(), case.effects[0].parameters["loss_factor"]
    for f in (0.5, 2.0, 10.0, 50.0):
        s = 2j * np.pi * f
        k = 1 + sum(g * s / (s + w) for g, w in zip(P.ladder_k, P.ladder_w, strict=True))
        softer = P.k[0, 0] / draw_plant(rig(), np.random.default_rng([5, 0])).k[0, 0]
        assert k.imag * softer == pytest.approx(eta, rel=0.08)


@pytest.mark.parametrize(("effect", "field"), [("cubic_stiffness", "k3"), ("asymmetric_stiffness", "k2")])
def test_hardening_spring_under_a_held_weight(effect, field):
    plant = plant_with(effect)
    plant.k[:, 2], plant.c = 4.5e4, plant.c * 12
    plant.extra[field] = np.full(4, float(plant.extra[field][0]))
    plant.extra[field] *= 1 if field == "k3" else np.sign(plant.extra[field])
    u = np.zeros((6000, 8))
    u[:, plant.motor_d[:, 2] == 1] = 1.0
    _, trace = response_to(plant, u, states=True)
    k = plant.extra[field][0]
    roots = np.roots([k, 0, 4.5e4, -2.0] if field == "k3" else [k, 4.5e4, -2.0])
    z = min((root.real for root in roots if abs(root.imag) < 1e-12), key=abs)
    assert trace[-1, 2] == pytest.approx(z, rel=1e-5)
    assert abs(trace[-1, 2] * 4.5e4 / 2.0 - 1) > 1e-3


def test_friction_sticks_as_a_spring_and_slips_at_its_force():
    seed = next(s for s in range(50) if draw_case(s, effect="contact_friction").effects[0].details["stiction"] == 1.0)
    case = draw_case(seed, effect="contact_friction", strength="gross")
    plant = build_plant(case)
    plant.c = plant.c * 12
    sigma, Fc = np.array(case.effects[0].details["stiffness_each"]), plant.extra["fric_Fc"]
    P = plant.physics()
    _, _, K, T = matrices(plant)
    D = np.array([d @ carry(p) for p, d in zip(P.motor_r, P.motor_d, strict=True)])
    stuck = K + D.T @ np.diag(sigma) @ D
    small = 2e-4 * float(Fc.min()) * np.sign(np.random.default_rng(0).standard_normal(8))
    _, trace = response_to(plant, np.tile(small, (6000, 1)), states=True)
    q = np.linalg.solve(stuck, T @ small)
    np.testing.assert_allclose(trace[-1, :3], q[:3], atol=5e-3 * np.abs(q[:3]).max())
    u = multisine(np.random.default_rng(1), 4000, 8, 4000, (0.5, 10.0), RATE, 0.5)
    _, trace = response_to(plant, u, states=True)
    force = np.abs(trace[:, FIRST_EFFECT_STATE:] * sigma).max(axis=0)
    assert (force <= Fc * (1 + 1e-6)).all() and (force > 0.8 * Fc).any()


def test_saturation_clips_the_loudest_records_only():
    case = draw_case(5, effect="actuator_saturation", strength="clear")
    plant, limit = build_plant(case), case.effects[0].parameters["limit_V"]
    u = simulate_case(replace(case, duration_s=4.0)).records[int(np.argmax(case.levels_V))].u
    assert 1e-4 < np.mean(np.abs(u) > limit) < 0.2
    bare = plant_with(None)
    y, _ = response_to(plant, u)
    clipped, _ = response_to(bare, np.clip(u, -limit, limit))
    free, _ = response_to(bare, u)
    np.testing.assert_array_equal(y, clipped)
    assert np.abs(y - free).max() > 1e-3


def test_drift_moves_the_stiffness_with_the_clock():
    plant, bare = plant_with("stiffness_drift"), plant_with(None)
    case = draw_case(5, effect="stiffness_drift", strength="gross")
    span, change = case.effects[0].details["span_s"], case.effects[0].parameters["change"]
    assert plant.stiffness(np.array([0.0, span])) == pytest.approx([1.0, 1.0 + change])
    u = multisine(np.random.default_rng(1), 4000, 8, 4000, (0.5, 20.0), RATE, 0.3)
    late, _ = run(plant, u, still(4000), 0, span - 4.0, np.random.default_rng(0))
    early, _ = response_to(bare, u)
    bare.k = bare.k * (1 + change)
    scaled, _ = response_to(bare, u)
    assert np.abs(late - scaled).max() < 0.03 * np.abs(late - early).max()


NONLINEAR = {
    "contact_friction",
    "cubic_stiffness",
    "actuator_saturation",
    "air_drag",
    "dead_zone",
    "asymmetric_stiffness",
    "force_constant_of_displacement",
    "force_constant_of_drive",
    "sensor_quadratic",
}
CONVERTER = {"mains_hum", "sensor_quantisation", "ground_motion", "noisy_sensor", "dropped_samples"}


ANALOGUE = [name for name in (*LIBRARY, *OUTSIDE_LIBRARY) if name not in CONVERTER | {"mount_relaxation"}]


@pytest.mark.parametrize("effect", ANALOGUE)
def test_level_dependence_only_where_it_belongs(effect):
    plant = plant_with(effect)
    level = max(draw_case(5, kind="none").levels_V) / 3
    u = multisine(np.random.default_rng(2), 3000, 8, 3000, (0.5, 60.0), RATE, level)
    low, high = response_to(plant, u)[0], response_to(plant, 3 * u)[0]
    off = np.abs(high - 3 * low).max() / np.abs(high).max()
    assert off > 5e-3 if effect in NONLINEAR else off < 5e-4


def test_hum_has_its_frequency_and_amplitude():
    case = draw_case(5, effect="mains_hum", strength="gross")
    plant, h = build_plant(case), case.effects[0]
    y, _ = response_to(plant, np.zeros((40000, 8)))
    t = np.arange(40000) / RATE
    basis = np.array(
        [g(2 * np.pi * n * h.parameters["frequency_Hz"] * t) for n in h.details["harmonics"] for g in (np.sin, np.cos)]
    ).T
    fit, rest = np.linalg.lstsq(basis, y, rcond=None)[:2]
    assert rest.max() < 1e-16 * 40000
    assert np.hypot(fit[0], fit[1]).max() == pytest.approx(h.parameters["amplitude_V"])


def test_converter_and_noise():
    plant = plant_with(None)
    y = convert(plant, np.tile(np.linspace(-12, 12, 50001)[:, None], 6), 0.0, np.random.default_rng(0))
    step = 20 / 2**14
    assert y.min() == -10 and y.max() == 10 - step
    np.testing.assert_allclose(y / step, np.round(y / step), atol=1e-9)
    quiet = convert(plant, np.full((50000, 6), 0.3), 0.0, np.random.default_rng(0))
    np.testing.assert_allclose(quiet.std(axis=0), np.sqrt(1e-6 + step**2 / 12), rtol=0.02)
    for seed in range(12):
        case = draw_case(seed, effect="sensor_quantisation", strength="gross")
        plant, h = build_plant(case), case.effects[0]
        out = convert(plant, np.tile(np.linspace(-12, 12, 5001)[:, None], 6), 0.0, np.random.default_rng(0))
        j = plant.sensors.index(h.location)
        if "step_V" in h.parameters:
            codes = out[:, j] / h.parameters["step_V"]
            inside = np.abs(out[:, j]) < 9
            np.testing.assert_allclose(codes[inside], np.round(codes[inside]), atol=1e-9)
        else:
            assert np.abs(out[:, j]).max() == pytest.approx(h.parameters["range_V"])
        assert out[:, (j + 1) % 6].max() == 10 - step


def test_floor_has_the_rms_and_band_that_it_says(rng):
    for slope in (0.0, 1.0):
        floor = floor_motion(rng, 60000, RATE, 2e-6, slope)
        f = np.fft.rfftfreq(60000, 1 / RATE)
        power = np.abs(np.fft.rfft(floor[:, 3:6] * np.hanning(60000)[:, None], axis=0)) ** 2
        np.testing.assert_allclose(floor[:, 3:6].std(axis=0), 2e-6, rtol=0.15)
        assert power[(f > 61) | (f < 0.4)].sum() < 1e-3 * power.sum()
        for order in (0, 3):  # velocity and acceleration are derivatives of what stands before
            slope_of = (floor[2:, order : order + 3] - floor[:-2, order : order + 3]) * RATE / 2
            np.testing.assert_allclose(
                slope_of, floor[1:-1, order + 3 : order + 6], atol=0.05 * np.abs(floor[:, order + 3 : order + 6]).max()
            )


def test_chassis_follows_the_floor_statically():
    """A slow floor carries the table along: over the mounts nothing stretches."""
    plant = plant_with(None)
    t = np.arange(20001) / RATE
    w = 2 * np.pi * 0.1
    floor = np.zeros((20001, 9))
    floor[:, 0:3], floor[:, 3:6], floor[:, 6:9] = (
        column[:, None] * np.array([1e-3, -2e-3, 1.5e-3])
        for column in (np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t))
    )
    _, trace = run(plant, np.zeros((20000, 8)), floor, 0, 0.0, np.random.default_rng(0), states=True)
    motion = trace[15000:, 0:3] - floor[15000:20000, 0:3]
    assert np.abs(motion).max() < 1.5 * (0.1 / 1.9) ** 2 * 2e-3  # (f/f0)^2 of the softest mode, and some ringing


def test_held_voltage_by_brute_force():
    for delay, error in ((1e-3, 0.0), (1.3e-3, 0.0), (4.75e-3, 0.0), (1e-3, 8e-4), (1.6e-3, -8e-4)):
        first, switch = held_voltage(3000, 10, 1e-3, delay, error)
        for k in range(0, 3000, 37):
            for t in (0.013, 0.31, 0.73, 0.99):
                row = first[k + 10] + (t >= switch[k + 10])
                assert row == np.floor((k + t - delay / 1e-3) * (1 + error) + 1e-9)


def test_sensor_delay_and_crosstalk():
    y = np.random.default_rng(0).standard_normal((4000, 6))
    smooth = np.apply_along_axis(lambda one: np.convolve(one, np.hanning(30) / 15, "same"), 0, y)
    case = draw_case(5, effect="sensor_delay", strength="gross")
    plant, tau = build_plant(case), case.effects[0].parameters["delay_s"]
    j, t = plant.sensors.index(case.effects[0].location), np.arange(4000) / RATE
    out = plant.analogue[0](smooth, t, np.random.default_rng(0))
    f = np.fft.rfftfreq(4000, 1 / RATE)
    expected = np.fft.irfft(np.fft.rfft(smooth[:, j]) * np.exp(-2j * np.pi * f * tau), 4000)
    assert np.abs(out[:, j] - expected)[100:-100].max() < 2e-3
    case = draw_case(5, effect="sensor_crosstalk")
    h = case.effects[0]
    out = build_plant(case).analogue[0](y, t, np.random.default_rng(0))
    a, b = plant.sensors.index(h.location), plant.sensors.index(h.details["source"])
    np.testing.assert_allclose(out[:, a], y[:, a] + h.parameters["share"] * y[:, b])


def test_ambient_motion_has_settled_and_the_converter_does_not_clip():
    case = draw_case(11, kind="none", duration_s=12.0)
    for record in simulate_case(case).records:
        assert np.mean(np.abs(record.y) > 9.9) < 1e-3
    plant = build_plant(case)
    floor = floor_motion(np.random.default_rng(0), 36001, RATE, 2e-6, 0.5)
    short = run(plant, np.zeros((4000, 8)), floor[32000 - 12000 :], 12000, 0.0, np.random.default_rng(0))[0]
    long = run(plant, np.zeros((4000, 8)), floor, 32000, 0.0, np.random.default_rng(0))[0]
    assert np.std(short - long) < 0.05 * np.std(long)


def test_pilot_agrees_with_the_simulation():
    case = draw_case(2, kind="none", duration_s=30.0)
    plant = build_plant(case)
    expected = pilot(plant, case.band_Hz, 0.3)
    u = multisine(np.random.default_rng(0), 60000, 8, 20000, case.band_Hz, RATE, 0.3)
    y, trace = response_to(plant, u, states=True)
    np.testing.assert_allclose(stretches(plant, trace[40000:]).std(axis=0), expected.stretch, rtol=0.35)
    np.testing.assert_allclose(y[40000:].std(axis=0), expected.y, rtol=0.35)
