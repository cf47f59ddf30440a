"""What is said of a gap without a name: how it grows with the level, and where to look."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avis_ctrl.gap.analysis import separating_measurement
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.next_measurement import between, grows, grows_faster, of_unexplained
from avis_ctrl.gap.result import NamedEffect, RecordGap, Where
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs import load_rig

LEVELS = (0.05, 0.05, 0.15, 0.15, 0.5, 0.5)


def records(power, size=40.0, levels=LEVELS, scatter=0.0):
    """Residuals beside noise of one that grow as the level to a power."""
    random = np.random.default_rng(2)
    excess = size * np.array(levels) ** power * np.exp(scatter * random.standard_normal(len(levels)))
    return [
        RecordGap(f"{k:02d}", level, 60.0 * k, k > 3, 0.0, float(np.sqrt(1 + e**2)))
        for k, (level, e) in enumerate(zip(levels, excess, strict=True))
    ]


@given(st.floats(-1.0, 3.0), st.floats(1e3, 1e6))
def test_the_power_of_the_level_comes_back(power, size):
    found = grows(records(power, size))
    assert found is not None and found[0] == pytest.approx(power, abs=1e-6)


def test_its_deviation_is_that_of_least_squares():
    """Against the covariance of numpy's polyfit."""
    some = records(1.0, 1e4, scatter=0.1)
    x, y = np.log([r.level_V for r in some]), np.log([np.sqrt(r.after**2 - 1) for r in some])
    (slope, _), C = np.polyfit(x, y, 1, cov=True)
    assert grows(some) == pytest.approx((slope, np.sqrt(C[0, 0])), rel=1e-9)


@pytest.mark.parametrize(
    "some",
    [
        records(1.0, levels=(0.1,) * 6),
        records(1.0, size=1e-3),
        records(1.0)[:2],
        [],
        records(1.0, levels=(0.0,) * 6, size=9.0),
    ],
    ids=["one level", "noise", "two records", "none", "rest"],
)
def test_what_tells_nothing_of_growth(some):
    assert grows(some) is None
    assert "half and twice the level" in of_unexplained((), some)
    place = Where(3.0, 4.0, "", "Sz2", 0.5)
    assert of_unexplained((place,), some).startswith("50 % of the residual is at Sz2 from 3 to 4 Hz. Repeat")


@pytest.mark.parametrize(
    ("power", "said"),
    [
        (1.0, "it may be linear"),
        (0.0, "may not depend on the drives"),
        (0.45, "more slowly"),
        (2.0, "faster"),
        (-0.6, "more slowly"),
    ],
)
def test_what_growth_says(power, said):
    assert said in of_unexplained((), records(power, 1e3))


def test_the_channel_and_band_that_hold_most_are_named():
    places = (
        Where(3.0, 4.2, "Az1", "Sz2", 0.5),
        Where(4.2, 6.0, "Az1", "Sz2", 0.2),
        Where(40.0, 56.0, "", "Sz2", 0.01),
        Where(10.0, 14.0, "", "Sx2", 0.29),
    )
    text = of_unexplained(places, records(1.0, 1e3))
    assert text.startswith("70 % of the residual is at Sz2 from 3 to 6 Hz. The residual beyond noise varies")
    assert "one actuator at a time" in text


def test_records_of_another_noise_do_not_bend_the_power():
    """A linear residual; where the floor is not measured the noise is three times as large."""
    noise = (1.0, 3.0, 1.0, 3.0, 3.0, 3.0)
    some = [
        RecordGap(f"{k}", level, 0.0, False, 0.0, float(np.hypot(1.0, 300 * level / n)), f"floor {n}")
        for k, (level, n) in enumerate(zip(LEVELS, noise, strict=True))
    ]
    found = grows(some)
    assert found is not None and found[0] == pytest.approx(1.0, abs=1e-9)


def test_no_law_is_told_from_records_of_which_each_says_another():
    some = [
        RecordGap(f"{k}", level, 0.0, False, 0.0, after)
        for k, (level, after) in enumerate([(0.1, 3.0), (0.1, 12.0), (0.2, 9.0), (0.2, 4.0)])
    ]
    assert "half and twice the level" in of_unexplained((), some)


MODEL = TableModel(ResponseModel.of(load_rig("avis"), ()))


def with_effect(model, name, place, *values):
    return model.with_effect(active(library()[name], model, place, values))


@pytest.mark.parametrize("damping", [0.003, 0.03])
@pytest.mark.parametrize("frequency", [8.0, 11.3])
def test_predictions_differ_most_where_it_is_said(frequency, damping):
    """Against a comparison at so many frequencies that no peak falls between."""
    a = with_effect(MODEL, "sensor_gain", "Sz1", 1.02)
    b = with_effect(
        MODEL,
        "attached_oscillator",
        "payload/axes",
        0.3,
        frequency,
        1.2 * frequency,
        0.8 * frequency,
        damping,
        0.2,
        0.1,
        0.2,
    )
    f = np.geomspace(1.0, 50.0, 8000)
    D = np.abs(a.response(2 * np.pi * f) - b.response(2 * np.pi * f))[:, :, : len(a.actuators)]
    k, i, j = np.unravel_index(np.argmax(D), D.shape)
    text = between("sensor_gain", "attached_oscillator", a, b)
    low, high = (
        float(word)
        for word in (text.split(" from ")[2].split(" to ")[0], text.split(" from ")[2].split(" to ")[1].split()[0])
    )
    assert f"drive {a.actuators[j]} " in text and f"measure {a.sensors.names[i]}:" in text
    assert low <= f[k] * 1.005 and f[k] <= high * 1.005 and low < high
    assert float(text.split(" by ")[1].split()[0]) == pytest.approx(D.max(), rel=0.03)
    band = (f > 1.01 * low) & (f < 0.99 * high)
    assert np.all(D[band, i, j] > 0.45 * D.max())


def test_amplitude_counts_only_in_what_differs():
    """Both hold the same nonlinear effect, which comes last; what differs is linear."""
    a, b = (
        with_effect(with_effect(MODEL, "sensor_gain", place, 1.2), "cubic_stiffness", "isolators z", 1e9, 0.0, 0.0, 0.0)
        for place in ("Sz1", "Sz2")
    )
    assert "their predictions differ most" in between("sensor_gain", "sensor_gain", a, b)
    bent = with_effect(MODEL, "cubic_stiffness", "isolators z", 1e9, 0.0, 0.0, 0.0)
    assert "only cubic_stiffness depends" in between(
        "cubic_stiffness", "sensor_gain", bent, with_effect(MODEL, "sensor_gain", "Sz1", 1.2)
    )


def test_a_drift_is_told_apart_by_time_and_not_by_the_level():
    """A drifting stiffness is the same fraction of the response at every level."""
    drift = with_effect(MODEL, "stiffness_drift", "isolators/linear", 0.1)
    gain = with_effect(MODEL, "sensor_gain", "Sz1", 1.2)
    text = between("stiffness_drift", "sensor_gain", drift, gain)
    assert "over a longer time: only stiffness_drift depends on time" in text and "level" not in text
    other = with_effect(MODEL, "stiffness_drift", "isolators/settling", 0.1, 0.3)
    assert "they depend on time in different ways" in between("stiffness_drift", "stiffness_drift", drift, other)
    bent = with_effect(MODEL, "cubic_stiffness", "isolators z", 1e9, 0.0, 0.0, 0.0)
    assert "only cubic_stiffness depends on amplitude" in between("stiffness_drift", "cubic_stiffness", drift, bent)


def test_the_rival_is_compared_at_the_place_that_cannot_be_ruled_out():
    """Not at the first place that was fitted."""

    def fitted(name, place, log_likelihood, *values):
        return SimpleNamespace(
            model=with_effect(MODEL, name, place, *values),
            log_evidence=log_likelihood,
            log_likelihoods={(0.1, 1): log_likelihood},
        )

    tried = {
        "sensor_gain@Sz1": fitted("sensor_gain", "Sz1", 0.0, 1.2),
        "actuator_gain@Az1": fitted("actuator_gain", "Az1", -9.0, 0.9),
        "actuator_gain@Az3": fitted("actuator_gain", "Az3", -1.0, 0.9),
    }
    step = SimpleNamespace(label="sensor_gain@Sz1", tried=tried)
    told = [NamedEffect("sensor_gain", "Sz1", "", {}, 0.6, ("actuator_gain",), "sensor_gain@Sz1")]
    mine, best = (tried[label].model for label in ("sensor_gain@Sz1", "actuator_gain@Az3"))
    text = separating_measurement(told, SimpleNamespace(steps=[step]))
    assert text == between("sensor_gain", "actuator_gain", mine, best)


def test_growth_is_stated_where_the_records_say_it():
    assert grows_faster(records(2.0, 1e4)) is True
    assert grows_faster(records(0.5, 1e4)) is False
    assert grows_faster(records(1.0, 1e4)) is False
    assert grows_faster(records(1.1, 1e4, scatter=0.3)) is None
    assert grows_faster(records(2.0, 1e4)[:1]) is None
