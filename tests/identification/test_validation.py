"""Validation on held-out data against the exact simulation, known laws, finite differences and Monte Carlo."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from exact import discrete_avis, floor_velocity, multisine, record
from scipy import stats
from scipy.ndimage import uniform_filter1d
from scipy.signal import dlsim

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.campaign_fit import excited_band, fit_campaign
from avis_ctrl.identification.maximum_likelihood import Residual
from avis_ctrl.identification.measured_responses import overlay
from avis_ctrl.identification.modes import measured_modes, mode_table, model_modes
from avis_ctrl.identification.noise import noise_from_residuals
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.prediction_error import PredictionError, interval, prediction_error
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import record_block
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.validation import floor_interval, validate, verdict_of
from avis_ctrl.identification.whiteness import whiteness
from avis_ctrl.measurement.campaign import Campaign, Portion
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.simulation.campaign_data import open_loop
from avis_ctrl.simulation.loop import simulate
from avis_ctrl.study.files import as_json
from avis_ctrl.study.plan_file import plan_from_table

BAND = (0.5, 30.0)


@pytest.fixture(scope="module")
def model(avis):
    return ResponseModel.of(avis, default_parameters(avis))


@pytest.fixture(scope="module")
def true(model):
    rng = np.random.default_rng(3)
    return model.at(model.values * (1 + 0.05 * rng.uniform(-1, 1, len(model.names))))


@pytest.fixture(scope="module")
def records(true):
    """Six records of 20 s; the period is the record, so that every line is excited."""
    rng = np.random.default_rng(4)
    found = []
    for k in range(6):
        u = multisine(rng, 0.3, period=20_000, periods=1, band_Hz=BAND)
        found.append(record(true.rig, u, floor_velocity(rng, len(u)), rng, name=f"{k:02d}"))
    return found


@pytest.fixture(scope="module")
def found(model, records):
    return fit_campaign(Campaign("avis", tuple(records[:4])), model, BAND)


@pytest.fixture(scope="module")
def checked(found, records):
    return validate(found, Campaign("avis", tuple(records[:4])), Campaign("avis", tuple(records[4:])))


def test_an_identified_rig_leaves_what_noise_leaves(checked):
    assert [one.name for one in checked.held_out] == ["04", "05"]
    for one in checked.held_out:
        assert abs(one.chi2_per_dof - 1) < 0.06 and one.chi2_start > 100
        assert one.nrms_all == pytest.approx(one.nrms_all_floor, rel=0.15) and one.nrms_all_start > 10 * one.nrms_all
        assert np.allclose(one.nrms, one.nrms_floor, rtol=0.3)
        assert 0.97 * one.nrms_all_interval[0] < one.nrms_all < 1.03 * one.nrms_all_interval[1]
        assert one.whiteness is not None and one.whiteness.white
        assert 0.7 < one.chi2_local < 1.3 and not one.repeats
    assert (
        checked.explains
        and "expected" in checked.verdict
        and checked.verdict.startswith("the identified model agrees with the held-out")
    )
    as_json(checked.as_dict())


def test_one_record_beyond_its_noise_is_enough(checked):
    """The record of largest chi-square is predicted as well as noise allows, another one is not: that one is told."""
    one, other = checked.held_out
    high = one.nrms_all_interval[1]
    first = replace(one, chi2_per_dof=9.0 * one.chi2_interval[1], nrms_all=0.9 * high)
    second = replace(other, chi2_per_dof=5.0 * other.chi2_interval[1], nrms_all=3.0 * other.nrms_all_interval[1])
    assert "small systematic error" in verdict_of([first, one]) and "record 04" in verdict_of([first, one])
    assert "does not agree" in verdict_of([first, second]) and "record 05" in verdict_of([first, second])


def test_noise_larger_than_the_error_of_the_start_model_uninformative(checked):
    one = checked.held_out[0]
    assert not one.uninformative
    noisy = replace(
        one, nrms_all_interval=(1.5 * one.nrms_all_start, 3.0 * one.nrms_all_start), chi2_start=0.1, chi2_per_dof=0.01
    )
    assert "do not test the model" in verdict_of([noisy]) and not replace(checked, held_out=(noisy,)).passed
    assert "do not test the model" not in verdict_of([noisy, one])


def test_a_residual_that_is_not_white_is_in_the_verdict(checked):
    """The colour of the verdict is that of `passed`, and the words say the same."""
    one = checked.held_out[0]
    coloured = replace(one, whiteness=SimpleNamespace(white=False, sentences=()))
    assert one.whiteness.white and "not white" not in verdict_of([one])
    assert not replace(checked, held_out=(coloured,)).passed and "not white" in verdict_of([coloured])


def test_errors_in_time_and_by_frequency_agree(checked):
    """Parseval: they differ by the transient of the floor's motion at the ends of the record."""
    for one in checked.held_out:
        assert np.allclose(one.nrms_time, one.nrms, rtol=0.12)
        assert np.allclose(one.nrms_time_start, one.nrms_start, rtol=0.3)


def test_the_band_that_is_driven_leaves_out_an_offset(records):
    """Of a flat spectrum from 0.5 to 30 Hz 0.05 % of the power may lie outside at either end: within a line."""
    shifted = replace(records[0], u=records[0].u + 0.5)
    assert excited_band(Campaign("avis", (shifted,))) == pytest.approx(BAND, abs=0.051)


def test_the_overlay_reaches_the_lines_at_the_edges_of_the_band(checked):
    """0.5 and 30 Hz are lines of records of 20 s, whatever 30 / 0.05 rounds to."""
    assert checked.overlay.frequency_Hz[[0, -1]] == pytest.approx(BAND, rel=1e-12)


def test_the_prediction_in_time_is_that_of_scipy(found, records, checked):
    """The identified rig by matrix exponentials and scipy's discrete simulation, and what the simulator of closed loops
    has beside its linear table; error without a filter."""
    held = records[4]
    A, B, C, _ = discrete_avis(found.fit.model.rig)
    u = np.vstack([np.zeros((1, 8)), held.u[:-1]])
    _, y, _ = dlsim((A, B[:, :8], C, np.zeros((6, 8)), 1e-3), u)
    plan = plan_from_table({"ambient": {"velocity_rms_m_per_s": 0.0}, "record": [{"excitation": "rest"}]})
    loop = open_loop(found.fit.model.rig, plan)
    loop = replace(loop, sensors=replace(loop.sensors, noise_rms_V=np.zeros(6)))
    table, linear = (
        simulate(loop, 20.0, settle_s=0.0, nonlinear=one, floor=np.zeros((20_001, 6)), drive=held.u).sensed
        for one in (True, False)
    )
    e = held.y - y - (table - linear)
    assert np.allclose(np.std(e, axis=0) / np.std(held.y, axis=0), checked.held_out[0].nrms_time_whole, rtol=1e-5)


def test_chi_square_of_the_true_model_obeys_its_law(true):
    """Noise of known covariance: chi2 of the projected error has the dof claimed, in all and by output."""
    rng = np.random.default_rng(5)
    w = 2 * np.pi * np.arange(10, 310) / 20.0
    C = np.eye(6) + 0.5
    factor = np.linalg.cholesky(C)
    block = SpectralBlock(
        "00", w, np.zeros((300, 11, 1), complex), np.zeros((300, 6, 1), complex), transient=True, kind="k"
    ).with_noise(np.broadcast_to(C, (300, 6, 6)))
    totals, outputs = [], []
    for _ in range(40):
        e = factor @ (rng.normal(size=(300, 6, 1)) + 1j * rng.normal(size=(300, 6, 1))) / np.sqrt(2)
        one = prediction_error(true, replace(block, Y=e), derivative=False)
        totals.append(one.chi2)
        outputs.append(one.output_chi2)
    assert one.dof < 3600 - 20
    law = stats.chi2(40 * one.dof)
    assert law.ppf(1e-4) < np.sum(totals) < law.ppf(1 - 1e-4)
    assert np.all(np.abs(np.mean(outputs, 0) / one.output_dof - 1) < 4.5 * np.sqrt(2 / (40 * one.output_dof)))
    assert stats.kstest(totals, stats.chi2(one.dof).cdf).pvalue > 1e-4


def test_the_interval_is_fishers():
    """Ratio of two mean squares, drawn."""
    rng = np.random.default_rng(6)
    ratio = rng.chisquare(300, 20000) / 300 / (rng.chisquare(200, 20000) / 200)
    low, high = interval(1.0, 300, 200)
    inside = np.mean((ratio / ratio.mean() >= low) & (ratio / ratio.mean() <= high))
    assert inside == pytest.approx(0.95, abs=0.006)
    assert interval(1.0, 300, np.inf) == pytest.approx(tuple(stats.chi2(300).ppf([0.025, 0.975]) / 300))


def test_the_interval_of_chi_square_allows_for_the_noise_estimated(found, checked, rng):
    """Fisher's law; the inverse of a covariance is known as the inverse of a Wishart matrix scatters, drawn."""
    one = checked.held_out[0]
    dof = int(re.search(r"(\d+) degrees of freedom per line", one.noise)[1])
    X = rng.normal(size=(4000, 6, dof)) + 1j * rng.normal(size=(4000, 6, dof))
    trace = np.trace(np.linalg.inv(X @ np.conj(X.swapaxes(1, 2))), axis1=1, axis2=2).real
    worth = 2 * np.mean(trace) ** 2 / np.var(trace)
    law = stats.f(2 * 6 * one.lines, worth * found.fit.dof / (2 * 6 * dof))
    low, high = one.chi2_interval
    assert np.log(high / low) == pytest.approx(np.log(law.ppf(0.975) / law.ppf(0.025)), rel=0.01)


def test_chi_square_is_consistent_up_to_the_end_of_its_interval(checked):
    """Below it the record has less noise than the fitted ones, which is no error of the model."""
    one = checked.held_out[0]
    low, high = one.chi2_interval
    for value, inside in ((0.99 * low, True), (low, True), (1.0, True), (high, True), (1.01 * high, False)):
        assert replace(one, chi2_per_dof=value).consistent == inside


def white_error(rng, n=400, n_y=3, n_u=2, white=None):
    omega = 2 * np.pi * np.linspace(1, 41, n)
    U = rng.normal(size=(n, n_u, 1)) + 1j * rng.normal(size=(n, n_u, 1))
    w = (rng.normal(size=(n, n_y, 1)) + 1j * rng.normal(size=(n, n_y, 1))) / np.sqrt(2) if white is None else white(U)
    block = SpectralBlock("00", omega, U, w).with_noise(np.broadcast_to(np.eye(n_y), (n, n_y, n_y)))
    return PredictionError(block, w, w, w, np.zeros((1, n, n_y, 1), complex), 2 * n * n_y, np.full(n_y, 2.0 * n))


def test_white_residuals_raise_few_alarms():
    """1 % of validations: 300 draws, no more than the binomial law allows."""
    rng = np.random.default_rng(7)
    alarms = sum(not whiteness(white_error(rng), "abc", "uv", np.zeros((1, 1))).white for _ in range(300))
    assert alarms <= stats.binom(300, 0.01).ppf(0.999)


@pytest.mark.parametrize("kind", ["lines", "time", "input"])
def test_what_is_not_white_is_found(kind):
    rng = np.random.default_rng(8)
    plain = white_error(rng).white
    omega = 2 * np.pi * np.linspace(1, 41, 400)
    planted = {
        "lines": lambda U: (plain + 0.5 * np.roll(plain, 3, axis=0)) / np.sqrt(1.25),
        "time": lambda U: plain * np.sqrt(1 + 0.7 * np.cos(0.5 * omega))[:, None, None],
        "input": lambda U: plain + 0.3 * U[:, 1:2] * np.exp(-0.3j * omega)[:, None, None],
    }[kind]
    said = whiteness(white_error(rng, white=planted), ("a", "b", "c"), ("u", "v"), np.zeros((1, 1)))
    which = dict(zip(("lines", "time", "input"), said.correlations, strict=True))[kind]
    assert which.beyond and "values exceed their limit" in which.sentence
    row, lag = np.unravel_index(np.argmax(which.value / which.limit), which.value.shape)
    assert which.lags[lag] == pytest.approx({"lines": 3, "time": 0.5, "input": 0.3}[kind], abs=0.03)
    if kind == "input":
        assert which.rows[row].endswith("with v")


def test_the_start_model_does_not_pass(found, records):
    """The same figures for a rig 5 % off: every one of them says so."""
    wrong = replace(found, fit=replace(found.fit, model=found.start))
    one = validate(wrong, Campaign("avis", tuple(records[:4])), Campaign("avis", (records[4],)))
    assert not one.passed and not one.held_out[0].whiteness.white
    assert one.held_out[0].chi2_per_dof > 100 * one.held_out[0].chi2_interval[1]
    assert one.overlay.inside < 0.9 and one.verdict.startswith("the identified model does not agree")


def test_modes_and_their_spread_by_differences(true):
    """Against eigenvalues of numpy at displaced parameters, and the undamped frequencies of the rig."""
    for row in np.diag(true.values):
        up, down = (model_modes(true.at(true.values + sign * 1e-5 * row)) for sign in (1, -1))
        slope = np.concatenate([up.frequency_Hz - down.frequency_Hz, up.damping - down.damping]) / 2e-5
        found = model_modes(true, np.outer(row, row))
        size = np.abs(found.covariance).max()
        assert np.allclose(found.covariance, np.outer(slope, slope), rtol=1e-3, atol=1e-6 * size)
    table = true.rig.equations_of_motion()
    assert np.allclose(found.frequency_Hz, table.natural_frequencies().frequencies_Hz, rtol=1e-3)
    assert [words.split()[0] for words in found.words[:4]] == ["y", "x", "z", "phi_z"]


def test_measured_modes_know_their_errors(found, true, records, checked):
    """Poles of held-out data against the truth, in their own standard deviations, over several records."""
    exact = model_modes(true)
    z = []
    for one in records:
        block = record_block(one, true, BAND)
        noisy = found.fit.residuals[0].block
        measured = measured_modes([block.with_noise(noisy.noise[:, 0], noisy.dof)], true)
        assert measured.misfit == pytest.approx(1, abs=0.2)
        z.append(
            (np.concatenate([measured.frequency_Hz - exact.frequency_Hz, measured.damping - exact.damping]))
            / np.sqrt(np.diag(measured.covariance))
        )
    assert 0.6 < np.mean(np.square(z)) < 1.6 and np.max(np.abs(z)) < 4.5
    assert len(checked.modes) == 6 and max(abs(row.frequency_sigma) for row in checked.modes) < 4.5
    errors = [
        abs(row.frequency_Hz - f) / row.frequency_std_Hz
        for row, f in zip(checked.modes, exact.frequency_Hz, strict=True)
    ]
    assert max(errors) < 4.5


def test_modes_that_cannot_be_measured_are_answered(true, records):
    block = record_block(records[0], true, (20.0, 30.0))
    with pytest.raises(ComputationError, match="band"):
        measured_modes([block], true)
    short = record_block(records[0], true, BAND).lines(np.arange(40))
    with pytest.raises(ComputationError, match="unknown residues"):
        measured_modes([short.with_noise(np.broadcast_to(np.eye(6), (40, 6, 6)))], true)
    heavy = true.at(np.where([".c_" in name for name in true.names], 40 * true.values, true.values))
    with pytest.raises(ComputationError, match="oscillates"):
        mode_table(heavy, np.eye(len(true.names)), heavy, None)
    free = true.rig.with_parameters({f"isolator{i}.{kind}_x": 0.0 for i in (1, 2, 3, 4) for kind in "kc"})
    with pytest.raises(ComputationError, match="5 of 6 modes do"):
        model_modes(ResponseModel.of(free, ["mass"]))


def test_the_scatter_of_a_measured_response_is_that_of_its_noise(true):
    f = np.array([1.0, 2.5, 4.0, 20.0])
    exact, C = true.response(2 * np.pi * f)[:, :, :8], np.broadcast_to(1e-6 * np.eye(6), (4, 6, 6))
    measured = FrequencyResponse(f, exact, C, np.broadcast_to(np.eye(8), (4, 8, 8)), true.actuators, true.sensors.names)
    drawn = overlay(measured, true, true)
    assert np.allclose(drawn.measured_std, 1e-3 / np.sqrt(2)) and drawn.inside == 1.0


def test_the_floor_of_a_few_loud_lines_is_wide(true):
    """Noise on mostly five lines: the interval of the r.m.s. error against draws."""
    rng = np.random.default_rng(14)
    level = np.where(np.arange(200) < 5, 100.0, 0.1)
    C = level[:, None, None] * np.eye(6)
    block = SpectralBlock(
        "00", 2 * np.pi * np.linspace(1, 20, 200), np.zeros((200, 11, 1), complex), np.ones((200, 6, 1), complex)
    ).with_noise(C)
    e = rng.normal(size=(4000, 200, 6, 1)) + 1j * rng.normal(size=(4000, 200, 6, 1))
    e *= np.sqrt(level / 2)[:, None, None]
    drawn = np.sqrt(np.sum(np.abs(e) ** 2, axis=(1, 2, 3)) / 1200)
    error = PredictionError(block, e[0], e[0], e[0], np.empty(0), 2400, np.full(6, 400.0))
    low, high = floor_interval(error, float(np.sum(6 * level) / 1200), np.inf)
    assert np.mean((drawn > low) & (drawn < high)) == pytest.approx(0.95, abs=0.012)


def test_noise_near_sharp_modes_is_measured(true):
    """Floor motion through the table and sensor noise, drawn: the estimate against the covariance it was drawn from."""
    rng = np.random.default_rng(10)
    w = 2 * np.pi * np.arange(10, 600) / 20.0
    G = true.response(w)[:, :, 8:]
    C = G @ np.conj(G.swapaxes(1, 2)) * (2e-4 / w[:, None, None]) ** 2 + 1e-6 * np.eye(6)
    factor = np.linalg.cholesky(C)
    residuals = []
    for k in range(4):
        e = factor @ (rng.normal(size=(len(w), 6, 1)) + 1j * rng.normal(size=(len(w), 6, 1))) / np.sqrt(2)
        block = SpectralBlock(f"{k}", w, np.zeros((len(w), 11, 1), complex), e, kind="k")
        residuals.append(Residual(block, e, e, e))

    def ratio(noise, dof):
        whole = np.trace(np.linalg.solve(noise, C), axis1=1, axis2=2).real / 6
        return np.mean(whole) * (dof - 6) / dof, np.std(whole)

    found = noise_from_residuals(residuals, [residuals[0].block], true)[0]
    shaped = ratio(found.noise[:, 0], found.dof)
    # Averaged over 25 lines of each record as they are.
    outer = sum(one.error @ np.conj(one.error.swapaxes(1, 2)) for one in residuals) / 4
    plain = ratio(uniform_filter1d(outer.real, 25, axis=0) + 1j * uniform_filter1d(outer.imag, 25, axis=0), 100)
    assert abs(shaped[0] - 1) < 0.03
    assert shaped[1] < 0.5 * plain[1]


def test_noise_where_few_lines_were_fitted_has_full_rank(true):
    """Thinned records have many lines at resonances and few elsewhere."""
    rng = np.random.default_rng(12)
    w = 2 * np.pi * np.concatenate([np.linspace(1, 3, 2000, endpoint=False), np.linspace(3, 30, 150)])
    e = rng.normal(size=(len(w), 6, 1)) + 1j * rng.normal(size=(len(w), 6, 1))
    block = SpectralBlock("0", w, np.zeros((len(w), 11, 1), complex), e, kind="k")
    sparse = block.lines(np.arange(2000, len(w)))
    found = noise_from_residuals([Residual(block, e, e, e)], [sparse], true)[0]
    assert found.dof >= 100
    assert np.linalg.eigvalsh(found.noise[:, 0]).min() > 0.5  # the variance of every output is 2


def test_responses_in_place_of_records(true, model):
    rng = np.random.default_rng(11)
    f = np.geomspace(0.7, 30, 240)
    flat = replace(model, period_s=0.0, delay_s=0.0)
    G = replace(true, period_s=0.0, delay_s=0.0).response(2 * np.pi * f)[:, :, :8]
    noise = 1e-2 * (rng.normal(size=G.shape) + 1j * rng.normal(size=G.shape)) / np.sqrt(2)
    measured = FrequencyResponse(
        f,
        G + noise,
        np.broadcast_to(1e-4 * np.eye(6), (240, 6, 6)),
        np.broadcast_to(np.eye(8), (240, 8, 8)),
        true.actuators,
        true.sensors.names,
    )
    third = np.arange(240) % 3 == 2
    found = fit_campaign(measured.at(~third), flat, (0.7, 30))
    one = validate(found, measured.at(~third), measured.at(third))
    held = one.held_out[0]
    assert held.chi2_interval[0] * 0.97 < held.chi2_per_dof < held.chi2_interval[1] * 1.03
    assert held.nrms_all == pytest.approx(held.nrms_all_floor, rel=0.05) and held.nrms_time is None
    assert one.overlay.inside == pytest.approx(0.95, abs=0.02)
    assert all(abs(row.frequency_sigma) < 4.5 for row in one.modes)
    with pytest.raises(InputError, match="same kind"):
        validate(found, measured, _silent(true))


def _silent(true):
    rng = np.random.default_rng(12)
    u = np.zeros((3000, 8))
    return Campaign("avis", (record(true.rig, u, floor_velocity(rng, 3000), rng, excitation="rest"),))


def test_parts_of_records_have_no_prediction_in_time(found, records):
    last = Portion(records[4], 10_000, 20_000)
    one = validate(found, Campaign("avis", tuple(records[:4])), Campaign("avis", (last,))).held_out[0]
    assert one.nrms_time is None and "rest" in one.time_note
    assert abs(one.chi2_per_dof - 1) < 0.1


def test_held_out_records_that_tell_nothing_are_answered(found, records, true):
    fitted = Campaign("avis", tuple(records[:4]))
    with pytest.raises(InputError, match="drives an actuator"):
        validate(found, fitted, _silent(true))
    rng = np.random.default_rng(13)
    other = record(true.rig, records[4].u[:5000], floor_velocity(rng, 5000), rng, floor_known=True)
    with pytest.raises(InputError, match="floor not measured"):
        validate(found, fitted, Campaign("avis", (other,)))
