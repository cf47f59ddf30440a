"""Single-axis models against closed forms and repeated experiments; measured ones in test_single_axis_measured.py."""

from __future__ import annotations

import re

import numpy as np
import pytest
from lags import compare_lags, cubic_share
from scipy import signal

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.single_axis.decay import fit_decay
from avis_ctrl.identification.single_axis.drive import fit_drive
from avis_ctrl.identification.single_axis.fit import long_run_covariance, regression
from avis_ctrl.identification.single_axis.identify import identify_single_axis
from avis_ctrl.identification.single_axis.oscillator import fit_oscillator
from avis_ctrl.identification.single_axis.seismometer import Responses, fit_seismometer, response
from avis_ctrl.identification.single_axis.sine import fit_sine

# --- standard deviations of regressions with coloured residuals


def coloured(rng: np.random.Generator, n: int, pole: float) -> np.ndarray:
    return signal.lfilter([1.0], [1.0, -pole], rng.standard_normal(n + 200))[200:]


def test_long_run_variance_of_an_autoregression_is_its_spectrum_at_zero(rng):
    """S = sigma^2/(1 - a)^2 for x_t = a x_(t-1) + e_t; the variance alone would be sigma^2/(1 - a^2)."""
    x = coloured(rng, 200_000, 0.8)[:, None]
    assert long_run_covariance(x, 200)[0, 0] == pytest.approx(25.0, rel=0.15)
    assert long_run_covariance(x, 0)[0, 0] == pytest.approx(1 / 0.36, rel=0.03)


def test_stated_deviations_are_those_of_repeated_experiments(rng):
    """400 experiments, residuals and regressors of pole 0.9: the scatter of the estimates is what one fit states."""
    found, stated, white = [], [], []
    for _ in range(400):
        X = np.column_stack([coloured(rng, 2000, 0.9), np.ones(2000)])
        fit = regression("", {"a": "", "b": ""}, X, X @ (2.0, 1.0) + coloured(rng, 2000, 0.9), np.arange(2000.0))
        found.append(fit.values)
        stated.append(np.diag(fit.covariance))
        white.append(fit.information.standard_deviation**2)
    ratio = np.std(found, axis=0) / np.sqrt(np.mean(stated, axis=0))
    # The Bartlett kernel states somewhat too little, as it must: it cuts the correlation at finite lag.
    assert np.all((ratio > 0.9) & (ratio < 1.2)), ratio
    assert fit.noise == "residual" and fit.chi2 == fit.dof
    # A white residual would be believed to be three to four times better.
    assert np.all(np.std(found, axis=0) / np.sqrt(np.mean(white, axis=0)) > 2.5)


def test_instruments_undo_the_bias_of_noisy_regressors(rng):
    n = 20_000
    clean = coloured(rng, n, 0.5)
    y = 3.0 * clean
    seen = (clean + rng.standard_normal(n))[:, None]
    biased = regression("", {"a": ""}, seen, y, np.arange(n))
    unbiased = regression("", {"a": ""}, seen, y, np.arange(n), instruments=clean[:, None])
    # Attenuation by var/(var + 1), var = 1/(1 - 0.25).
    assert biased.values[0] == pytest.approx(3.0 * (4 / 3) / (7 / 3), rel=0.03)
    value, sigma = unbiased.of("a")
    assert abs(value - 3.0) < 4 * sigma < 0.2


def test_an_offset_beside_two_coulomb_frictions_is_not_determined(rng):
    """F_c+ on the way out, -F_c- on the way back and a constant are dependent: three columns of rank two."""
    v = np.sin(np.linspace(0, 60, 4000)) + 1e-9
    X = np.column_stack([v > 0, -1.0 * (v < 0), np.ones_like(v)]).astype(float)
    y = X @ (3.0, 2.0, 1.0) + 0.1 * rng.standard_normal(4000)
    fit = regression("", dict.fromkeys(("ahead", "back", "offset"), "N"), X, y, np.arange(4000.0))
    assert fit.information.rank == 2
    assert np.all(np.isinf(fit.standard_deviation))


# --- drive


def simulated_drive(rng: np.random.Generator, noise: float = 0.0) -> tuple[np.ndarray, ...]:
    t = np.arange(20_000) / 1000.0
    w = 2 * np.pi * np.array([0.3, 0.7, 1.1])[:, None]
    size = np.array([0.1, 0.03, 0.01])[:, None]
    q, v = np.sum(size * np.sin(w * t), 0), np.sum(size * w * np.cos(w * t), 0)
    a = -np.sum(size * w**2 * np.sin(w * t), 0)
    force = 95.0 * a + 200.0 * v + 20.0 * np.sign(v) - 3.0
    return t, q + 1e-6 * noise * rng.standard_normal(len(t)), force + noise * rng.standard_normal(len(t)), q


def test_a_simulated_drive_is_recovered(rng):
    t, q, force, reference = simulated_drive(rng)
    force = force + rng.standard_normal(len(t))
    for fit in (fit_drive(t, q, force), fit_drive(t, q, force, reference=reference)):
        assert np.all(np.abs(fit.values - [95.0, 200.0, 20.0, -3.0]) < 4 * fit.standard_deviation)
        assert np.all(fit.standard_deviation < [0.2, 1.0, 0.2, 0.1])
    ahead_back = fit_drive(t, q, force, coulomb="asymmetric")
    assert ahead_back.of("Fc_ahead")[0] == pytest.approx(17.0, abs=0.2)  # 20 - 3: the offset shares itself out
    assert ahead_back.of("Fc_back")[0] == pytest.approx(23.0, abs=0.2)


def test_noise_of_the_position_lowers_the_mass_unless_the_reference_is_the_instrument(rng):
    """Least squares shrinks M by var(noise of a)/var(a), noise of 1 um through the filter and two differences."""
    t, q, force, reference = simulated_drive(rng, noise=1.0)
    plain, instrumental = fit_drive(t, q, force), fit_drive(t, q, force, reference=reference)
    w, H = signal.freqz_sos(signal.butter(4, 60.0 / 500, output="sos"), 4096)
    noise = 1e-12 * np.mean(np.abs(H) ** 4 * (2 - 2 * np.cos(w)) ** 2) * 1000.0**4
    a = np.gradient(np.gradient(reference, 1e-3), 1e-3)[50:-50]
    shrunk = 95.0 * noise / (noise + a.var())
    assert shrunk > 4 * plain.of("M")[1]
    assert 95.0 - plain.of("M")[0] == pytest.approx(shrunk, rel=0.35)
    assert abs(instrumental.of("M")[0] - 95.0) < 3 * instrumental.of("M")[1] < 0.1


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"cutoff_Hz": 600.0}, "cutoff_Hz = 600.0: expected a cutoff between 0 and 500 Hz"),
        ({"cutoff_Hz": 0.0}, "cutoff_Hz = 0.0: expected a cutoff between 0 and 500 Hz"),
        ({"coulomb": "both"}, "coulomb = 'both': expected one of symmetric, asymmetric, none"),
        ({"time": np.arange(31.0)}, "expected at least 32 samples"),
        ({"position": np.full(20_000, np.nan)}, "expected finite numbers"),
    ],
)
def test_wrong_input_of_a_drive_is_named(rng, change, expected):
    t, q, force, _ = simulated_drive(rng)
    with pytest.raises(InputError, match=expected.replace("(", r"\(")):
        fit_drive(**({"time": t, "position": q, "force": force} | change))


def test_a_drive_that_never_moved_is_refused(rng):
    t, q, force, _ = simulated_drive(rng)
    with pytest.raises(ComputationError, match="the data contain no information on M"):
        fit_drive(t, 0 * q, force)


# --- sine records and the seismometer


def test_a_sine_is_found_with_the_scatter_that_it_states(rng):
    t, found, stated = np.arange(3000) * 0.01, [], []
    for _ in range(80):
        drift = coloured(rng, 3000, 0.95)
        u = np.cos(2 * np.pi * 0.73 * t)
        y = 2 * np.cos(2 * np.pi * 0.73 * t - 0.4) + 0.1 * np.cos(4 * np.pi * 0.73 * t) + 0.02 * drift
        record = fit_sine("0", t, {"u": u, "y": y}, "u")
        H, variance = record.ratio("y", "u")
        found.append(H)
        stated.append(variance)
    error = np.array(found) - 2 * np.exp(-0.4j)
    assert record.frequency_Hz == pytest.approx(0.73, abs=1e-5)
    assert record.harmonics[1, 0] == pytest.approx(0.05, abs=0.01)
    assert np.mean(np.abs(error) ** 2) == pytest.approx(np.mean(stated), rel=0.35)
    assert np.abs(np.mean(error)) < 3 * np.sqrt(np.mean(stated) / 80)


def test_a_clipped_sine_is_refused_with_its_reason():
    t = np.arange(4000) * 0.01
    y = np.cos(2 * np.pi * 0.2 * t)
    over = np.where(y < -0.6, 1.4, y)  # as a laser sensor answers beyond its range
    record = fit_sine("bad", t, {"u": y, "laser": over}, "u")
    assert record.refusal("u") == ""
    assert "out of range" in record.refusal("laser")


def test_a_record_without_a_sine_is_refused():
    with pytest.raises(ComputationError, match="no sine found in the reference"):
        fit_sine("0", np.arange(500.0), {"u": np.ones(500)}, "u")


def made_responses(
    rng: np.random.Generator, noise: float, kinds: tuple[str, ...]
) -> tuple[Responses, tuple, np.ndarray]:
    f = np.geomspace(0.1, 10.0, 17)
    names = {
        2: ("corner_Hz", "damping", "force_gain", "sensitivity", "drive_delay_s", "delay_s"),
        1: ("corner_Hz", "damping", "sensitivity", "delay_s"),
    }[len(kinds)]
    true = np.array({2: [0.487, 0.775, 0.025, 175.0, 3e-4, 2.4e-3], 1: [0.487, 0.775, 175.0, 1e-3]}[len(kinds)])
    value = {kind: H for kind, H in response(f, names, true).items() if kind in kinds}
    e = {
        kind: noise * np.abs(H) * (rng.standard_normal(17) + 1j * rng.standard_normal(17)) / np.sqrt(2)
        for kind, H in value.items()
    }
    return (
        Responses(
            f,
            {kind: H + e[kind] for kind, H in value.items()},
            {kind: (noise * np.abs(H)) ** 2 for kind, H in value.items()},
        ),
        names,
        true,
    )


@pytest.mark.parametrize("kinds", [("coil", "displacement"), ("ground",)])
def test_a_seismometer_is_recovered_with_the_scatter_that_it_states(rng, kinds):
    scores, chi2 = [], []
    for _ in range(100):
        data_, names, true = made_responses(rng, 1e-3, kinds)
        fit = fit_seismometer(data_)
        order = [fit.names.index(name) for name in names]
        scores.append((fit.values[order] - true) / fit.standard_deviation[order])
        chi2.append(fit.chi2_per_dof)
    assert fit.information.rank == len(names)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.1)
    # Never below the bound for independent errors, so that the scores are at most of unit size.
    assert np.all(np.std(scores, axis=0) < 1.15) and np.all(np.std(scores, axis=0) > 0.6)


def test_the_ground_response_at_the_corner():
    """At the corner the ground response is -S/(2 j zeta) = j S/(2 zeta)."""
    names, values = ("corner_Hz", "damping", "sensitivity"), np.array([0.5, 0.7, 100.0])
    at_corner = response(np.array([0.5]), names, values)["ground"]
    assert at_corner[0] == pytest.approx(1j * 100.0 / 1.4)
    # g s / (s^2 + 2 zeta w s + w^2) of the coil: all force against the damping alone.
    at_corner = response(np.array([0.5]), ("corner_Hz", "damping", "gain"), np.array([0.5, 0.7, 3.0]))["coil"]
    assert at_corner[0] == pytest.approx(3.0 / (1.4 * 2 * np.pi * 0.5))


def test_delay_pole_and_mode_are_told_apart(rng):
    f = np.geomspace(0.3, 20, 20)
    s, keep = 2j * np.pi * f, f < 12
    noise = 1 + 1e-4 * (rng.standard_normal(20) + 1j * rng.standard_normal(20))
    shapes = {
        "delay": np.exp(-s * 3e-3),
        "pole": 1 / (1 + 3e-3 * s),
        "mode": 1 / (1 + 2 * 0.1 * s / 200 + (s / 200) ** 2),
    }
    for truth, D in shapes.items():
        found = compare_lags(f, -5 * D / s * noise, keep)
        assert min(found, key=lambda name: found[name].held_out_deg) == truth
    assert cubic_share(f, shapes["delay"] / s * noise)[0] == pytest.approx(0.0, abs=0.05)
    assert cubic_share(f, shapes["pole"] / s * noise)[0] == pytest.approx(1.0, abs=0.15)


# --- decay and oscillator


@pytest.mark.parametrize("damping", [0.02, 0.7, 1.0, 1.4])
def test_a_decay_is_recovered_below_at_and_beyond_critical_damping(rng, damping):
    t = np.arange(0, 8, 0.01)
    system = signal.StateSpace(
        [[0, 1], [-((2 * np.pi * 0.5) ** 2), -2 * damping * 2 * np.pi * 0.5]], [[0], [0]], np.eye(2), [[0], [0]]
    )
    x = signal.lsim(system, np.zeros_like(t), t, [1.0, 2.0])[2]  # another solution of the equation
    fit = fit_decay(t, x + 1e-4 * rng.standard_normal(x.shape) + 0.3, 0.6, 0.5, drift=0)
    error = fit.values - [0.5, damping]
    assert np.all(np.abs(error) < 5 * fit.standard_deviation) and np.all(np.abs(error) < 0.01)


def test_what_does_not_decay_is_refused(rng):
    with pytest.raises(ComputationError, match="no decaying oscillation"):
        fit_decay(np.arange(500) * 0.01, rng.standard_normal(500), 1.0, 0.1)
    with pytest.raises(InputError, match="one is constant"):
        fit_decay(np.arange(500) * 0.01, np.ones(500), 1.0, 0.1)


def oscillator_record(rng: np.random.Generator, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """m = 2, d = 4, k = 5000 (7.96 Hz, 2 %) at 100 Hz from a record simulated at 3200 Hz, start not at rest."""
    n, fine = 4096, 32
    u = signal.sosfiltfilt(signal.butter(6, 20 / 1600, output="sos"), rng.standard_normal(n * fine + 4000))[4000:]
    b, a, _ = signal.cont2discrete(([1.0], [2.0, 4.0, 5000.0]), 1 / (100.0 * fine), method="foh")
    y = signal.lfilter(b.ravel(), a, u)[1000:][::fine]
    return u[1000:][::fine], y + noise * y.std() * rng.standard_normal(len(y))


def test_an_oscillator_is_recovered_from_a_piece_of_record(rng):
    u, y = oscillator_record(rng, 0.01)
    fit = fit_oscillator(u, y, 100.0, (0.5, 18.0))
    assert np.all(np.abs(fit.values / [2.0, 4.0, 5000.0] - 1) < 0.02)
    assert np.all(np.abs(fit.values - [2.0, 4.0, 5000.0]) < 4 * fit.standard_deviation)
    m, d, k = fit.values
    assert np.sqrt(k / m) == pytest.approx(50, rel=1e-3) and d / np.sqrt(m * k) / 2 == pytest.approx(0.02, rel=0.03)


@pytest.mark.parametrize(("m", "k"), [(2.0, -5000.0), (-2.0, 5000.0), (-2.0, -5000.0)])
def test_an_oscillator_of_negative_mass_or_stiffness_is_none(rng, m, k):
    """Without noise, over whole periods: the fit finds the numbers that were put in, and refuses them."""
    n, rate = 4096, 100.0
    s, U = 2j * np.pi * np.fft.rfftfreq(n, 1 / rate), np.fft.rfft(rng.standard_normal(n))
    U[np.abs(s) > 2 * np.pi * 30] = 0
    u, y = np.fft.irfft(U), np.fft.irfft(U / (m * s**2 + 40.0 * s + k))
    with pytest.raises(ComputationError, match=re.escape(f"measured: m {m:.3g}, k {k:.3g};")):
        fit_oscillator(u, y, rate, (0.5, 18.0))


def test_deviations_of_an_oscillator_hold_over_repeated_records():
    """A resonance five lines wide, on which the damping rests; noise of another colour than the response."""
    theta, rate, whole = np.array([2.0, 3.0, 2 * (2 * np.pi * 8) ** 2]), 200.0, 16384
    s, z = 2j * np.pi * np.fft.rfftfreq(whole, 1 / rate), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        U = np.where(s.imag < 2 * np.pi * 60, np.fft.rfft(rng.standard_normal(whole)), 0)
        u, y = np.fft.irfft(U), np.fft.irfft(U / (theta[0] * s**2 + theta[1] * s + theta[2]))
        noise = signal.lfilter([1], [1, -0.8], rng.standard_normal(whole))
        y = y + 0.05 * noise * y.std() / noise.std()
        fit = fit_oscillator(u[5000:9096], y[5000:9096], rate, (1.0, 40.0))
        z.append((fit.values - theta) / fit.standard_deviation)
    assert np.all(np.mean(np.square(z), axis=0) < 1 + 4 * np.sqrt(2 / 40))


# --- the door


@pytest.mark.parametrize(
    ("kind", "columns", "options", "expected"),
    [
        ("geophone", {}, {}, "kind = 'geophone': expected one of seismometer, decay, drive, oscillator"),
        ("drive", {"force": "vir"}, {}, "expected a column for position"),
        ("drive", {"force": "vir", "position": "qm", "speed": "v"}, {}, "role of drive = 'speed'"),
        ("drive", {"force": "vir", "position": "qm"}, {"cutoff": 3.0}, "option of drive = 'cutoff'"),
        ("drive", {"force": "vir", "position": "qm"}, {"cutoff_Hz": "60"}, "cutoff_Hz = '60': expected a number"),
        ("drive", {"force": "vir", "position": "qm"}, {"offset": 1}, "offset = 1: expected true or false"),
        ("oscillator", {"u": "u", "y": "y"}, {"band_Hz": (1.0,)}, "band_Hz = .*: expected two numbers"),
        ("decay", {"y": "y"}, {"drift": True}, "drift = True: expected a whole number"),
        ("drive", {"force": "vir", "position": "qm"}, {"scale": {"force": 0.0}}, "scale of force = 0.0"),
        ("seismometer", {"drive": "u"}, {}, "expected a column for coil or displacement or ground"),
    ],
)
def test_wrong_requests_are_named(tmp_path, kind, columns, options, expected):
    with pytest.raises(InputError, match=expected):
        identify_single_axis(kind, tmp_path / "absent.csv", columns, **options)


def test_from_a_csv_file_to_a_drive(tmp_path, rng):
    t, q, force, _ = simulated_drive(rng, noise=0.1)
    np.savetxt(
        tmp_path / "drive.csv",
        np.column_stack([t, q, force / 35.0])[:8000],
        delimiter=",",
        fmt="%.12g",
        header="t,pos,volts",
        comments="",
    )
    fit = identify_single_axis(
        "drive", tmp_path / "drive.csv", {"t": "t", "position": "pos", "force": "volts"}, scale={"force": 35.0}
    )
    assert fit.of("M")[0] == pytest.approx(95.0, rel=0.01)
    assert fit.lines()[0].startswith("M = 9")
    with pytest.raises(InputError, match="scale of force = 1e\\+308: expected a factor that keeps all samples finite"):
        identify_single_axis(
            "drive", tmp_path / "drive.csv", {"t": "t", "position": "pos", "force": "volts"}, scale={"force": 1e308}
        )


def test_too_few_sines_are_refused(tmp_path):
    t = np.arange(2000) * 0.01
    for f in (1, 2):
        y = np.cos(2 * np.pi * f * t)
        np.savetxt(tmp_path / f"{f}.csv", np.column_stack([t, y, y]), delimiter=",", header="t,u,y", comments="")
    with pytest.raises(ComputationError, match="too few sine records; measured: 2 usable of 2"):
        identify_single_axis("seismometer", tmp_path, {"t": "t", "drive": "u", "coil": "y"})
