"""The printed criterion curves, and ratings at and around them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from avis_ctrl.rigs.floor_motion import third_octave_midbands
from avis_ctrl.rigs.vibration_criteria import CRITERIA, rating

BANDS = third_octave_midbands(1.0, 80.0)


def test_the_curves_are_those_of_gordon_and_amick():
    # Amick et al. 2005, table 1, printed to two or three digits [um/s].
    printed = {"VC-A": 50, "VC-B": 25, "VC-C": 12.5, "VC-D": 6.25, "VC-E": 3.1, "VC-F": 1.6, "VC-G": 0.78}
    for one in CRITERIA:
        assert one.limit(np.array([16.0]))[0] * 1e6 == pytest.approx(printed[one.name], rel=0.03)


def test_vc_a_is_about_260_micro_g_below_8_hz():
    # Amick et al. 2005, table 1: 260 ug between 4 and 8 Hz for VC-A, 130 ug for VC-B.
    f = np.array([4.0, 5.0, 6.3])
    for one, micro_g in zip(CRITERIA[:2], (260.0, 130.0), strict=True):
        acceleration = one.limit(f) * 2 * np.pi * f / 9.80665e-6
        np.testing.assert_allclose(acceleration, micro_g, rtol=0.02)
    assert np.isinf(CRITERIA[0].limit(np.array([3.0, 100.0]))).all()


def test_motion_on_a_curve_meets_it_and_a_little_more_does_not():
    for worse, better in pairwise(CRITERIA):
        v = np.where(np.isfinite(better.limit(BANDS)), better.limit(BANDS), 0.0)
        assert rating(BANDS, v) == better.name
        assert rating(BANDS, 1.001 * v) == worse.name


def test_the_loudest_band_decides():
    v = np.full(BANDS.size, 1e-6)
    v[10] = 5e-6
    assert rating(BANDS, v) == "VC-D"


def test_worse_than_vc_a_and_bands_that_are_not_all():
    assert rating(BANDS, np.full(BANDS.size, 1e-3)) is None
    assert rating(third_octave_midbands(4.0, 20.0), np.full(8, 1e-7)) == "VC-G"


def test_low_frequency_motion_counts_only_where_the_curve_reaches():
    v = np.full(BANDS.size, 1e-9)
    v[0] = 20e-6
    assert rating(BANDS, v) == "VC-B"
