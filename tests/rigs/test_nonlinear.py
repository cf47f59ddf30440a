"""The nonlinear model against conservation laws, power balance and the linear model, at small and large motion."""

from dataclasses import replace

import numpy as np
import pytest
from nonlinear_rig import NonlinearRig, body_rate_map, rotation_matrix
from numba import njit
from scipy.linalg import expm

from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.mounted_body import MountedBody
from avis_ctrl.rigs.nonlinear import payload_acceleration
from avis_ctrl.rigs.rigid_body import cross_matrix

SKEW = {"com_x": 0.05, "com_y": -0.03, "com_z": 0.12, "J12": 3.0, "J13": -2.0, "J23": 4.0}
UNDAMPED = {f"isolator{i}.c_{axis}": 0.0 for i in range(1, 5) for axis in "xyz"}


@njit
def runge_kutta(state, u, q_ch, q_ch_dot, arrays, dt, steps, keep_every):
    """Classical fourth-order steps with held inputs; every keep_every-th state."""
    kept = np.empty((steps // keep_every + 1, 12))
    kept[0] = state
    slopes = np.empty((4, 12))
    fractions = np.array([0.0, 0.5, 0.5, 1.0])
    for step in range(1, steps + 1):
        for k in range(4):
            trial = state.copy()
            if k:
                trial += dt * fractions[k] * slopes[k - 1]
            slopes[k, :6] = trial[6:]
            slopes[k, 6:] = payload_acceleration(trial[:6], trial[6:], u, q_ch, q_ch_dot, arrays)
        state = state + dt / 6 * (slopes[0] + 2 * slopes[1] + 2 * slopes[2] + slopes[3])
        if step % keep_every == 0:
            kept[step // keep_every] = state
    return kept


def run(rig, state, dt, steps, keep_every, u=None, q_ch=None):
    u = np.zeros(len(rig.body.actuators)) if u is None else u
    q_ch = np.zeros(6) if q_ch is None else q_ch
    return runge_kutta(np.asarray(state, float), u, q_ch, np.zeros(6), rig.arrays, dt, steps, keep_every)


def bodies():
    avis = load_rig("avis")
    feet = tuple(replace(one, chassis_offset=(0.02, 0.01 * k, -0.3)) for k, one in enumerate(avis.isolators))
    return {
        "avis": avis,
        "avis skew": replace(avis.with_parameters(SKEW), isolators=feet),
        "halcyonics_loaded": load_rig("halcyonics_loaded"),
    }


@pytest.mark.parametrize("name", ["avis", "avis skew", "halcyonics_loaded"])
def test_the_linear_model_is_the_jacobian(name):
    """Complex step on state, voltages and chassis motion; 1e-8 asked, round-off found."""
    rig = bodies()[name]
    eom, nonlinear = rig.equations_of_motion(), NonlinearRig(rig.mounted_body())
    n_u, h = len(eom.actuators), 1e-30
    columns = []
    for k in range(12 + n_u + 12):
        point = np.zeros(24 + n_u, complex)
        point[k] = 1j * h
        state, u, q_ch, q_ch_dot = np.split(point, [12, 12 + n_u, 18 + n_u])
        columns.append(nonlinear.derivative(state, u, q_ch, q_ch_dot).imag / h)
    jacobian = np.column_stack(columns)
    expected = np.vstack(
        [np.eye(6, 24 + n_u, k=6), np.linalg.solve(eom.M, np.hstack([-eom.K, -eom.C, eom.T, eom.K_floor, eom.C_floor]))]
    )
    error = np.abs(jacobian - expected)
    for block in np.split(np.arange(24 + n_u), [6, 12, 12 + n_u, 18 + n_u]):
        scale = np.abs(expected[:, block]).max(axis=1, keepdims=True)
        assert np.all(error[:, block] <= 1e-8 * scale)
        assert np.max(error[:, block]) <= 1e-12 * np.max(scale)


def test_energy_is_conserved_over_1e5_steps():
    """Undamped, offset centre of mass, full inertia, angles to 0.4 rad; 20 s at 0.2 ms: the integrator errs little."""
    rig = NonlinearRig(load_rig("avis").with_parameters(SKEW | UNDAMPED).mounted_body())
    start = np.concatenate([[0.02, -0.03, 0.04, 0.25, -0.2, 0.3], [0.3, -0.2, 0.1, 0.5, 1.0, -0.7]])
    kept = run(rig, start, 2e-4, 100_000, 500)
    energy = np.array([rig.energy(state) for state in kept])
    assert np.abs(kept[:, 3:6]).max() > 0.25
    assert np.max(np.abs(energy / energy[0] - 1)) < 1e-9


def test_halving_the_step_reduces_the_energy_error_as_the_fifth_power():
    """What is left of the energy error is the integrator's (fourth order: 2^5 in energy), not the model's."""
    rig = NonlinearRig(load_rig("avis").with_parameters(SKEW | UNDAMPED).mounted_body())
    start = np.concatenate([[0.02, -0.03, 0.04, 0.25, -0.2, 0.3], [0.3, -0.2, 0.1, 0.5, 1.0, -0.7]])
    errors = []
    for dt, steps in ((4e-3, 5000), (2e-3, 10_000)):
        energy = [rig.energy(state) for state in run(rig, start, dt, steps, steps)]
        errors.append(abs(energy[-1] / energy[0] - 1))
    assert 20 < errors[0] / errors[1] < 50


def test_the_loaded_table_conserves_energy_too():
    """The generalised stiffness (k_t, k_r on the coordinates) has a potential, also at large angles."""
    table = load_rig("halcyonics_loaded").with_parameters({f"d{k}": 0.0 for k in (1, 3, 4, 5, 6)})
    rig = NonlinearRig(table.mounted_body())
    kept = run(rig, [0.01, 0.02, -0.01, 0.2, -0.3, 0.25, *np.zeros(6)], 2e-4, 20_000, 200)
    energy = np.array([rig.energy(state) for state in kept])
    assert np.max(np.abs(energy / energy[0] - 1)) < 1e-6


def test_a_free_body_keeps_its_momentum_and_its_spin():
    """No mounts: the centre of mass moves straight, the angular momentum in earth axes stays."""
    skew = load_rig("avis").with_parameters(SKEW).mounted_body()
    body = MountedBody(skew.mass, skew.inertia, skew.centre_of_mass, (), skew.actuators)
    rig = NonlinearRig(body)
    kept = run(rig, [0, 0, 0, 0.1, -0.2, 0.3, 0.5, 0.1, -0.4, 0.9, -0.5, 0.7], 1e-3, 1500, 100)

    def momenta(state):
        R, omega = rotation_matrix(state[3:6]), body_rate_map(state[3:6]) @ state[9:]
        return state[6:9] + R @ np.cross(omega, body.centre_of_mass), R @ body.inertia @ omega

    first = momenta(kept[0])
    for state in kept:
        assert np.allclose(momenta(state), first, rtol=1e-9, atol=1e-9)
    assert np.abs(kept[:, 3:6]).max() > 0.7
    centres = np.array([state[:3] + rotation_matrix(state[3:6]) @ body.centre_of_mass for state in kept])
    assert np.allclose(np.diff(centres, 2, axis=0), 0, atol=1e-10)


@pytest.mark.parametrize("name", ["avis skew", "halcyonics_loaded"])
def test_power_balance_at_any_state(name, rng):
    """dE/dt is the power of motors, dampers and moving chassis, each from force times velocity of its point."""
    rig = NonlinearRig(bodies()[name].mounted_body())
    body, h = rig.body, 1e-5

    def motion(q, q_dot, p):
        R = rotation_matrix(q[3:])
        omega = body_rate_map(q[3:]) @ q_dot[3:]
        return q[:3] + R @ p - p, q_dot[:3] + R @ cross_matrix(omega) @ p

    for _ in range(10):
        state, u = rng.uniform(-0.5, 0.5, 12), rng.uniform(-10, 10, 8)
        q_ch, q_ch_dot = rng.uniform(-0.2, 0.2, (2, 6))
        slope = rig.derivative(state, u, q_ch, q_ch_dot)
        change = (
            rig.energy(state + h * slope, q_ch + h * q_ch_dot) - rig.energy(state - h * slope, q_ch - h * q_ch_dot)
        ) / (2 * h)

        q, q_dot = state[:6], state[6:]
        power = sum(
            a.constant_N_per_V * u_k * a.direction @ motion(q, q_dot, a.position)[1]
            for a, u_k in zip(body.actuators, u, strict=True)
        )
        for mount in body.mounts:
            place, speed = motion(q, q_dot, mount.position)
            place_ch, speed_ch = motion(q_ch, q_ch_dot, mount.chassis_point)
            # The spring's energy is in E: of its work only what the moving chassis puts in is left.
            power -= (mount.damping @ (speed - speed_ch)) @ speed + (mount.stiffness @ (place - place_ch)) @ speed_ch
        power += (-body.damping @ (q_dot - q_ch_dot)) @ q_dot - (body.stiffness @ (q - q_ch)) @ q_ch_dot
        assert change == pytest.approx(power, rel=1e-6, abs=1e-6 * rig.energy(state, q_ch))


def both_models(size):
    """Free motion from (position, speed) of a given size, voltages held and chassis displaced in proportion."""
    table = load_rig("avis").with_parameters(SKEW)
    start = size * np.concatenate([[1.0, -0.5, 0.7, 0.8, -1.0, 0.6], [5.0, 3.0, -4.0, 6.0, -5.0, 4.0]])
    u, q_ch = size * np.array([40.0, 50.0, -30.0, 20.0, 10.0, -60.0, 30.0, 20.0]), size * np.full(6, 0.3)
    kept = run(NonlinearRig(table.mounted_body()), start, 1e-3, 1000, 10, u, q_ch)
    eom = table.equations_of_motion()
    A = np.block([[np.zeros((6, 6)), np.eye(6)], [-np.linalg.solve(eom.M, np.hstack([eom.K, eom.C]))]])
    rest = np.concatenate([np.linalg.solve(eom.K, eom.T @ u + eom.K_floor @ q_ch), np.zeros(6)])
    step = expm(A * 0.01)
    linear = [start]
    for _ in range(100):
        linear.append(rest + step @ (linear[-1] - rest))
    return kept[:, :6], np.array(linear)[:, :6]


def test_at_micrometres_the_models_agree():
    nonlinear, linear = both_models(1e-6)
    assert np.max(np.abs(nonlinear - linear)) < 2e-5 * np.max(np.abs(linear))


def test_the_difference_is_of_second_order():
    """Ten times the motion, a hundred times the difference: what linearising leaves out, and nothing else."""
    small, large = (np.max(np.abs(np.subtract(*both_models(size)))) for size in (1e-3, 1e-2))
    assert 80 < large / small < 125


def test_at_large_angles_they_disagree_visibly():
    nonlinear, linear = both_models(0.2)
    assert np.max(np.abs(nonlinear - linear)) > 0.1 * np.max(np.abs(linear))


def test_a_rigid_turn_of_everything_leaves_the_springs_at_rest():
    """Chassis and payload shifted alike and yawed alike: no force, no acceleration, at any angle."""
    rig = NonlinearRig(load_rig("avis").with_parameters(SKEW).mounted_body())
    q = np.array([0.3, -0.2, 0.5, 0.4, -0.3, 1.2])
    assert np.allclose(rig.derivative(np.concatenate([q, np.zeros(6)]), q_ch=q), 0, atol=1e-12)
