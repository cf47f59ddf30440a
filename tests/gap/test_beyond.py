"""Faults that the library has no name for: their first order against differences, and whose name they take away."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from avis_ctrl.gap.effects.base import Effect, EffectParameter, library
from avis_ctrl.gap.effects.beyond import beyond
from avis_ctrl.gap.effects.beyond.base import FirstOrder
from avis_ctrl.gap.judgement import unequal_levels
from avis_ctrl.gap.motion import RecordMotion
from avis_ctrl.gap.record_motion import mount_rows
from avis_ctrl.gap.refit import refit
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.search import GIVEN_UP, Found, Rival, contested, search, weaker
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import SpectralBlock
from avis_ctrl.rigs import load_rig

RIG = load_rig("avis")
BARE = TableModel(ResponseModel.of(RIG, default_parameters(RIG)))
RATE, SAMPLES, NOISE = 1000.0, 8000, 2e-3
LINES = np.arange(4, 320, 5)
OMEGA = 2 * np.pi * LINES * RATE / SAMPLES


def record(name, level):
    """A record of random voltages; deflection and y are of a likely size, random too."""
    rng = np.random.default_rng([5, int(name)])
    volts, slow = level * rng.standard_normal((SAMPLES, 8)), rng.standard_normal((SAMPLES, 18))
    slow = np.apply_along_axis(lambda x: np.convolve(x, np.ones(20) / 5, "same"), 0, slow)
    return RecordMotion(name, RATE, 10.0 * int(name), (0.0, 60.0), volts, 1e-5 * slow[:, :12], *mount_rows(BARE), level,
                        actuators=BARE.actuators, sensors=BARE.sensors.names, y=0.1 * slow[:, 12:])


MOTION = {name: record(name, level) for name, level in (("00", 0.1), ("01", 0.5), ("02", 0.1), ("03", 0.5))}
MODEL = replace(BARE, motion=MOTION)


def block(truth, name, noise=NOISE):
    rng = np.random.default_rng([3, int(name)])
    U = np.zeros((len(OMEGA), 11, 1), complex)
    U[:, :8, 0] = MOTION[name].spectrum(MOTION[name].volts, OMEGA)
    made = SpectralBlock(name, OMEGA, U, np.zeros((len(OMEGA), 6, 1), complex), transient=False)
    white = (rng.standard_normal((len(OMEGA), 6, 1)) + 1j * rng.standard_normal((len(OMEGA), 6, 1))) / np.sqrt(2)
    Y = truth.answer(made, None, False).Y + noise * white
    return replace(made, Y=Y).with_noise(np.broadcast_to(noise ** 2 * np.eye(6), (len(OMEGA), 6, 6)).astype(complex))


def test_none_of_them_is_in_the_library():
    assert all(one.outside for one in beyond().values())
    assert not any(one.outside for one in library().values())
    assert not set(beyond()) & set(library())


@pytest.mark.parametrize("name", [name for name, one in beyond().items() if isinstance(one, FirstOrder)])
def test_first_order_is_the_slope_of_the_whole_model(name):
    effect = beyond()[name]
    score = Score(MODEL, [block(MODEL, "00")])
    for place in (effect.places(MODEL)[0], effect.places(MODEL)[-1]):
        point = effect.starts(MODEL, place)[0]
        one = active(effect, MODEL, place, point)
        by_differences = score.of_effect(one)
        closed = score.directions([effect.first_order(part, place, point) for part in score.parts])
        size = np.linalg.norm(by_differences, axis=1)
        assert np.all(size > 0)
        assert np.linalg.norm(by_differences - closed, axis=1) == pytest.approx(0 * size, abs=2e-2 * size.max())


def searched(truth, names):
    fitted, held = [block(truth, "00"), block(truth, "01")], [block(truth, "02"), block(truth, "03")]
    base = refit(MODEL, fitted, held)
    return search(base, fitted, held, effects=[library()[name] for name in names])


def test_crosstalk_is_no_misalignment():
    found = searched(MODEL.with_effect(active(beyond()["sensor_crosstalk"], MODEL, "Sz1/Sz3", (0.03,))),
                     ["sensor_misalignment", "sensor_gain"])
    assert len(found.chain) == 1
    assert found.beaten is not None and found.beaten.words == "a share of Sz3's signal in Sz1"
    last = found.beaten.refit.model.effects[-1]
    assert last.values[0] == pytest.approx(0.03, abs=4 * np.sqrt(found.beaten.refit.covariance_of(last)[0, 0]))


def test_a_misalignment_keeps_its_name():
    truth = MODEL.with_effect(active(library()["sensor_misalignment"], MODEL, "Sz1", (1.5, 1.0)))
    found = searched(truth, ["sensor_misalignment", "sensor_gain"])
    assert found.beaten is None
    assert found.best.labels == ("sensor_misalignment@Sz1",)


def test_a_dead_zone_is_no_force_constant():
    truth = MODEL.with_effect(active(beyond()["dead_zone"], MODEL, "Az2", (0.01,)))
    blocks = [block(truth, "00"), block(truth, "01")]
    gain = refit(MODEL.with_effect(active(library()["actuator_gain"], MODEL, "Az2")), blocks, blocks)
    assert "differs" in unequal_levels(blocks, gain)
    found = searched(truth, ["actuator_gain"])
    assert found.beaten is not None and found.beaten.words == "a dead zone of Az2"


def test_a_force_constant_is_the_same_at_every_level():
    truth = MODEL.with_effect(active(library()["actuator_gain"], MODEL, "Az2", (1.05,)))
    blocks = [block(truth, "00"), block(truth, "01")]
    gain = refit(MODEL.with_effect(active(library()["actuator_gain"], MODEL, "Az2")), blocks, blocks)
    assert unequal_levels(blocks, gain) == ""


class LateSensor(Effect):
    """A user's own: what a competitor describes, too, with one parameter more."""

    name = "late_sensor"
    title = "a sensor is late"
    looks_like = "one output lags"

    def places(self, model):
        return model.sensors.names

    def parameters(self, model, place):
        return (EffectParameter("tau_s", "s", "time constant", 0.0, 0.0, 0.1, 1e-3),)

    def change(self, ops, place, values):
        ops.sense[:, ops.sensor(place)] /= 1 + ops.s * values["tau_s"]


def test_a_user_s_own_effect_that_closes_the_gap_is_not_taken_away():
    """A low pass with a little delay: the competitor that has both fits better, but both leave noise."""
    truth = MODEL.with_effect(active(beyond()["sensor_late"], MODEL, "Sz1", (2e-5, 2e-3)))
    blocks = {name: block(truth, name) for name in MOTION}
    fitted, held = [blocks["00"], blocks["01"]], [blocks["02"], blocks["03"]]
    found = search(refit(MODEL, fitted, held), fitted, held, effects=[LateSensor()])
    assert found.best.labels == ("late_sensor@Sz1",)
    rival = found.rivals[0]
    assert rival.refit.excess_held < rival.against.excess_held and not rival.wins
    # The same odds against an effect of the library would have counted.
    shipped = replace(rival, against=replace(rival.against, model=MODEL.with_effect(
        active(library()["sensor_gain"], MODEL, "Sz1"))))
    assert shipped.left == rival.left and shipped.wins == (rival.left < GIVEN_UP)


@dataclass(frozen=True)
class Weighed:
    """What a contest asks of a refit; of so many numbers that the held-out residual is noise."""

    criterion: float
    excess_held: float = 1000.0
    excess_fit: float = 0.0
    held_per_dof: float = 1.0
    model = SimpleNamespace(effects=())


def test_what_came_near_is_contested_anew():
    base, named, far, near = (Weighed(c) for c in (5000.0, 1000.0, 2000.0, 1100.0))
    # Held against what was found before it was refitted, the competitor would win; against the refit it does not.
    rival = Rival(replace(near, excess_fit=100.0), replace(far, excess_fit=1000.0, excess_held=1001.0), "a competitor")
    assert rival.left < GIVEN_UP
    # What the held-out data do not bear out counts for nothing: ten to one beforehand.
    assert replace(rival, refit=replace(rival.refit, excess_held=1001.0)).left == pytest.approx(10 / 11)
    found = Found((base, named), (), True, (), (rival,))
    kept = contested(found)
    assert kept.chain is found.chain and kept.rivals[0].against is named
    # By what it falls short: odds of e^((1100 - 1000)/2), ten to one beforehand.
    assert replace(rival, against=named).odds == pytest.approx(2 * np.log(10.0) + 100.0)
    better = replace(rival, refit=Weighed(800.0, 990.0, -200.0))
    beaten = contested(replace(found, rivals=(better,)))
    assert beaten.chain == (base,)
    assert not beaten.reached_noise
    assert beaten.beaten is not None
    assert beaten.beaten.against is named
    # What has been decided stays.
    kept = replace(found, rivals=(better,), beaten=rival)
    assert contested(kept) is kept


def test_a_weaker_start_goes_to_a_tenth_of_the_way():
    one = active(library()["sensor_gain"], MODEL, "Sz1", (1.5,))
    assert weaker(one).values == pytest.approx((1.05,))
    drift = active(library()["stiffness_drift"], MODEL, "isolators/settling", (0.4, 20.0))
    assert weaker(drift).values == pytest.approx((0.04, 20.0))
