"""The independent bench itself, held against textbook formulas and against linear algebra that it does not use."""

import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.linalg import eigh, expm
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[2]))

from avis_ctrl.rigs.rig_file import load_rig
from benchmarks.own_tables import campaign, closed_loop, tables
from benchmarks.own_tables.physics import (
    Drive,
    FloorVelocity,
    Geophone,
    Mount,
    PositionSensor,
    State,
    Table,
    cross_matrix,
    drive_matrix,
    floor_motion,
    rigid,
    simulate,
)

J = np.array([[5.0, 0.4, -0.3], [0.4, 7.0, 0.2], [-0.3, 0.2, 9.0]])


def table(mounts=(), drives=(), sensors=(), **changes) -> Table:
    return replace(
        Table("t", 100.0, J, (0.0, 0.0, 0.0), mounts, drives, sensors, 1000.0, 16, 10.0, 0.001, 2e-6), **changes
    )


def mounts(damping=(0.0, 0.0, 0.0)):
    places = ((-0.4, -0.3, -0.1), (0.4, -0.3, -0.12), (0.0, 0.35, -0.1))
    return tuple(Mount(p, (9e3 + 500 * i, 8e3, 2e4 - 900 * i), damping) for i, p in enumerate(places))


def one_axis(zeta=0.05, f=2.0, **changes) -> Table:
    """A mount at the centre of mass: six decoupled springs of which z is looked at."""
    w = 2 * np.pi * f
    far = tuple(Mount(p, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for p in ((1.0, 0.0, 0.0),))
    return table((Mount((0.0, 0.0, 0.0), (1e5, 1e5, 100 * w * w), (0.0, 0.0, 200 * zeta * w)), *far), **changes)


def sine_floor(N, dt, f, level, axis=2):
    """Floor velocity level * sin(2 pi f t) along one axis, from t = 0."""
    t, w = np.arange(N + 1) * dt, 2 * np.pi * f
    floor = np.zeros((N + 1, 18))
    floor[:, axis], floor[:, 6 + axis], floor[:, 12 + axis] = (
        -level / w * np.cos(w * t),
        level * np.sin(w * t),
        level * w * np.cos(w * t),
    )
    return floor


def amplitude(signal, f, dt):
    """Complex amplitude of sin(2 pi f t) in a signal of whole periods."""
    t = np.arange(len(signal)) * dt
    return 2j * np.mean(signal * np.exp(-2j * np.pi * f * t))


def test_free_body_keeps_energy_and_angular_momentum():
    body = table()
    state = State.rest(body)
    state.x[7:13] = 0.01, -0.02, 0.015, 1.5, 0.4, -0.7  # turns three times over in the run
    r = simulate(body, np.zeros((10000, 0)), state=state)
    R = Rotation.from_rotvec(r.place[:, 3:]).as_matrix()
    body_rate = np.einsum("nji,nj->ni", R, r.velocity[:, 3:])
    momentum = np.einsum("nij,nj->ni", R, body_rate @ J)
    energy = 0.5 * np.einsum("ni,ij,nj->n", body_rate, J, body_rate)
    assert np.ptp(energy) < 1e-9 * energy[0]
    assert np.ptp(momentum, axis=0).max() < 1e-9 * np.linalg.norm(momentum[0])
    assert np.ptp(body_rate, axis=0).min() > 0.1  # it tumbles: the above says something
    assert r.place[-1, :3] == pytest.approx(9.999 * r.velocity[0, :3], rel=1e-9)


def test_undamped_table_keeps_energy_in_large_motion():
    body = table(mounts(), gravity_m_per_s2=9.81)
    state = State.rest(body)
    state.x[7:13] = 0.3, -0.2, 0.1, 1.5, -1.8, 0.6
    r = simulate(body, np.zeros((5000, 0)), state=state)
    R = Rotation.from_rotvec(r.place[:, 3:]).as_matrix()
    rate = np.einsum("nji,nj->ni", R, r.velocity[:, 3:])
    P = body.arrays
    energy = 50.0 * (r.velocity[:, :3] ** 2).sum(axis=1) + 0.5 * np.einsum("ni,ij,nj->n", rate, J, rate)
    energy += 981.0 * r.place[:, 2]
    for m, p, F in zip(body.mounts, P.mount_p, P.mount_F, strict=True):
        e = r.place[:, :3] + R @ p - p
        energy += 0.5 * (e**2) @ np.array(m.stiffness_N_per_m) - e @ F
    assert abs(r.place[:, 3:]).max() > 0.05  # large turns
    assert np.ptp(energy) < 1e-7 * energy[0]
    assert P.mount_F[:, 2].sum() == pytest.approx(981.0)


def test_modes_are_those_of_the_eigenproblem():
    body = table(mounts(), centre_of_mass_m=(0.02, -0.03, 0.05))
    K, M = np.zeros((6, 6)), np.diag([100.0] * 3 + [0.0] * 3)
    M[3:, 3:] = J
    for m in body.mounts:
        x, y, z = np.subtract(m.position_m, body.centre_of_mass_m)
        G = np.array([[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 1, y, -x, 0]])
        K += G.T @ np.diag(m.stiffness_N_per_m) @ G
    expected = np.sqrt(eigh(K, M, eigvals_only=True)) / (2 * np.pi)
    found = sorted(m.frequency_Hz for m in closed_loop.linearise(body).modes)
    assert found == pytest.approx(expected, rel=1e-7)
    assert tables.modes(body)[0] == pytest.approx(expected, rel=1e-9)


def test_transmissibility_is_the_textbook_one():
    zeta, f0 = 0.05, 2.0
    f, T = closed_loop.transmissibility(one_axis(zeta, f0), band=(0.5, 20.0), period_s=10.0, settle_periods=2)
    r = f / f0
    expected = (1 + 2j * zeta * r) / (1 - r**2 + 2j * zeta * r)
    assert T[:, 2, 2] == pytest.approx(expected, rel=2e-4)
    assert abs(T[:, [0, 1, 3, 4, 5], 2]).max() < 1e-6


def test_weight_above_the_mounts_softens_the_tilt():
    lower = table(mounts(), gravity_m_per_s2=9.81)
    (k,) = (np.diag(closed_loop.lifted_map(t)[0])[10] for t in (lower,))
    (k0,) = (np.diag(closed_loop.lifted_map(t)[0])[10] for t in (table(mounts()),))
    height = -np.average([m.position_m[2] for m in lower.mounts], weights=lower.arrays.mount_F[:, 2])
    # d phi_y'' / d phi_y changes by m g h J^-1; over one sample the turn rate's own entry by half of that times dt^2
    assert k - k0 == pytest.approx(0.5e-6 * 981.0 * height * np.linalg.inv(J)[1, 1], rel=1e-3)


def test_geophone_is_the_formula_of_its_data_sheet():
    w0, z, wc, zc = 2 * np.pi * 4.5, 0.56, 2 * np.pi * 0.5, 0.7
    own = Geophone("own", (0.1, 0.2, 0.0), (0, 0, -1), 30.0, 4.5, 0.6, 7.0, 0.5, 0.7, on="floor", trimmed=(4.5, 0.56))
    ideal = FloorVelocity("ideal", (0.0, 0.0, 0.0), (0, 0, 2.0), 3.0)
    body, f, N = one_axis(sensors=(own, ideal)), 3.0, 10000
    y = simulate(body, np.zeros((N, 0)), floor=sine_floor(N, 1e-3, f, 1e-3), quantise=False).y[-2000:]
    s = 2j * np.pi * f
    expected = (
        -30.0
        * 7
        * s**2
        / (s**2 + 1.2 * w0 * s + w0**2)
        * (s**2 + 2 * z * w0 * s + w0**2)
        / (s**2 + 2 * zc * wc * s + wc**2)
    )
    assert amplitude(y[:, 0], f, 1e-3) == pytest.approx(1e-3 * expected, rel=1e-6)
    assert amplitude(y[:, 1], f, 1e-3) == pytest.approx(3e-3, rel=1e-9)


def test_command_acts_after_the_delay_and_not_before():
    drive = Drive("F", (0.0, 0.0, 0.0), (0.0, 3.0, 4.0), -5.0)
    sensor = PositionSensor("P", (0.0, 0.0, 0.0), (0.0, 0.6, 0.8), 1e4)
    r = simulate(table((), (drive,), (sensor,), loop_delay_s=0.0013), np.full((20, 1), 2.0), quantise=False)
    since = np.maximum(np.arange(20) * 1e-3 - 0.0013, 0.0)
    assert r.y[:, 0] == pytest.approx(-1e4 * 0.5 * (10.0 / 100.0) * since**2, rel=1e-9, abs=1e-15)


def test_loop_is_that_of_the_matrix_exponential():
    """One axis, a sampled filter with feedthrough, delay of 1.5 samples, against expm of pieces put together."""
    drive, sensor = Drive("F", (0.0, 0.0, 0.0), (0, 0, 1), 5.0), PositionSensor("P", (0.0, 0.0, 0.0), (0, 0, 1), 1e4)
    body = one_axis(0.02, 3.0, drives=(drive,), sensors=(sensor,), loop_delay_s=0.0015)
    K = closed_loop.Controller(np.array([[0.7]]), np.array([[0.3]]), np.array([[8.0]]), np.array([[-8.5]]), 1000.0)
    w = 6 * np.pi
    F = np.array([[0.0, 1.0, 0.0], [-w * w, -0.04 * w, 0.05], [0.0, 0.0, 0.0]])
    half = expm(F * 0.5e-3)
    p, g = half[:2, :2], half[:2, 2:]
    A = np.zeros((5, 5))  # z, v, u before, u before that, filter
    A[:2, :2], A[:2, 3:4], A[:2, 2:3] = p @ p, p @ g, g
    A[2, 0], A[2, 4], A[3, 2], A[4, 0], A[4, 4] = -8.5e4, 8.0, 1.0, 0.3e4, 0.7
    values = np.linalg.eigvals(A)
    mine, names = closed_loop.lifted_map(body, K)
    found = np.linalg.eigvals(mine)
    assert len(names) == len(mine)
    for value in values:
        assert abs(found - value).min() < 1e-7


@pytest.mark.parametrize(("gain", "stable"), [(0.3, True), (2.0, False)])
def test_eigenvalues_and_simulation_agree_on_the_tripod(gain, stable):
    """Velocity feedback with 1 Hz geophones: braked softly it holds, braked hard it swings below 1 Hz, horizontally."""
    real = tables.truth("tripod", 1)
    loop = closed_loop.velocity_feedback(tables.tripod(), gain * 200.0 * 4 * np.pi)
    linear, shown = closed_loop.linearise(real, loop), closed_loop.run(real, loop, seconds=10.0)
    assert linear.stable is stable and shown.stable is stable, shown.why
    if not stable:
        assert linear.least_stable.axis in "xy" and linear.least_stable.frequency_Hz < 1.0
        assert shown.growing_axis == linear.least_stable.axis


def test_controller_file_is_read_back(tmp_path):
    loop = closed_loop.velocity_feedback(tables.twelve_sensors(), 3000.0)
    rig = tables.twelve_sensors()
    swapped = replace(
        loop,
        D=loop.D[::-1],
        C=loop.C[::-1],
        inputs=tuple(s.name for s in rig.sensors),
        outputs=tuple(d.name for d in rig.drives)[::-1],
    )
    swapped.write(tmp_path / "controller.json")
    back = closed_loop.Controller.read(tmp_path / "controller.json").on(rig)
    for own, theirs in zip(back, loop.on(rig), strict=True):
        assert np.array_equal(own, theirs)
    with pytest.raises(ValueError, match="sensors"):
        swapped.on(tables.skewed())


def test_campaign_file_holds_the_response(tmp_path):
    """A multisine's last period is the linear frequency response at its lines: hold, delay, mechanics, geophone."""
    drive, sensor = (
        Drive("F", (0.0, 0.0, 0.0), (0, 0, 1), 5.0),
        Geophone("G", (0.0, 0.0, 0.0), (0, 0, 1), 30.0, 1.0, 0.7, 100.0),
    )
    body = one_axis(
        0.2, 3.0, drives=(drive,), sensors=(sensor,), adc_bits=24, floor_velocity_rms_m_per_s=1e-12, loop_delay_s=0.0014
    )
    settings = campaign.Settings(period_s=4.0, rest_s=1.0, validation_s=2.0, settle_s=0.5)
    told = campaign.write_campaign(body, "single", tmp_path / "c.h5", seed=1, floor_measured=True, settings=settings)
    assert [t["excitation"] for t in told] == ["multisine", "rest", "noise"]
    with h5py.File(tmp_path / "c.h5") as file:
        assert file.attrs["format"] == "avis-campaign" and list(file["records/00/floor"].attrs["names"]) == [
            "vx",
            "vy",
            "vz",
        ]
        u, y = file["records/00/u"][-4000:, 0], file["records/00/y"][-4000:, 0]
        assert file["records/00"].attrs["period_s"] == 4.0 and file["records/00/y"].attrs["unit"] == "V"
    assert 3.0 < abs(y).max() < 4.5
    line = np.arange(2, 50)
    s = 2j * np.pi * line / 4.0
    hold = (1 - np.exp(-s * 1e-3)) / (s * 1e-3) * np.exp(-s * 0.0014)
    w, g = 6 * np.pi, 2 * np.pi
    expected = hold * 0.05 * s / (s**2 + 0.4 * w * s + w**2) * 3000 * s**2 / (s**2 + 1.4 * g * s + g**2)
    # images of the held command above half the sample rate fold back: a thousandth at these lines
    assert np.fft.rfft(y)[line] / np.fft.rfft(u)[line] == pytest.approx(expected, rel=2e-3)


def test_tables_are_what_they_say():
    for name, make in tables.NOMINAL.items():
        real = tables.truth(name, 3)
        again = tables.truth(name, 3)
        f, zeta = tables.modes(make())
        assert real.mass_kg == again.mass_kg and real.mass_kg != make().mass_kg
        assert f.min() > 1.4 and f.max() < 16.0 and zeta.min() > 0.01 and zeta.max() < 0.07
        assert closed_loop.linearise(real).stable
        assert campaign.logical_axes(real).shape[1] == (3 if name == "four_vertical" else 6)


def test_floor_motion_is_one_motion():
    floor = floor_motion(4000, 1e-3, 2e-6, np.random.default_rng(1), (0.5, 60.0), (0, 2))
    assert floor[:-1, [6, 8]].std(axis=0) == pytest.approx([2e-6, 2e-6], rel=1e-6)
    assert not floor[:, 1].any()
    for k in (0, 6):  # central differences of place and velocity
        slope = (floor[2:, k] - floor[:-2, k]) / 2e-3
        assert np.abs(slope - floor[1:-1, k + 6]).max() < 0.03 * np.abs(slope).max()


@pytest.mark.parametrize("name", tables.NOMINAL)
def test_nominal_table_is_that_of_the_rig_file(name):
    """Equations of motion, drives, and each sensor's response: a comparison with another table would say nothing."""
    own, rig = tables.NOMINAL[name](), load_rig(str(Path(__file__).parents[2] / "designs" / "rigs" / f"{name}.toml"))
    equations = rig.equations_of_motion()
    # The rig's coordinates describe its geometric centre, those of the independent table its centre of mass.
    there = np.eye(6)
    there[:3, 3:] = cross_matrix(own.centre_of_mass_m)
    theirs = [there.T @ X @ there for X in (equations.M, equations.C, equations.K)] + [there.T @ equations.T]
    for mine, other in zip((*rigid(own), drive_matrix(own)), theirs, strict=True):
        assert np.allclose(mine, other, rtol=0, atol=1e-4 * abs(other).max())  # directions have four digits
    for mine in own.sensors:
        other = next(one for one in rig.sensors() if one.name == mine.name)
        assert mine.position_m == pytest.approx(other.position) and mine.direction == pytest.approx(
            other.direction, abs=1e-4
        )
        assert mine.noise_rms_V == other.noise_rms_V
        order, (A, B, C, D) = mine.filter()  # of acceleration, floor excluded; a position sensor's of displacement
        for f in (0.3, 1.0, 20.0, 200.0):
            s = 2j * np.pi * f
            response = (C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D)[0, 0] * (s if order < 2 else 1.0)
            expected = other.as_velocity(np.array([2 * np.pi * f]))[0] * other.gain * (1.0 if order < 2 else s)
            assert response == pytest.approx(expected, rel=1e-9), mine.name
    said = rig.acquisition, rig.ambient
    assert (own.sample_rate_Hz, own.adc_bits, own.adc_range_V, own.loop_delay_s, own.floor_velocity_rms_m_per_s) == (
        said[0].sample_rate_Hz,
        said[0].adc_bits,
        said[0].adc_range_V,
        said[0].loop_delay_s,
        said[1].floor_velocity_rms_m_per_s,
    )


def test_units_of_the_controllers_states_change_no_eigenvalue():
    """States 1e9 times smaller and an output matrix 1e9 times larger: the finite differences must not reach a limit."""
    twelve = tables.NOMINAL["twelve_sensors"]()
    K = closed_loop.velocity_feedback(twelve, 500.0)
    assert len(K.A)  # states: the integrators of the accelerometers
    other = replace(K, B=K.B * 1e-9, C=K.C * 1e9)
    one, two = (np.sort_complex(np.linalg.eigvals(closed_loop.lifted_map(twelve, c)[0])) for c in (K, other))
    assert np.abs(np.abs(one) - np.abs(two)).max() < 1e-5
