"""Every effect of the mechanics against the same physics with explicit coordinates, and its limits in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from assembled_table import Assembly, mount_map
from noise_fit import fitted, reported

from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.operators import Assembled
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.instruments import PositionSensorAt

RIG = load_rig("avis")
# Displacements against the voltage itself: no chain, no hold, no aliases.
BARE = TableModel(ResponseModel.of(RIG, (), unit="m", sampled=False))
F = np.geomspace(0.3, 150.0, 50)
OMEGA = 2 * np.pi * F
VERTICAL = [one.stiffness[2] for one in RIG.isolators]
RIGS = Path(__file__).parents[2] / "designs" / "rigs"


def with_effect(name, place, values, model=BARE):
    return model.with_effect(active(library()[name], model, place, values))


def agree(model, assembly, rtol=1e-9):
    found, true = model.response(OMEGA), assembly.response(F)
    for part in (slice(0, 8), slice(8, 11)):  # by volts, by the floor's velocity
        off = np.abs(found - true)[:, :, part].max(axis=(1, 2)) / np.abs(true)[:, :, part].max(axis=(1, 2))
        assert np.max(off) < rtol
    # and the effect is not one that could be left out
    plain = Assembly(RIG).mounts().response(F)
    assert np.max(np.abs(true - plain).max(axis=(1, 2)) / np.abs(plain).max(axis=(1, 2))) > 1e-3


def dynamic_stiffness(model, f):
    """(n, 6, 6) at rest floor."""
    return Assembled(model.operators(2 * np.pi * np.atleast_1d(np.asarray(f, float)))).D


def added_stiffness(name, place, values, f, model=BARE):
    return dynamic_stiffness(with_effect(name, place, values, model), f) - dynamic_stiffness(model, f)


def test_bare_table():
    np.testing.assert_allclose(BARE.response(OMEGA), Assembly(RIG).mounts().response(F), rtol=1e-9, atol=1e-20)


# --- sensors


def test_what_a_geophone_rings_with_is_found_with_its_transient():
    """Both states of its suspension, and what another corner or damping makes of them; of its own channel only."""
    volts = TableModel(ResponseModel.of(RIG, (), sampled=False))
    model = with_effect("geophone_corner", "Sy1", [6.0, 0.5], volts)
    k = model.sensors.names.index("Sy1")

    def left_of(y):
        columns = model.sensor_transients(OMEGA)[:, k]
        columns = columns[:, np.any(columns, axis=0)]
        A, b = (np.concatenate([x.real, x.imag]) for x in (columns / np.linalg.norm(columns, axis=0), y))
        return np.linalg.norm(b - A @ np.linalg.lstsq(A, b, rcond=None)[0]) / np.linalg.norm(b)

    s, w = 1j * OMEGA, 2 * np.pi * 6.0
    poles = s**2 + 2 * 0.5 * w * s + w**2
    for ringing in (1 / poles, s / poles, 1 / poles**2, s**3 / poles**2):
        assert left_of(ringing) < 1e-9
    elsewhere = 1 / (s**2 + 2 * 0.5 * 2 * w * s + (2 * w) ** 2)
    assert left_of(elsewhere) > 1e-2
    plain = volts.sensor_transients(OMEGA)
    added = model.sensor_transients(OMEGA)[:, :, plain.shape[2] :]
    assert added.shape[2] == 4 and not np.any(np.delete(added, k, axis=1))
    # A fit counts its unknowns on one line.
    assert model.sensor_transients(OMEGA[:1]).shape[2] == plain.shape[2] + 4
    np.testing.assert_array_equal(with_effect("sensor_gain", "Sy1", [1.1], volts).sensor_transients(OMEGA), plain)


def test_a_record_that_begins_driven_does_not_move_a_geophone_s_corner():
    """Ringing of the suspension in the data, hundreds of times the noise."""
    free = TableModel(ResponseModel.of(RIG, ("mass",), sampled=False))
    truth = with_effect("geophone_corner", "Sy1", [6.0, 0.5], free)
    k, rng, omega = free.sensors.names.index("Sy1"), np.random.default_rng(2), 2 * np.pi * np.geomspace(1.0, 40.0, 200)
    U = np.zeros((200, 11, 1), complex)
    U[:, :8, 0] = rng.standard_normal((200, 8)) + 1j * rng.standard_normal((200, 8))
    made = SpectralBlock("00", omega, U, np.zeros((200, 6, 1), complex), transient=True)
    Y = truth.answer(made, None, False).Y
    noise = 1e-4 * np.sqrt(np.mean(np.abs(Y[:, k]) ** 2))
    s = 1j * omega
    ringing = (s + 20.0) / (s**2 + 2 * 0.5 * 2 * np.pi * 6.0 * s + (2 * np.pi * 6.0) ** 2)
    Y[:, k, 0] += 300 * noise * ringing / np.abs(ringing).max()
    Y = Y + noise / np.sqrt(2) * (rng.standard_normal(Y.shape) + 1j * rng.standard_normal(Y.shape))
    block = replace(made, Y=Y).with_noise(np.broadcast_to(noise**2 * np.eye(6), (200, 6, 6)).astype(complex))
    found = fitted(with_effect("geophone_corner", "Sy1", [5.5, 0.55], free), [block])
    assert found.chi2_per_dof == pytest.approx(1.0, abs=0.1)
    told = reported(found)
    assert abs(told["corner_Hz"].value - 6.0) < 4 * told["corner_Hz"].std < 0.01


# --- mounts


@pytest.mark.parametrize(("ratio", "corner"), [(0.1, 0.5), (1.0, 3.0), (5.0, 40.0)])
def test_relaxation_is_a_spring_with_a_damper_in_series(ratio, corner):
    table = Assembly(RIG, 4).mounts()
    for i, (G, k) in enumerate(zip(table.maps, VERTICAL, strict=True)):
        between = {f"e{i}": -1.0}
        table.spring(table.row(G[2], **between), ratio * k)
        table.spring(table.row(**{f"e{i}": 1.0}), 0.0, ratio * k / (2 * np.pi * corner), [0, 0, 1])
    agree(with_effect("mount_relaxation", "isolators z", [ratio, corner]), table)


def test_relaxation_stiffness_at_rest_and_at_high_frequency():
    low, high = added_stiffness("mount_relaxation", "isolators z", [0.7, 2.0], [1e-5, 1e5])[:, 2, 2]
    assert abs(low) < 1e-4 * sum(VERTICAL)
    assert high == pytest.approx(0.7 * sum(VERTICAL), rel=1e-4)


@pytest.mark.parametrize("eta", [0.02, 0.2])
def test_structural_loss(eta):
    """Both laws lose the same share at every frequency; the causal one stiffens as Kramers and Kronig ask."""
    f = np.array([0.5, 3.0, 20.0])
    K = Assembly(RIG).mounts().K
    for place in ("isolators/causal", "isolators/complex"):
        Z = added_stiffness("structural_damping", place, [eta], f) + K
        np.testing.assert_allclose(Z.imag, eta * Z.real, atol=1e-9 * np.max(K))
    causal = added_stiffness("structural_damping", "isolators/causal", [eta], f)[:, 2, 2] + K[2, 2]
    assert abs(causal[1]) == pytest.approx(K[2, 2])
    # Bode's relation: phase = pi/2 times the slope of the modulus on logarithmic axes
    slope = np.log(abs(causal[2] / causal[0])) / np.log(f[2] / f[0])
    assert np.angle(causal[1]) == pytest.approx(np.pi / 2 * slope, rel=1e-9)


@pytest.mark.parametrize("place", ["isolators/causal", "isolators/complex"])
def test_viscous_damping_in_place_of_structural_loss(place):
    """A spring and a dashpot in every mount, which equal the law at the resonances of the suspension."""
    M, K = RIG.equations_of_motion().M, Assembly(RIG).mounts().K
    squares, modes = scipy.linalg.eigh(K, M)
    mounts = BARE.operators(OMEGA).mounts
    moved = (mounts.payload @ modes) ** 2  # of every mode by a force along each row
    w = mounts.resonances(M)
    np.testing.assert_allclose(w, np.sqrt(moved @ squares / moved.sum(axis=1)), rtol=1e-9)

    model = with_effect("structural_damping", place, [0.1])
    viscous = model.with_law_of_rig_file(model.labels[0])
    law, instead = (one.operators(w).stiffness_factor for one in (model, viscous))
    np.testing.assert_allclose(np.diagonal(instead), np.broadcast_to(law, instead.shape).diagonal(), rtol=1e-12)
    at = 2 * np.pi * np.array([0.1, 10.0, 300.0])
    factor = viscous.operators(at).stiffness_factor
    np.testing.assert_allclose(factor.real, np.broadcast_to(factor.real[0], factor.shape), rtol=1e-12)
    np.testing.assert_allclose(factor.imag / at[:, None], np.broadcast_to(factor.imag[0] / at[0], factor.shape))


def test_other_effects_have_no_law_in_a_rig_file():
    model = with_effect("mount_relaxation", "isolators z", [0.1, 1.0])
    assert model.with_law_of_rig_file(model.labels[0]).effects == ()


@pytest.mark.parametrize(
    ("frequency", "share", "zeta", "uneven"),
    [(20.0, 0.5, 0.0, (0.0, 0.0, 0.0)), (45.0, 0.3, 0.02, (0.0, 0.0, 0.0)), (12.0, 0.7, 0.3, (0.03, -0.02, 0.01))],
)
def test_surge_is_a_mass_between_two_springs(frequency, share, zeta, uneven):
    table = Assembly(RIG, 4).mounts(without="z")
    offsets = (*uneven, -sum(uneven))
    for i, (G, one) in enumerate(zip(table.maps, RIG.isolators, strict=True)):
        k, c, z = one.stiffness[2], one.damping[2], np.array([0, 0, 1])
        upper, lower, w = k / share, k / (1 - share), 2 * np.pi * frequency * (1 + offsets[i])
        mass = (upper + lower) / w**2
        damper = 2 * zeta * np.sqrt((upper + lower) * mass)
        table.spring(table.row(G[2], **{f"e{i}": -1.0}), upper, damper * upper / (upper + lower))
        table.spring(table.row(**{f"e{i}": 1.0}), lower, damper * lower / (upper + lower), z)
        table.spring(table.row(G[2]), 0.0, c, z)
        table.mass(table.row(**{f"e{i}": 1.0}), mass)
    agree(with_effect("mount_surge", "isolators z", [frequency, share, zeta, *uneven]), table)


def test_surge_keeps_the_static_stiffness_and_resonates_where_it_says():
    quiet = replace(
        BARE,
        base=replace(
            BARE.base,
            rig=RIG.with_parameters(
                {f"isolator{i}.c_z": 1e-3 for i in range(1, 5)} | {f"isolator{i}.k_z": 4e4 for i in range(1, 5)}
            ),
        ),
    )
    f0, share = 18.4, 0.4
    values = [f0, share, 1e-3, 0.0, 0.0, 0.0]
    assert added_stiffness("mount_surge", "isolators z", values, 1e-4, quiet)[0, 2, 2] == pytest.approx(0, abs=1e-2)
    f = np.linspace(0.9 * f0, 1.1 * f0, 4001)
    peak = np.abs(added_stiffness("mount_surge", "isolators z", values, f, quiet)[:, 2, 2])
    assert f[np.argmax(peak)] == pytest.approx(f0, rel=1e-4)
    model = with_effect("mount_surge", "isolators z", values, quiet)
    names = [one.name for one in library()["mount_surge"].parameters(model, "isolators z")]
    told = library()["mount_surge"].reported(
        model, "isolators z", dict(zip(names, values, strict=True)), np.diag([0.1**2, 0.0, 0.0, 0.0, 0.0, 0.0])
    )
    assert told["frequency_Hz"].value == f0
    mass = 4e4 * (1 / share + 1 / (1 - share)) / (2 * np.pi * f0) ** 2
    assert told["mass_kg"].value == pytest.approx(mass)
    assert told["mass_kg"].std == pytest.approx(mass * 2 * 0.1 / f0)  # m goes as f^-2


@pytest.mark.parametrize(
    ("law", "values", "valve", "each"),
    [
        ("plain", [0.1], None, [1.0, 1.0, 1.0]),
        ("lag", [0.1, 0.4], 0.4, [1.0, 1.0, 1.0]),
        ("each", [0.1, 0.3, -0.2], None, [1.3, 0.8, 0.9]),
    ],
)
def test_leveling_integrates_the_deflection_of_three_mounts(law, values, valve, each):
    rate = 0.1
    model = with_effect("leveling_loop", f"isolators 1-3 z/{law}", values)
    true = []
    for f in F:
        s, table = 2j * np.pi * f, Assembly(RIG).mounts()
        integral = 2 * np.pi * rate / s / (1 + s / (2 * np.pi * valve) if valve else 1)
        for G, k, own in zip(table.maps[:3], VERTICAL, each, strict=False):
            table.spring(table.row(G[2]), k * own * integral, floor=[0, 0, 1])
        true.append(table.response([f])[0])
    np.testing.assert_allclose(model.response(OMEGA), true, rtol=1e-9, atol=1e-20)
    # An integral undoes a static force on three mounts; the fourth alone cannot hold the vertical axis there.
    assert np.max(np.abs(np.array(true) / Assembly(RIG).mounts().response(F) - 1)) > 0.05


def test_an_integrator_feeds_energy_in():
    """The one law of the library that is active: its loss is negative at every frequency."""
    Z = added_stiffness("leveling_loop", "isolators 1-3 z/plain", [0.04], F)
    assert np.all(np.linalg.eigvalsh((Z - np.conj(np.swapaxes(Z, 1, 2))) / 2j)[:, 0] < 0)


# --- chassis

CHASSIS = {
    "mass_kg": 900.0,
    "damping": 0.05,
    "frequency_x_Hz": 9.0,
    "frequency_y_Hz": 11.0,
    "frequency_z_Hz": 14.0,
    "frequency_rx_Hz": 10.0,
    "frequency_ry_Hz": 12.0,
    "frequency_rz_Hz": 13.0,
    "gyration_x_m": 0.4,
    "gyration_y_m": 0.5,
    "gyration_z_m": 0.6,
    "centre_z_m": -0.45,
    "base_z_m": -0.2,
}


def on_chassis(place, **changes):
    values = {one.name: CHASSIS[one.name] for one in library()["base_compliance"].parameters(BARE, place)}
    return with_effect("base_compliance", place, list((values | changes).values()))


@pytest.mark.parametrize("place", ["chassis/translation", "chassis/rocking"])
def test_base_compliance_is_a_second_body(place):
    """Its coordinates are the displacement of its point at the table's centre, and its rotation."""
    rocking, table, v = place.endswith("rocking"), Assembly(RIG, 6), CHASSIS
    for G, one in zip(table.maps, RIG.isolators, strict=True):
        for a in range(3):
            row = np.concatenate([G[a], -G[a] if rocking else [*-G[a][:3], 0, 0, 0]])
            table.spring(row, one.stiffness[a], one.damping[a])
    table.T[6:] = -table.T[:6] if rocking else np.vstack([-table.T[:3], np.zeros((3, 8))])
    height = v["centre_z_m"] if rocking else 0.0
    centre, below = (0, 0, height), (0, 0, height + (v["base_z_m"] if rocking else 0.0))
    for a, axis in enumerate("xyz"):
        m, w = v["mass_kg"], 2 * np.pi * v[f"frequency_{axis}_Hz"]
        at_centre, at_base = (np.concatenate([np.zeros(6), mount_map(p)[a]]) for p in (centre, below))
        table.mass(at_centre, m)
        table.spring(at_base, m * w**2, 2 * v["damping"] * w * m, np.eye(3)[a])
        J, w = m * v[f"gyration_{axis}_m"] ** 2, 2 * np.pi * v[f"frequency_r{axis}_Hz"]
        turned = table.row(**{f"e{3 + a}": 1.0})
        table.mass(turned, J)
        table.spring(turned, J * w**2, 2 * v["damping"] * w * J)
    agree(on_chassis(place), table)


def test_momentum_is_conserved_far_above_the_resonance_of_the_base():
    """Without outer force payload and chassis move against each other, in inverse proportion to their masses."""
    model = on_chassis("chassis/translation", frequency_x_Hz=2.0, frequency_y_Hz=2.0, frequency_z_Hz=2.0, damping=1e-3)
    made = Assembled(model.operators(2 * np.pi * np.array([2000.0])))
    x = made.inverse @ np.asarray(made.T[:, :1])[None]
    moved = made.chassis(x, np.zeros((1, 3, 1)))
    np.testing.assert_allclose(RIG.mass * x[0, :3] + 900.0 * moved[0, :3], 0, atol=1e-5 * RIG.mass * np.abs(x).max())


def test_a_heavy_chassis_is_a_stiff_floor():
    bare = BARE.response(OMEGA)
    for mass, close in ((1e5, 0.05), (1e12, 1e-8)):  # its own resonances stay, but nothing of the table moves it
        by_u = on_chassis("chassis/rocking", mass_kg=mass).response(OMEGA)[:, :, :8]
        assert np.max(np.abs(by_u - bare[:, :, :8])) < close * np.max(np.abs(bare[:, :, :8]))
    hard = on_chassis(
        "chassis/translation", mass_kg=1e12, frequency_x_Hz=1e5, frequency_y_Hz=1e5, frequency_z_Hz=1e5
    ).response(OMEGA)
    np.testing.assert_allclose(hard, bare, rtol=1e-3)  # (150 Hz / 100 kHz)^2 and the damper


# --- payload


def test_centre_of_mass_by_the_parallel_axis_theorem():
    c = np.array([0.03, -0.02, 0.05])
    table = Assembly(RIG).mounts()
    J = RIG.inertia_matrix() + RIG.mass * (c @ c * np.eye(3) - np.outer(c, c))
    S = np.array([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]])
    table.M = np.block([[RIG.mass * np.eye(3), -RIG.mass * S], [RIG.mass * S, J]])
    agree(with_effect("com_offset", "payload", c), table)


@pytest.mark.parametrize(("place", "a", "b"), [("Jxy", 0, 1), ("Jxz", 0, 2), ("Jyz", 1, 2)])
def test_product_of_inertia_is_that_entry_of_the_tensor(place, a, b):
    table = Assembly(RIG).mounts()
    table.M[3 + a, 3 + b] = table.M[3 + b, 3 + a] = 4.0
    agree(with_effect("product_of_inertia", place, [4.0]), table)


@pytest.mark.parametrize("axes", ["z", "x", "y", "xyz"])
def test_oscillator_is_a_mass_on_a_spring(axes):
    m, f, zeta = 15.0, 12.0, 0.04
    place = np.array([0.35, -0.2, 0.3])
    if axes != "xyz":
        place["xyz".index(axes)] = 0.0  # along its own axis a place makes no difference
    table, w = Assembly(RIG, len(axes)).mounts(), 2 * np.pi * f
    for k, axis in enumerate(axes):
        table.mass(table.row(**{f"e{k}": 1.0}), m)
        table.spring(table.row(mount_map(place)["xyz".index(axis)], **{f"e{k}": -1.0}), m * w**2, 2 * zeta * w * m)
    values = [m, f, zeta, *(x for x, name in zip(place, "xyz", strict=True) if axes == "xyz" or name != axes)]
    agree(with_effect("attached_oscillator", f"payload/{axes}", values), table)


def test_oscillator_is_added_mass_far_below_and_nothing_far_above():
    values = [10.0, 20.0, 0.05, 0.0, 0.0]
    low, high = added_stiffness("attached_oscillator", "payload/z", values, [0.1, 4000.0])[:, 2, 2]
    assert low == pytest.approx(-10.0 * (2 * np.pi * 0.1) ** 2, rel=1e-3)
    assert abs(high) < 3e-3 * 10.0 * (2 * np.pi * 4000.0) ** 2  # its damper: 2 zeta f0/f


def test_flexible_mode_is_a_coordinate_of_unit_mass():
    rng = np.random.default_rng(3)
    shape, f, zeta = 0.02 * rng.standard_normal(12), 25.0, 0.01
    table, w = Assembly(RIG, 1), 2 * np.pi * 25.0
    for i, (G, one) in enumerate(zip(table.maps, RIG.isolators, strict=True)):
        for a in range(3):
            table.spring(table.row(G[a], e0=shape[3 * i + a]), one.stiffness[a], one.damping[a], np.eye(3)[a])
    table.mass(table.row(e0=1.0), 1.0)
    table.spring(table.row(e0=1.0), w**2, 2 * zeta * w)
    for k, motor in enumerate(RIG.motors):
        table.T[6, k] = motor.constant_N_per_V * shape[3 * (motor.isolator - 1) + "xyz".index(motor.axis)]
    g = RIG.geophones
    table.R[:, 6] = [shape[3 * (i - 1) + "xyz".index(axis)] for i, axis in zip(g.isolator, g.axis, strict=True)]
    agree(with_effect("payload_flexible_mode", "payload", [f, zeta, *shape]), table)


def test_cable_along_the_axes_and_oblique():
    place, d = np.array([0.3, 0.2, -0.1]), np.array([0.6, 0.0, 0.8])
    for along, K, values in (
        ("axes", np.diag([800.0, 300.0, 1500.0]), [800.0, 300.0, 1500.0]),
        ("oblique", 2000.0 * np.outer(d, d), list(np.sqrt(2000.0) * d)),
    ):
        table, k = Assembly(RIG).mounts(), np.zeros((6, 6))
        G = mount_map(place)
        k[:6, :6] = G.T @ K @ G
        table.K, table.C = table.K + k, table.C + 2e-3 * k
        table.K_w, table.C_w = table.K_w + G.T @ K, table.C_w + 2e-3 * G.T @ K
        agree(with_effect("cable_stiffness", f"payload/{along}", [*values, 2e-3, *place]), table)


@pytest.mark.parametrize(
    ("name", "place", "values"),
    [
        ("mount_relaxation", "isolators z", [0.5, 2.0]),
        ("structural_damping", "isolators/causal", [0.1]),
        ("structural_damping", "isolators/complex", [0.1]),
        ("attached_oscillator", "payload/xyz", [10.0, 8.0, 0.05, 0.3, 0.2, 0.1]),
        ("cable_stiffness", "payload/axes", [500.0, 500.0, 500.0, 1e-3, 0.3, 0.2, 0.1]),
        ("mount_surge", "isolators z", [20.0, 0.4, 0.03, 0.02, 0.01, -0.01]),
    ],
)
def test_passive_at_every_frequency(name, place, values):
    """Power taken by a motion, w/2 q^H Im(Z) q, is never negative: of the effect itself, or of the mounts with it."""
    Z = (
        added_stiffness(name, place, values, F)
        if name != "mount_surge"
        else dynamic_stiffness(with_effect(name, place, values), F)
    )
    loss = np.linalg.eigvalsh((Z - np.conj(np.swapaxes(Z, 1, 2))) / 2j)
    assert np.all(loss[:, 0] > -1e-9 * np.abs(Z).max(axis=(1, 2)))
    assert np.all(loss[:, -1] > 0)


@pytest.mark.parametrize(
    ("name", "place", "values"),
    [
        ("mount_relaxation", "isolators z", [0.5, 2.0]),
        ("attached_oscillator", "payload/xyz", [10.0, 8.0, 0.05, 0.3, 0.2, 0.1]),
        ("com_offset", "payload", [0.02, 0.01, -0.03]),
        ("mount_surge", "isolators z", [20.0, 0.3, 0.05, 0.0, 0.02, 0.01]),
        ("base_compliance", "chassis/rocking", list(CHASSIS.values())),
        ("payload_flexible_mode", "payload", [25.0, 0.01, *np.linspace(-0.02, 0.03, 12)]),
    ],
)
def test_reciprocity(name, place, values):
    """Whatever has no rotor and no feedback answers alike when force and displacement change places."""
    made = Assembled(with_effect(name, place, values).operators(OMEGA))
    inverse = made.inverse
    if name == "base_compliance":  # forces between chassis and payload move these against each other
        inverse = inverse - made.chassis(inverse, np.zeros((len(OMEGA), 3, 6)))
    np.testing.assert_allclose(inverse, np.swapaxes(inverse, 1, 2), rtol=0, atol=1e-9 * np.abs(inverse).max())


@pytest.mark.parametrize(
    "effect",
    [
        None,
        ("geophone_corner", "Sz1", [5.0, 0.6]),
        ("actuator_lag", "actuators", [2e-3]),
        ("attached_oscillator", "payload/z", [20.0, 12.0, 0.05, 0.3, 0.2]),
        ("payload_flexible_mode", "payload", [25.0, 0.01, *np.linspace(-0.02, 0.03, 12)]),
        (
            "base_compliance",
            "chassis/rocking",
            [900.0, 0.05, 9.0, 11.0, 14.0, 10.0, 12.0, 13.0, 0.4, 0.5, 0.6, -0.45, -0.2],
        ),
    ],
)
def test_derivatives_by_parameters_and_tolerances_are_those_of_differences(effect):
    """Volts, floor and transient; one oblique sensor reads against the chassis. Effects on mounts leave out that they
    move with an isolator's place. The slope by a corner's tolerance is that without the effect on the same corner:
    beside a large effect it is good to the effect's size only, and left out."""
    rig = RIG.with_channels_apart()
    one, *others = rig.instruments
    rig = replace(rig, instruments=(PositionSensorAt(one.name, one.position, (0.6, 0.0, 0.8), 3e3), *others))
    same = ("corner.Sz1", "damping.Sz1") if effect and effect[0] == "geophone_corner" else ()
    free = [
        name
        for name in ResponseModel.of(rig, ()).all_parameters()
        if name != "loop_delay_s"
        and name not in same
        and not (effect and effect[0] in ("base_compliance", "payload_flexible_mode") and ".p_" in name)
    ]
    model = TableModel(ResponseModel.of(rig, free))
    if effect:
        model = with_effect(*effect, model)
    rng = np.random.default_rng(4)
    U = rng.standard_normal((len(OMEGA), 23, 1)) + 1j * rng.standard_normal((len(OMEGA), 23, 1))
    dY = model.driven(OMEGA, U).dY
    assert dY.shape == (len(model.names), len(OMEGA), 6, 1)
    for j, name in enumerate(free):
        step = 1e-5 * max(abs(model.values[j]), 0.1) * np.eye(len(model.names))[j]
        up, down = (model.at(model.values + sign * step).driven(OMEGA, U, False).Y for sign in (1, -1))
        slope = (up - down) / (2 * step[j])
        assert np.max(np.abs(dY[j] - slope)) <= 5e-6 * np.max(np.abs(slope)), name


@pytest.mark.parametrize(
    ("name", "place", "values"),
    [("sensor_misalignment", "Pz1", [5.0, -3.0]), ("tilt_coupling", "horizontal geophones", [9.80665])],
)
def test_a_position_sensor_reads_neither_common_motion_nor_gravity(name, place, values):
    """Payload and chassis move together far below the resonances."""
    base = TableModel(ResponseModel.of(load_rig(RIGS / "granite.toml"), ()))
    model = with_effect(name, place, values, base)
    omega = 2 * np.pi * np.array([0.01])
    position = base.sensors.relative.astype(bool)
    per_m = 1j * omega[0] / base.sensors.sensitivity[:, None]
    moved = (model.response(omega)[0, :, -3:] * per_m)[position]
    assert np.max(np.abs(moved)) < 1e-4  # 0.09 before, with the tilted axis read against the floor
    if name == "tilt_coupling":
        np.testing.assert_array_equal(model.response(omega)[0, position], base.response(omega)[0, position])
