"""Even and odd distortion of one record: static nonlinearities whose parts are known."""

from __future__ import annotations

import numpy as np
import pytest
from known_systems import Modal, campaign

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.frequency_response.distortion_lines import distortion_levels

RATE, N = 256.0, 1024
ODD = np.arange(9, 401, 2)


def above_noise_dB(levels, kind):
    """(n_y,) total power of a kind of lines, noise included, over that of noise alone."""
    here = levels.kind == kind
    return 10 * np.log10(levels.power[here].sum(axis=0) / levels.noise[here].sum(axis=0))


def odd_multisine(rng, detection=True):
    """Odd lines but for one of each group of four, chosen at random."""
    left_out = {int(rng.choice(ODD[k : k + 4])) for k in range(0, ODD.size - 4, 4)} if detection else set()
    spectrum = np.zeros(N // 2 + 1, complex)
    for line in ODD:
        if line not in left_out:
            spectrum[line] = np.exp(2j * np.pi * rng.random())
    u = np.fft.irfft(spectrum, N)
    return u / u.std()


def record(rng, plant, noise, periods=4, detection=True):
    u = np.tile(odd_multisine(rng, detection), periods + 1)[:, None]
    y = plant(u) + noise * rng.standard_normal((u.size, 2))
    return campaign([(u[N:], y[N:])], RATE, "multisine", N / RATE)


@pytest.mark.parametrize(("even", "odd"), [(0.1, 0.0), (0.0, 0.03), (0.05, 0.02)])
def test_parts_of_a_static_nonlinearity(even, odd):
    """y = u + even u^2 + odd u^3: noise-free parts by direct computation, u^3 less its regression on u."""
    rng = np.random.default_rng(1)
    data = record(rng, lambda u: np.hstack([u + even * u**2 + odd * u**3, u]), 0.01)
    got = distortion_levels(data, "00", transient="none")
    u = data.records[0].u[:N, 0]
    band = slice(ODD[0], ODD[-1] + 1)
    square, cube = (np.fft.rfft(x)[band] / N for x in (u**2, u**3 - (u @ u**3) / (u @ u) * u))
    assert got.rms("even")[0] == pytest.approx(even * np.sqrt(2 * np.sum(np.abs(square) ** 2)), rel=0.05, abs=0.002)
    # Detection lines are a fourth of the odd ones: their share is known to about 1 / sqrt(49).
    assert got.rms("odd")[0] == pytest.approx(odd * np.sqrt(2 * np.sum(np.abs(cube) ** 2)), rel=0.2, abs=0.002)
    # The second output is linear: nothing above the noise.
    for kind in ("even", "odd"):
        assert abs(above_noise_dB(got, kind)[1]) < 1.0
        assert got.rms(kind)[1] < 0.002
    assert above_noise_dB(got, "even")[0] > 10 or even == 0
    assert above_noise_dB(got, "odd")[0] > 10 or odd == 0


def test_noise_level_on_the_lines(rng):
    """White noise of variance s^2 has mean square 2 s^2 / N on a line, 1/periods of it in the mean."""
    got = distortion_levels(record(rng, lambda u: np.hstack([u, u]), 0.1), "00", transient="none")
    assert np.mean(got.noise) == pytest.approx(2 * 0.01 / N / 4, rel=0.1)
    assert np.mean(got.power[got.kind != "excited"]) == pytest.approx(2 * 0.01 / N / 4, rel=0.15)


def test_a_transient_is_no_distortion():
    """A record from rest through a linear mode: with its transient removed nothing even or odd is left."""
    rng = np.random.default_rng(2)
    system = Modal(rng, 2, 1, [20.0], 0.15, RATE)
    u = np.tile(odd_multisine(rng), 2)[:, None]
    data = campaign([(u, system.simulate(u) + 0.01 * rng.standard_normal((2 * N, 2)))], RATE, "multisine", N / RATE)
    left, removed = (distortion_levels(data, "00", transient=t) for t in ("none", "auto"))
    even = left.kind == "even"
    assert left.power[even].sum() > 5 * removed.power[even].sum()
    assert np.all(np.abs(above_noise_dB(removed, "even")) < 1.5)


def test_records_without_detection_lines_are_refused(rng):
    with pytest.raises(InputError, match="odd harmonics that are not excited"):
        distortion_levels(record(rng, lambda u: np.hstack([u, u]), 0.1, detection=False), "00")
    full = campaign([(np.tile(rng.standard_normal(N), 3)[:, None], np.zeros((3 * N, 1)))], RATE, "multisine", N / RATE)
    with pytest.raises(InputError, match="even harmonics"):
        distortion_levels(full, "00")
    with pytest.raises(InputError, match="periodic record"):
        distortion_levels(campaign([(np.ones((9, 1)), np.ones((9, 1)))], RATE), "00")
    with pytest.raises(InputError, match="record = '7'"):
        distortion_levels(full, "7")


def test_the_identification_report_states_it():
    """A table where lines are left out, of the output with most of it; none where every odd line is excited."""
    from avis_ctrl.report.identification.measurements import distortion

    rng = np.random.default_rng(1)
    data = record(rng, lambda u: np.hstack([u + 0.1 * u**2, u]), 0.01)
    shown = distortion(data)
    [(name, even, odd)] = shown.rows
    size, _, channel = even.partition(" % ")
    square = np.fft.rfft(data.records[0].u[:N, 0] ** 2)[ODD[0] : ODD[-1] + 1] / N  # u itself has unit variance
    assert float(size) == pytest.approx(10 * np.sqrt(2 * np.sum(np.abs(square) ** 2)), rel=0.05)
    assert channel == "(y1)"
    assert name == "00" and (odd == "below the noise" or float(odd.partition(" ")[0]) < 1.0)
    assert distortion(record(rng, lambda u: np.hstack([u, u]), 0.01, detection=False)) is None
