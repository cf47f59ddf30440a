"""The tests inside the gates against closed forms, and their false alarms counted."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.measurement.gates import Expectation, examine, periodicity
from avis_ctrl.measurement.gates.channel_faults import MapSettings, compare, explain
from avis_ctrl.measurement.gates.clipping import over_range, repeated_extreme
from avis_ctrl.measurement.gates.dead_channel import equal_runs
from avis_ctrl.measurement.gates.excerpt import excerpt
from avis_ctrl.measurement.gates.h1 import Samples, Spectra, h1
from avis_ctrl.measurement.gates.hum import Hum
from avis_ctrl.measurement.gates.missing_samples import delay_step, drifts, repeated_block
from avis_ctrl.measurement.gates.periodicity import Periodicity, compared
from avis_ctrl.measurement.gates.sine_fit import fit_sine, second_order
from avis_ctrl.measurement.gates.spikes import departure, jump_corner

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.integers(6, 14))
def test_unclipped_signals_have_no_flat_tops(seed, bits):
    """Sines and noises, rounded: below the 1 % that a campaign shares."""
    rng = np.random.default_rng(seed)
    step = 2.0**-bits
    sine = np.sin(2 * np.pi * rng.uniform(0.001, 0.4) * np.arange(5000) + rng.uniform(0, 6))
    for x in (sine, sine + step * rng.standard_normal(5000), rng.standard_normal(5000)):
        rounded = step * np.round(x / step)
        assert not over_range(rounded).any()
    assert repeated_extreme(step * np.round(rng.standard_normal(5000) / step))[1] > 1e-4


@given(seeds, st.floats(0.5, 0.95))
def test_a_clipped_sine_is_found(seed, part):
    rng = np.random.default_rng(seed)
    x = np.sin(2 * np.pi * rng.uniform(0.003, 0.1) * np.arange(5000)) + 1e-3 * rng.standard_normal(5000)
    assert repeated_extreme(np.round(1e4 * np.minimum(x, part)))[1] < 1e-6


def test_over_range_runs_are_marked_exactly():
    x = np.sin(2 * np.pi * 0.01 * np.arange(1000))
    want = np.zeros(1000, bool)
    for start in (60, 260, 460):
        want[start : start + 25] = True
    assert np.array_equal(over_range(np.where(want, 3.0, x)), want)


@given(st.lists(st.integers(0, 2), min_size=2, max_size=60))
def test_longest_run_by_groupby(values):
    from itertools import groupby

    lengths = sorted((len(list(g)) for _, g in groupby(values)), reverse=True)
    assert [n for n, _ in equal_runs(np.array(values, float))] == lengths[:2]


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("size", [1.0, -2.5])
def test_a_corner_leaves_nothing_and_a_single_sample_much(share, size):
    """Where the slope changes, at a sample or between two, the departure from cubics has the shape of a corner."""
    t = np.arange(-4.0, 5.0)
    bend = size * np.maximum(t - share, 0.0)
    assert jump_corner(departure(bend)) < 1e-12 * np.sum(departure(bend) ** 2)
    alone = np.where(t == 0, size, 0.0)
    assert jump_corner(departure(alone)) > 0.04 * np.sum(departure(alone) ** 2)


@given(seeds, st.integers(20, 200), st.integers(0, 300))
def test_a_repeated_block_is_found_where_it_is(seed, rows, at):
    y = np.random.default_rng(seed).standard_normal((1000, 2))
    assert repeated_block(y, None) is None
    y[at + 300 : at + 300 + rows] = y[at : at + rows]
    found = repeated_block(y, None)
    assert found is not None and found[1] == 300 and found[0] == at + 300
    assert found[2] == rows


def test_periods_that_repeat_are_no_repeated_block(rng):
    y = np.tile(rng.standard_normal((100, 2)), (5, 1))
    assert repeated_block(y, 100) is None
    assert repeated_block(y, None) is not None


def test_false_alarms_of_the_delay_step(rng):
    """300 records at 1 % each: more than 10 come in 0.03 % of such tests."""
    hits = sum(delay_step(0.1 * rng.standard_normal(40), 0.01 / 40) is not None for _ in range(300))
    assert hits <= 10


def test_a_step_of_the_delay_has_its_place_and_size(rng):
    delay = 0.1 * rng.standard_normal(40)
    delay[25:] -= 2
    where, size = delay_step(delay, 1e-4)
    assert abs(where - 25) <= 1 and size == pytest.approx(-2, abs=0.2)


@pytest.mark.parametrize(("shape", "away"), [(np.linspace(0, 3, 60), True), (3.0 * (np.arange(60) > 20), False)])
def test_two_clocks_are_no_lost_samples(rng, shape, away):
    delay = shape + 0.1 * rng.standard_normal(60)
    where, size = delay_step(delay, 1e-4)
    assert drifts(delay, where) == away and size > 1


@given(seeds)
def test_fitted_sine(seed):
    rng = np.random.default_rng(seed)
    rate, f = 130.0, rng.uniform(0.3, 30)
    t = np.arange(4000) / rate
    X = rng.uniform(0.5, 2, 2) * np.exp(2j * np.pi * rng.random(2))
    x = np.real(X * np.exp(2j * np.pi * f * t)[:, None]) + [3.0, -1.0] + 1e-3 * rng.standard_normal((4000, 2))
    fit = fit_sine("a", x, 1, rate)
    assert fit.f == pytest.approx(f, abs=1e-4)
    np.testing.assert_allclose(fit.X, X, atol=2e-3)
    np.testing.assert_allclose(fit.residual_rms, 1e-3, rtol=0.1)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(st.floats(0.3, 5), st.floats(0.2, 1.2), st.sampled_from([0, 1, 2]), st.sampled_from([-1.0, 1.0]))
def test_second_order_response(corner, damping, k, gain):
    f = np.geomspace(0.1, 10, 15)
    s, w = 2j * np.pi * f, 2 * np.pi * corner
    found = second_order(f, gain * 7 * s**k / (s * s + 2 * damping * w * s + w * w))
    assert found.k == k and found.misfit < 1e-3
    assert found.corner_Hz == pytest.approx(corner, rel=1e-3) and found.damping == pytest.approx(damping, rel=1e-3)


def test_h1_of_white_noise_is_the_gain_with_its_stated_error(rng):
    """G constant: no leakage; the residual is the noise, and the errors follow inv(gram)."""
    G = np.array([[1.0, -2.0], [0.5, 0.0], [0.0, 3.0]])
    u = rng.standard_normal((40000, 2))
    y = u @ G.T + 0.1 * rng.standard_normal((40000, 3))
    made = h1([Samples(u, y, 100.0).spectra(256)])
    np.testing.assert_allclose(made.G.mean(axis=0).real, G, atol=0.005)
    variance = np.einsum("fi,fjj->fij", made.noise, made.covariance).real
    ratio = np.mean(np.abs(made.G - G) ** 2 / variance)
    assert ratio == pytest.approx(1.0, abs=0.15)


def spectra_of(rng, M, noise=0.02, K=60):
    U = rng.standard_normal((K, 40, M.shape[2])) + 1j * rng.standard_normal((K, 40, M.shape[2]))
    Y = np.einsum("fij,kfj->kfi", M, U)
    return Spectra(np.arange(40.0), U, Y + noise * rng.standard_normal(Y.shape)), U


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_faults_of_a_random_matrix_are_recovered(seed):
    """Any permutation and any signs (fewer flips than half) of a generic response."""
    rng = np.random.default_rng(seed)
    E = rng.standard_normal((40, 4, 3)) + 1j * rng.standard_normal((40, 4, 3))
    p, q = rng.permutation(4), np.arange(3)
    r = np.ones(4)
    r[rng.integers(4)] = -1
    measured, U = spectra_of(rng, r[:, None] * E[:, p][:, :, q])
    expected = Spectra(measured.f, U, np.einsum("fij,kfj->kfi", E, U))
    faults = explain(compare([(measured, expected)]))
    assert np.array_equal(faults.p, p) and np.array_equal(faults.r, r)
    assert np.array_equal(faults.q, q) and np.all(faults.c > 0)


def reversed_row(noise, delay_s=MapSettings.delay_s):
    """Row 2 of four reversed, under noise; with the number of independent values in a row."""
    rng, r = np.random.default_rng(1), np.array([1.0, 1.0, -1.0, 1.0])
    E = rng.standard_normal((40, 4, 3)) + 1j * rng.standard_normal((40, 4, 3))
    measured, U = spectra_of(rng, r[:, None] * E, noise)
    expected = Spectra(measured.f, U, np.einsum("fij,kfj->kfi", E, U))
    comparison = compare([(measured, expected)], settings=MapSettings(delay_s=delay_s))
    return explain(comparison), comparison.N


@pytest.mark.parametrize("noise", [1.0, 3.0, 6.0])
def test_the_chance_that_is_told_is_the_one_found(noise):
    """4 + 6 * 4 changes of rows, of columns 3 + 3 * 4 in each of four rows; in 38 Hz 25 ms hold 3 delays."""
    faults, N = reversed_row(noise)
    a = faults.other[2]
    assert list(faults.p_value) == [("row", 2)] and a > 0.9
    assert faults.p_value["row", 2] == pytest.approx(88 * 3 * max((1 - 0.9 * a**2) ** N, (1 - a**2) ** (N - 1)))


def test_the_more_delays_are_tried_the_less_a_fault_proves():
    """Under this noise the reversed row is proved for a known delay, but not where one of 8 was chosen."""
    known, tried = reversed_row(9.0, (0.0, 0.0))[0], reversed_row(9.0, (-0.045, 0.045))[0]
    assert known.r[2] == -1 and 1e-4 / 8 < known.p_value["row", 2] < 1e-4
    assert np.all(tried.r == 1) and not tried.p_value and tried.doubtful == (("row", 2),)


def rest(rng, samples=30000, rate=1000.0, channels=4, colour=(1.0,)):
    y = signal.lfilter([1.0], colour, rng.standard_normal((samples, channels)), axis=0)
    names = tuple(f"y{k}" for k in range(channels))
    return Record(RecordHeader("00", rate, samples, ("u",), names, "rest"), np.zeros((samples, 1)), y)


@pytest.mark.parametrize("colour", [(1.0,), (1.0, -0.95)])
def test_false_alarms_of_hum(colour):
    """100 campaigns of white and of red noise at 1 % each: 5 or more by chance in 0.4 % of such tests."""
    hits = 0
    for seed in range(100):
        record = rest(np.random.default_rng(seed), colour=colour)
        gate = Hum(Campaign("x", (record,)), Expectation())
        found = gate.conclude([gate.look(excerpt(record))])
        hits += any(f.severity != "ok" for f in found)
    assert hits <= 4


@pytest.mark.parametrize("off", [0.9975, 1.003])
@pytest.mark.parametrize("mains", [50.0, 60.0])
def test_hum_names_mains_channel_and_size(rng, mains, off):
    """Anywhere in the tolerance; the frequency to half a bin of 1/4 Hz, the size within the noise of its bins."""
    record = rest(rng)
    y = record.y.copy()
    y[:, 2] += 0.4 * np.sin(2 * np.pi * (mains * off) * np.arange(len(y)) / 1000)
    record = Record(record.header, record.u, y)
    gate = Hum(Campaign("x", (record,)), Expectation())
    found = gate.conclude([gate.look(excerpt(record))])
    assert [(f.channels, f.severity) for f in found] == [(("y2",), "warning")]
    assert f"carries mains hum at {mains:g} Hz:" in found[0].sentence
    said = re.search(r"Hz: at (\S+) Hz (\S+) V r\.m\.s\.", found[0].sentence)
    assert float(said[1]) == pytest.approx(mains * off, abs=0.13)
    assert float(said[2]) == pytest.approx(0.4 / np.sqrt(2), rel=0.1)
    # Over the louder of 16 bins on either side, three bins away from the tolerance of one bin.
    P, middle = signal.welch(y[:, 2], 1000, "hann", 4000, 0, detrend="linear")[1], round(4 * mains)
    floor = max(P[middle - 20 : middle - 4].mean(), P[middle + 5 : middle + 21].mean())
    assert found[0].value == pytest.approx(P[middle - 1 : middle + 2].max() / floor)


@pytest.mark.parametrize(("lines", "mains"), [((60, 120, 300), [60]), ((50, 300), [50]), ((300,), [50, 60])])
def test_a_common_harmonic_is_hum_of_the_frequency_with_other_lines(rng, lines, mains):
    """300 Hz is a harmonic of 50 Hz and of 60 Hz."""
    record = rest(rng)
    y = record.y.copy()
    y[:, 2] += 0.4 * sum(np.sin(2 * np.pi * f * np.arange(len(y)) / 1000) for f in lines)
    gate = Hum(Campaign("x", (Record(record.header, record.u, y),)), Expectation())
    found = gate.conclude([gate.look(excerpt(Record(record.header, record.u, y)))])
    assert len(found) == len(mains)
    named = ", ".join(f"{f:g}" for f in lines)
    assert all(f"carries mains hum at {named} Hz:" in one.sentence for one in found)


@pytest.mark.parametrize("excitation", ["multisine", "noise"])
def test_signal_to_noise_is_what_was_put_in(rng, excitation):
    """20 dB and 0 dB on every line, of six periods or of white noise, in each octave within what few lines scatter."""
    lines, N = np.arange(1, 1024), 2048
    U = np.zeros(N // 2 + 1, complex)
    U[lines] = np.sqrt(N) * np.exp(2j * np.pi * rng.random(lines.size))  # the power of white noise of r.m.s. 1
    u = np.tile(np.fft.irfft(U, N), 6) if excitation == "multisine" else rng.standard_normal(60000)
    y = u[:, None] * [1.0, 0.1] + 0.1 * rng.standard_normal((len(u), 2))
    header = RecordHeader(
        "00", 1000.0, len(u), ("u",), ("a", "b"), excitation, 1.0, 0.0, N / 1000 if excitation == "multisine" else None
    )
    campaign = Campaign("x", (Record(header, u[:, None], y),))
    (said,) = [f for f in examine(campaign) if f.gate == "signal to noise" and f.picture.series]
    for series, dB in zip(said.picture.series, (20.0, 0.0), strict=True):
        wide = series.x > 10
        assert wide.sum() > 3 and np.all(np.abs(series.y[wide] - dB) < 1.5)


def test_false_alarms_of_periodicity(rng):
    """T of pure noise is 1 on average, and its largest over periods stays under the F limit."""
    from scipy import stats

    hits = 0
    for _ in range(200):
        T, _, lines, R = compared(rng.standard_normal((8, 256, 2)))
        assert T.mean() == pytest.approx(1.0, abs=0.25)
        hits += T.max() > stats.f.isf(0.01 / T.size, lines, lines * (R - 1))
    assert hits <= 7


def test_a_channel_that_differs_only_before_the_reference_has_settled():
    """Of 6 periods, "a" fails in the last one and "b" in the last one before the reference, which is no drift."""
    T = np.ones((6, 2))
    T[5, 0], T[2, 1] = 9.0, 9.0
    header = RecordHeader("00", 100.0, 600, ("u",), ("a", "b"), "multisine", 1.0, 0.0, 1.0)
    campaign = Campaign("x", (Record(header, np.zeros((600, 1)), np.zeros((600, 2))),))
    periods = periodicity._Kept("00", 1.0, T, 0.1 * T, 50, 2)
    (finding,) = Periodicity(campaign, Expectation()).conclude([periods])
    assert finding.severity == "warning" and finding.channels == ("a",)


def test_long_records_are_looked_at_in_pieces_and_that_is_said(rng):
    class Watched(Record):
        sizes: tuple[int, ...] = ()

        def load(self, start=0, stop=None):
            stop = self.header.samples if stop is None else stop
            Watched.sizes += (stop - start,)
            return super().load(start, stop)

    short = rest(rng, samples=30000)
    record = Watched(short.header, short.u, short.y)
    findings = examine(Campaign("x", (record,)), longest=8000)
    assert sum(Watched.sizes) <= 8000
    assert all("only pieces with 8000 samples" in f.sentence for f in findings)


def test_expectation_refuses_a_noise_of_zero():
    with pytest.raises(InputError, match="sensor_noise_rms_V"):
        Expectation(sensor_noise_rms_V=0.0)


@pytest.mark.parametrize("samples", [2, 3, 4, 5, 8, 15, 16, 17, 40])
def test_records_of_a_few_samples_end_in_no_error_and_no_stop(samples, rng):
    """Shorter than one segment of any length: nothing can be said of them, so nothing is."""
    names = tuple("abcdef"), tuple("uvw")
    header = RecordHeader("00", 100.0, samples, names[1], names[0], "noise", 0.1, 0.0, None)
    campaign = Campaign("", (Record(header, rng.standard_normal((samples, 3)), rng.standard_normal((samples, 6))),))
    assert not [one for one in examine(campaign, None) if one.severity == "stop"]
