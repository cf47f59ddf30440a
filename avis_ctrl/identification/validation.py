"""An identified rig against data that no fit has seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.identification.campaign_fit import LONGEST_PIECE, CampaignFit, Portion, measured_noise
from avis_ctrl.identification.noise import noise_from_residuals
from avis_ctrl.identification.prediction import predict
from avis_ctrl.identification.prediction_error import PredictionError, interval, prediction_error
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import SpectralBlock, record_block, response_block
from avis_ctrl.measurement.campaign import Campaign, Record, RecordSource
from avis_ctrl.measurement.frequency_response import FrequencyResponse

# Level of the intervals.
LEVEL = 0.95


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Figures of one record (or piece of a long one, or response) that no fit has seen.

    Attributes
    ----------
    name : of the record. lines : in the band. noise : which noise the error is held against, in words.
    chi2_per_dof, chi2_interval : with where it lies at 95 % if only noise and the uncertainty of the parameters are
        left. chi2_start : of the start model. chi2_local : held against the noise of the local polynomial model of the
        fitted records, NaN where there is none.
    output_chi2_per_dof, output_chi2_interval : (n_y,) and (n_y, 2), each output by itself.
    nrms, nrms_start : (n_y,) r.m.s. error in the band over r.m.s. output in the band, transient of the ends taken out.
    nrms_floor : (n_y,) what noise alone would leave.
    nrms_all, nrms_all_start, nrms_all_floor : the same of all outputs together.
    nrms_time, nrms_time_start : (n_y,) of the prediction from rest in time, its error and the output filtered to the
        band; None where the record does not start at rest. nrms_time_whole : (n_y,) without the filter.
    time_note : why there is no prediction in time, or what it covers.
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
    nrms_time: np.ndarray | None = None
    nrms_time_start: np.ndarray | None = None
    nrms_time_whole: np.ndarray | None = None
    time_note: str = ""

    @property
    def consistent(self) -> bool:
        """Whether chi-square is inside its interval."""
        return self.chi2_interval[0] <= self.chi2_per_dof <= self.chi2_interval[1]


@dataclass(frozen=True, eq=False)
class Validation:
    """Report-ready figures of an identified model on held-out data.

    outputs, band_Hz : of all figures. held_out : one a record. verdict : one sentence with the numbers. notes :
    sentences on what was used and what could not be computed.
    """

    outputs: tuple[str, ...]
    band_Hz: tuple[float, float]
    held_out: tuple[HeldOut, ...]
    verdict: str
    notes: tuple[str, ...]


def validate(found: CampaignFit, fitted: Campaign | FrequencyResponse, held_out: Campaign | FrequencyResponse
             ) -> Validation:
    """Prediction errors, their whiteness, responses and modes of the fitted model on data that no fit has seen.

    Raises
    ------
    InputError : held-out data of another kind than the fitted ones, without lines in the band, or without anything
        that moves.
    """
    notes: list[str] = []
    if isinstance(fitted, FrequencyResponse) != isinstance(held_out, FrequencyResponse):
        raise InputError("expected held-out data of the same kind as the fitted ones", field="held out",
                         value=type(held_out).__name__)
    figures = []
    for block, record in _blocks(found, held_out):
        figures.append(_figures(found, fitted, block, record, notes))
    model = found.fit.model
    return Validation(model.sensors.names, found.band_Hz, tuple(figures), _verdict(figures), tuple(notes))


def _blocks(found: CampaignFit, held_out: Campaign | FrequencyResponse
            ) -> list[tuple[SpectralBlock, RecordSource | None]]:
    """Spectra of what is held out, in pieces where it is long, with the record where it begins at its start."""
    model = found.fit.model
    if isinstance(held_out, FrequencyResponse):
        return [(response_block(held_out.between(*found.band_Hz), model, "held-out lines"), None)]
    blocks: list[tuple[SpectralBlock, RecordSource | None]] = []
    for record in held_out.records:
        for k, piece in enumerate(record.pieces(max(LONGEST_PIECE, record.header.period_samples or 0))):
            block = record_block(piece, model, found.band_Hz)
            if np.any(block.U):
                whole = k == 0 and not (isinstance(record, Portion) and record.start > 0)
                blocks.append((block, piece if whole else None))
    if not blocks:
        raise InputError("expected a record that drives an actuator, or one with the floor measured", field="held out")
    return blocks


def _with_noise(found: CampaignFit, fitted: Campaign | FrequencyResponse, block: SpectralBlock
                ) -> tuple[SpectralBlock, float, str]:
    """The block with the noise of the fitted data, real numbers that this was estimated from, and words on it."""
    if isinstance(fitted, FrequencyResponse):
        near = response_block(fitted.between(*found.band_Hz), found.fit.model)
        assert near.noise is not None
        at = np.clip(np.searchsorted((near.omega[1:] + near.omega[:-1]) / 2, block.omega), 0, len(near.omega) - 1)
        return (block.with_noise(near.noise[at], near.dof), np.inf,
                "covariance of the nearest fitted line, as estimated with the responses")
    residuals = found.fit.residuals
    kinds = {one.block.kind for one in residuals}
    if block.kind not in kinds:
        raise InputError(f"expected records of the kind that was fitted: {', '.join(sorted(kinds))}",
                         field=f"held-out record {block.name}", value=block.kind)
    noisy = noise_from_residuals(residuals, [block])[0]
    pool = sum(one.block.numbers for one in residuals if one.block.kind == block.kind)
    # The fit bent the model to its own residuals: its free numbers are missing in them.
    share = found.fit.dof / sum(one.block.numbers for one in residuals)
    assert noisy.noise is not None
    return (noisy.with_noise(noisy.noise / share, noisy.dof), pool * share,
            f"covariance of the fit's residuals in the fitted records ({block.kind}), {noisy.dof:.0f} degrees of "
            "freedom a line; it holds for all lines, resonances included, where a local model is biased")


def _figures(found: CampaignFit, fitted: Campaign | FrequencyResponse, raw: SpectralBlock, record: RecordSource | None,
             notes: list[str]) -> HeldOut:
    block, noise_dof, words = _with_noise(found, fitted, raw)
    model = found.fit.model
    error, before = prediction_error(model, block), prediction_error(found.start, block, derivative=False)
    expected = error.expected(found.fit.information.covariance) / error.dof
    power = np.sum(np.abs(block.Y) ** 2, axis=(0, 2))
    if not np.all(power > 0):
        raise InputError("expected outputs that move", field=f"held-out record {block.name}", value=power.tolist())
    of_output = [interval(expected, dof, noise_dof / len(power), LEVEL) for dof in error.output_dof]
    floor = error.noise_share()
    in_time = _in_time(found, record, notes)
    return HeldOut(
        block.name, len(block.omega), words, error.chi2 / error.dof, interval(expected, error.dof, noise_dof, LEVEL),
        before.chi2 / before.dof, _local_chi2(found, fitted, raw, notes), error.output_chi2 / error.output_dof,
        np.array(of_output), _root(error.error, power), _root(before.error, power), np.sqrt(floor / power),
        _root_all(error), _root_all(before), float(np.sqrt(floor.sum() / power.sum())), *in_time)


def _root(error: np.ndarray, power: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sum(np.abs(error) ** 2, axis=(0, 2)) / power)


def _root_all(error: PredictionError) -> float:
    return float(np.linalg.norm(error.error) / np.linalg.norm(error.block.Y))


def _local_chi2(found: CampaignFit, fitted: Campaign | FrequencyResponse, raw: SpectralBlock, notes: list[str]
                ) -> float:
    """chi-square per degree of freedom with the noise of the local polynomial model."""
    if isinstance(fitted, FrequencyResponse):
        return float("nan")
    try:
        error = prediction_error(found.fit.model, measured_noise(fitted, raw, found.band_Hz), derivative=False)
    except AvisError as failed:
        notes.append(f"record {raw.name}: no noise of a local polynomial model ({failed})")
        return float("nan")
    return error.chi2 / error.dof


def _in_time(found: CampaignFit, record: RecordSource | None, notes: list[str]
             ) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None, str]:
    """n.r.m.s. of the prediction in time: in the band, of the start model, and without a filter."""
    if record is None:
        return None, None, None, "no prediction in time: the data do not start at rest, or are responses"
    whole = record.load()
    after, unfiltered = _time_nrms(found.fit.model, whole, found.band_Hz)
    before, _ = _time_nrms(found.start, whole, found.band_Hz)
    return after, before, unfiltered, f"predicted from rest, {whole.header.duration_s:.4g} s"


def _time_nrms(model: ResponseModel, record: Record, band_Hz: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """(n_y,) in the band, and of the whole signal without its mean."""
    y = record.y[:, [record.header.y_names.index(name) for name in model.sensors.names]]
    e = y - predict(model, record)
    return (np.sqrt(_band_power(e, record.header.sample_rate_Hz, band_Hz)
                    / _band_power(y, record.header.sample_rate_Hz, band_Hz)), np.std(e, axis=0) / np.std(y, axis=0))


def _band_power(x: np.ndarray, rate: float, band_Hz: tuple[float, float]) -> np.ndarray:
    """(n_y,) mean square of the part of x inside a band, by a filter without phase in time."""
    spectrum, f = np.fft.rfft(x - x.mean(0), axis=0), np.fft.rfftfreq(len(x), 1 / rate)
    spectrum[(f < band_Hz[0]) | (f > band_Hz[1])] = 0
    return np.mean(np.fft.irfft(spectrum, len(x), axis=0) ** 2, axis=0)


def _verdict(figures: list[HeldOut]) -> str:
    worst = max(figures, key=lambda one: one.chi2_per_dof / one.chi2_interval[1])
    return (f"the identified model leaves {_percent(worst.nrms_all)} on held-out record {worst.name} where noise alone "
            f"leaves {_percent(worst.nrms_all_floor)} and the start model left {_percent(worst.nrms_all_start)}; "
            f"chi-square per degree of freedom {worst.chi2_per_dof:.4g} ({worst.chi2_interval[0]:.4g} to "
            f"{worst.chi2_interval[1]:.4g} expected)")


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
