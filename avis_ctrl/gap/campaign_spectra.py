"""The campaign as used by `gap`: fitted and held-out records, and spectra with measured noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.campaign_fit import (
    divided,
    drive_power,
    driven_inputs,
    excites_as_well,
    measured_noise,
    of_one_level,
)
from avis_ctrl.identification.maximum_likelihood import Residual
from avis_ctrl.identification.noise import noise_from_residuals
from avis_ctrl.identification.prediction_error import prediction_error
from avis_ctrl.identification.spectra import record_block
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.measurement.campaign import Campaign, Record, RecordSource
from avis_ctrl.summary import joined


@dataclass(frozen=True)
class SilentLineSettings:
    """Settings of the lines on which the drives are silent.

    bands_per_octave : bands per octave in which these lines are weighted by their residual.
    weightings : number of times these weights are computed, starting from weights that are equal over frequency.
    settled : minimum number of periods of a record for its first period to be dropped as transient.
    rest : minimum length of the records at rest, over that of the longest driven record, for the noise to be measured
        at rest alone [1]: a shorter one has too few lines to resolve the modes.
    """

    bands_per_octave: int = 2
    weightings: int = 4
    settled: int = 3
    rest: float = 0.5


SETTINGS = SilentLineSettings()


@dataclass(frozen=True, eq=False)
class Halves:
    """Fitted and held-out records (or parts of records), and a sentence on the choice."""

    fitted: Campaign
    held_out: Campaign
    how: str


def divide(campaign: Campaign) -> Halves:
    """Hold out records if another record of the same level and kind is fitted; otherwise the last third of each record.

    The highest level is held out first, then the lowest: effects that depend on amplitude show there. At most a third
    of the records is held out.

    Raises
    ------
    InputError : no record drives an actuator.
    """
    driven = [record for record in campaign.records if driven_inputs(record)]
    if not driven:
        raise InputError("expected records that drive the actuators", field="records")
    groups = of_one_level(driven, lambda record: (record.header.excitation, record.header.level_V))
    groups.sort(key=lambda group: -group[0].header.level_V)
    several = [group for group in groups if len(group) > 1]
    order = several[:1] + several[:0:-1]
    chosen = [group[-1].header.name for group in order][: max(len(driven) // 3, 1)]
    power = {record.header.name: drive_power(record) for record in driven}
    others = np.sum([value for name, value in power.items() if name not in chosen], axis=0)
    if chosen and len(driven) - len(chosen) >= 2 and all(excites_as_well(others, power[name]) for name in chosen):
        rest = tuple(record.header.name for record in campaign.records if record.header.name not in chosen)
        return Halves(
            campaign.only(rest),
            campaign.only(tuple(sorted(chosen))),
            f"record{'s' * (len(chosen) > 1)} {joined(sorted(chosen))} (for each of them, another record of the same "
            "level is fitted)",
        )
    parts = [_parted(record) for record in driven]
    quiet = tuple(record for record in campaign.records if record not in driven)
    return Halves(
        replace(campaign, records=(*(first for first, _ in parts), *quiet)),
        replace(campaign, records=tuple(last for _, last in parts)),
        "the last third of every record, because no whole record can be spared",
    )


def _parted(record: RecordSource) -> tuple[RecordSource, RecordSource]:
    first, last = divided(record)
    last.header = replace(last.header, name=f"{record.header.name} (end)")
    return first, last


def blocks_of(campaign: Campaign, model: TableModel, band_Hz: tuple[float, float]) -> list[SpectralBlock]:
    """Spectra of every record that drives an actuator or has its floor measured."""
    found = [record_block(record.load(), model.base, band_Hz) for record in campaign.records]
    return [block for block in found if np.any(block.U)]


def with_noise(
    blocks: Sequence[SpectralBlock],
    campaign: Campaign,
    residual: Campaign,
    model: TableModel,
    band_Hz: tuple[float, float],
) -> tuple[list[SpectralBlock], str]:
    """The blocks with noise that is not affected by errors of the modelled response to the drives, and a sentence.

    The noise is measured where u is silent: in records at rest or, without them, on the lines between the harmonics of
    periodic records after their first period. If there are none, it is the residual of a local polynomial model
    (Schoukens, Vandersteen, Barbe, Pintelon 2009) of `residual`, the campaign minus the model's prediction. The local
    model absorbs what is missing from the modelled response to the drives; this error is smooth where the response
    itself is sharp.

    Raises
    ------
    InputError : the noise cannot be estimated from the records.
    """
    rest, between = _silent(campaign, model, band_Hz)
    quiet = [*rest, *between]
    kinds = {one.block.kind for one in quiet}
    known: dict[tuple[str, bytes], SpectralBlock] = {}
    made = []
    for block in blocks:
        key = (block.kind, block.omega.tobytes())
        if key not in known:
            known[key] = (
                noise_from_residuals(quiet, [block], model=model)[0]
                if block.kind in kinds
                else _local(residual, block, band_Hz)
            )
        like = known[key]
        assert like.noise is not None
        made.append(block.with_noise(like.noise, like.dof))
    dof, better = f"{made[0].dof:.0f} degrees of freedom per line", "; a record at rest would give a better estimate"
    if kinds:
        places = (("in records at rest", rest), ("between the harmonics of periodic records", between))
        where = " and ".join(words for words, found in places if found)
        return made, f"noise measured {where}: {dof}{'' if rest else better}"
    return made, f"noise estimated with a local polynomial model: {dof}{better}"


def all_silent(campaign: Campaign, blocks: Sequence[SpectralBlock]) -> bool:
    """Whether `with_noise` finds lines without drive for every kind of block."""
    kinds = {
        "floor measured" if r.header.floor_names else "floor not measured"
        for r in campaign.records
        if _is_periodic(r) or not driven_inputs(r)
    }
    return {block.kind for block in blocks} <= kinds


def _local(campaign: Campaign, block: SpectralBlock, band_Hz: tuple[float, float]) -> SpectralBlock:
    try:
        return measured_noise([block], campaign, band_Hz)[0]
    except AvisError:
        pass
    # Where the floor does not move in part of the band, floor and drives cannot be separated there. The response to the
    # floor is already subtracted.
    records = []
    for source in campaign.records:
        record = source.load()
        records.append(Record(replace(record.header, floor_names=()), record.u, record.y, None))
    try:
        still = replace(block, kind="floor not measured")
        found = measured_noise([still], replace(campaign, records=tuple(records)), band_Hz)[0]
        return replace(found, kind=block.kind)
    except AvisError as error:
        raise InputError(
            f"expected records from which the noise can be estimated ({error})", field=f"record {block.name}"
        ) from None


def _silent(
    campaign: Campaign, model: TableModel, band_Hz: tuple[float, float]
) -> tuple[list[Residual], list[Residual]]:
    """Residuals of the model on lines without drive: at rest; and, if these records are short, between harmonics."""
    driven = [(record, bool(driven_inputs(record))) for record in campaign.records]
    longest = max((record.header.duration_s for record, moves in driven if moves), default=0.0)
    at_rest, between = [], []
    for floor in (False, True):
        alike = [(record, moves) for record, moves in driven if bool(record.header.floor_names) == floor]
        rest = [record for record, moves in alike if not moves]
        at_rest += [_residual(record_block(record.load(), model.base, band_Hz), model) for record in rest]
        if sum(record.header.duration_s for record in rest) < SETTINGS.rest * longest:
            periodic = (record for record, moves in alike if moves and _is_periodic(record))
            between += [_between_harmonics(record, model, band_Hz) for record in periodic]
    return at_rest, between


def _is_periodic(record: RecordSource) -> bool:
    return bool(record.header.period_samples) and record.header.periods >= SETTINGS.settled


def _between_harmonics(record: RecordSource, model: TableModel, band_Hz: tuple[float, float]) -> Residual:
    """Residual on the lines between the harmonics of a periodic record, after the first period, which contains most of
    the starting transient. What a model error leaves of the rest counts as noise."""
    h = record.header
    period = h.period_samples or 0
    segment = record.load(period, h.periods * period)
    block = record_block(segment, model.base, band_Hz)
    lines = np.rint(block.omega * segment.header.samples / (2 * np.pi * h.sample_rate_Hz)).astype(int)
    block = block.lines(np.flatnonzero(lines % (h.periods - 1)))
    block.U[:, : len(model.actuators)] = 0
    return _residual(block, model)


def _residual(block: SpectralBlock, model: TableModel) -> Residual:
    # The transient of the record's ends is estimated by weighted least squares. With equal weights its error at all
    # frequencies would be as large as the largest noise.
    power = np.broadcast_to(np.mean(np.abs(block.Y) ** 2, axis=(0, 2)), block.Y.shape[:2])
    octave = np.floor(SETTINGS.bands_per_octave * np.log2(block.omega / block.omega[0])).astype(int)
    lines = np.maximum(np.bincount(octave), 1)
    for _ in range(SETTINGS.weightings):
        weights = power[:, :, None] * np.eye(power.shape[1])
        residual = prediction_error(model, block.with_noise(weights.astype(complex)), derivative=False)
        found = np.mean(np.abs(residual.error) ** 2, axis=2)
        power = np.stack([(np.bincount(octave, one) / lines)[octave] for one in found.T], axis=1)
    return Residual(block, residual.error, residual.error, residual.white)
