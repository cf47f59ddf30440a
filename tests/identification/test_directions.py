"""Directions of correlated parameters: coverage by Monte Carlo, sensitivities by differences, what they leave."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.identification.directions import directions_that_matter, half_widths, relative_sensitivity
from avis_ctrl.rigs import load_rig

KEEP = ("z", "phi_x")
NAMES = ["mass", "J1", *(f"isolator{i}.{kind}_{axis}" for i in (1, 2, 3, 4) for kind in "kc" for axis in "yz")]
OMEGA = 2 * np.pi * np.geomspace(0.1, 100, 60)


def factor(size: float, seed: int = 0) -> np.ndarray:
    """Correlated errors of about `size`, and combinations known a hundred times better than single parameters."""
    rng, known = np.random.default_rng(seed), load_rig("avis").parameters()
    Q, _ = np.linalg.qr(rng.normal(size=(len(NAMES), len(NAMES))))
    scale = np.array([known[name].value for name in NAMES])
    return scale[:, None] * Q * size * np.geomspace(0.01, 1, len(NAMES))


def responses(rig) -> tuple[np.ndarray, np.ndarray]:
    """Forces to motion through the allocation of the shipped rig, and floor to motion, written out once more."""
    eom = rig.equations_of_motion()
    i = [eom.coordinates.index(name) for name in KEEP]
    S = np.diag([1.0, 1 / rig.edge_m])
    found = []
    for w in OMEGA:
        M, C, K = (S @ X[np.ix_(i, i)] @ S for X in (eom.M, eom.C, eom.K))
        found.append((np.linalg.inv(K + 1j * w * C - w * w * M), K + 1j * w * C))
    return np.array([B for B, _ in found]), np.array([B @ F for B, F in found])


@pytest.mark.parametrize("name", NAMES)
def test_sensitivities_are_those_of_the_responses(name):
    rig = load_rig("avis")
    value, h = rig.parameters()[name].value, 1e-5
    G, T = responses(rig)
    up, down = (responses(rig.with_parameters({name: value * (1 + sign * h)})) for sign in (1, -1))
    driven, floor = relative_sensitivity(rig, [name], KEEP, OMEGA)
    for analytic, nominal, high, low in ((driven[0], G, up[0], down[0]), (floor[0], T, up[1], down[1])):
        differences = np.linalg.solve(nominal, high - low) / (2 * h * value)
        assert np.max(np.abs(differences - analytic)) < 1e-6 * np.max(np.abs(analytic)) + 1e-9 / value


def test_box_and_ball_hold_together_as_often_as_they_say(rng):
    z = rng.standard_normal((200_000, 8))
    for q in (0, 3, 8):
        for confidence in (0.8, 0.95, 0.99):
            box, ball = half_widths(q, 8, confidence)
            inside = np.all(np.abs(z[:, :q]) <= box, axis=1) & (np.sum(z[:, q:] ** 2, axis=1) <= ball**2 + (q == 8))
            assert np.mean(inside) == pytest.approx(confidence, abs=0.003)


def test_parameters_drawn_from_the_covariance_lie_in_the_set(rng):
    """Monte Carlo over the whole chain: deltas within 1, and the response left over within what is stated."""
    rig, S = load_rig("avis"), factor(3e-3)
    found = directions_that_matter(rig, NAMES, S, KEEP, OMEGA)
    q = len(found.changes)
    assert 0 < q < 10
    driven, floor = relative_sensitivity(rig, NAMES, KEEP, OMEGA)
    inside = []
    for _ in range(1500):
        step = S @ rng.standard_normal(len(NAMES))
        # In whitened numbers the directions are orthonormal.
        white = np.linalg.solve(S, found.changes.T) / found.box
        delta = white.T @ np.linalg.solve(S, step) / found.box
        left = step - found.changes.T @ delta
        rest = [np.linalg.norm(np.tensordot(left, one, 1), 2, axis=(1, 2)) for one in (driven, floor)]
        covered = np.all(rest[0] <= found.rest) and np.all(rest[1] <= found.rest_floor)
        inside.append(np.all(np.abs(delta) <= 1) and covered)
    # The ball is enclosed by its bound on the response: coverage is what was asked or more.
    assert 0.95 - 3 * np.sqrt(0.95 * 0.05 / 1500) < np.mean(inside)


@settings(max_examples=20, deadline=None)
@given(st.floats(1e-6, 1e-2), st.sampled_from([1e-4, 1e-3, 1e-2]), st.integers(0, 5))
def test_the_fewest_that_leave_little(size, negligible, seed):
    rig, S = load_rig("avis"), factor(size, seed)
    found = directions_that_matter(rig, NAMES, S, KEEP, OMEGA, negligible=negligible)
    assert max(found.rest.max(initial=0.0), found.rest_floor.max(initial=0.0)) <= negligible
    q = len(found.changes)
    # No rotation helps: with one fewer of these the rest is too large.
    if q:
        larger = directions_that_matter(rig, NAMES, S, KEEP, OMEGA, negligible=negligible * 10)
        assert len(larger.changes) <= q
    assert np.all(found.effect > 0) and found.changes.shape == (q, len(NAMES))


def test_perfectly_known_parameters_need_no_direction():
    found = directions_that_matter(load_rig("avis"), NAMES, np.zeros((len(NAMES), 0)), KEEP, OMEGA)
    assert found.changes.shape == (0, len(NAMES)) and not np.any(found.rest)


def test_two_coordinates_have_at_most_eight_combinations():
    """M diagonal (2), C and K symmetric (3 each): what else is uncertain changes nothing there."""
    found = directions_that_matter(load_rig("avis"), NAMES, factor(1e-2), KEEP, OMEGA, negligible=1e-8)
    assert len(found.changes) == 8


@pytest.mark.parametrize(
    ("names", "S", "confidence", "field"),
    [
        (["mass"], np.ones((2, 1)), 0.95, "factor"),
        (["mass"], np.array([[np.nan]]), 0.95, "factor"),
        (["mass"], np.ones((1, 1)), 1.0, "confidence"),
        (["no"], np.ones((1, 1)), 0.95, "names"),
    ],
)
def test_what_is_refused(names, S, confidence, field):
    with pytest.raises(InputError, match=field):
        directions_that_matter(load_rig("avis"), names, S, KEEP, OMEGA, confidence)
