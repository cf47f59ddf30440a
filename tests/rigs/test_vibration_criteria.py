"""The printed criterion curves, and ratings at and around them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.floor_motion import third_octave_midbands
from avis_ctrl.rigs.vibration_criteria import CRITERIA, criterion, rating

BANDS = third_octave_midbands(1.0, 80.0)


def test_the_curves_are_those_of_gordon_and_amick():
    # Amick et al. 2005, table 1, printed to two or three digits [um/s].
    printed = {"VC-A": 50, "VC-B": 25, "VC-C": 12.5, "VC-D": 6.25, "VC-E": 3.1, "VC-F": 1.6, "VC-G": 0.78}
    for one in CRITERIA:
        assert one.limit(np.array([16.0]))[0] * 1e6 == pytest.approx(printed[one.name], rel=0.03)


def test_vc_a_is_about_260_micro_g_below_8_hz():
    # Amick et al. 2005, table 1: 260 ug between 4 and 8 Hz for VC-A, 130 ug for VC-B.
    for name, micro_g in (("VC-A", 260.0), ("VC-B", 130.0)):
        f = np.array([4.0, 5.0, 6.3])
        acceleration = criterion(name).limit(f) * 2 * np.pi * f / 9.80665e-6
        np.testing.assert_allclose(acceleration, micro_g, rtol=0.02)
    assert np.isinf(criterion("VC-A").limit(np.array([3.0, 100.0]))).all()


def test_motion_on_a_curve_meets_it_and_a_little_more_does_not():
    for worse, better in pairwise(CRITERIA):
        v = np.where(np.isfinite(better.limit(BANDS)), better.limit(BANDS), 0.0)
        assert rating(BANDS, v).criterion == better.name
        assert rating(BANDS, 1.001 * v).criterion == worse.name


def test_the_deciding_band_is_where_the_next_curve_is_exceeded():
    v = np.full(BANDS.size, 1e-6)
    v[10] = 5e-6
    found = rating(BANDS, v)
    assert (found.criterion, found.against) == ("VC-D", "VC-E")
    assert found.deciding_band_Hz == pytest.approx(10.0)
    assert found.deciding_rms == 5e-6 and found.deciding_limit == 3.12e-6
    assert found.bands_missing_Hz == ()


def test_worse_than_vc_a_and_incomplete_data_are_said():
    loud = rating(BANDS, np.full(BANDS.size, 1e-3))
    assert loud.criterion is None and loud.against == "VC-A"
    part = rating(third_octave_midbands(4.0, 20.0), np.full(8, 1e-7))
    assert part.criterion == "VC-G" and len(part.bands_missing_Hz) == 12


def test_low_frequency_motion_counts_only_where_the_curve_reaches():
    v = np.full(BANDS.size, 1e-9)
    v[0] = 20e-6
    assert rating(BANDS, v).criterion == "VC-B"


@pytest.mark.parametrize(
    ("bands", "rms", "field"),
    [
        ([8.0], [np.nan], "rms"),
        ([8.0], [-1.0], "rms"),
        ([8.0, 10.0], [1e-6], "rms"),
        ([0.0], [1e-6], "midband_Hz"),
        ([1.0], [1e-6], "midband_Hz"),
    ],
)
def test_wrong_input_is_refused_by_name(bands, rms, field):
    with pytest.raises(InputError, match=field):
        rating(np.array(bands), np.array(rms))


def test_an_unknown_criterion_is_refused():
    with pytest.raises(InputError, match="VC-A"):
        criterion("VC-Z")
