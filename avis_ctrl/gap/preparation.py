"""Preparation of a campaign for the search: repaired signals, spectra with noise, motion in time, held-out data.

Faults visible in the signals themselves (a converter that clips or is coarse, hum) are detected and removed before any
fit, since no fit of a table can absorb them. A first fit, with every line weighted relative to its response, is
accurate enough to distinguish noise and hum from the response.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.campaign_spectra import Halves, all_silent, blocks_of, divide, with_noise
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.line_response import clear_cache
from avis_ctrl.gap.motion_estimate import motion_of, origin, with_large_motion
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.run import Mapper, Run
from avis_ctrl.gap.settings import GapSettings
from avis_ctrl.gap.signal_effects import SignalFaults, converter_faults, predicted, time_residuals, without_hum
from avis_ctrl.gap.signals.declipping import repair
from avis_ctrl.gap.signals.hum import HumFinding, find_hum, polluted
from avis_ctrl.gap.signals.record_residual import RecordResidual
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.campaign_fit import excited_band, levels_of
from avis_ctrl.identification.likelihood import Data
from avis_ctrl.identification.maximum_likelihood import fit
from avis_ctrl.identification.noise import relative_noise
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import thinned
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.measurement.campaign import Campaign, Record
from avis_ctrl.measurement.gates.sample_clock import no_constant_delay
from avis_ctrl.rigs.rig import Rig

# Second-order terms by Newton-Euler, with sensors fixed to the payload and forces along the earth axes.
BY_PHYSICS = (1.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A prepared campaign.

    campaign : without hum and clipping. fitted, held_out : spectra of all lines, with noise. unmasked : the held-out
        spectra including the lines polluted by hum. noise : a sentence on the source of the noise. nominal : the rig as
        in its file. rough : the first fit. faults : of the signals. clipped : the campaign before the repair of clipped
        samples, None if there are few. run : how the search runs.
    """

    campaign: Campaign
    halves: Halves
    band_Hz: tuple[float, float]
    fitted: tuple[SpectralBlock, ...]
    held_out: tuple[SpectralBlock, ...]
    unmasked: tuple[SpectralBlock, ...]
    noise: str
    nominal: TableModel
    rough: TableModel
    faults: SignalFaults
    clipped: Campaign | None
    run: Run

    @property
    def local_noise(self) -> bool:
        """Whether the noise is that of a local polynomial model of driven records, which includes their distortion."""
        return not all_silent(self.halves.fitted, self.fitted)

    @cached_property
    def fit_data(self) -> Data:
        """Lines of the fitted records for a fit."""
        return self._data(self.fitted)

    @cached_property
    def held_data(self) -> Data:
        """Lines of the held-out records."""
        return self._data(self.held_out)

    def _data(self, blocks: Sequence[SpectralBlock]) -> Data:
        """Some lines of blocks, with the level of the group of records to which each block belongs."""
        records = (*self.halves.fitted.records, *self.halves.held_out.records)
        return Data.of(blocks, levels_of(records), self.run.settings.lines)


def prepare(
    campaign: Campaign, rig: Rig, band_Hz: tuple[float, float] | None, amplifier_corner_Hz: float | None, run: Run
) -> Prepared:
    """Compute spectra with noise from the records.

    Raises
    ------
    InputError : a band without excitation, too few lines, no record that drives an actuator, or noise that cannot be
        estimated.
    """
    settings, progress = run.settings, run.progress
    progress("converters and sample clocks; choice of the held-out records")
    converter = converter_faults(campaign, rig)
    faults = SignalFaults(converter, drifting_delay=no_constant_delay(campaign))
    mended = repair(campaign, rig, None, converter) if campaign.y_unit == "V" and rig.acquisition else None
    campaign = mended.campaign if mended else campaign
    halves = divide(campaign)
    band = band_Hz or excited_band(halves.fitted)
    check_band(halves.fitted, band, settings)
    if amplifier_corner_Hz is not None and not 0 < amplifier_corner_Hz < np.inf:
        raise InputError("expected a frequency above zero", field="amplifier corner", value=amplifier_corner_Hz)
    apart = rig.with_channels_apart() if hasattr(rig, "with_channels_apart") else rig
    base = ResponseModel.of(
        apart, default_parameters(apart), campaign.y_unit, campaign.y_names, campaign.u_names, True, amplifier_corner_Hz
    )
    nominal = TableModel(base, nominal=base)
    progress(f"first fit, {band[0]:.3g} to {band[1]:.3g} Hz; held out: {halves.how}")
    rough = _rough(nominal, halves, band, settings)
    clipped = campaign if mended and max(mended.clipped.values()) > settings.few_clipped else None
    if clipped is not None:
        progress("clipped samples: replaced by the prediction of the model")
        for _ in range(settings.repairs):
            campaign = repair(clipped, rig, predicted(clipped, rough, run.each), converter).campaign
            halves = divide(campaign)
            rough = _rough(rough, halves, band, settings)
    return _ready(campaign, nominal, rough, band, faults, clipped, run)


def mended_with(prepared: Prepared, model: TableModel) -> Prepared:
    """Repair the clipped samples again, with the prediction of a better model."""
    assert prepared.clipped is not None
    expected = predicted(prepared.clipped, model, prepared.run.each)
    campaign = repair(prepared.clipped, model.rig, expected, prepared.faults.converter).campaign
    rough, band = replace(prepared.rough, effects=()), prepared.band_Hz
    return _ready(campaign, prepared.nominal, rough, band, prepared.faults, prepared.clipped, prepared.run)


def with_noise_from(prepared: Prepared, model: TableModel) -> Prepared:
    """Estimate the noise again, from the residual of a better model."""
    groups = [list(prepared.fitted), list(prepared.held_out), list(prepared.unmasked)]
    residual = time_residuals(prepared.campaign, model, prepared.run.each)
    clear_cache()
    (fitted, held_out, unmasked), how = _noise(groups, prepared.halves, residual, prepared.rough, prepared.band_Hz)
    return replace(prepared, fitted=tuple(fitted), held_out=tuple(held_out), unmasked=tuple(unmasked), noise=how)


def with_motion_of(prepared: Prepared, model: TableModel) -> Prepared:
    """Estimate the motion of every record again, with a better model."""
    motion = _motion(prepared.campaign, prepared.halves, model, prepared.run.each)
    return replace(
        prepared, nominal=replace(prepared.nominal, motion=motion), rough=replace(prepared.rough, motion=motion)
    )


def _motion(campaign: Campaign, halves: Halves, model: TableModel, each: Mapper) -> dict[str, RecordMotion]:
    """Motion of every fitted and held-out record, by record name, with its second-order terms."""
    parts = replace(halves.fitted, records=(*halves.fitted.records, *halves.held_out.records))
    motion = with_large_motion(motion_of(parts, model, campaign, each), model)
    clear_cache()
    return motion


def check_band(campaign: Campaign, band: tuple[float, float], settings: GapSettings) -> None:
    """Raise InputError for a band in which the records are not excited, or have too few lines."""
    low, high = excited_band(campaign)
    if band[1] <= low or band[0] >= high:
        raise InputError(
            f"expected a band in which the records are excited, {low:.3g} to {high:.3g} Hz", field="band_Hz", value=band
        )
    for record in campaign.records:
        lines = int((band[1] - band[0]) * record.header.duration_s)
        if lines < settings.fewest_lines:
            raise InputError(
                f"expected a wider band or longer records: {lines} lines of record {record.header.name} "
                f"lie in it, and a fit needs {settings.fewest_lines}",
                field="band_Hz",
                value=band,
            )


def _ready(
    campaign: Campaign,
    nominal: TableModel,
    rough: TableModel,
    band: tuple[float, float],
    faults: SignalFaults,
    clipped: Campaign | None,
    run: Run,
) -> Prepared:
    """Remove hum; compute spectra with noise, and the motion of every record with its second-order terms."""
    settings, progress, each = run.settings, run.progress, run.each
    halves, residual = divide(campaign), time_residuals(campaign, rough, each)
    raw_held = blocks_of(halves.held_out, rough, band)
    hum = find_hum(residual)
    if hum is not None:
        progress(f"hum of {hum.frequency_Hz.value:.5g} Hz removed")
        campaign = without_hum(campaign, hum, residual)
        halves = divide(campaign)
        rough = _rough(rough, halves, band, settings)
        residual = time_residuals(campaign, rough, each)
    fitted = _masked(blocks_of(halves.fitted, rough, band), halves.fitted, hum)
    held_out = _masked(blocks_of(halves.held_out, rough, band), halves.held_out, hum)
    progress("noise; motion of the table in every record")
    (fitted, held_out, unmasked), how = _noise((fitted, held_out, raw_held), halves, residual, rough, band)
    motion = _motion(campaign, halves, rough, each)
    return Prepared(
        campaign,
        halves,
        band,
        tuple(fitted),
        tuple(held_out),
        tuple(unmasked),
        how,
        replace(nominal, motion=motion),
        with_second_order(replace(rough, motion=motion)),
        replace(faults, hum=hum),
        clipped,
        run,
    )


def with_second_order(model: TableModel) -> TableModel:
    """The model with the second-order terms of its rotations."""
    return model.with_effect(active(LargeMotion(), model, "payload", BY_PHYSICS))


def _noise(
    groups: Sequence[list[SpectralBlock]],
    halves: Halves,
    residual: tuple[RecordResidual, ...],
    model: TableModel,
    band: tuple[float, float],
) -> tuple[list[list[SpectralBlock]], str]:
    """Groups of blocks with the noise of the fitted records, from the residual of a model in time; and a sentence."""
    of, records = {one.header.name: one for one in residual}, []
    for source in halves.fitted.records:
        whole, start, stop = origin(source)
        record = source.load()
        records.append(Record(record.header, record.u, of[whole.header.name].e[start:stop], record.floor))
    every = [block for group in groups for block in group]
    made, how = with_noise(every, halves.fitted, replace(halves.fitted, records=tuple(records)), model, band)
    ends = np.cumsum([len(group) for group in groups])
    return [made[end - len(group) : end] for group, end in zip(groups, ends, strict=True)], how


def _rough(model: TableModel, halves: Halves, band: tuple[float, float], settings: GapSettings) -> TableModel:
    """A first fit, each line weighted relative to its response."""
    blocks = [thinned(block, settings.lines) for block in relative_noise(blocks_of(halves.fitted, model, band))]
    return replace(model, base=fit(model.base, blocks).model)


def _masked(blocks: Sequence[SpectralBlock], campaign: Campaign, hum: HumFinding | None) -> list[SpectralBlock]:
    """Blocks without the lines polluted by hum."""
    if hum is None:
        return list(blocks)
    found = []
    for block in blocks:
        h = campaign.named(block.name).header
        spoiled = polluted(hum, h.samples, h.sample_rate_Hz)
        lines = np.rint(block.omega * h.samples / (2 * np.pi * h.sample_rate_Hz)).astype(int)
        found.append(block.lines(np.flatnonzero(~spoiled[lines])))
    return found
