"""Residual of a model on held-out records: how large it is, in which bands and channels, at which level."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import stats

from avis_ctrl.gap.campaign_spectra import all_silent
from avis_ctrl.gap.power_fractions import power_shares
from avis_ctrl.gap.preparation import Prepared
from avis_ctrl.gap.result import HeatMap, PowerShares, RecordGap, Where
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.prediction_error import PredictionError, prediction_error
from avis_ctrl.identification.spectra import thinned
from avis_ctrl.identification.spectral_block import SpectralBlock


@dataclass(frozen=True)
class ResidualSettings:
    """Settings of the location and size of the residual.

    place_alarm : significance level of a place of the gap, over all places together [1].
    most_places : maximum number of places reported, the largest first.
    bands_per_octave : bands per octave of these places.
    shown_lines : lines of each record from which its residual and the fractions of power are computed: for a figure,
        not for a fit.
    """

    place_alarm: float = 0.01
    most_places: int = 10
    bands_per_octave: int = 2
    shown_lines: int = 1200


SETTINGS = ResidualSettings()


@dataclass(frozen=True, eq=False)
class ModelResidual:
    """Residual of a model on held-out blocks; names of its outputs and inputs."""

    errors: tuple[PredictionError, ...]
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]

    @staticmethod
    def of(model: TableModel, blocks: Sequence[SpectralBlock]) -> ModelResidual:
        """Residual of a model on some blocks."""
        errors = (prediction_error(model, block, derivative=False) for block in blocks)
        return ModelResidual(tuple(errors), model.sensors.names, model.inputs)

    @property
    def chi2_per_dof(self) -> float:
        """Chi-square over degrees of freedom."""
        return sum(e.chi2 for e in self.errors) / sum(e.dof for e in self.errors)

    @property
    def nrmse(self) -> float:
        """Error over y in the band, r.m.s. over channels."""
        return _relative(np.sum([np.sum(np.abs(e.error) ** 2, axis=(0, 2)) for e in self.errors], axis=0), self.errors)

    @property
    def noise_nrmse(self) -> float:
        """The `nrmse` expected from noise alone."""
        return _relative(np.sum([e.noise_share() for e in self.errors], axis=0), self.errors)


def _relative(power: np.ndarray, errors: Sequence[PredictionError]) -> float:
    whole = np.sum([np.sum(np.abs(e.block.Y) ** 2, axis=(0, 2)) for e in errors], axis=0)
    return float(np.sqrt(np.mean(power / whole)))


def edges_of(errors: Sequence[PredictionError]) -> np.ndarray:
    """Band edges [Hz], `bands_per_octave`."""
    low = min(float(e.block.omega[0]) for e in errors) / (2 * np.pi)
    high = max(float(e.block.omega[-1]) for e in errors) / (2 * np.pi)
    count = max(int(np.ceil(SETTINGS.bands_per_octave * np.log2(high / low))), 1)
    return np.geomspace(low, high * (1 + 1e-9), count + 1)


def _banded(e: PredictionError, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By band, over the noise: power (n_bands, n_y) of a record's residual, number of lines (n_bands, 1), and the part
    of the power that is coherent with each input (n_bands, n_y, n_in)."""
    assert e.block.noise is not None
    white, U = e.error[:, :, 0] / np.sqrt(np.real(np.einsum("nkk->nk", e.block.noise[:, 0]))), e.block.U[:, :, 0]
    inside = (np.digitize(e.block.omega / (2 * np.pi), edges) - 1)[:, None] == np.arange(len(edges) - 1)
    along = np.abs(np.einsum("nb,nk,ni->bki", inside, white, np.conj(U), optimize=True)) ** 2
    strength = (inside.T @ np.abs(U) ** 2)[:, None]
    return (
        inside.T @ np.abs(white) ** 2,
        np.sum(inside, axis=0)[:, None],
        np.divide(along, strength, out=np.zeros(along.shape), where=strength > 0),
    )


def places(residual: ModelResidual) -> tuple[Where, ...]:
    """Bands and outputs where the residual exceeds the noise significantly, each with the most coherent input."""
    edges = edges_of(residual.errors)
    power, lines, found = (
        np.sum(parts, axis=0) for parts in zip(*(_banded(e, edges) for e in residual.errors), strict=True)
    )
    dof = min(e.block.dof for e in residual.errors)
    excess, count = np.maximum(power - lines, 0.0), max(np.count_nonzero(lines) * power.shape[1], 1)
    made = []
    for b, (low, high) in enumerate(pairwise(edges.tolist())):
        n = int(lines[b, 0])
        # At most a third of the records is held out: the noise of a band is estimated from at least twice as many
        # lines.
        known = min(dof * max(n / 60, 1), max(dof, 2 * n))
        for k, output in enumerate(residual.outputs if n else ()):
            p = count * float(
                stats.f.sf(power[b, k] / n, 2 * n, 2 * known)
                if np.isfinite(dof)
                else stats.chi2.sf(2 * power[b, k], 2 * n)
            )
            if p < SETTINGS.place_alarm:
                best = int(np.argmax(found[b, k]))
                source = residual.inputs[best] if found[b, k, best] > 0.1 * power[b, k] else ""
                made.append(
                    Where(low, high, source, output, float(excess[b, k] / excess.sum()), float(power[b, k] / n), p)
                )
    return tuple(sorted(made, key=lambda w: -w.share)[: SETTINGS.most_places])


def heat_map(before: ModelResidual, after: ModelResidual) -> HeatMap:
    """Residual power over noise power by band, held-out record and output."""
    edges = edges_of(before.errors)

    def ratios(residual: ModelResidual) -> np.ndarray:
        banded = [_banded(e, edges) for e in residual.errors]
        with np.errstate(invalid="ignore"):  # a band without lines has no ratio
            return np.hstack([power / lines for power, lines, _ in banded])

    columns = tuple(f"{e.block.name}: {output}" for e in before.errors for output in before.outputs)
    return HeatMap(edges, columns, ratios(before), ratios(after))


def every_record(
    prepared: Prepared, before: TableModel, after: TableModel, sensors_rms: Mapping[str, float] | None
) -> tuple[tuple[RecordGap, ...], tuple[PowerShares, ...]]:
    """Residual of the models in each record, including fitted ones, and decomposition of the outputs' power; on
    `shown_lines` of each record."""
    held = {block.name for block in prepared.held_out}
    blocks = [thinned(block, SETTINGS.shown_lines) for block in (*prepared.fitted, *prepared.held_out)]
    headers = {r.header.name: r.header for r in (*prepared.halves.fitted.records, *prepared.halves.held_out.records)}
    last = ModelResidual.of(after, blocks).errors
    first = last if after is before else ModelResidual.of(before, blocks).errors

    def ratio(e: PredictionError) -> float:
        return float(np.sqrt(e.chi2 / e.dof))

    records = []
    for a, b in zip(first, last, strict=True):
        h, name = headers[a.block.name], a.block.name
        kind = f"{h.excitation}, {b.block.kind}"
        records.append(RecordGap(name, h.level_V, h.start_s, name in held, ratio(a), ratio(b), kind))
    shares = power_shares(last, headers, after, all_silent(prepared.halves.fitted, blocks), sensors_rms)
    return tuple(sorted(records, key=lambda one: one.name)), shares
