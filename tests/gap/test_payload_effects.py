"""Sprung masses, bending payloads, cables and leveling against explicit coordinates, and the seeds that find them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from assembled_table import Assembly, mount_map
from noise_fit import fitted, reported
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.effects.impedance import peaks
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.operators import Assembled
from avis_ctrl.gap.realisation import realise
from avis_ctrl.gap.result import NamedEffect
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.search import at_the_edge
from avis_ctrl.gap.starting_values import seeds
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs import load_rig

RIG = load_rig("avis")
BARE = TableModel(ResponseModel.of(RIG, (), unit="m", sampled=False))
VOLTS = TableModel(ResponseModel.of(RIG, ("mass",), sampled=False))
FREE = TableModel(ResponseModel.of(RIG, ("mass", "J1", "J2", "J3"), sampled=False))
F = np.geomspace(0.3, 90.0, 60)
PLACE = np.array([0.35, -0.2, 0.3])
MASS, ZETA = 12.0, 0.04
ALONG = np.array([2.0, -1.0, 2.0]) / 3


def test_the_sentence_gives_place_and_direction_also_where_they_are_zero():
    """Two certain sizes beside them; a frequency in three axes is one quantity."""

    def said(**parameters):
        own = {name: Reported(value, std, unit) for name, (value, std, unit) in parameters.items()}
        return NamedEffect("attached_oscillator", "payload", "a sprung mass", own, 0.99).in_words()

    at = {"x_m": (0.3, 0.002, "m"), "y_m": (0.0, 0.002, "m"), "z_m": (0.2, 0.002, "m")}
    each = {f"frequency_{axis}_Hz": (f, 0.01, "Hz") for axis, f in zip("xyz", (14.0, 15.0, 22.0), strict=True)}
    assert said(mass_kg=(8.0, 0.1, "kg"), **each, damping=(0.01, 0.02, "1"), **at) == (
        "a sprung mass (attached_oscillator, payload: mass 8.00 +- 0.10 kg, frequency x 14.000 +- 0.010 Hz, "
        "y 15.000 +- 0.010 Hz, z 22.000 +- 0.010 Hz, position x 0.3000 +- 0.0020 m, y 0.0000 +- 0.0020 m, "
        "z 0.2000 +- 0.0020 m; probability 0.99)"
    )
    product = said(Jxy_kgm2=(0.5, 0.01, "kg m^2"))  # no component of a vector
    assert "Jxy 0.500 +- 0.010 kg m^2" in product
    chassis = {
        f"frequency_{axis}_Hz": (f, 0.01, "Hz") for axis, f in zip(("x", "y", "rx"), (14.0, 15.0, 22.0), strict=True)
    }
    told = "frequency x 14.000 +- 0.010 Hz, y 15.000 +- 0.010 Hz, about x 22.000 +- 0.010 Hz; probability 0.99)"
    assert said(mass_kg=(8.0, 0.1, "kg"), **chassis).endswith(told)
    along = {f"direction_{axis}": (value, 0.01, "1") for axis, value in zip("xyz", (0.0, 0.0, 1.0), strict=True)}
    assert "direction x 0.000 +- 0.010, y 0.000 +- 0.010, z 1.000 +- 0.010, line of action through x 0.3" in said(
        mass_kg=(8.0, 0.1, "kg"), **along, **at
    )


def with_effect(name, place, values, model=BARE):
    return model.with_effect(active(library()[name], model, place, values))


def forbidden(model):
    """Why the last effect of a model is no effect of a table, by its values and by the ends of their ranges."""
    one = model.effects[-1]
    return one.effect.implausible(one.by_name, dict.fromkeys(one.by_name, 1e-3)) or at_the_edge(one)


def differ(a, b):
    return float(np.max(np.abs(a - b).max(axis=(1, 2)) / np.abs(b).max(axis=(1, 2))))


def sprung_table(directions, frequencies):
    table = Assembly(RIG, len(directions)).mounts()
    for k, (d, f) in enumerate(zip(directions, frequencies, strict=True)):
        w = 2 * np.pi * f
        table.mass(table.row(**{f"e{k}": 1.0}), MASS)
        table.spring(table.row(d @ mount_map(PLACE), **{f"e{k}": -1.0}), MASS * w**2, 2 * ZETA * w * MASS)
    return table


ONE = ([ALONG], [14.0], "payload/oblique", [*(np.sqrt(MASS) * ALONG), 14.0, ZETA, *PLACE])
THREE = (list(np.eye(3)), [14.0, 9.0, 21.0], "payload/axes", [MASS, 14.0, 9.0, 21.0, ZETA, *PLACE])
TURN = [0.4, -0.3, 0.5]
TURNED = (
    list(expm(np.cross(np.eye(3), TURN)).T),
    [14.0, 9.0, 21.0],
    "payload/turned",
    [MASS, 14.0, 9.0, 21.0, ZETA, *PLACE, *TURN],
)
SPRUNG = [ONE, THREE, TURNED]


@pytest.mark.parametrize(("directions", "frequencies", "place", "values"), SPRUNG, ids=["one", "three", "turned"])
def test_sprung_mass_is_masses_on_springs(directions, frequencies, place, values):
    model, table = with_effect("attached_oscillator", place, values), sprung_table(directions, frequencies)
    true = table.response(F)
    assert differ(model.response(2 * np.pi * F), true) < 1e-9
    assert differ(BARE.response(2 * np.pi * F), true) > 1e-2


@pytest.mark.parametrize(("directions", "frequencies", "place", "values"), SPRUNG, ids=["one", "three", "turned"])
def test_transients_hold_whatever_the_mass_starts_with(directions, frequencies, place, values):
    """R inv(s^2 M + s C + K) ((s M + C) z0 + M v0) with the masses displaced and moving, in real coefficients."""
    model, table = with_effect("attached_oscillator", place, values), sprung_table(directions, frequencies)
    rng, n = np.random.default_rng(1), table.n
    z0, v0 = np.zeros(n), np.zeros(n)
    z0[6:], v0[6:] = rng.standard_normal((2, n - 6))
    omega = 2 * np.pi * F
    free = np.array(
        [
            table.R
            @ np.linalg.solve(s**2 * table.M + s * table.C + table.K, (s * table.M + table.C) @ z0 + table.M @ v0)
            for s in 1j * omega
        ]
    )
    U = np.zeros((len(F), 11 + 12, 12), complex)
    U[:, 11:] = np.eye(12)
    body = model.driven(omega, U, False).Y
    both = np.concatenate([body, model.inner_transients(omega)], axis=2)
    assert left_of(free, both) < 1e-8
    assert left_of(free, body) > 0.05


def left_of(y, columns):
    """Share of y (n, n_y) that real combinations of columns (n, n_y, k) leave."""
    A, b = columns.reshape(-1, columns.shape[2]), y.reshape(-1)
    A, b = np.concatenate([A.real, A.imag]), np.concatenate([b.real, b.imag])
    A = A / np.linalg.norm(A, axis=0)
    return float(np.linalg.norm(b - A @ np.linalg.lstsq(A, b, rcond=None)[0]) / np.linalg.norm(b))


def test_a_bending_payload_and_its_transients():
    shapes = 0.03 * np.random.default_rng(3).standard_normal((2, 12))
    f, zeta = (25.0, 40.0), (0.01, 0.02)
    model = with_effect("payload_flexible_mode", "payload/two", [f[0], zeta[0], *shapes[0], f[1], zeta[1], *shapes[1]])
    table = Assembly(RIG, 2)
    for i, (G, one) in enumerate(zip(table.maps, RIG.isolators, strict=True)):
        for a in range(3):
            own = shapes[:, 3 * i + a]
            table.spring(table.row(G[a], e0=own[0], e1=own[1]), one.stiffness[a], one.damping[a], np.eye(3)[a])
    g = RIG.geophones
    for m in range(2):
        w = 2 * np.pi * f[m]
        table.mass(table.row(**{f"e{m}": 1.0}), 1.0)
        table.spring(table.row(**{f"e{m}": 1.0}), w**2, 2 * zeta[m] * w)
        for k, motor in enumerate(RIG.motors):
            at = 3 * (motor.isolator - 1) + "xyz".index(motor.axis)
            table.T[6 + m, k] = motor.constant_N_per_V * shapes[m, at]
        table.R[:, 6 + m] = [
            shapes[m, 3 * (i - 1) + "xyz".index(axis)] for i, axis in zip(g.isolator, g.axis, strict=True)
        ]
    omega = 2 * np.pi * F
    assert differ(model.response(omega), table.response(F)) < 1e-9
    assert differ(BARE.response(omega), table.response(F)) > 1e-2
    z0 = np.r_[np.zeros(6), 1.0, -2.0]
    free = np.array(
        [
            table.R @ np.linalg.solve(s**2 * table.M + s * table.C + table.K, (s * table.M + table.C) @ z0)
            for s in 1j * omega
        ]
    )
    assert left_of(free, model.inner_transients(omega)) > 1e-3  # damping of the mounts pushes the body too
    U = np.zeros((len(F), 23, 12), complex)
    U[:, 11:] = np.eye(12)
    assert left_of(free, np.concatenate([model.driven(omega, U, False).Y, model.inner_transients(omega)], 2)) < 1e-8
    assert realise(with_effect("payload_flexible_mode", "payload/two", model.effects[0].values, VOLTS)).error < 1e-9


def test_modes_are_reported_in_the_order_of_their_frequencies():
    own, place = library()["payload_flexible_mode"], "payload/two"
    values = [40.0, 0.02, *np.full(12, 0.01), 25.0, 0.01, *np.full(12, 0.02)]
    names = [one.name for one in own.parameters(BARE, place)]
    C = np.diag(np.arange(1.0, 29.0) ** 2)
    told = own.reported(BARE, place, dict(zip(names, values, strict=True)), C)
    assert (told["frequency_Hz"].value, told["frequency_Hz"].std) == (25.0, 15.0)
    assert (told["frequency_2_Hz"].value, told["damping_2"].value) == (40.0, 0.02)


# --- what is told of them


def monte_carlo(f, mean, C):
    drawn = np.random.default_rng(2).multivariate_normal(mean, C, 20000)
    return np.std([f(one) for one in drawn])


def test_stiffness_of_one_direction_and_its_deviation():
    place, own = "payload/oblique", library()["cable_stiffness"]
    values = [*(np.sqrt(2100.0) * ALONG), 1e-3, *PLACE]
    root = 0.05 * np.random.default_rng(5).standard_normal((7, 7))
    names = [one.name for one in own.parameters(BARE, place)]
    told = own.reported(BARE, place, dict(zip(names, values, strict=True)), root @ root.T)
    assert next(iter(told)) == "stiffness_N_per_m"
    assert told["stiffness_N_per_m"].value == pytest.approx(2100.0)
    std = monte_carlo(lambda x: x[:3] @ x[:3], values, root @ root.T)
    assert told["stiffness_N_per_m"].std == pytest.approx(std, rel=0.03)


def test_mass_direction_and_line_of_a_sprung_mass():
    own, place = library()["attached_oscillator"], "payload/oblique"
    names = [one.name for one in own.parameters(BARE, place)]
    for sign in (1.0, -1.0):  # a direction has no sign
        values = np.array([*(sign * np.sqrt(MASS) * ALONG), 14.0, ZETA, *PLACE])
        root = 0.01 * np.random.default_rng(6).standard_normal((8, 8))
        told = own.reported(BARE, place, dict(zip(names, values, strict=True)), root @ root.T)
        assert told["mass_kg"].value == pytest.approx(MASS)
        spread = monte_carlo(lambda x: x[:3] @ x[:3], values, root @ root.T)
        assert told["mass_kg"].std == pytest.approx(spread, rel=0.03)
        np.testing.assert_allclose([told[f"direction_{a}"].value for a in "xyz"], ALONG, rtol=1e-12)
        foot = np.array([told[f"{a}_m"].value for a in "xyz"])
        np.testing.assert_allclose([np.cross(foot - PLACE, ALONG) @ np.ones(3), foot @ ALONG], 0, atol=1e-12)


def test_gain_of_the_leveling_follows_from_its_rate():
    own, place = library()["leveling_loop"], "isolators 1-3 z/plain"
    told = own.reported(BARE, place, {"rate_Hz": 0.05}, np.array([[1e-6]]))
    k = np.mean([one.stiffness[2] for one in RIG.isolators[:3]])
    assert told["rate_Hz"].std == pytest.approx(1e-3)
    assert told["integral_gain_N_per_ms"].value == pytest.approx(2 * np.pi * 0.05 * k)
    assert told["integral_gain_N_per_ms"].std == pytest.approx(2 * np.pi * 1e-3 * k)


def test_a_valve_that_follows_at_once_is_no_fault_of_a_leveling_and_one_that_never_does_is():
    own, place = library()["leveling_loop"], "isolators 1-3 z/lag"

    def of(corner):
        return forbidden(with_effect("leveling_loop", place, [0.05, corner]))

    assert of(100.0) == of(0.3) == "" and "does not level" in of(0.01)
    told = [
        own.reported(BARE, place, {"rate_Hz": 0.05, "valve_corner_Hz": corner}, 1e-6 * np.eye(2))
        for corner in (0.3, 100.0)
    ]
    assert ["valve_corner_Hz" in one for one in told] == [True, False]


def test_leveling_measures_the_payload_against_a_chassis_that_moves():
    """On a chassis carried by springs, which the valves and mounts push back: explicit coordinates of both."""
    m, hertz, zeta, rate = 900.0, 11.0, 0.05, 0.1
    model = with_effect("base_compliance", "chassis/translation", [m, zeta, hertz, hertz, hertz])
    model = with_effect("leveling_loop", "isolators 1-3 z/plain", [rate], model)
    w, true = 2 * np.pi * hertz, []
    for f in F:
        s, table = 2j * np.pi * f, Assembly(RIG, 3)
        for i, (G, one) in enumerate(zip(table.maps, RIG.isolators, strict=True)):
            for a in range(3):
                law = 1 + 2 * np.pi * rate / s if a == 2 and i < 3 else 1
                table.spring(table.row(G[a], **{f"e{a}": -1.0}), one.stiffness[a] * law, one.damping[a])
        for a in range(3):
            table.mass(table.row(**{f"e{a}": 1.0}), m)
            table.spring(table.row(**{f"e{a}": 1.0}), m * w**2, 2 * zeta * w * m, np.eye(3)[a])
        true.append(table.response([f])[0])
    found, true = model.response(2 * np.pi * F), np.array(true)
    floor = slice(8, 11)
    assert differ(found[:, :, floor], true[:, :, floor]) < 1e-6
    both = VOLTS
    for one in model.effects:
        both = with_effect(one.effect.name, one.place, one.values, both)
    assert realise(both).error < 1e-6


IDENTIFIED = TableModel(ResponseModel.of(RIG, default_parameters(RIG), sampled=False))


def measured(truth, rng):
    """Four experiments on all motors at once, with noise of 0.1 % in each sensor."""
    omega = 2 * np.pi * np.geomspace(1.0, 60.0, 300)

    def drawn(*shape):
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    U = np.concatenate([drawn(len(omega), 8, 4), np.zeros((len(omega), 3, 4))], axis=1)
    made = SpectralBlock("00", omega, U, np.zeros((len(omega), 6, 4), complex))
    Y = truth.answer(made, None, False).Y
    power = 1e-6 * np.mean(np.abs(Y) ** 2, axis=(0, 2))
    return replace(made, Y=Y + np.sqrt(power / 2)[:, None] * drawn(*Y.shape)).with_noise(
        np.broadcast_to(np.diag(power), (len(omega), 6, 6)).astype(complex).copy()
    )


def test_what_no_record_tells_of_a_mode_is_in_the_deviation_of_its_frequency():
    """Points that no motor pushes add stiffness to the mode alone, along one combination of them."""
    rng = np.random.default_rng(3)
    seen = [17.0, 0.02, *0.015 * rng.standard_normal(12)]
    parameters = library()["payload_flexible_mode"].parameters(IDENTIFIED, "payload")
    start = [
        0.0 if one.optional and one.name.startswith("shape") else value
        for one, value in zip(parameters, seen, strict=True)
    ]
    assert start.count(0.0) == 4
    truth, begin = (with_effect("payload_flexible_mode", "payload", values, IDENTIFIED) for values in (seen, start))
    block = measured(truth, rng)
    found = fitted(begin, [block], 40)
    told = reported(found)
    assert found.chi2_per_dof == pytest.approx(1.0, abs=0.1)
    for name, true in (("frequency_Hz", 17.0), ("damping", 0.02)):
        assert abs(told[name].value - true) < 3 * told[name].std
    # By noise alone it would be known to a few parts in a million.
    assert told["frequency_Hz"].std > 1e-4 * 17.0


def test_a_fit_reaches_how_a_resonance_scatters_over_the_mounts():
    """In few steps: none is held to a share of a unit that is small beside the way."""
    rng = np.random.default_rng(5)
    hidden = [54.0, 0.5, 0.1, 0.08, -0.09, 0.06]
    truth = with_effect("mount_surge", "isolators z", hidden, IDENTIFIED)
    begin = with_effect("mount_surge", "isolators z", [60.0, 0.5, 0.05, 0.0, 0.0, 0.0], IDENTIFIED)
    block = measured(truth, rng)
    found = fitted(begin, [block], 12)
    assert found.chi2_per_dof == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(found.model.effects[0].values[3:], hidden[3:], atol=0.02)


# --- seeds


def block_of(truth, noise=1e-4):
    """What a table answers to eight motors, without noise in the data."""
    rng, omega = np.random.default_rng(7), 2 * np.pi * np.geomspace(1.0, 70.0, 250)
    U = np.zeros((len(omega), 11, 1), complex)
    U[:, :8, 0] = rng.standard_normal((len(omega), 8)) + 1j * rng.standard_normal((len(omega), 8))
    made = SpectralBlock("00", omega, U, np.zeros((len(omega), 6, 1), complex))
    Y = truth.answer(made, None, False).Y
    plain = FREE.answer(made, None, False).Y
    power = noise * np.mean(np.abs(plain) ** 2, axis=(0, 2))
    return replace(made, Y=Y).with_noise(np.broadcast_to(np.diag(power), (len(omega), 6, 6)).astype(complex).copy())


def seeds_of(truth, name, place, noise=1e-4):
    """What the score makes of a weak effect."""
    score = Score(FREE, [block_of(truth, noise)])
    return score, seeds(library()[name], score, [place])[0]


def test_seed_of_a_sprung_mass_along_any_direction():
    truth = with_effect("attached_oscillator", "payload/oblique", [*ALONG, 17.0, 0.03, *PLACE], FREE)
    score, found = seeds_of(truth, "attached_oscillator", "payload/oblique")
    a, point = np.array(found[0].values[:3]), np.array(found[0].values[5:])
    assert abs(a @ ALONG) / np.linalg.norm(a) > 0.95
    assert a @ a == pytest.approx(1.0, rel=0.5)
    assert found[0].values[3] == pytest.approx(17.0, rel=0.03)
    assert np.linalg.norm(np.cross(point - PLACE, ALONG)) < 0.2
    assert any(abs(f / 17.0 - 1) < 0.03 for f in peaks(score))
    assert found[0].chi2 > 0.6 * score.chi2


def test_seed_of_a_sprung_mass_with_three_frequencies():
    truth = with_effect("attached_oscillator", "payload/axes", [1.0, 20.0, 13.0, 30.0, 0.04, *PLACE], FREE)
    _, found = seeds_of(truth, "attached_oscillator", "payload/axes")
    np.testing.assert_allclose(found[0].values[1:4], [20.0, 13.0, 30.0], rtol=0.1)
    assert np.linalg.norm(np.array(found[0].values[5:]) - PLACE) < 0.25
    _, one = seeds_of(truth, "attached_oscillator", "payload/oblique")
    assert found[0].chi2 > 1.2 * one[0].chi2


@pytest.mark.parametrize("turn", [(0.4, -0.3, 0.5), (-0.6, 0.5, 0.9), (2.0, -1.0, 0.7)])
def test_seed_of_a_sprung_mass_along_turned_axes(turn):
    """Any three orthogonal axes are found as a permutation of x, y, z with a smaller rotation."""
    frequencies, place = np.array([9.0, 4.7, 12.6]), (0.28, -0.1, 0.04)
    axes = expm(np.cross(np.eye(3), turn))
    small = Rotation.from_matrix(axes @ permutation(axes))
    values = [1.0, *(frequencies @ np.abs(permutation(axes))), 0.04, *place, *small.as_rotvec()]
    truth = with_effect("attached_oscillator", "payload/turned", values, FREE)
    score, found = seeds_of(truth, "attached_oscillator", "payload/turned")
    _, straight = seeds_of(truth, "attached_oscillator", "payload/axes")
    assert found[0].chi2 > 0.8 * score.chi2 and found[0].chi2 > 1.1 * straight[0].chi2
    assert np.linalg.norm(np.array(found[0].values[5:8]) - place) < 0.1
    d = Rotation.from_rotvec(found[0].values[8:]).as_matrix().T
    for f, axis in zip(frequencies, axes.T, strict=True):
        k = int(np.argmin(np.abs(np.log(np.array(found[0].values[1:4]) / f))))
        assert found[0].values[1 + k] == pytest.approx(f, rel=0.1)
        assert abs(d[k] @ axis) > np.cos(np.radians(20.0))


def permutation(axes):
    """(3, 3) signed permutation of the columns of a rotation that brings it nearest to the identity."""
    group = Rotation.create_group("O").as_matrix()
    return max(group, key=lambda one: np.trace(axes @ one))


@pytest.mark.parametrize("place", [(-0.076, -0.12, 0.024), (0.31, 0.4, -0.18), (-0.5, 0.1, 0.28)])
def test_a_place_between_those_of_the_grid_is_found(place):
    """The grid's steps are 0.2 m and more."""
    truth = with_effect("attached_oscillator", "payload/axes", [1.4, 17.5, 15.5, 12.3, 0.06, *place], FREE)
    _, found = seeds_of(truth, "attached_oscillator", "payload/axes")
    np.testing.assert_allclose(found[0].values[1:4], [17.5, 15.5, 12.3], rtol=0.1)
    assert np.linalg.norm(np.array(found[0].values[5:]) - place) < 0.08
    tied = with_effect("cable_stiffness", "payload/axes", [150.0, 220.0, 300.0, 1e-3, *place], FREE)
    _, found = seeds_of(tied, "cable_stiffness", "payload/axes")
    assert np.linalg.norm(np.array(found[0].values[-3:]) - place) < 0.08


def test_along_its_line_of_action_a_place_may_end_anywhere():
    def of(point):
        values = [0.0, 1.9, 0.0, 21.0, 0.02, *point]
        return forbidden(with_effect("attached_oscillator", "payload/oblique", values, FREE))

    assert of((0.1, 2.0, 0.1)) == ""
    assert "line of action" in of((2.0, 0.0, 0.1))


def test_a_flexible_mode_without_a_resonance_is_refused():
    def reason(damping):
        shapes = np.linspace(-0.02, 0.03, 12)
        values = [25.0, 0.01, *shapes, 60.0, damping, *shapes[::-1]]
        return forbidden(with_effect("payload_flexible_mode", "payload/two", values))

    assert not reason(0.2)
    assert reason(0.5) == "a mode so strongly damped that it is no resonance"


def test_a_second_mode_and_a_second_frequency_begin_beside_what_is_fitted():
    rng = np.random.default_rng(8)
    first, second = (3e-3 * rng.standard_normal(12) for _ in range(2))
    one = with_effect("payload_flexible_mode", "payload", [22.0, 0.01, *first], FREE)
    _, found = seeds_of(one, "payload_flexible_mode", "payload")
    assert found[0].values[0] == pytest.approx(22.0, rel=0.03)
    two = with_effect("payload_flexible_mode", "payload/two", [22.0, 0.01, *first, 41.0, 0.01, *second], FREE)
    [(place, values)] = one.effects[0].effect.extended_models(Score(one, [block_of(two, 1e-6)]), one.effects[0])
    assert place == "payload/two"
    assert values[:14] == one.effects[0].values
    assert values[14] == pytest.approx(41.0, rel=0.03)
    along_z = with_effect("attached_oscillator", "payload/oblique", [0.0, 0.0, 1.2, 17.0, 0.04, *PLACE], FREE)
    along_all = with_effect("attached_oscillator", "payload/axes", [1.44, 31.0, 24.0, 17.0, 0.04, *PLACE], FREE)
    score = Score(along_z, [block_of(along_all, 1e-6)])
    [(place, values)] = along_z.effects[0].effect.extended_models(score, along_z.effects[0])
    assert place == "payload/axes"
    np.testing.assert_allclose(values[:4], [1.44, 31.0, 24.0, 17.0], rtol=0.06)


def test_a_mass_without_strength_changes_nothing():
    model = with_effect("attached_oscillator", "payload/oblique", [0.0, 0.0, 0.0, 14.0, ZETA, *PLACE])
    with_it, without = (Assembled(one.operators(2 * np.pi * F)) for one in (model, BARE))
    np.testing.assert_array_equal(with_it.D, without.D)
    assert model.inner_transients(2 * np.pi * F).shape == (len(F), 6, 0)
