"""What is said of a gap: by figures that were computed, and no more than they hold."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from avis_ctrl.errors import ComputationError
from avis_ctrl.gap import analysis, judgement
from avis_ctrl.gap.judgement import _considered, _gain
from avis_ctrl.gap.result import NamedEffect, Stage
from avis_ctrl.gap.search import _worth_it
from avis_ctrl.gap.show import _noisy, bent, opening, places


def test_each_of_two_effects_is_confirmed_by_its_own_step():
    chain = [SimpleNamespace(labels=labels, excess_held=chi2) for labels, chi2 in (
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
    found = SimpleNamespace(pool=((refit(1.6, "first"), refit(5.0, "other")), (pair,)), best=pair, passed_over=(),
                            chain=(refit(9.0),), beaten=None)
    assert [one.name for one in _considered(found, pair, 1.0)] == ["other"]


@pytest.mark.parametrize(("left", "said"), [(0.0101, "1.01 %, which is the noise."),
                                            (0.0119, "1.19 %, beside 1 % of noise."),
                                            (0.0006, "less than the noise as it was estimated (1 %), which is too "
                                                     "much then.")])
def test_a_gap_is_called_the_noise_only_where_it_is(left, said):
    one = NamedEffect("actuator_lag", "actuators", "the amplifiers lag", {}, 0.9)
    ladder = [Stage("nominal", 0.3, 900.0), Stage("re-identified", 0.1, 100.0), Stage("actuator_lag", left, 1.3)]
    judged = SimpleNamespace(verdict="explained", effects=(one,), raised=())
    told = opening(judged, ladder, SimpleNamespace(noise_nrmse=0.01))
    assert told.endswith(said)


def test_a_fault_of_the_signals_and_a_noisy_sensor_let_no_gap_fall():
    ladder = [Stage("nominal", 0.3, 900.0), Stage("re-identified", 0.012, 1.0)]
    after = SimpleNamespace(noise_nrmse=0.012)
    floor = NamedEffect("ground_motion", "floor", "the floor moves more", {}, 0.99)
    told = opening(SimpleNamespace(verdict="explained", effects=(floor,), raised=()),
                   [*ladder, Stage("ground_motion", 0.012, 1.0)], after)
    assert "falls" not in told and told.endswith("leaves 1.2 %, which is the noise.")
    told = opening(SimpleNamespace(verdict="unexplained", effects=(), raised=("Sz3",)), ladder, after)
    assert told.startswith("The noise of Sz3 is above") and "no other missing effect" in told


def test_parameters_that_bend_to_what_is_missing_are_said_to():
    nominal = Stage("nominal", 0.10, 50.0)
    told, = bent(nominal, Stage("re-identified", 0.12, 20.0))
    assert "12 % of the held-out records instead of 10 %" in told and "20 instead of 50" in told
    assert bent(nominal, Stage("re-identified", 0.09, 60.0))
    assert not bent(nominal, Stage("re-identified", 0.09, 20.0))
    # An exact file, which noise makes a little worse: nothing bends.
    assert not bent(Stage("nominal", 0.0100, 1.0), Stage("re-identified", 0.0101, 1.002))


def test_a_noisy_sensor_is_where_its_noise_was_measured():
    noise = SimpleNamespace(raised=[SimpleNamespace(channel=name, ratio=ratio)
                                    for name, ratio in (("Sz3", 2.0), ("Sy1", 3.0), ("Sz1", 9.0))])
    found = _noisy(noise, ("Sy1", "Sz3"), 1000.0)
    assert [(one.output, one.input, one.from_Hz, one.to_Hz) for one in found] == [("Sy1", "", 100.0, 490.0),
                                                                                 ("Sz3", "", 100.0, 490.0)]
    assert [one.share for one in found] == [pytest.approx(8 / 11), pytest.approx(3 / 11)]  # 3^2 - 1 and 2^2 - 1


def _stand_in(held, labels):
    effects = [SimpleNamespace(label=label, effect=SimpleNamespace(name=label, idealised=True, confusable=()))
               for label in labels]
    return SimpleNamespace(held_per_dof=held, criterion=3e4 * held, excess_held=1e4 * held, labels=labels,
                           model=SimpleNamespace(effects=effects))


@pytest.mark.parametrize(("three", "with_more", "kept"), [
    (1.18, 1.19, 2), (1.18, 1.17, 2), (30.0, 1.1, 3), (40.0, 39.0, 0)])
def test_what_a_further_mode_takes_is_no_sign_of_the_effect_behind_it(three, with_more, kept):
    base, two = _stand_in(100.0, ()), _stand_in(41.0, ("two",))
    grown = (base, _stand_in(three, ("three",)), _stand_in(with_more, ("three", "more")))
    found = _worth_it(grown, (base, two), [(base, two)], 1.0)
    assert len(found or ()) == kept and (not kept or found == grown[:kept])


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


def test_the_next_measurement_compares_the_best_refits_in_one_place(monkeypatch):
    """A pair; for its first effect another one is as good. A worse refit of that one came later, and at the first stage
    it was refitted by itself."""
    def refit(criterion, *names):
        effects = [SimpleNamespace(effect=SimpleNamespace(name=name), label=f"{name}@x", place="x") for name in names]
        return SimpleNamespace(model=SimpleNamespace(effects=effects), labels=tuple(one.label for one in effects),
                               criterion=criterion, implausible=lambda: "")
    pair, tied, worse, alone = (refit(100.0, "first", "second"), refit(101.0, "other", "second"),
                                refit(900.0, "other", "second"), refit(5000.0, "other"))
    found = SimpleNamespace(pool=((alone,), (pair, tied, worse)), beaten=None)
    effects = [NamedEffect("second", "x", "", {}, 0.99, (), label="second@x"),
               NamedEffect("first", "x", "", {}, 0.6, ("other",), label="first@x")]
    monkeypatch.setattr(judgement, "between", lambda *told: told)
    assert judgement._next(effects, found, pair) == ("first", "other", pair.model, tied.model)


def test_a_model_that_cannot_be_simulated_does_not_end_the_analysis(monkeypatch):
    """Clipped samples stay as the re-identified model expects them, and the search is done in full."""
    class SearchedInFullError(Exception):
        pass

    def repaired_with(model, each):
        raise ComputationError("the table leaves every bound")

    def search(*_, longest=None, **__):
        if longest is None:
            raise SearchedInFullError
        return None
    prepared = SimpleNamespace(clipped=object(), base=None, thin=[], thin_held=[], repaired_with=repaired_with)
    monkeypatch.setattr(analysis, "prepare", lambda *_: prepared)
    monkeypatch.setattr(analysis, "search", search)
    monkeypatch.setattr(analysis, "_nearest", lambda found: SimpleNamespace(effects=()))
    with pytest.raises(SearchedInFullError):
        analysis.analyse(None, None)
