"""What is said of a gap: by figures that were computed, and no more than they hold."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from avis_ctrl.gap.judgement import _considered, _gain
from avis_ctrl.gap.result import NamedEffect, Stage
from avis_ctrl.gap.show import opening, places


def test_each_of_two_effects_is_confirmed_by_its_own_step():
    chain = [SimpleNamespace(labels=labels, chi2_held=chi2) for labels, chi2 in (
        (("large_motion@payload",), 9000.0), (("large_motion@payload", "first@a"), 4000.0),
        (("large_motion@payload", "first@a", "second@b"), 1000.0))]
    found = SimpleNamespace(chain=chain)
    assert (_gain(found, "first@a"), _gain(found, "second@b"), _gain(found, "third@c")) == (2500.0, 1500.0, 0.0)


def test_a_step_on_the_way_to_a_pair_is_no_runner_up():
    def refit(chi2, *names):
        effects = [SimpleNamespace(effect=SimpleNamespace(name=name), place=f"at {name}") for name in names]
        return SimpleNamespace(labels=names, model=SimpleNamespace(effects=effects), criterion=1e4 * chi2,
                               held_per_dof=chi2, misfit=max(chi2, 1.0), implausible=lambda: "",
                               reported=lambda effect: {})
    pair = refit(1.0, "first", "second")
    found = SimpleNamespace(pool=((refit(1.6, "first"), refit(5.0, "other")), (pair,)), best=pair, passed_over=())
    assert [one.name for one in _considered(found, pair, 1.0)] == ["other"]


@pytest.mark.parametrize(("left", "said"), [(0.0101, "1.01 %, which is the noise."),
                                            (0.0119, "1.19 %, beside 1 % of noise.")])
def test_a_gap_is_called_the_noise_only_where_it_is(left, said):
    one = NamedEffect("actuator_lag", "actuators", "the amplifiers lag", {}, 0.9)
    ladder = [Stage("nominal", 0.3, 900.0), Stage("re-identified", 0.1, 100.0), Stage("actuator_lag", left, 1.3)]
    told = opening(SimpleNamespace(verdict="explained", effects=(one,)), ladder, SimpleNamespace(noise_nrmse=0.01))
    assert told.endswith(said)


@pytest.mark.parametrize("dof", [30.0, 100.0, 400.0])
def test_chance_of_a_place_does_not_count_noise_that_was_not_measured(dof):
    """Two held-out records of 400 lines, known from no more than twice as many lines: a band without a gap beside one
    with a faint one."""
    omega, rng = 2 * np.pi * np.geomspace(1.0, 2.0 ** 0.499, 400), np.random.default_rng(3)
    noise = np.ones((400, 1, 1, 1))

    def error():
        E = (rng.standard_normal((400, 1, 1)) + 1j * rng.standard_normal((400, 1, 1))) / np.sqrt(2)
        block = SimpleNamespace(U=np.zeros((400, 1, 1)), omega=omega, noise=noise, dof=dof)
        return SimpleNamespace(block=block, error=1.15 * E / np.sqrt(np.mean(np.abs(E) ** 2)))
    left = SimpleNamespace(errors=(error(), error()), outputs=("Sz1",), inputs=("Az1",))
    told = places(left)
    least = stats.f.sf(1.15 ** 2, 1600, 2 * max(dof, 1600))
    assert not told or told[0].p_value >= least * (1 - 1e-9)
    assert (dof < 60) or told
