"""What is said of a gap without a name: how it grows with the level, and where to look."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avis_ctrl.gap.next_measurement import grows, of_unexplained
from avis_ctrl.gap.result import RecordGap, Where

LEVELS = (0.05, 0.05, 0.15, 0.15, 0.5, 0.5)


def records(power, size=40.0, levels=LEVELS, scatter=0.0):
    """Residuals beside noise of one that grow as the level to a power."""
    random = np.random.default_rng(2)
    excess = size * np.array(levels) ** power * np.exp(scatter * random.standard_normal(len(levels)))
    return [RecordGap(f"{k:02d}", level, 60.0 * k, k > 3, 0.0, float(np.sqrt(1 + e ** 2)))
            for k, (level, e) in enumerate(zip(levels, excess, strict=True))]


@given(st.floats(-1.0, 3.0), st.floats(1e3, 1e6))
def test_the_power_of_the_level_comes_back(power, size):
    found = grows(records(power, size))
    assert found is not None and found[0] == pytest.approx(power, abs=1e-6)


def test_its_deviation_is_that_of_least_squares():
    """Against the covariance of numpy's polyfit."""
    some = records(1.0, 1e4, scatter=0.1)
    x, y = np.log([r.level_V for r in some]), np.log([np.sqrt(r.after ** 2 - 1) for r in some])
    (slope, _), C = np.polyfit(x, y, 1, cov=True)
    assert grows(some) == pytest.approx((slope, np.sqrt(C[0, 0])), rel=1e-9)


@pytest.mark.parametrize("some", [records(1.0, levels=(0.1,) * 6), records(1.0, size=1e-3), records(1.0)[:2], [],
                                  records(1.0, levels=(0.0,) * 6, size=9.0)],
                         ids=["one level", "noise", "two records", "none", "rest"])
def test_what_tells_nothing_of_growth(some):
    assert grows(some) is None
    assert "half and at twice the level" in of_unexplained((), some)
    place = Where(3.0, 4.0, "", "Sz2", 0.5)
    assert of_unexplained((place,), some).startswith("What remains lies to 50% at Sz2 from 3 to 4 Hz. Repeat")


@pytest.mark.parametrize(("power", "said"), [(1.0, "it is linear"), (0.0, "hardly depends on the drives"),
                                             (0.45, "more slowly"), (2.0, "faster"), (-0.6, "more slowly")])
def test_what_growth_says(power, said):
    assert said in of_unexplained((), records(power, 1e3))


def test_the_channel_and_band_that_hold_most_are_named():
    places = (Where(3.0, 4.2, "Az1", "Sz2", 0.5), Where(4.2, 6.0, "Az1", "Sz2", 0.2),
              Where(40.0, 56.0, "", "Sz2", 0.01), Where(10.0, 14.0, "", "Sx2", 0.29))
    text = of_unexplained(places, records(1.0, 1e3))
    assert "What remains, to 71% at Sz2 from 3 to 6 Hz, grows" in text and "one actuator at a time" in text
