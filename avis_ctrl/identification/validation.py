"""Validation of an identified rig on data that no fit has used.

The noise that errors are compared with comes from the fitted records, never from the held-out ones: it is the
covariance of the fit's own residuals, pooled over records of a kind (records share their noise when the floor was
measured in all of them, or in none). An error of the model that repeats in all records is part of this covariance. The
noise of a local polynomial model, which does not depend on the rig's, shows it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.identification.campaign_fit import SETTINGS as FIT
from avis_ctrl.identification.campaign_fit import CampaignFit, measured_noise
from avis_ctrl.identification.measured_responses import ResponseOverlay, measured_response, overlay
from avis_ctrl.identification.modes import MeasuredModes, ModeRow, measured_modes, mode_table
from avis_ctrl.identification.noise import noise_from_residuals
from avis_ctrl.identification.prediction_error import PredictionError, interval, prediction_error
from avis_ctrl.identification.predictor import predict
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.second_order import terms, without
from avis_ctrl.identification.spectra import record_block, response_block
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.whiteness import Whiteness, whiteness
from avis_ctrl.measurement.campaign import Campaign, Portion, Record, RecordSource
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.summary import percent


@dataclass(frozen=True)
class ValidationSettings:
    """level : probability of the intervals of chi-square [1]: the usual one.
    repeats : r.m.s. of the residual, whitened by the noise of a local polynomial model [1], from which it is an error
        of the model that repeats in the records. Of a correct model it is about 1.
    """

    level: float = 0.95
    repeats: float = 2.0


SETTINGS = ValidationSettings()
Measured = Campaign | FrequencyResponse


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Figures of one record (or piece of a long one, or response) that no fit has used.

    Attributes
    ----------
    name : of the record. lines : in the band. noise : which noise the error is compared with, in words.
    chi2_per_dof, chi2_interval : with its 95 % interval if only noise and the uncertainty of the parameters remain.
        chi2_start : of the start model. chi2_local : with the noise of the local polynomial model of the fitted
        records, NaN without one.
    output_chi2_per_dof, output_chi2_interval : (n_y,) and (n_y, 2), each output separately.
    nrms, nrms_start : (n_y,) r.m.s. error in the band over r.m.s. output in the band, transient of the ends removed.
    nrms_floor : (n_y,) expected from noise alone.
    nrms_all, nrms_all_start, nrms_all_floor : the same for all outputs together. nrms_all_interval : 95 % interval of
        nrms_all for noise alone; wide if few lines at a resonance contain most of the noise.
    nrms_time, nrms_time_start : (n_y,) of the time-domain prediction from rest, with error and output filtered to the
        band; None if the record does not start at rest. nrms_time_whole : (n_y,) without the filter.
    time_note : why there is no prediction in time, or what it covers.
    whiteness : correlations of the residual; None if there are too few lines.
    nrms_all_exact : nrms_all of the fit that takes the rig file as exact, None if no tolerance was fitted.
    """

    name: str
    lines: int
    noise: str
    chi2_per_dof: float
    chi2_interval: tuple[float, float]
    chi2_start: float
    chi2_local: float
    output_chi2_per_dof: np.ndarray
    output_chi2_interval: np.ndarray
    nrms: np.ndarray
    nrms_start: np.ndarray
    nrms_floor: np.ndarray
    nrms_all: float
    nrms_all_start: float
    nrms_all_floor: float
    nrms_all_interval: tuple[float, float]
    nrms_time: np.ndarray | None = None
    nrms_time_start: np.ndarray | None = None
    nrms_time_whole: np.ndarray | None = None
    time_note: str = ""
    whiteness: Whiteness | None = None
    nrms_all_exact: float | None = None

    @property
    def consistent(self) -> bool:
        """Whether chi-square is not above its interval. Below it, the record has less noise than the fitted ones."""
        return self.chi2_per_dof <= self.chi2_interval[1]

    @property
    def beyond_noise(self) -> bool:
        """Whether chi-square and r.m.s. error are above their intervals."""
        return not self.consistent and self.nrms_all > self.nrms_all_interval[1]

    @property
    def repeats(self) -> bool:
        """Whether the residual is an error of the model that repeats in all records: far above the noise of a local
        polynomial model."""
        return self.chi2_local > SETTINGS.repeats**2

    @property
    def uninformative(self) -> bool:
        """Whether noise alone would leave more than the start model does, in r.m.s. and in chi-square."""
        return self.nrms_all_start < self.nrms_all_interval[0] and self.chi2_start < self.chi2_interval[0]


@dataclass(frozen=True, eq=False)
class Validation:
    """Report-ready figures of an identified model on held-out data.

    Attributes
    ----------
    outputs, band_Hz : of all figures. held_out : one per record, or piece of a long one.
    overlay : measured and model responses for figures, of all records; None if they do not allow it.
    modes : the model's, with the start's and those measured in the held-out data without the rig's equations.
    verdict : one sentence with the numbers. sentences : the verdict, whiteness, time, modes and responses in words.
    notes : what was used, and what could not be computed.
    """

    outputs: tuple[str, ...]
    band_Hz: tuple[float, float]
    held_out: tuple[HeldOut, ...]
    overlay: ResponseOverlay | None
    modes: tuple[ModeRow, ...]
    verdict: str
    sentences: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Chi-square not above its interval and residuals white in every held-out record, at least one of which
        tests the model; no error that repeats in all records."""
        tested = not all(one.uninformative for one in self.held_out)
        return tested and all(
            one.consistent and not one.repeats and (one.whiteness is None or one.whiteness.white)
            for one in self.held_out
        )

    @property
    def explains(self) -> bool:
        """Whether no error on held-out data is beyond noise in r.m.s., and none repeats in all records."""
        return not any(one.beyond_noise or one.repeats for one in self.held_out)

    def as_dict(self) -> dict[str, Any]:
        """Values for a file, without the arrays of figures."""
        return {
            "verdict": self.verdict,
            "passed": self.passed,
            "sentences": self.sentences,
            "notes": self.notes,
            "outputs": self.outputs,
            "band_Hz": self.band_Hz,
            "modes": [vars(row) for row in self.modes],
            "held_out": [_without_figures(one) for one in self.held_out],
        }


def _without_figures(one: HeldOut) -> dict[str, Any]:
    found = dict(vars(one))
    white = found.pop("whiteness")
    return found if white is None else found | {"whiteness": {"white": white.white, "sentences": white.sentences}}


def validate(found: CampaignFit, fitted: Measured, held_out: Measured) -> Validation:
    """Prediction errors, their whiteness, responses and modes of the fitted model on data that no fit has used.

    Raises
    ------
    InputError : held-out data of another kind than the fitted ones, without lines in the band, without excitation, or
        with outputs that do not move.
    """
    notes: list[str] = []
    if isinstance(fitted, FrequencyResponse) != isinstance(held_out, FrequencyResponse):
        raise InputError(
            "expected held-out data of the same kind as the fitted ones",
            field="held out",
            value=type(held_out).__name__,
        )
    blocks = [(*_with_noise(found, fitted, block), block, record) for block, record in _blocks(found, held_out)]
    figures = [_figures(found, fitted, *one, len(blocks), notes) for one in blocks]
    modes, mode_note = _modes(found, [one[0] for one in blocks])
    drawn = _overlay(found, fitted, held_out, notes)
    verdict = verdict_of(figures)
    said = [verdict, *_sentences(figures), *_mode_sentence(modes), mode_note]
    if drawn:
        said.append(
            f"{100 * drawn.inside:.3g} % of the values of the measured frequency response lie within their 95 % "
            f"confidence region about the model ({drawn.method})"
        )
    return Validation(
        found.fit.model.sensors.names, found.band_Hz, tuple(figures), drawn, modes, verdict, tuple(said), tuple(notes)
    )


def _blocks(found: CampaignFit, held_out: Measured) -> list[tuple[SpectralBlock, RecordSource | None]]:
    """Spectra of the held-out data, in pieces if long; each with its record if it begins at the record's start."""
    model = found.fit.model
    if isinstance(held_out, FrequencyResponse):
        return [(response_block(held_out.between(*found.band_Hz), model, "held-out lines"), None)]
    blocks: list[tuple[SpectralBlock, RecordSource | None]] = []
    for record in held_out.records:
        for k, piece in enumerate(record.pieces(max(FIT.longest_piece, record.header.period_samples or 0))):
            block = record_block(piece, model, found.band_Hz)
            if np.any(block.U):
                whole = k == 0 and not (isinstance(record, Portion) and record.start > 0)
                blocks.append((block, piece if whole else None))
    if not blocks:
        raise InputError("expected a record that drives an actuator, or one with the floor measured", field="held out")
    # The frequency-domain model is linear: it is compared with the linear part of the records.
    raw = [block for block, _ in blocks]
    linear = without(raw, [one[0] for one in terms(held_out, raw, model)])
    return [(block, record) for block, (_, record) in zip(linear, blocks, strict=True)]


def _with_noise(found: CampaignFit, fitted: Measured, block: SpectralBlock) -> tuple[SpectralBlock, float, str]:
    """The block with the noise of the fitted data, the real numbers used to estimate it, and a description."""
    if isinstance(fitted, FrequencyResponse):
        near = response_block(fitted.between(*found.band_Hz), found.fit.model)
        assert near.noise is not None
        at = np.clip(np.searchsorted((near.omega[1:] + near.omega[:-1]) / 2, block.omega), 0, len(near.omega) - 1)
        return (
            block.with_noise(near.noise[at], near.dof),
            np.inf,
            "covariance of the nearest fitted line, as estimated with the responses",
        )
    residuals = found.fit.residuals
    kinds = {one.block.kind for one in residuals}
    if block.kind not in kinds:
        raise InputError(
            f"expected records of the kind that was fitted: {', '.join(sorted(kinds))}",
            field=f"held-out record {block.name}",
            value=block.kind,
        )
    noisy = noise_from_residuals(residuals, [block], model=found.fit.model)[0]
    pool = sum(one.block.numbers for one in residuals if one.block.kind == block.kind)
    # The fit reduced its own residuals: they lack its degrees of freedom.
    share = found.fit.dof / sum(one.block.numbers for one in residuals)
    assert noisy.noise is not None
    return (
        noisy.with_noise(noisy.noise / share, noisy.dof),
        pool * share * _inverse_dof(noisy.dof, len(noisy.Y[0])),
        f"covariance of the fit's residuals in the fitted records ({block.kind}), {noisy.dof:.0f} degrees of "
        "freedom per line; unlike the noise of a local model it is not biased at resonances",
    )


def _inverse_dof(dof: float, n_y: int) -> float:
    """Relative variance of an estimated covariance over that of its inverse, a factor on the number of real numbers.

    The trace of the inverse of a complex Wishart matrix of n_y outputs and dof degrees of freedom has the relative
    variance dof / (n_y ((dof - n_y)^2 - 1)) (moments of Maiwald and Kraus, IEE Proc. Radar 147, 2000).
    """
    return max((dof - n_y) ** 2 - 1, 1.0) / dof**2


def _figures(
    found: CampaignFit,
    fitted: Measured,
    block: SpectralBlock,
    noise_dof: float,
    words: str,
    raw: SpectralBlock,
    record: RecordSource | None,
    families: int,
    notes: list[str],
) -> HeldOut:
    model, covariance = found.fit.model, found.fit.information.covariance
    error, before = prediction_error(model, block), prediction_error(found.start, block, derivative=False)
    expected = error.expected(covariance) / error.dof
    power = np.sum(np.abs(block.Y) ** 2, axis=(0, 2))
    if not np.all(power > 0):
        raise InputError(
            "expected outputs that are not zero", field=f"held-out record {block.name}", value=power.tolist()
        )
    of_output = [interval(expected, dof, noise_dof / len(power), SETTINGS.level) for dof in error.output_dof]
    floor = error.noise_share()
    white = whiteness(error, model.sensors.names, model.inputs, covariance, noise_dof / (2 * len(power)), families)
    return HeldOut(
        block.name,
        len(block.omega),
        words,
        error.chi2 / error.dof,
        interval(expected, error.dof, noise_dof, SETTINGS.level),
        before.chi2 / before.dof,
        _local_chi2(found, fitted, raw, notes),
        error.output_chi2 / error.output_dof,
        np.array(of_output),
        _root(error.error, power),
        _root(before.error, power),
        np.sqrt(floor / power),
        _root_all(error),
        _root_all(before),
        float(np.sqrt(floor.sum() / power.sum())),
        floor_interval(error, float(floor.sum() / power.sum()), noise_dof / (2 * block.Y.size)),
        *_in_time(found, record),
        white,
        _root_all(prediction_error(found.first.model, block, derivative=False)) if found.tolerances else None,
    )


def floor_interval(error: PredictionError, floor: float, times: float) -> tuple[float, float]:
    """Interval of the root of sum |e|^2 / sum |Y|^2 for noise alone, which was estimated from `times` as many lines;
    few degrees of freedom if few lines contain most of it (Welch and Satterthwaite)."""
    assert error.block.noise is not None
    C = np.broadcast_to(
        error.block.noise, (*error.block.noise.shape[:1], error.error.shape[2], *error.block.noise.shape[2:])
    )
    dof = 2 * np.real(np.einsum("kmii->", C)) ** 2 / np.real(np.einsum("kmij,kmji->", C, C))
    low, high = interval(floor, dof, max(dof * times, 3.0))
    return float(np.sqrt(low)), float(np.sqrt(high))


def _root(error: np.ndarray, power: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(np.abs(error) ** 2, axis=(0, 2)) / power)


def _root_all(error: PredictionError) -> float:
    return float(np.linalg.norm(error.error) / np.linalg.norm(error.block.Y))


def _local_chi2(found: CampaignFit, fitted: Measured, raw: SpectralBlock, notes: list[str]) -> float:
    """chi-square per degree of freedom with the noise of the local polynomial model."""
    if isinstance(fitted, FrequencyResponse):
        return float("nan")
    try:
        (block,) = measured_noise([raw], fitted, found.band_Hz)
        error = prediction_error(found.fit.model, block, derivative=False)
    except AvisError as failed:
        notes.append(f"record {raw.name}: no noise of a local polynomial model ({failed})")
        return float("nan")
    return error.chi2 / error.dof


def _in_time(
    found: CampaignFit, record: RecordSource | None
) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None, str]:
    """n.r.m.s. error of the time-domain prediction: in the band, of the start model, and without a filter."""
    if record is None:
        return None, None, None, "no time-domain prediction: the data do not start at rest, or are frequency responses"
    whole = record.load()
    after, unfiltered = _time_nrms(found.fit.model, whole, found.band_Hz)
    before, _ = _time_nrms(found.start, whole, found.band_Hz)
    return after, before, unfiltered, f"predicted from rest, {whole.header.duration_s:.4g} s"


def _time_nrms(model: ResponseModel, record: Record, band_Hz: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """(n_y,) n.r.m.s. error in the band, and that of the whole signal without its mean."""
    y = record.y[:, [record.header.y_names.index(name) for name in model.sensors.names]]
    e = y - predict(model, record)
    return (
        np.sqrt(
            _band_power(e, record.header.sample_rate_Hz, band_Hz)
            / _band_power(y, record.header.sample_rate_Hz, band_Hz)
        ),
        np.std(e, axis=0) / np.std(y, axis=0),
    )


def _band_power(x: np.ndarray, rate: float, band_Hz: tuple[float, float]) -> np.ndarray:
    """(n_y,) mean square of the part of x inside a band, by a zero-phase filter."""
    spectrum, f = np.fft.rfft(x - x.mean(0), axis=0), np.fft.rfftfreq(len(x), 1 / rate)
    spectrum[(f < band_Hz[0]) | (f > band_Hz[1])] = 0
    return np.mean(np.fft.irfft(spectrum, len(x), axis=0) ** 2, axis=0)


def _modes(found: CampaignFit, blocks: list[SpectralBlock]) -> tuple[tuple[ModeRow, ...], str]:
    """Table of modes, and a sentence on the measured ones."""
    model, covariance = found.fit.model, found.fit.information.covariance
    measured: MeasuredModes | None = None
    try:
        measured = measured_modes(blocks, model)
        note = (
            f"measured modes: common poles with free residues fitted to the held-out data, {measured.lines} lines "
            f"from {measured.band_Hz[0]:.3g} to {measured.band_Hz[1]:.3g} Hz, mean square of the whitened residual "
            f"{measured.misfit:.3g}"
        )
    except AvisError as failed:
        note = f"no measured modes: {failed}"
    try:
        return mode_table(model, covariance, found.start, measured), note
    except AvisError as failed:
        return (), f"no table of modes: {failed}"


def _overlay(found: CampaignFit, fitted: Measured, held_out: Measured, notes: list[str]) -> ResponseOverlay | None:
    """Responses from all measured data: a single record seldom separates all inputs."""
    if isinstance(fitted, Campaign) and isinstance(held_out, Campaign):
        data: Measured = replace(fitted, records=(*fitted.records, *held_out.records))
    else:
        data = held_out
    try:
        return overlay(measured_response(data, found.band_Hz, found.fit.model), found.fit.model, found.start)
    except AvisError as failed:
        notes.append(f"no measured response to draw ({failed})")
        return None


def verdict_of(figures: list[HeldOut]) -> str:
    """Verdict on the record that fits worst; if some records exceed what noise explains, on the worst of these."""

    def ratio(one: HeldOut) -> float:
        return one.chi2_per_dof / one.chi2_interval[1]

    off = [one for one in figures if not one.consistent]
    beyond = [one for one in off if one.beyond_noise]
    if not beyond and (again := [one for one in figures if one.repeats]):
        worst = max(again, key=lambda one: one.chi2_local)
        return (
            "the identified model does not explain the records; its error repeats in all of them (avis gap searches "
            f"for the cause): on record {worst.name} its residual is {percent(worst.nrms_all)} of the signal, r.m.s. "
            f"(start model {percent(worst.nrms_all_start)}), {np.sqrt(worst.chi2_local):.3g} times the noise of a "
            f"local polynomial model (chi-square per degree of freedom {worst.chi2_local:.4g})"
        )
    worst = max(beyond or off or figures, key=ratio)
    if not off and all(one.uninformative for one in figures):
        judged = (
            "the held-out data do not test the model, because noise alone, as estimated from the fitted records, would "
            "exceed the error of the start model; the records are too short, or the held-out ones are quieter"
        )
    elif beyond:
        judged = "the identified model does not agree with the held-out data (avis gap searches for the cause)"
    elif off:
        judged = (
            "the identified model predicts the held-out data as well as their noise allows, but chi-square shows "
            "a small systematic error"
        )
    elif not all(one.whiteness is None or one.whiteness.white for one in figures):
        judged = (
            "the identified model predicts the held-out data as well as their noise allows, but the residual "
            "is not white"
        )
    else:
        judged = "the identified model agrees with the held-out data"
    return (
        f"{judged}: on record {worst.name} its residual is {percent(worst.nrms_all)} of the signal, r.m.s. "
        f"(expected from noise alone {percent(worst.nrms_all_interval[0])} to "
        f"{percent(worst.nrms_all_interval[1])}; start model {percent(worst.nrms_all_start)}), and chi-square "
        f"per degree of freedom is {worst.chi2_per_dof:.4g} (expected {worst.chi2_interval[0]:.4g} to "
        f"{worst.chi2_interval[1]:.4g})"
    )


def _sentences(figures: list[HeldOut]) -> list[str]:
    said = []
    for one in figures:
        if one.nrms_time is not None and one.nrms_time_start is not None:
            said.append(
                f"record {one.name} {one.time_note}: normalised r.m.s. error in the band "
                f"{percent(one.nrms_time.min())} to {percent(one.nrms_time.max())}, depending on the output "
                f"(start model: {percent(one.nrms_time_start.min())} to "
                f"{percent(one.nrms_time_start.max())})"
            )
        if one.nrms_all_exact is not None:
            said.append(
                f"record {one.name}: residual {percent(one.nrms_all_exact)} of the signal, r.m.s., with the "
                f"values of the rig file taken as exact, and {percent(one.nrms_all)} with them fitted within "
                "their tolerances"
            )
        if one.whiteness is not None:
            said += [f"record {one.name}: {sentence}" for sentence in one.whiteness.sentences]
    return said


def _mode_sentence(modes: tuple[ModeRow, ...]) -> list[str]:
    """The largest difference between model and measured modes."""
    known = [
        (abs(sigma), what, row.frequency_Hz)
        for row in modes
        for what, sigma in (("frequency", row.frequency_sigma), ("damping", row.damping_sigma))
        if np.isfinite(sigma)
    ]
    if not known:
        return []
    sigma, what, mode = max(known)
    return [
        f"model and measured modes differ by at most {sigma:.2g} standard deviations, in the {what} of the mode at "
        f"{mode:.4g} Hz"
    ]
