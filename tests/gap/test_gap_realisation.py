"""State-space realisations of effects against responses, closed forms and an integration in time."""

from __future__ import annotations

from dataclasses import replace
from math import factorial

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.base import SETTINGS as LIBRARY
from avis_ctrl.gap.effects.base import Effect, EffectParameter
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.operators import Assembled
from avis_ctrl.gap.realisation import realise, sufficient_order, with_effects
from avis_ctrl.gap.state_space import SETTINGS, ReducedTable, impedance, ladder
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.lti.statespace import gain
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rigid_body import COORDINATES, point_map
from avis_ctrl.uncertainty.uncertain_rig import uncertain_rig

TAU = 1 / (2 * np.pi * 90)
SHAPE = tuple(0.05 * np.random.default_rng(4).standard_normal(12))
# Linear effects: name, place, values.
LINEAR = [
    ("geophone_corner", "Sz1", (4.0, 0.5)),
    ("sensor_gain", "Sz1", (1.2,)),
    ("sensor_misalignment", "Sz1", (5.0, -8.0)),
    ("tilt_coupling", "horizontal geophones", (9.8,)),
    ("actuator_gain", "Az1", (1.3,)),
    ("actuator_lag", "actuators", (TAU,)),
    ("actuator_lag", "actuators/each", (TAU, 0.1, -0.2, 0.05, 0.12, -0.1, 0.15, -0.07)),
    ("actuator_lag", "actuators/two", (TAU, 0.7)),
    ("loop_delay", "loop", (2e-3,)),
    ("com_offset", "payload", (0.02, 0.01, -0.03)),
    ("product_of_inertia", "Jxy", (5.0,)),
    ("mount_relaxation", "isolators z", (0.4, 3.0)),
    ("mount_surge", "isolators z", (40.0, 0.4, 0.03, 0.01, -0.02, 0.02)),
    ("leveling_loop", "isolators 1-3 z/plain", (0.18,)),
    ("leveling_loop", "isolators 1-3 z/lag", (0.18, 0.5)),
    ("leveling_loop", "isolators 1-3 z/each", (0.18, 0.2, -0.1)),
    ("base_compliance", "chassis/translation", (2000.0, 0.06, 20.0, 20.0, 14.0)),
    ("base_compliance", "chassis/rocking", (2000.0, 0.06, 20.0, 20.0, 14.0, 25.0, 25.0, 25.0, 0.6, 0.6, 0.6, 0.0, 0.0)),
    (
        "base_compliance",
        "chassis/rocking",
        (1000.0, 0.06, 20.0, 22.0, 14.0, 25.0, 24.0, 26.0, 0.4, 0.5, 0.6, -0.4, -0.1),
    ),
    ("attached_oscillator", "payload/oblique", (2.0, -3.0, 1.5, 12.0, 0.04, 0.3, -0.2, 0.1)),
    ("attached_oscillator", "payload/axes", (20.0, 9.0, 11.0, 14.0, 0.04, 0.3, -0.2, 0.1)),
    ("attached_oscillator", "payload/z", (20.0, 12.0, 0.04, 0.3, -0.2)),
    ("attached_oscillator", "payload/xyz", (20.0, 12.0, 0.04, 0.3, -0.2, 0.1)),
    ("cable_stiffness", "payload/axes", (1e4, 2e4, 3e3, 5e-3, 0.3, 0.2, 0.1)),
    ("cable_stiffness", "payload/oblique", (100.0, -30.0, 60.0, 5e-3, 0.3, 0.2, 0.1)),
    ("payload_flexible_mode", "payload", (30.0, 0.02, *SHAPE)),
    ("payload_flexible_mode", "payload/two", (30.0, 0.02, *SHAPE, 55.0, 0.01, *SHAPE[::-1])),
]
MECHANICAL = [
    one
    for one in LINEAR
    if one[0]
    not in (
        "geophone_corner",
        "sensor_gain",
        "sensor_misalignment",
        "tilt_coupling",
        "actuator_gain",
        "actuator_lag",
        "loop_delay",
    )
]


def name_of(one) -> str:
    return f"{one[0]}@{one[1]}"


@pytest.fixture(scope="module")
def rig():
    return load_rig("avis")


@pytest.fixture(scope="module")
def plain(rig):
    """Not sampled: nothing of the response is beyond state space but a delay."""
    return TableModel(ResponseModel.of(rig, ("mass",), sampled=False))


@pytest.fixture(scope="module")
def sampled(rig):
    return TableModel(ResponseModel.of(rig, ("mass",)))


def with_one(model: TableModel, name: str, place: str, values) -> TableModel:
    return replace(model, effects=(*model.effects, active(library()[name], model, place, values)))


def differ(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(np.linalg.norm(a - b, axis=(1, 2)) / np.linalg.norm(b, axis=(1, 2))))


@pytest.mark.parametrize("one", LINEAR, ids=name_of)
def test_linear_effects_are_realised_to_rounding(plain, one):
    model = with_one(plain, *one)
    made = realise(model, pade_order=10)
    omega, n_u = made.omega, len(model.actuators)
    asked = model.response(omega)
    found = made.system.select(list(model.sensors.names), None).frequency_response(omega)
    assert max(differ(found[:, :, k], asked[:, :, k]) for k in (slice(0, n_u), slice(n_u, None))) < 1e-9
    assert made.error < 1e-9 and made.aliases == 0 and made.notes == ()
    # The effect is there to be seen.
    without = plain.response(omega)
    assert max(differ(asked[:, :, k], without[:, :, k]) for k in (slice(0, n_u), slice(n_u, None))) > 1e-2


@pytest.mark.parametrize("one", [LINEAR[5], LINEAR[6], ("actuator_lag", "actuators", (-0.3 * TAU,))], ids=name_of)
def test_an_added_lag_is_realised_with_the_expected_one(plain, one):
    known = replace(plain, base=replace(plain.base, amplifier_corner_Hz=1 / (2 * np.pi * TAU)))
    assert realise(with_one(known, *one), pade_order=10).error < 1e-9


@pytest.mark.parametrize("one", [LINEAR[5], LINEAR[6], LINEAR[9]], ids=name_of)
def test_sampled_models_differ_by_their_aliases(sampled, one):
    model = with_one(sampled, *one)
    made = realise(model)
    found = made.system.select(list(model.sensors.names), None).frequency_response(made.omega)
    whole = differ(found[:, :, :8], model.response(made.omega)[:, :, :8])
    assert made.error < 2e-3
    assert whole <= made.error * (1 + made.aliases) + made.aliases < 0.05


def test_two_effects_at_once(plain):
    model = with_one(with_one(plain, *LINEAR[0]), *LINEAR[9])
    model = with_one(with_one(model, *LINEAR[3]), *LINEAR[15])
    assert realise(model).error < 1e-9


@pytest.mark.parametrize("one", MECHANICAL, ids=name_of)
def test_locked_coordinates_are_rows_and_columns_left_out(plain, one):
    """with_effects on z and phi_x against D with the other rows and columns struck out."""
    model, keep = with_one(plain, *one), ("z", "phi_x")
    omega = 2 * np.pi * np.geomspace(0.5, 80.0, 40)
    system = with_effects(uncertain_rig(model.effective.rig, [], keep).system, model, keep)
    made = Assembled(model.operators(omega))
    kept = [COORDINATES.index(name) for name in keep]
    edge = np.array([1.0, model.rig.edge_m])
    if made.ops.recoil is not None:  # what the chassis feels of coordinates that are locked is the wall's
        kept_only = np.zeros((6, 6))
        kept_only[np.ix_(kept, kept)] = made.M[np.ix_(kept, kept)]
        made = assemble_with_mass(model, omega, kept_only, kept)
    rows = [*kept, *range(6, made.n_q)]
    D, T = made.D[:, rows][:, :, rows], made.T[rows]
    x = np.linalg.solve(D, np.broadcast_to(T, (len(omega), *T.shape)))[:, :2]
    asked = 1j * omega[:, None, None] * x * edge[:, None]
    found = system.select(["z_dot", "phi_x_edge_dot"], list(model.actuators)).frequency_response(omega)
    assert differ(found, asked) < 1e-9


def assemble_with_mass(model: TableModel, omega: np.ndarray, M: np.ndarray, kept: list[int]):
    """Assembled with the recoil of a part of the mass matrix only, of a chassis that is locked where the payload is."""
    ops = model.operators(omega)
    rigid, own = model.effective.matrices.M, np.ix_(range(len(omega)), kept, kept)
    held = np.linalg.pinv(np.linalg.pinv(ops.recoil)[own])
    ops.recoil = np.zeros_like(ops.recoil)
    ops.recoil[own] = held
    ops.recoil = ops.recoil @ M @ np.linalg.inv(rigid)
    return Assembled(ops)


def test_friction_at_rest_is_stiffness_of_the_driven_mounts(rig, plain):
    model = with_one(plain, "contact_friction", "actuators", (7e3, 1e-5, *(0.0,) * 7))
    changes = {
        f"isolator{m.isolator}.k_{m.axis}": rig.parameters()[f"isolator{m.isolator}.k_{m.axis}"].value + 7e3
        for m in rig.motors
    }
    stiffer = realise(replace(plain, base=replace(plain.base, rig=rig.with_parameters(changes))))
    made = realise(model)
    omega = made.omega
    assert differ(made.system.frequency_response(omega), stiffer.system.frequency_response(omega)) < 1e-9
    assert "spring at every drive" in made.notes[0]


@pytest.mark.parametrize("when", [-0.5, 0.0, 0.5])
def test_drift_is_the_stiffness_of_that_moment(rig, plain, when):
    model = with_one(plain, "stiffness_drift", "isolators/linear", (0.3,))
    changes = {name: (1 + 0.3 * when) * one.value for name, one in rig.parameters().items() if ".k_" in name}
    other = realise(replace(plain, base=replace(plain.base, rig=rig.with_parameters(changes))))
    made = realise(model, when=when)
    assert differ(made.system.frequency_response(made.omega), other.system.frequency_response(made.omega)) < 1e-9


def test_a_settling_drift_is_nearly_over_in_the_middle_of_the_campaign(rig, plain):
    """(1 - exp(-t/tau))/(1 - exp(-T/tau)) of the change is made by t = T/2, less the half that the middle counts."""
    model = with_one(plain, "stiffness_drift", "isolators/settling", (0.3, 0.1))
    made = (1 - np.exp(-5.0)) / (1 - np.exp(-10.0)) - 0.5
    changes = {name: (1 + 0.3 * made) * one.value for name, one in rig.parameters().items() if ".k_" in name}
    other = realise(replace(plain, base=replace(plain.base, rig=rig.with_parameters(changes))))
    found = realise(model, when=0.0)
    assert differ(found.system.frequency_response(found.omega), other.system.frequency_response(found.omega)) < 1e-9


@pytest.mark.parametrize(
    "name, place, values",
    [("cubic_stiffness", "isolators z", (1e9, 0.0, 0.0, 0.0)), ("actuator_saturation", "actuators", (3.0,))],
)
def test_what_vanishes_with_amplitude_is_left_out_and_said(plain, name, place, values):
    made, without = realise(with_one(plain, name, place, values)), realise(plain)
    assert differ(made.system.frequency_response(made.omega), without.system.frequency_response(made.omega)) < 1e-9
    assert len(made.notes) == 1 and "left out" in made.notes[0]


def test_structural_damping_is_a_ladder(plain):
    made = realise(with_one(plain, "structural_damping", "isolators/causal", (0.08,)))
    assert 1e-6 < made.error < 2e-2 and made.system.is_stable()


def test_constant_complex_stiffness_is_not_claimed(plain):
    """No causal system has it: the distance is large, and told."""
    made = realise(with_one(plain, "structural_damping", "isolators/complex", (0.08,)))
    assert made.error > 0.05 and any("no causal system" in note for note in made.notes)


@given(st.floats(1e-3, 0.5))
@settings(max_examples=25, deadline=None)
def test_the_ladder_is_passive_and_follows_the_power(power):
    rest, corners, ratios = ladder(power)
    assert rest >= 0 and np.all(corners > 0) and np.all(ratios > 0)
    s = 2j * np.pi * np.geomspace(*SETTINGS.ladder_Hz, 333)
    made = rest + sum(ratio * s / (s + w) for w, ratio in zip(corners, ratios, strict=True))
    assert np.max(np.abs(made / (s / (2 * np.pi * LIBRARY.loss_Hz)) ** power - 1)) < 1.1 * SETTINGS.ladder_error
    assert np.all(made.imag > 0)


def test_a_hanging_mass_in_time(rig, plain):
    """Seven coordinates integrated in time by scipy: the payload and the mass, a force step of one motor."""
    mass, frequency, zeta, x, y = 20.0, 12.0, 0.04, 0.3, -0.2
    made = realise(with_one(plain, "attached_oscillator", "payload/z", (mass, frequency, zeta, x, y))).system
    eom, w = rig.equations_of_motion(), 2 * np.pi * frequency
    g = np.append(point_map(np.array([x, y, 0.0]))[2], -1.0)  # stretch of the spring by (q, displacement of the mass)
    M = la.block_diag(eom.M, mass)
    K = la.block_diag(eom.K, 0.0) + mass * w**2 * np.outer(g, g)
    C = la.block_diag(eom.C, 0.0) + 2 * zeta * w * mass * np.outer(g, g)
    push = np.append(eom.T[:, eom.actuators.index("Az2")], 0.0)

    def slope(t: float, state: np.ndarray) -> np.ndarray:
        q, v = state[:7], state[7:]
        return np.concatenate([v, la.solve(M, push - K @ q - C @ v, assume_a="pos")])

    times = np.linspace(0.05, 1.0, 20)
    there = solve_ivp(slope, (0.0, 1.0), np.zeros(14), t_eval=times, rtol=1e-10, atol=1e-14).y[7:13].T
    step = made.select(["x_dot", "y_dot", "z_dot", "phi_x_edge_dot", "phi_y_edge_dot", "phi_z_edge_dot"], ["Az2"])
    both = np.block([[step.A, step.B], [np.zeros((1, step.nstates + 1))]])
    found = np.array([step.C @ la.expm(both * t)[:-1, -1:] for t in times])[:, :, 0]
    there[:, 3:] *= rig.edge_m
    assert np.max(np.abs(found - there)) < 1e-6 * np.max(np.abs(there))


def test_the_order_of_a_delay():
    for order, x in ((2, 0.3), (3, 0.5), (4, 1.0)):
        # Leading term of the error of [n/n]: (n!)^2 / ((2n)! (2n+1)!) x^(2n+1).
        size = factorial(order) ** 2 / (factorial(2 * order) * factorial(2 * order + 1)) * x ** (2 * order + 1)
        found, error = sufficient_order(x / 100.0, 100.0, 1.5 * size, 10)
        assert found == order and error == pytest.approx(size, rel=0.1)
    # 200 rad of delay at order 10: of no use, and not taken for exact by a chance agreement of phases.
    assert sufficient_order(2.0, 100.0, 1e-3, 10) == (10, 2.0)


def test_refusals(rig, plain):
    with pytest.raises(InputError, match="chassis with a mass"):
        realise(with_one(plain, "base_compliance", "chassis/translation", (0.0, 0.06, 20.0, 20.0, 14.0)))
    with pytest.raises(InputError, match="sensors of velocity"):
        realise(TableModel(ResponseModel.of(rig, ("mass",), unit="m/s^2", sampled=False)))
    ideal = TableModel(ResponseModel.of(rig, ("mass",), unit="m/s", sampled=False))
    with pytest.raises(InputError, match="integrate gravity twice"):
        realise(replace(ideal, effects=(active(library()["tilt_coupling"], plain, "horizontal geophones", (9.8,)),)))


class _Skyhook(Effect):
    """Not registered: a user's effect, a damper of the payload to the sky along z."""

    name = "sky_damper"
    title = "a damper to the sky"
    looks_like = "more damping along z"

    def places(self, model):
        return ("payload",)

    def parameters(self, model, place):
        return (EffectParameter("damping_Ns_per_m", "N s/m", "to the sky", 0.0, 0.0, 1e6, 1e3),)

    def change(self, ops, place, values):
        ops.add_impedance(values["damping_Ns_per_m"] * ops.s[:, None], np.eye(6)[2:3])


class _WithStates(_Skyhook):
    def addition(self, table: ReducedTable, place, values):
        g = table.rows(np.eye(6)[2:3])
        return impedance(table, values["damping_Ns_per_m"] * g.T @ g, gain([[1.0]]), "v")


def test_effects_of_the_users_own(plain):
    """Without a state-space form it is left out, and said so with its cost; with one it is in."""
    left_out = realise(replace(plain, effects=(active(_Skyhook(), plain, "payload", (2e4,)),)))
    assert "left out" in left_out.notes[0] and left_out.error > 0.1
    held = realise(replace(plain, effects=(active(_WithStates(), plain, "payload", (2e4,)),)))
    assert held.notes == () and held.error < 1e-9
    assert held.omega == pytest.approx(2 * np.pi * np.geomspace(*SETTINGS.check_Hz))
