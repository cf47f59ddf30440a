"""Local polynomial method on systems whose response is known exactly."""

from __future__ import annotations

import re
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known_systems import Modal, campaign, multisine, squared_error
from scipy import stats

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.measurement.campaign import Campaign, RecordSource
from avis_ctrl.measurement.frequency_response.local_fit import LocalFit, least_half_width
from avis_ctrl.measurement.frequency_response.local_polynomial import local_polynomial, noise_covariance

RATE = 200.0


def noisy(system, rng, samples, records, noise=0.05, factor=None, discard=0):
    factor = np.eye(system.n_y) if factor is None else factor
    runs = []
    for _ in range(records):
        u = rng.standard_normal((samples + discard, system.n_u))
        y = system.simulate(u) + noise * rng.standard_normal((samples + discard, system.n_y)) @ factor.T
        runs.append((u[discard:], y[discard:]))
    return campaign(runs, RATE)


def local_model(U, Y, line_Hz, frequency_Hz=None, order=2, half_width=None):
    """The estimate of records of one length, U (n_records, n_lines, n_u), Y (n_records, n_lines, n_y)."""
    n_records, _, n_u = U.shape
    width = half_width or least_half_width(n_records, n_u, Y.shape[2], order)
    where = line_Hz if frequency_Hz is None else frequency_Hz
    fit = LocalFit(where, n_u, Y.shape[2], order, width, width * (line_Hz[1] - line_Hz[0]))
    fit.add(U, Y, line_Hz)
    return fit.estimate()


@pytest.mark.parametrize("order", [2, 3, 4])
def test_a_response_that_is_a_polynomial_is_found_exactly(rng, order):
    """G and the transients polynomial over the band: no bias at all, transients included."""
    f = np.arange(1, 61) * 0.5
    G = sum(rng.standard_normal((2, 3)) * (f[:, None, None] / 30) ** s for s in range(order + 1))
    U = rng.standard_normal((4, 60, 3)) + 1j * rng.standard_normal((4, 60, 3))
    T = sum(rng.standard_normal((4, 1, 2)) * (f[:, None] / 30) ** s for s in range(order + 1))
    found = local_model(U, (G @ U[..., None])[..., 0] + T, f, order=order)
    assert np.abs(found.value - G).max() < 1e-10


def test_the_same_estimate_as_the_full_least_squares_of_the_book(rng):
    """One line solved by lstsq with the transients as explicit unknowns (P&S 2012, section 7.2.2)."""
    f, n_rec, n_u, n_y, order, w = np.arange(1, 40.0), 3, 2, 2, 2, 4
    U = rng.standard_normal((n_rec, 39, n_u)) + 1j * rng.standard_normal((n_rec, 39, n_u))
    Y = rng.standard_normal((n_rec, 39, n_y)) + 1j * rng.standard_normal((n_rec, 39, n_y))
    found = local_model(U, Y, f, f[20:21], order, w)
    rows, right = [], []
    for r in range(n_rec):
        for k in range(20 - w, 20 + w + 1):
            d = float(k - 20) ** np.arange(order + 1)
            own = np.zeros((n_rec, order + 1))
            own[r] = d
            rows.append(np.concatenate([np.kron(d, U[r, k]), own.ravel()]))
            right.append(Y[r, k])
    K, right = np.array(rows), np.array(right)
    solution = np.linalg.lstsq(K, right)[0]
    assert found.dof == K.shape[0] - K.shape[1]
    assert np.allclose(found.value[0], solution[:n_u].T)
    residual = right - K @ solution
    assert np.allclose(found.noise[0], residual.T @ residual.conj() / found.dof)
    inverse = np.linalg.inv(K.conj().T @ K)[:n_u, :n_u]
    assert np.allclose(np.linalg.inv(found.gram[0]).T, inverse)


def test_the_default_window_is_the_smallest_with_equations_to_spare():
    """Lines less unknowns, counted: of G and of each record's transient; 2 n_y + 4 are left."""
    for records, n_u, n_y, order in product((1, 2, 5), (0, 1, 8), (1, 6), (2, 3)):

        def spare(w, records=records, n_u=n_u, n_y=n_y, order=order):
            unknowns = (order + 1) * n_u + (order + 1) * records
            return records * (2 * w + 1) - unknowns - (2 * n_y + 4)

        w = least_half_width(records, n_u, n_y, order)
        assert spare(w) >= 0 and w > order
        assert w == order + 1 or spare(w - 1) < 0


def test_the_window_of_a_periodic_record_holds_enough_excited_lines():
    """As many as G has coefficients of an input, in all records as many as it has unknowns; one to spare at most."""
    for records, n_u, order, spacing in product((1, 2, 5), (1, 2, 8), (2, 3), (2, 5, 6)):
        w, plain = (least_half_width(records, n_u, 1, order, spacing=each) for each in (spacing, 1))
        excited, wanted = (2 * w + 1) // spacing, (order + 1) * n_u
        assert w >= plain and excited > order and excited * records >= wanted
        enough = max(order, wanted / records) + 2
        assert w == plain or 2 * w - 1 <= spacing * enough


def test_records_taken_in_one_by_one_give_the_same_as_together(rng):
    f = np.arange(1, 101.0)
    U = rng.standard_normal((5, 100, 2)) + 1j * rng.standard_normal((5, 100, 2))
    Y = rng.standard_normal((5, 100, 3)) + 1j * rng.standard_normal((5, 100, 3))
    fit = LocalFit(f, 2, 3, 2, 5, 5.0)
    for r in range(5):
        fit.add(U[r : r + 1], Y[r : r + 1], f)
    one, together = fit.estimate(), local_model(U, Y, f, half_width=5)
    for field in ("value", "noise", "gram"):
        assert np.allclose(getattr(one, field), getattr(together, field), rtol=1e-9, atol=1e-12), field


def test_covariance_covers_what_it_claims():
    """200 campaigns of a 2x2 system: the error of vec(G), measured by its estimated covariance, follows Hotelling's
    law, 2 n F(2n, 2(dof - n + 1))-like for complex errors; 95 % regions hold 95 %."""
    rng = np.random.default_rng(5)
    system = Modal(rng, 2, 2, [20.0, 50.0], 0.3, RATE)
    mixing, noise = np.array([[1.0, 0.0], [0.8, 0.6]]), 0.2
    ratio, scaled, entries = [], [], []
    for _ in range(200):
        got = local_polynomial(
            noisy(system, rng, 600, 3, noise, mixing), band_Hz=(10.0, 80.0), frequency_Hz=np.linspace(12, 78, 5)
        )
        error = got.value - system.response(got.frequency_Hz)
        entries.append(squared_error(got, system.response(got.frequency_Hz)))
        # Column j of G along S: e S^(1/2) has independent columns of covariance C.
        root = np.linalg.cholesky(got.gram)
        columns = error @ root
        ratio.append(np.real(np.einsum("nij,nik,nkj->n", columns.conj(), np.linalg.inv(got.noise), columns)))
        scaled.append(got.noise)
    dof = got.dof
    # A Student's law of each entry: |e|^2/var is F(2, 2 dof).
    inside = np.mean(np.array(entries) < stats.f(2, 2 * dof).isf(0.05))
    assert 0.93 < inside < 0.97
    # E of the quadratic form over 2 columns: n_u n_y dof / (dof - n_y) for a complex Wishart estimate.
    assert np.mean(ratio) == pytest.approx(4 * dof / (dof - 2), rel=0.08)
    # 1/sqrt(N) scaling: variance of a line is that of a sample; trace test of chi-square at 1000 estimates.
    mean = np.mean(scaled, axis=(0, 1))
    assert np.allclose(mean, noise**2 * mixing @ mixing.T, atol=4 * noise**2 / np.sqrt(1000 * dof) * 2)


def hann_error(system, u, y, keep):
    """SISO H1 of a single record with a Hann window in the frequency domain (no averaging): for comparison only."""

    def smooth(x):
        X = np.fft.rfft(x[:, 0])
        return X[1:-1] - 0.5 * (X[:-2] + X[2:])

    return (smooth(y) / smooth(u))[keep]


def test_leakage_falls_with_the_order_and_beats_a_hann_window():
    """Noise-free: halving the resolution divides the error by about 2^(order + 1) at least, Hann's by less."""
    rng = np.random.default_rng(8)
    system = Modal(rng, 1, 1, [30.0], 0.05, RATE)
    sizes, where = [1000, 2000, 4000], np.linspace(20, 40, 41)
    rms = {2: [], 4: [], "hann": []}
    for n in sizes:
        data = noisy(system, rng, n, 1, 0.0, discard=700)
        exact = system.response(where)
        for order in (2, 4):
            got = local_polynomial(data, band_Hz=(10, 60), frequency_Hz=where, order=order, half_width=8)
            rms[order].append(np.sqrt(np.mean(np.abs(got.value - exact) ** 2)))
        record = data.records[0]
        got = hann_error(system, record.u, record.y, np.rint(where * n / RATE).astype(int) - 1)
        rms["hann"].append(np.sqrt(np.median(np.abs(got - exact[:, 0, 0]) ** 2)))
    slope = {key: np.log2(value[0] / value[-1]) / 2 for key, value in rms.items()}
    assert slope[2] > 2.5 and slope[4] > 4.0 and slope["hann"] < 2.2, (slope, rms)
    assert rms[2][-1] < rms["hann"][-1] / 5 and rms[4][-1] < rms["hann"][-1] / 50


def test_long_records_in_pieces_and_records_of_different_length(rng):
    system = Modal(rng, 2, 2, [20.0, 55.0], 0.1, RATE)
    u = rng.standard_normal((30000, 2))
    long = campaign([(u, system.simulate(u) + 0.1 * rng.standard_normal((30000, 2)))], RATE)
    where = np.linspace(10, 80, 40)
    whole = local_polynomial(long, band_Hz=(5, 90), frequency_Hz=where)
    pieces = local_polynomial(long, band_Hz=(5, 90), frequency_Hz=where, longest_piece=5000)
    assert "6 records or pieces" in pieces.method
    for got in (whole, pieces):
        assert np.mean(squared_error(got, system.response(where))) == pytest.approx(1.15, abs=0.3)
    mixed = campaign([(u[:4000], system.simulate(u[:4000])), (u[4000:10000], system.simulate(u[4000:10000]))], RATE)
    got = local_polynomial(mixed, band_Hz=(5, 90), frequency_Hz=where)
    assert np.abs(got.value - system.response(where)).max() < 1e-2


class Guarded(RecordSource):
    """A record that refuses to be loaded in more than a piece at once."""

    def __init__(self, record, longest):
        self.record, self.header, self.longest = record, record.header, longest

    def load(self, start=0, stop=None):
        stop = self.header.samples if stop is None else stop
        assert stop - start <= self.longest, "too much at once"
        return self.record.load(start, stop)


def test_no_more_than_a_piece_is_in_memory(rng):
    system = Modal(rng, 2, 2, [20.0], 0.1, RATE)
    data = noisy(system, rng, 10007, 2)
    guarded = Campaign("test", tuple(Guarded(r, 3000) for r in data.records))
    where = np.linspace(10, 80, 20)
    got = local_polynomial(guarded, band_Hz=(5, 90), frequency_Hz=where, longest_piece=3000)
    assert np.mean(squared_error(got, system.response(where))) == pytest.approx(1.1, abs=0.4)
    assert noise_covariance(guarded, where, smooth_Hz=1.0, longest_piece=3000).covariance.shape == (20, 2, 2)


@given(st.integers(-8, 8), st.integers(-8, 8))
@settings(max_examples=15, deadline=None)
def test_units_do_not_matter(a, b):
    """Volts or nanometres: G, C and S follow the units of the channels exactly."""
    rng = np.random.default_rng(1)
    f, scale_u, scale_y = np.arange(1, 41.0), np.array([1.0, 10.0**a]), np.array([10.0**b, 1.0])
    U = rng.standard_normal((3, 40, 2)) + 1j * rng.standard_normal((3, 40, 2))
    Y = rng.standard_normal((3, 40, 2)) + 1j * rng.standard_normal((3, 40, 2))
    one, other = (local_model(*pair, f) for pair in ((U, Y), (U * scale_u, Y * scale_y)))
    assert np.allclose(other.value * scale_u / scale_y[:, None], one.value, rtol=1e-9)
    assert np.allclose(other.noise / np.outer(scale_y, scale_y), one.noise, rtol=1e-9)
    assert np.allclose(other.gram / np.outer(scale_u, scale_u), one.gram, rtol=1e-9)


def test_floor_velocity_as_further_inputs(rng):
    """A system of 2 actuators and 3 floor channels; without the floor its motion is noise, 10 times larger."""
    system = Modal(rng, 2, 5, [25.0], 0.2, RATE)
    runs, floors = [], []
    for _ in range(2):
        u, v = rng.standard_normal((3000, 2)), rng.standard_normal((3000, 3))
        runs.append((u, system.simulate(np.hstack([u, v])) + 0.01 * rng.standard_normal((3000, 2))))
        floors.append(v)
    data = campaign(runs, RATE, floors=floors)
    got = local_polynomial(data, band_Hz=(5, 80))
    assert got.inputs == ("u1", "u2", "vx", "vy", "vz") and "floor m/s" in got.input_unit
    assert np.mean(squared_error(got, system.response(got.frequency_Hz))) < 1.6
    without = local_polynomial(data, band_Hz=(5, 80), floor=False)
    assert without.inputs == ("u1", "u2")
    assert np.mean(without.variance()) > 100 * np.mean(got.variance()[:, :, :2])
    with pytest.raises(InputError, match="floor is requested"):
        local_polynomial(noisy(Modal(rng, 1, 1, [25.0], 0.2, RATE), rng, 400, 1), floor=True)


def test_noise_covariance_of_coloured_noise(rng):
    """First-order noise, correlated between outputs; the mean of C inv(C0) is 1 and C stays positive definite."""
    system = Modal(rng, 3, 2, [25.0], 0.3, RATE)
    mixing = np.array([[1.0, 0, 0], [0.9, 0.1, 0], [0.2, 0.3, 0.5]])
    runs = []
    for _ in range(4):
        u, white = rng.standard_normal((8000, 2)), 0.1 * rng.standard_normal((8000, 3))
        white[1:] += 0.8 * white[:-1]
        runs.append((u, system.simulate(u) + white @ mixing.T))
    where = np.linspace(2, 95, 50)
    got = noise_covariance(campaign(runs, RATE), where, smooth_Hz=2.0)
    shape = 0.01 * np.abs(1 + 0.8 * np.exp(-2j * np.pi * where / RATE)) ** 2
    exact = shape[:, None, None] * (mixing @ mixing.T)
    assert np.all(np.linalg.eigvalsh(got.covariance) > 0)
    # dof C inv(C0) is complex Wishart: its trace is chi-square of 2 n dof degrees over 2.
    trace = np.real(np.einsum("nij,nji->n", got.covariance, np.linalg.inv(exact))) / 3
    assert abs(np.mean(trace) - 1) < 3 / np.sqrt(3 * got.dof.sum()) + 0.02
    chi = stats.chi2(6 * got.dof)
    inside = (6 * got.dof * trace > chi.ppf(0.005)) & (6 * got.dof * trace < chi.ppf(0.995))
    assert np.mean(inside) > 0.93
    # The degrees of freedom agree with the scatter: var(trace) = 1 / (n dof).
    assert 0.5 < np.mean((trace - 1) ** 2 * 3 * got.dof) < 2.0


def test_records_at_rest_give_the_sensors_noise(rng):
    """u = 0: no input to estimate; offsets stay on line 0."""
    runs = [(np.zeros((4000, 2)), 5.0 + 0.2 * rng.standard_normal((4000, 3))) for _ in range(2)]
    got = noise_covariance(campaign(runs, RATE, "rest"), np.linspace(5, 90, 20), smooth_Hz=10.0)
    assert np.allclose(got.covariance, 0.04 * np.eye(3), atol=0.04 * 5 / np.sqrt(got.dof.min()))


def test_inputs_that_cannot_be_told_apart_are_named(rng):
    system = Modal(rng, 1, 3, [25.0], 0.3, RATE)
    u = rng.standard_normal((2000, 3))
    u[:, 2] = 2 * u[:, 0]
    with pytest.raises(ComputationError, match=r"u1, u3 cannot be distinguished"):
        local_polynomial(campaign([(u, system.simulate(u))], RATE))
    u[:, 2] = 0
    got = local_polynomial(campaign([(u, system.simulate(u))], RATE), band_Hz=(5, 80))
    assert got.inputs == ("u1", "u2") and "left out: u3" in got.method
    assert np.abs(got.value - system.response(got.frequency_Hz)[:, :, :2]).max() < 1e-3


def test_inputs_that_depend_on_each_other_tell_what_they_span(rng):
    """u3 = 2 u1: the response to u1 + 2 u3 and to u2 is that of two inputs, so is the noise; the rest is unknown."""
    system = Modal(rng, 2, 3, [25.0, 50.0], 0.3, RATE)
    two = rng.standard_normal((4000, 2))
    u = np.column_stack([two, 2 * two[:, 0]])
    y = system.simulate(u) + 0.05 * rng.standard_normal((4000, 2))
    V = np.array([[1.0, 0.0], [0.0, 1.0], [2.0, 0.0]])
    got = local_polynomial(campaign([(u, y)], RATE), band_Hz=(5, 80), partial=True)
    plain = local_polynomial(campaign([(two, y)], RATE), band_Hz=(5, 80))
    assert np.array_equal(got.spanned(np.eye(3)).any(axis=0), [False, True, False])
    assert np.all(np.isinf(got.variance()[:, :, [0, 2]])) and np.all(np.isfinite(got.variance()[:, :, 1]))
    along = got.along(V, ("one", "two"), "V")
    assert np.allclose(along.value, plain.value, rtol=1e-6, atol=1e-9)
    assert np.allclose(along.noise, plain.noise, rtol=1e-6) and got.dof == plain.dof
    assert np.allclose(along.variance(), plain.variance(), rtol=1e-5)
    with pytest.raises(InputError, match="exciting three"):
        got.along(np.array([[1.0], [0.0], [0.0]]), ("three",), "V")
    at = np.linspace(10, 75, 20)
    of_three, of_two = (
        noise_covariance(campaign([(one, y)], RATE), at, smooth_Hz=1.0, band_Hz=(5, 80)) for one in (u, two)
    )
    assert np.allclose(of_three.covariance, of_two.covariance, rtol=1e-6)
    assert np.array_equal(of_three.dof, of_two.dof)


def test_an_input_90_dB_down_in_part_of_the_band_is_not_silent(rng):
    """Without noise the response is exact there too, alone and beside an input that follows another."""
    f = np.arange(1, 61) * 0.5
    G = sum(rng.standard_normal((2, 2)) * (f[:, None, None] / 30) ** s for s in range(3))
    U = rng.standard_normal((4, 60, 2)) + 1j * rng.standard_normal((4, 60, 2))
    U[:, 30:, 1] *= 3e-5
    Y = (G @ U[..., None])[..., 0]
    assert np.allclose(local_model(U, Y, f).value, G, atol=1e-9)
    fit = LocalFit(f, 3, 2, 2, 8, 4.0)
    fit.add(np.concatenate([U, 2 * U[..., :1]], axis=2), Y, f)
    value = fit.estimate(partial=True).value
    assert np.allclose(value[:, :, 0] + 2 * value[:, :, 2], G[:, :, 0], atol=1e-9)
    assert np.allclose(value[:, :, 1], G[:, :, 1], atol=1e-9)


def test_silence_is_measured_against_the_band(rng):
    """A line with 1e-15 of the band's r.m.s.: its own part over -100 dB of the band's part of a window, by lstsq."""
    records, order, w = 3, 2, 4
    U = rng.standard_normal((records, 60, 1)) + 1j * rng.standard_normal((records, 60, 1))
    U[:, 30:] *= 1e-15
    with pytest.raises(ComputationError, match="are not excited") as caught:
        local_model(U, U, np.arange(60.0), np.array([45.0]), order, w)
    d = np.arange(-w, w + 1.0)
    powers, here = d[:, None] ** np.arange(order + 1), U[:, 45 - w : 45 + w + 1, 0].ravel()
    others = np.hstack([here[:, None] * np.tile(powers[:, 1:], (records, 1)), np.kron(np.eye(records), powers)])
    own = np.linalg.norm(here - others @ np.linalg.lstsq(others, here, rcond=1e-25)[0])
    rms = np.sqrt(np.mean(np.abs(U) ** 2))
    said = float(re.search(r"own part (\S+?)[;,\s]", f"{caught.value} ")[1])
    assert said == pytest.approx(own / (1e-5 * rms * np.sqrt(records * (2 * w - order))), rel=0.05)


def test_an_input_silent_in_part_of_the_band_is_named_with_the_frequencies(rng):
    """u2 has no power above 50 Hz: roundoff there is not an excitation."""
    u = rng.standard_normal((2000, 2))
    spectrum = np.fft.rfft(u[:, 1])
    spectrum[500:] = 0
    u[:, 1] = np.fft.irfft(spectrum, 2000)
    data = campaign([(u, u @ np.ones((2, 1)))], RATE)
    with pytest.raises(ComputationError, match=r"u2 .* to 80 Hz"):
        local_polynomial(data, band_Hz=(5, 80))
    assert local_polynomial(data, band_Hz=(5, 45)).inputs == ("u1", "u2")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"band_Hz": (50.0, 20.0)}, "band_Hz"),
        ({"band_Hz": (5.0, 120.0)}, "100 Hz"),
        ({"order": 9}, "order"),
        ({"order": 2.5}, "whole order"),
        ({"half_width": 1}, "half_width"),
        ({"band_Hz": (5.0, 5.5)}, "longer records"),
        ({"half_width": 0}, "half_width"),
        ({"longest_piece": 0}, "longest_piece"),
        ({"frequency_Hz": np.array([5.0, 99.99])}, "frequency_Hz"),
        ({"half_width": 2, "order": 3}, "degrees of freedom"),
    ],
)
def test_wrong_requests_are_answered(rng, change, words):
    data = noisy(Modal(rng, 2, 2, [25.0], 0.3, RATE), rng, 1000, 1)
    with pytest.raises(InputError, match=words):
        local_polynomial(data, **change)


@pytest.mark.parametrize("change", [{"frequency_Hz": [5.0, 150.0]}, {"frequency_Hz": [9.0, 8.0]}])
def test_wrong_requests_of_a_noise_covariance_are_answered(rng, change):
    data = noisy(Modal(rng, 2, 2, [25.0], 0.3, RATE), rng, 1000, 2)
    with pytest.raises(InputError, match=next(iter(change))):
        noise_covariance(data, **({"frequency_Hz": [5.0, 50.0], "smooth_Hz": 1.0} | change))


def test_odd_periodic_records_get_windows_that_hold_enough_lines(rng):
    """Three periods of odd multisines: one line in six is excited."""
    system = Modal(rng, 2, 2, [25.0], 0.2, RATE)
    runs = []
    for _ in range(2):
        for period in multisine(rng, 1000, np.arange(11, 400, 2), 2):
            u = np.tile(period, (3, 1))
            runs.append((u, system.simulate(u) + 0.001 * rng.standard_normal((3000, 2))))
    got = local_polynomial(campaign(runs, RATE, "multisine", 5.0), band_Hz=(3.0, 78.0))
    exact = system.response(got.frequency_Hz)
    assert np.median(np.abs(got.value - exact) / np.abs(exact).max()) < 0.003


def test_dead_channels_and_exact_data_are_no_error(rng):
    """An output that is 0, an output that is an input: G is exact."""
    u = rng.standard_normal((2000, 2))
    data = campaign([(u, np.stack([0 * u[:, 0], u[:, 1]], axis=1))], RATE)
    got = local_polynomial(data, frequency_Hz=np.linspace(5, 90, 20))
    assert np.allclose(got.value, [[0, 0], [0, 1]], atol=1e-9)
    assert np.abs(got.noise).max() < 1e-18


def test_a_campaign_of_the_rigs_size():
    """6 records x 60 s x 1 kHz x (8 + 3) inputs x 6 outputs, 0.5 to 80 Hz: 4771 lines."""
    rng = np.random.default_rng(1)
    D = rng.standard_normal((6, 11))
    runs, floors = [], []
    for _ in range(6):
        x = rng.standard_normal((60000, 11))
        runs.append((x[:, :8], x @ D.T + rng.standard_normal((60000, 6))))
        floors.append(x[:, 8:])
    data = campaign(runs, 1000.0, floors=floors)
    got = local_polynomial(data, band_Hz=(0.5, 80.0))
    assert got.value.shape == (4771, 6, 11) and got.dof == 27
    assert np.mean(squared_error(got, D)) == pytest.approx(27 / 26, rel=0.02)
