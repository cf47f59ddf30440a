"""Spectral averages against scipy, closed-form biases and chi-square laws."""

from __future__ import annotations

import numpy as np
import pytest
from known_systems import Modal, campaign, squared_error
from scipy import signal, stats

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.measurement.frequency_response.welch import effective_averages, spectral_average

RATE = 200.0


def flat(rng, samples, G, input_noise=0.0, output_noise=0.0, records=1):
    """A gain without dynamics: no leakage, so that only the noise biases."""
    runs = []
    for _ in range(records):
        u = rng.standard_normal((samples, G.shape[1]))
        y = u @ G.T + output_noise * rng.standard_normal((samples, G.shape[0]))
        runs.append((u + input_noise * rng.standard_normal(u.shape), y))
    return campaign(runs, RATE)


@pytest.mark.parametrize("window", ["hann", "boxcar", ("kaiser", 8.0)])
def test_one_input_as_scipy_computes_it(rng, window):
    system = Modal(rng, 1, 1, [30.0], 0.1, RATE)
    u = rng.standard_normal((5000, 1))
    y = system.simulate(u) + 0.3 * rng.standard_normal((5000, 1))
    got = spectral_average(campaign([(u, y)], RATE), segment_samples=512, window=window, overlap=0.6)
    step = {"fs": RATE, "window": window, "nperseg": 512, "noverlap": 512 - round(512 * 0.4), "axis": 0}
    f, cross = signal.csd(u[:, 0], y[:, 0], **step)
    _, power = signal.welch(u[:, 0], **step)
    assert np.allclose(got.frequency_Hz, f[1:-1])
    assert np.allclose(got.value[:, 0, 0], (cross / power)[1:-1])
    assert np.allclose(got.coherence[:, 0], signal.coherence(u[:, 0], y[:, 0], **step)[1][1:-1])


@pytest.mark.parametrize("overlap", [0.0, 0.5, 0.75])
@pytest.mark.parametrize("window", ["hann", "boxcar"])
def test_effective_averages_are_those_of_the_power(window, overlap):
    """Mean square over variance of averaged periodograms of white noise, over lines and records."""
    rng = np.random.default_rng(1)
    n, segments = 64, 9
    step = round(n * (1 - overlap))
    shape = signal.get_window(window, n)
    x = rng.standard_normal((3000, (segments - 1) * step + n))
    P = signal.welch(x, window=shape, nperseg=n, noverlap=n - step, detrend=False)[1][:, 3:-3]
    measured = np.mean(P.mean(axis=0) ** 2 / P.var(axis=0))
    assert effective_averages(shape, step, segments) == pytest.approx(measured, rel=0.03)


@pytest.mark.parametrize("overlap", [0.0, 0.5])
def test_covariance_and_coverage_for_two_inputs(overlap):
    rng = np.random.default_rng(3)
    G = np.array([[1.0, -0.5], [0.3, 2.0], [0.0, 1.0]])
    inside, noise = [], []
    for _ in range(60):
        got = spectral_average(flat(rng, 4096, G, output_noise=0.5), segment_samples=256, overlap=overlap,
                               band_Hz=(5, 95))
        inside.append(squared_error(got, G) < stats.f(2, 2 * got.dof).isf(0.05))
        noise.append(got.noise.mean(axis=0))
    # 'hann' with overlap: the error's law is F only in its first two moments.
    assert np.mean(inside) == pytest.approx(0.95, abs=0.01)
    assert np.allclose(np.mean(noise, axis=0), 0.25 * np.eye(3), atol=0.006)


def test_biases_in_closed_form():
    """Input noise of power ratio r: H1 = G / (1 + r). Output noise: H2 = G (1 + noise / (|G|^2 S_uu))."""
    rng = np.random.default_rng(4)
    G = np.array([[2.0]])
    both = {"segment_samples": 256, "band_Hz": (5, 95)}
    inputs = flat(rng, 400000, G, input_noise=0.5)
    assert np.mean(spectral_average(inputs, **both).value) == pytest.approx(2 / 1.25, rel=0.005)
    assert np.mean(spectral_average(inputs, estimator="H2", **both).value) == pytest.approx(2.0, rel=0.005)
    outputs = flat(rng, 400000, G, output_noise=1.0)
    assert np.mean(spectral_average(outputs, **both).value) == pytest.approx(2.0, rel=0.005)
    assert np.mean(spectral_average(outputs, estimator="H2", **both).value) == pytest.approx(2 * 1.25, rel=0.005)
    assert np.mean(spectral_average(outputs, **both).coherence) == pytest.approx(4 / 5, abs=0.005)


def test_total_least_squares_with_the_true_noise_ratio_is_unbiased():
    rng = np.random.default_rng(5)
    G = np.array([[2.0, 0.5], [-1.0, 1.0], [0.2, 0.0]])
    data = flat(rng, 600000, G, input_noise=0.5, output_noise=0.8)
    case = {"segment_samples": 256, "band_Hz": (5, 95)}
    right = spectral_average(data, estimator="Hv", noise_ratio=([0.5, 0.5], [0.8] * 3), **case)
    assert np.allclose(right.value.mean(axis=0), G, atol=0.01)
    wrong = spectral_average(data, estimator="H1", **case)
    assert np.abs(wrong.value.mean(axis=0) - G).max() > 0.2
    # A ratio that says "all noise on the outputs" gives H1.
    limit = spectral_average(data, estimator="Hv", noise_ratio=([1e-5] * 2, [1.0] * 3), **case)
    assert np.allclose(limit.value, wrong.value, atol=1e-6)


def test_exact_data_give_the_same_by_all_estimators(rng):
    G = rng.standard_normal((3, 2))
    got = [spectral_average(flat(rng, 4000, G), estimator=name).value for name in ("H1", "H2", "Hv")]
    for value in got:
        assert np.allclose(value, G, atol=1e-6)


def test_multiple_coherence_of_two_inputs():
    """y = u1 + u2 + v of variance 1 each: 2/3 explained, whatever the correlation of the inputs."""
    rng = np.random.default_rng(6)
    u = rng.standard_normal((200000, 2)) @ np.array([[1.0, 0.0], [0.6, 0.8]]).T
    y = u @ np.ones((2, 1)) + np.sqrt(1.6) * rng.standard_normal((200000, 1))
    got = spectral_average(campaign([(u, y)], RATE), segment_samples=256)
    assert np.mean(got.coherence) == pytest.approx(3.2 / 4.8, abs=0.01)


def test_records_of_different_length_and_floor_inputs(rng):
    G = rng.standard_normal((2, 4))
    runs, floors = [], []
    for n in (3000, 5000, 100):
        x = rng.standard_normal((n, 4))
        runs.append((x[:, :1], x @ G.T + 0.1 * rng.standard_normal((n, 2))))
        floors.append(x[:, 1:])
    got = spectral_average(campaign(runs, RATE, floors=floors), segment_samples=256)
    assert got.inputs == ("u1", "vx", "vy", "vz")
    assert np.mean(squared_error(got, G)) == pytest.approx(1.0, abs=0.25)


def test_wrong_requests_are_answered(rng):
    data = flat(rng, 2000, rng.standard_normal((2, 3)))
    for change, words in [({"estimator": "H2"}, "not defined for 3 inputs and 2 outputs"), ({"estimator": "H3"}, "H3"),
                          ({"overlap": 1.0}, "overlap"), ({"window": "hat"}, "window"),
                          ({"segment_samples": 1000, "overlap": 0}, "more than 3 averages"),
                          ({"segment_samples": 5000}, "segment_samples"), ({"band_Hz": (1.01, 1.02)}, "band_Hz"),
                          ({"estimator": "Hv", "noise_ratio": ([1], [1])}, "noise_ratio"),
                          ({"estimator": "Hv", "noise_ratio": ([0, 1, 1], [1, 1])}, "positive")]:
        with pytest.raises(InputError, match=words):
            spectral_average(data, **change)
    u = rng.standard_normal((2000, 2)) @ np.array([[1.0, 2.0], [0.0, 0.0]])
    with pytest.raises(ComputationError, match="u1, u2 cannot be distinguished"):
        spectral_average(campaign([(u, u)], RATE))
    u[:, 1] = 0
    with pytest.raises(ComputationError, match="u2"):
        spectral_average(campaign([(u, u)], RATE))
