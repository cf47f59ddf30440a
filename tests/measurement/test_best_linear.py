"""Best linear approximation: noise and distortion against what was put in."""

from __future__ import annotations

import numpy as np
import pytest
from known_systems import Modal, campaign, multisine, squared_error
from scipy import stats

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.frequency_response.best_linear import best_linear_approximation, best_linear_approximations
from avis_ctrl.measurement.frequency_response.periodic import Channels, average

RATE, N = 256.0, 512
LINES = np.arange(4, 201)


def experiments(rng, plant, n_u, realisations, periods, noise=0.0, lead=0, amplitude=1.0, lines=LINES, factor=None):
    """Records of orthogonal multisines; `lead` periods are left out at the start, so that 0 means from rest."""
    runs = []
    for _ in range(realisations):
        for period in multisine(rng, N, lines, n_u, amplitude):
            u = np.tile(period, (periods + lead, 1))
            y = plant(u)
            white = noise * rng.standard_normal(y.shape)
            runs.append((u[lead * N :], (y + (white if factor is None else white @ factor.T))[lead * N :]))
    return campaign(runs, RATE, "multisine", N / RATE)


def test_linear_system_without_noise_is_exact(rng):
    system = Modal(rng, 3, 2, [20.0, 60.0], 0.05, RATE)
    data = experiments(rng, system.simulate, 2, 1, 2, lead=6)
    got = best_linear_approximation(data, transient="none")
    assert got.frequency_Hz == pytest.approx(LINES * RATE / N)
    assert np.allclose(got.value, system.response(got.frequency_Hz), atol=1e-9)


def test_noise_and_no_distortion_for_a_linear_system():
    """Total and noise covariance both equal the noise put in, correlated between outputs; entries are covered."""
    rng = np.random.default_rng(2)
    system, factor = Modal(rng, 2, 2, [20.0, 60.0], 0.1, RATE), np.array([[1.0, 0.0], [0.9, 0.4]])
    noise, inside = 0.3, []
    for _ in range(8):
        data = experiments(rng, system.simulate, 2, 4, 3, noise, lead=4, factor=factor)
        got = best_linear_approximation(data, transient="none")
        assert got.dof == 18  # three lines of six
        exact = noise**2 * factor @ factor.T / 3  # of the mean of three periods
        for part in (got.noise, got.measurement_noise):
            assert np.allclose(part.mean(axis=0), exact, atol=0.08 * exact[0, 0])
        assert np.abs(got.distortion.mean(axis=0)).max() < 0.1 * exact[0, 0]
        inside.append(squared_error(got, system.response(got.frequency_Hz)) < stats.f(2, 36).isf(0.05))
    assert np.mean(inside) == pytest.approx(0.95, abs=0.012)


def hammerstein(system, cubic):
    """y = G (u + cubic u^3): its best linear approximation and distortion come from many noise-free realisations."""
    return lambda u: system.simulate(u + cubic * u**3)


def test_noise_and_distortion_of_a_cubic_system_separate():
    """Noise-free, 200 realisations give the distortion; estimates from noisy ones must find both parts."""
    rng = np.random.default_rng(7)
    system, cubic, noise = Modal(rng, 2, 2, [40.0], 0.2, RATE), 0.15, 0.02
    plant = hammerstein(system, cubic)
    clean = experiments(rng, plant, 2, 200, 1, lead=3)
    U = np.array([np.fft.rfft(r.u[-N:], axis=0)[LINES] for r in clean.records]) / np.sqrt(N)
    Y = np.array([np.fft.rfft(r.y[-N:], axis=0)[LINES] for r in clean.records]) / np.sqrt(N)
    G = np.stack([np.linalg.lstsq(U[:, k], Y[:, k])[0].T for k in range(len(LINES))])
    left = Y - np.einsum("kij,ekj->eki", G, U)
    distortion = np.mean(np.sum(np.abs(left) ** 2, axis=0) / (400 - 2), axis=0)

    data = experiments(rng, plant, 2, 10, 4, noise, lead=3)
    got = best_linear_approximation(data, transient="none")
    measured = np.real(np.einsum("nii->i", got.distortion)) / len(LINES)
    assert measured == pytest.approx(distortion, rel=0.15)
    assert np.real(np.einsum("nii->i", got.measurement_noise)) / len(LINES) == pytest.approx(
        np.full(2, noise**2 / 4), rel=0.05
    )
    # The gain that Gaussian inputs see: 1 + 3 cubic sigma^2 for each input (Bussgang).
    exact = system.response(got.frequency_Hz) * (1 + 3 * cubic)
    strong = np.abs(exact) > 0.3 * np.abs(exact).max()
    assert np.abs(np.mean((got.value / exact)[strong]) - 1) < 0.02
    # G's scatter agrees with its covariance on the mean over inputs: (1 + 10/200) for the reference's own error and
    # dof / (dof - 1) for the estimated variance, with 9 to 18 degrees of freedom.
    assert 0.95 < np.mean(np.abs(got.value - G) ** 2 / got.variance()) < 1.35
    assert np.mean(np.abs(got.value - G) ** 2 / got.variance("measurement_noise")) > 20


def test_one_group_of_experiments_separates_nothing(rng):
    system = Modal(rng, 2, 2, [40.0], 0.2, RATE)
    got = best_linear_approximation(experiments(rng, system.simulate, 2, 1, 3, 0.1, lead=2), transient="none")
    assert got.distortion is None and "distortion not separated" in got.method
    got = best_linear_approximation(experiments(rng, system.simulate, 2, 3, 1, 0.1, lead=2), transient="none")
    assert got.measurement_noise is None and "together" in got.method
    with pytest.raises(InputError, match="repeated periods or more than 2 experiments"):
        best_linear_approximation(experiments(rng, system.simulate, 2, 1, 1, 0.1, lead=2), transient="none")


def test_repeated_records_are_not_realisations(rng):
    """The same multisines twice: noise is known better, distortion is not."""
    system = Modal(rng, 2, 2, [40.0], 0.2, RATE)
    plant = hammerstein(system, 0.15)
    first = experiments(rng, plant, 2, 1, 2, lead=2)
    noisy = [(r.u, r.y + 0.01 * rng.standard_normal(r.y.shape)) for r in first.records for _ in range(2)]
    got = best_linear_approximation(campaign(noisy, RATE, "multisine", N / RATE), transient="none")
    assert got.distortion is None and "2 experiments" in got.method
    assert np.real(np.einsum("nii->ni", got.noise)).mean() == pytest.approx(0.01**2 / 4, rel=0.1)


def test_transient_from_rest_is_removed_with_two_periods():
    """A mode of 6 % damping at 20 Hz, half-power width of 9.6 lines of the record: the transient dwarfs the noise."""
    rng = np.random.default_rng(11)
    system, noise = Modal(rng, 2, 2, [20.0], 0.06, RATE), 0.003
    data = experiments(rng, system.simulate, 2, 3, 2, noise)
    exact = system.response(LINES * RATE / N)
    kept = best_linear_approximation(data, transient="none")
    got = best_linear_approximation(data)
    assert "transient removed" in got.method
    error = [np.sqrt(np.mean(np.abs(r.value - exact) ** 2)) for r in (kept, got)]
    assert error[1] < error[0] / 5, error
    away = np.abs(got.frequency_Hz - 20) > 2
    assert np.mean((np.abs(got.value - exact) ** 2 / got.variance())[away]) == pytest.approx(1.1, abs=0.4)
    # Noise from the lines between, the leverage of the interpolation included: nearly noise^2 / 2 (1 + 3 / 8).
    diagonal = np.real(np.einsum("nii->ni", got.measurement_noise))[away]
    assert 0.5 < np.median(diagonal) / noise**2 < 1.0


def test_transient_of_a_sharp_mode_is_removed_as_a_rational_function():
    """Table-like: 6 modes from 2 to 9 Hz of 2 % damping, the narrowest 1.7 lines of a record of two 10 s periods."""
    rng = np.random.default_rng(0)
    system = Modal(rng, 6, 3, [2.1, 2.4, 3.5, 4.8, 6.2, 9.5], 0.02, 200.0)
    runs = []
    for _ in range(2):
        for period in multisine(rng, 2000, np.arange(5, 801), 3):
            u = np.tile(period, (2, 1))
            runs.append((u, system.simulate(u) + 0.002 * rng.standard_normal((4000, 6))))
    data = campaign(runs, 200.0, "multisine", 10.0)
    exact = system.response(np.arange(5, 801) / 10)
    error = {t: np.abs(best_linear_approximation(data, transient=t).value - exact) for t in ("none", "auto")}
    rms = {t: np.sqrt(np.mean(e**2)) for t, e in error.items()}
    assert rms["auto"] < rms["none"] / 10, rms
    got = best_linear_approximation(data)
    assert np.mean(squared_error(got, exact)) < 1.3


def test_noise_beside_a_sharp_mode_is_that_of_the_mean():
    """One output: two of its five degrees of freedom go into the denominator, and the covariance allows for them.

    Stated variance against the scatter over draws, at 2 to 6 lines of the period from the mode, 1 % damped.
    """
    rng, noise, t = np.random.default_rng(1), 1e-3, np.arange(2 * N) / RATE
    free = np.exp(-0.01 * 2 * np.pi * 20.3 * t) * np.cos(2 * np.pi * 20.3 * t)
    u, used = np.tile(multisine(rng, N, LINES, 1)[0], (2, 1)), Channels(("u1",), ("y1",), False, "V", "V")
    means = []
    for _ in range(150):
        data = campaign([(u, (free + noise * rng.standard_normal(2 * N))[:, None])], RATE, "multisine", N / RATE)
        means.append(average(data.records[0], used, slice(30, 60), 0, True))
    beside = [k for k in range(30) if 2 <= abs(30 + k - 20.3 * N / RATE) <= 6]
    stated = np.mean([mean.covariance[beside, 1, 1].real for mean in means])
    assert stated == pytest.approx(np.mean(np.var([mean.Z[beside, 1] for mean in means], axis=0)), rel=0.2)


@pytest.mark.parametrize("damping", [0.3, 0.03, 0.01])
def test_periods_that_still_settle_are_dropped(damping):
    """What remains of the transient in the mean of the kept periods hides in the noise; two periods fewer would not."""
    rng = np.random.default_rng(12)
    system, noise, count = Modal(rng, 2, 1, [20.0], damping, RATE), 0.001, 8
    data = experiments(rng, system.simulate, 1, 3, count, noise)
    got = best_linear_approximation(data)
    dropped = int(got.method.split(" periods dropped")[0].split()[-1])

    def left(drop):
        """Largest transient on a line of the mean of the kept periods over the noise's standard deviation there."""
        worst = 0.0
        for record in data.records:
            clean = system.simulate(record.u).reshape(count, N, 2)
            steady = system.simulate(np.tile(record.u[:N], (40, 1)))[-N:]
            worst = max(worst, np.abs(np.fft.rfft(clean[drop:].mean(axis=0) - steady, axis=0)[LINES]).max())
        return worst / np.sqrt(N) / (noise / np.sqrt(count - drop))

    assert left(dropped) < 1.5
    assert dropped <= 1 or left(dropped - 2) > 1.5
    assert np.mean(squared_error(got, system.response(got.frequency_Hz))) < 2.0


def test_settled_records_lose_no_period():
    rng = np.random.default_rng(13)
    system = Modal(rng, 3, 1, [20.0], 0.05, RATE)
    lost = [
        best_linear_approximation(experiments(rng, system.simulate, 1, 2, 4, 0.1, lead=5)).method for _ in range(20)
    ]
    assert sum(", 0 periods dropped" in words for words in lost) >= 19


def test_noise_of_a_measured_input_is_taken_over():
    """Errors in variables: C is that of y - G u, and the mean over periods reduces the bias of G."""
    rng = np.random.default_rng(14)
    system = Modal(rng, 2, 2, [40.0], 0.3, RATE)
    data = experiments(rng, system.simulate, 2, 6, 4, 0.0, lead=2)
    noisy = campaign(
        [
            (r.u + 0.05 * rng.standard_normal(r.u.shape), r.y + 0.02 * rng.standard_normal(r.y.shape))
            for r in data.records
        ],
        RATE,
        "multisine",
        N / RATE,
    )
    got = best_linear_approximation(noisy, transient="none")
    assert got.frequency_Hz == pytest.approx(LINES * RATE / N)  # noise alone is no excitation
    G = system.response(got.frequency_Hz)
    exact = (0.02**2 + 0.05**2 * np.sum(np.abs(G) ** 2, axis=2)) / 4
    assert np.mean(np.real(np.einsum("nii->ni", got.measurement_noise)) / exact) == pytest.approx(1, rel=0.05)
    assert np.mean(squared_error(got, G)) == pytest.approx(1.05, abs=0.15)


def test_zippered_multisines_give_one_response_for_each_input(rng):
    """u1 on odd, u2 on even lines, in one record each: one experiment suffices."""
    system = Modal(rng, 2, 2, [40.0], 0.3, RATE)
    runs = []
    for _ in range(3):
        both = multisine(rng, N, LINES, 1)[0] @ np.ones((1, 2))
        spectra = np.fft.rfft(both, axis=0)
        spectra[::2, 0], spectra[1::2, 1] = 0, 0
        u = np.tile(np.fft.irfft(spectra, N, axis=0), (5, 1))
        y = system.simulate(u)
        runs.append((u[3 * N :], (y + 0.01 * rng.standard_normal(y.shape))[3 * N :]))
    data = campaign(runs, RATE, "multisine", N / RATE)
    parts = {r.inputs: r for r in best_linear_approximations(data, transient="none")}
    assert set(parts) == {("u1",), ("u2",)}
    for j, part in enumerate((parts["u1",], parts["u2",])):
        exact = system.response(part.frequency_Hz)[:, :, j : j + 1]
        assert np.mean(squared_error(part, exact)) == pytest.approx(1.2, abs=0.4)
    with pytest.raises(InputError, match="different lines excite different inputs"):
        best_linear_approximation(data, transient="none")


def test_inputs_one_after_the_other(rng):
    """Each record excites one of the inputs: together they determine all columns."""
    system = Modal(rng, 2, 2, [40.0], 0.3, RATE)
    runs = []
    for k in range(4):
        u = np.tile(multisine(rng, N, LINES, 1)[0], (4, 1)) @ np.eye(2)[k % 2][None]
        runs.append((u[2 * N :], system.simulate(u)[2 * N :]))
    data = campaign(runs, RATE, "multisine", N / RATE)
    got = best_linear_approximation(data, transient="none")
    assert got.inputs == ("u1", "u2") and np.allclose(got.value, system.response(got.frequency_Hz), atol=1e-6)
    one = best_linear_approximation(data.only(("00", "02")), transient="none")
    assert one.inputs == ("u1",)


def test_what_cannot_be_estimated_is_said(rng):
    system = Modal(rng, 1, 2, [40.0], 0.3, RATE)
    data = experiments(rng, system.simulate, 2, 2, 2, lead=2)
    with pytest.raises(ComputationError, match=r"u1, u2 cannot be distinguished"):
        best_linear_approximation(data.only(("00",)))
    noise = campaign([(rng.standard_normal((400, 1)), rng.standard_normal((400, 1)))], RATE)
    with pytest.raises(InputError, match="multisine records"):
        best_linear_approximation(noise)
    two = Campaign(
        "test",
        tuple(
            campaign(
                [(r.u * k, r.y) for r, k in zip(data.records, (1, 1, 3, 3), strict=True)],
                RATE,
                "multisine",
                N / RATE,
                levels=[0.01, 0.01, 0.03, 0.03],
            ).records
        ),
    )
    wrong = campaign([(rng.standard_normal((4 * N, 1)), rng.standard_normal((4 * N, 1)))], RATE, "multisine", N / RATE)
    with pytest.raises(InputError, match="check the period"):
        best_linear_approximation(wrong)
    with pytest.raises(InputError, match="level_V = "):
        best_linear_approximation(two)
    assert best_linear_approximation(two, level_V=0.03).value.shape == (len(LINES), 1, 2)
    with pytest.raises(InputError, match=r"level_V = 0.02.*one of the levels"):
        best_linear_approximation(two, level_V=0.02)
    with pytest.raises(InputError, match="transient = 'cut'"):
        best_linear_approximation(data, transient="cut")
    with pytest.raises(InputError, match="band_Hz"):
        best_linear_approximation(data, band_Hz=(5.1, 5.3))
