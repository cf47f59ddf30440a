"""Whether shifts of values of the rig file are credible as a whole: by Monte Carlo, and the limiting cases."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from avis_ctrl.gap.settings import SETTINGS
from avis_ctrl.gap.tolerances import credible
from avis_ctrl.rigs import load_rig

RIG = load_rig("avis")


def fitted(z, covariance):
    """What the test reads of a fit; the first name is a parameter without tolerance."""
    priors = SimpleNamespace(names=["mass", *(f"value {k}" for k in range(len(z) - 1))])
    return SimpleNamespace(z=z, covariance=covariance, priors=priors, model=SimpleNamespace(rig=RIG))


def test_false_alarms_are_as_frequent_as_stated():
    """Estimates of values drawn from their priors, measured in some directions (a linear model)."""
    rng, n = np.random.default_rng(3), 40
    H = rng.normal(size=(25, n)) * np.geomspace(10, 0.05, 25)[:, None]
    S = np.linalg.inv(np.eye(n) + H.T @ H)
    few = replace(SETTINGS, credible=0.05)
    alarms = 0
    for _ in range(2000):
        z = S @ H.T @ (H @ rng.normal(size=n) + rng.normal(size=25))
        z[0] = 100.0  # a parameter without tolerance may move as far as it likes
        alarms += not credible(fitted(z, S), few)
    assert 0.03 < alarms / 2000 < 0.075


def test_many_values_at_three_tolerances_are_not_credible_and_one_is():
    S = 0.5 * np.eye(41)
    assert not credible(fitted(np.full(41, 3.0), S), SETTINGS)
    assert credible(fitted(np.eye(41)[5] * 3.0, S), SETTINGS)


def test_exact_values_have_nothing_to_move():
    assert credible(fitted(np.array([2.0]), np.eye(1)), SETTINGS)
    assert credible(fitted(np.zeros(5), np.eye(5)), SETTINGS)
