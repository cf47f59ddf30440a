"""Second-order terms of large rotations in the spectra of records, for a fit whose model is linear in frequency.

They are the difference between time-domain predictions with and without them, at a model's present parameters: small,
and hardly affected by the remaining changes of a fit. A fit subtracts them from the records and recomputes them where
it ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft

from avis_ctrl.identification.large_motion import Turning
from avis_ctrl.identification.maximum_likelihood import added_terms
from avis_ctrl.identification.predictor import Predictor, model_inputs
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.measurement.campaign import Campaign, Portion, RecordSource, ranges


@dataclass(frozen=True)
class SecondOrderSettings:
    """piece : samples processed at once [1], to limit the memory: 1 MB a channel.
    odds : odds to one that the records must give against the model's own turning [1]: a confidence of 95 %.
    """

    piece: int = 1 << 17
    odds: float = 19.0


SETTINGS = SecondOrderSettings()


def terms(
    campaign: Campaign, blocks: Sequence[SpectralBlock], model: ResponseModel, turnings: Sequence[Turning] | None = None
) -> list[np.ndarray]:
    """(k, n, n_y, 1) for each block: the second-order terms of its record, for each of k turnings.

    blocks : of the campaign's records, or of pieces of them. turnings : by default only the model's own.
    """
    ways = [model.turning] if turnings is None else list(turnings)
    found: list[np.ndarray] = [np.zeros(0)] * len(blocks)
    for record in campaign.records:
        own = sorted(
            (k for k, block in enumerate(blocks) if block.name == record.header.name), key=lambda k: blocks[k].start_s
        )
        if own:
            models = [replace(model, turning=way) for way in ways]
            for k, spectra in zip(own, _of_record(record, [blocks[k] for k in own], models), strict=True):
                found[k] = spectra
    return found


def _of_record(
    record: RecordSource, blocks: Sequence[SpectralBlock], models: Sequence[ResponseModel]
) -> list[np.ndarray]:
    whole = record.whole if isinstance(record, Portion) else record
    fs, at, found = whole.header.sample_rate_Hz, 0, []
    predictors = [Predictor(models[0]), *(Predictor(one, large_motion=True) for one in models)]
    for block in blocks:
        start = round((block.start_s - whole.header.start_s) * fs)
        # The inputs between two pieces move the table, too.
        for first, last in ranges(start - at, SETTINGS.piece) if start - at > 1 else ():
            _read(whole, at + first, at + last, predictors)
        pieces = ranges(block.samples, SETTINGS.piece)
        parts = [_read(whole, start + first, start + last, predictors) for first, last in pieces]
        at = start + block.samples
        y = np.concatenate(parts, axis=1)
        lines = np.rint(block.omega * block.samples / (2 * np.pi * fs)).astype(int)
        spectra = scipy.fft.rfft(y - y.mean(axis=1, keepdims=True), axis=1)[:, lines] / np.sqrt(block.samples)
        found.append(spectra[..., None])
    return found


def _read(whole: RecordSource, start: int, stop: int, predictors: Sequence[Predictor]) -> np.ndarray:
    """(k, samples, n_y) output of each predictor minus that of the first, which is linear."""
    u, floor = model_inputs(predictors[0].model, whole.load(start, stop))
    linear, *others = (one.read(u, floor) for one in predictors)
    return np.array([y - linear for y in others])


def without(blocks: Sequence[SpectralBlock], of: Sequence[np.ndarray]) -> list[SpectralBlock]:
    """The blocks with their terms (n, n_y, 1) subtracted."""
    return [replace(block, Y=block.Y - one) for block, one in zip(blocks, of, strict=True)]


def chosen_turning(
    campaign: Campaign, blocks: Sequence[SpectralBlock], model: ResponseModel
) -> tuple[Turning, list[np.ndarray]]:
    """What turns with the payload according to blocks with noise, and the corresponding terms (n, n_y, 1) of each
    block.

    The model's own turning is replaced only if the records favour another by `odds` to 1.
    """
    ways = (Turning(0.0, 0.0), Turning(1.0, 0.0), Turning(0.0, 1.0))
    parts = terms(campaign, blocks, model, ways)
    # The terms are linear in both fractions, to the order considered.
    columns = [np.stack([one[0], one[1] - one[0], one[2] - one[0]]) for one in parts]
    H, g = added_terms(model, blocks, columns)

    def chi2(way: Turning) -> float:
        share = np.array([1.0, *way])
        return float(share @ H @ share - 2 * g @ share)

    best = min((Turning(a, b) for a in (0.0, 1.0) for b in (0.0, 1.0)), key=chi2)
    if chi2(model.turning) - chi2(best) < 2 * np.log(SETTINGS.odds):
        best = model.turning
    return best, [np.tensordot(np.array([1.0, *best]), one, axes=1) for one in columns]
