"""Bounds in text hold: upper ones are rounded up, lower ones down."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

import avis_ctrl as ac
from avis_ctrl.report import words
from avis_ctrl.summary import rounded_down, rounded_up

NUMBERS = st.floats(1e-9, 1e9) | st.floats(-1e9, -1e-9)


@given(NUMBERS, st.integers(1, 9))
def test_directed_rounding_keeps_bounds_valid(value, digits):
    up, down = rounded_up(value, digits), rounded_down(value, digits)
    # The decimal number that is printed, not only its nearest float, is on the right side.
    assert float(f"{down:.{digits}g}") == down <= value <= up == float(f"{up:.{digits}g}")
    assert up - down <= 1.001 * 10 ** (1 - digits) * abs(value) * 10


def test_what_needs_no_rounding_stays():
    assert rounded_up(0.875, 3) == rounded_down(0.875, 3) == 0.875 and rounded_up(0.0, 3) == 0.0
    assert rounded_up(float("inf"), 3) == float("inf")


def test_bounds_in_reports_and_in_a_terminal():
    assert words.upper(0.87631) == "0.877" and words.lower(0.87639) == "0.876"
    # An attained gain of 1.30004 dB is not "at or below 1.3 dB".
    assert words.decibel(1.16145, "upper") == "+1.4 dB" and words.decibel(1.16145, "lower") == "+1.3 dB"
    peak = ac.mu_peak(ac.tf([0.99955], [1.0, 1.0]), [ac.ComplexScalar(1)])
    assert peak.upper == pytest.approx(1.0000498) and "upper=1.0001, lower=0.99955," in repr(peak)
