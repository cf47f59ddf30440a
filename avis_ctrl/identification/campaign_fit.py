"""Maximum-likelihood fit of a campaign: what to fit, what to hold out, which band, which weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
import scipy.fft

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.identification.fit_settings import SETTINGS as FIT
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.maximum_likelihood import LikelihoodFit, Prior, fit
from avis_ctrl.identification.noise import noise_from_residuals, relative_noise
from avis_ctrl.identification.priors import Tolerance
from avis_ctrl.identification.response import MOMENTS, ResponseModel
from avis_ctrl.identification.second_order import chosen_turning, terms, without
from avis_ctrl.identification.spectra import record_block, response_block, thinned
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.tolerance_fit import as_likelihood_fit, begin, end
from avis_ctrl.measurement.campaign import Campaign, Portion, Record, RecordSource
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.local_polynomial import noise_covariance
from avis_ctrl.rigs.instruments import Tolerances
from avis_ctrl.rigs.isolator_table import IsolatorTable
from avis_ctrl.rigs.rig import Rig

Progress = Callable[[str], None]
Item = TypeVar("Item")


@dataclass(frozen=True)
class CampaignFitSettings:
    """longest_piece : samples; longer records are cut into pieces of this length, because the spectrum of the whole
    would fill the memory and its finer lines add nothing.
    most_lines : maximum number of spectral lines fitted, all records together: their derivatives with respect to some
        thirty parameters fit into memory (0.2 GB), and a rig of a few dozen parameters needs no more. If there are
        more, lines without drive are omitted first, and a random selection of the rest is fitted; averaging them into
        frequency responses would flatten the resonances.
    silent_line : ratio of the drive's amplitude at a line to that at the record's strongest line, below which the line
        counts as silent: -60 dB, a millionth of the power.
    least_excited : minimum ratio of the power in the other records to that in a record, for each combination of drives
        that it excites and as far as the others can separate it, if the record is to be held out: at a tenth of its
        amplitude they still determine the response to that combination.
    quiet_band_Hz : band of the fit if no input shows what band is excited: the band of the floor velocity in a rig
        file.
    tail : fraction of an input's power that may lie below the band of the fit, and above it; the noise of a generator
        has a smaller fraction.
    floor_tail : the same for a measured floor: up to one or two per cent of its power is its sensor's noise, at all
        frequencies.
    same_level : ratio up to which levels count as one [1]: 2 dB, less than a step between levels that are chosen to
        differ.
    """

    longest_piece: int = 1 << 18
    most_lines: int = 60_000
    silent_line: float = 1e-3
    least_excited: float = 0.01
    quiet_band_Hz: tuple[float, float] = (0.5, 60.0)
    tail: float = 5e-4
    floor_tail: float = 0.02
    same_level: float = 1.25


SETTINGS = CampaignFitSettings()


class Split(NamedTuple):
    """Fitted records, held-out records that no fit uses, and a sentence on how they were chosen."""

    fitted: Campaign
    held_out: Campaign
    how: str


def split_campaign(campaign: Campaign, hold_out: Sequence[str] | None = None) -> Split:
    """Hold out whole records, or the last third of each if the remaining records would not excite everything.

    Parameters
    ----------
    hold_out : names of records; by default the last driven record whose inputs are all driven by other records too.

    Raises
    ------
    InputError : unknown names, no records remaining for the fit, records too short to divide.
    """
    names = [record.header.name for record in campaign.records]
    if hold_out is not None:
        for name in hold_out:
            campaign.named(name)
        rest = tuple(name for name in names if name not in hold_out)
        if not rest or not hold_out:
            raise InputError(
                f"expected some of the records {', '.join(names)}, but not all", field="hold out", value=list(hold_out)
            )
        return Split(
            campaign.only(rest), campaign.only(tuple(hold_out)), f"records {', '.join(hold_out)} held out, as specified"
        )
    active = {record.header.name: power for record in campaign.records if np.any(power := drive_power(record))}
    for name in reversed(active):
        others = [power for other, power in active.items() if other != name]
        # The response to several inputs can seldom be separated with one record: at least two must remain.
        if len(others) >= 2 and excites_as_well(np.sum(others, axis=0), active[name]):
            rest = tuple(other for other in names if other != name)
            return Split(campaign.only(rest), campaign.only((name,)), f"record {name} held out")
    parts = [divided(record) for record in campaign.records]
    return Split(
        replace(campaign, records=tuple(first for first, _ in parts)),
        replace(campaign, records=tuple(last for _, last in parts)),
        "the last third of every record held out, because too few records excite every input",
    )


def of_one_level(items: Sequence[Item], kind_and_level: Callable[[Item], tuple[str, float]]) -> list[list[Item]]:
    """Group items of one kind and level, within `same_level` of the lowest in a group; sorted by kind, then level.

    kind_and_level : function that returns kind and level of an item.
    """
    groups: list[list[Item]] = []
    for item in sorted(items, key=kind_and_level):
        kind, level = kind_and_level(item)
        first = kind_and_level(groups[-1][0]) if groups else None
        if first and kind == first[0] and level <= SETTINGS.same_level * first[1]:
            groups[-1].append(item)
        else:
            groups.append([item])
    return groups


def levels_of(records: Sequence[RecordSource]) -> dict[str, float]:
    """Level [V] by record: the lowest level of the group that counts as one level."""
    groups = of_one_level([record.header for record in records], lambda header: ("", header.level_V))
    return {header.name: group[0].level_V for group in groups for header in group}


def drive_power(record: RecordSource) -> np.ndarray:
    """(n_u, n_u) sum of u u^T over the first quarter of a million samples."""
    u = _beginning(record).u
    return u.T @ u


def _beginning(record: RecordSource) -> Record:
    return record.load(0, min(record.header.samples, SETTINGS.longest_piece))


def excites_as_well(others: np.ndarray, one: np.ndarray) -> bool:
    """Whether the other records excite every combination of drives that one record excites, with power `one` (n_u,
    n_u).

    Records along the logical axes drive the same motors in different combinations: without the record that rotates the
    table, nothing is known about that rotation. Least squares from the others estimates the response to d, a
    combination, with the variance d^T inv(others) d; from the record itself with d^T inv(one) d. The worst ratio
    decides.
    """
    power, V = np.linalg.eigh(one)
    excited = power > SETTINGS.silent_line**2 * power[-1]
    root = V[:, excited] * np.sqrt(power[excited])
    # A combination that the others do not excite at all gets a large, not an infinite variance.
    rest = others + SETTINGS.silent_line**2 * np.linalg.eigvalsh(others)[-1] * np.eye(len(others))
    ratio = np.linalg.eigvalsh(root.T @ np.linalg.solve(rest, root))[-1]
    return bool(ratio * SETTINGS.least_excited < 1)


def driven_inputs(record: RecordSource) -> set[str]:
    """Inputs that are not zero in the first quarter of a million samples."""
    powers = np.diag(drive_power(record))
    return {name for name, power in zip(record.header.u_names, powers, strict=True) if power}


def divided(record: RecordSource) -> tuple[Portion, Portion]:
    """The first two thirds of a record (whole periods of a periodic one), and the last third.

    Raises InputError for fewer than 300 samples.
    """
    h = record.header
    if h.samples < 300:
        raise InputError(
            "expected at least 300 samples, of which a third is held out", value=h.samples, field=f"record {h.name}"
        )
    at = 2 * h.samples // 3
    if h.period_samples and h.periods >= 2:
        at = max(round(2 * h.periods / 3), 1) * h.period_samples
    return Portion(record, 0, at), Portion(record, at, h.samples)


def excited_band(campaign: Campaign) -> tuple[float, float]:
    """Lowest and highest frequency [Hz] that some record drives, limited to 0.2 Hz and a quarter of the sample rate.

    The band of each record contains its input's power except for a small fraction at either end: `tail` of the
    settings, `floor_tail` if only the measured floor moves.
    """
    ends: list[tuple[float, float]] = []
    for record in campaign.records:
        piece = _beginning(record)
        drive = piece.u if np.any(piece.u) else piece.floor
        if drive is None or not np.any(drive) or record.header.excitation == "rest":
            continue
        power = np.cumsum(np.sum(np.abs(scipy.fft.rfft(drive - drive.mean(0), axis=0)) ** 2, axis=1))
        frequency = scipy.fft.rfftfreq(piece.header.samples, 1 / piece.header.sample_rate_Hz)
        tail = SETTINGS.tail if drive is piece.u else SETTINGS.floor_tail
        low, high = np.searchsorted(power, np.array([tail, 1 - tail]) * power[-1])
        ends.append((float(frequency[low]), float(frequency[high])))
    low, high = (min(e[0] for e in ends), max(e[1] for e in ends)) if ends else SETTINGS.quiet_band_Hz
    return max(low, 0.2), min(high, campaign.sample_rate_Hz / 4)


def _fewer(block: SpectralBlock, share: float, crowded: bool, rng: np.random.Generator) -> SpectralBlock:
    """A random fraction of a block's driven lines if a campaign is `crowded`; otherwise the block unchanged."""
    power = np.sum(np.abs(block.U) ** 2, axis=(1, 2))
    if not crowded or not np.any(power):
        return block
    driven = np.flatnonzero(power > SETTINGS.silent_line**2 * power.max())
    count = max(round(share * len(driven)), min(len(driven), 10))
    return block.lines(np.sort(rng.choice(driven, min(count, len(driven)), replace=False)))


def campaign_blocks(
    campaign: Campaign, model: ResponseModel, band_Hz: tuple[float, float]
) -> tuple[list[SpectralBlock], list[str]]:
    """Spectral blocks of all records, long ones in pieces, and sentences on what was omitted."""
    width = band_Hz[1] - band_Hz[0]
    lines = [record.header.duration_s * width for record in campaign.records]
    driven = [n / max(record.header.periods, 1) for n, record in zip(lines, campaign.records, strict=True)]
    crowded, share = sum(lines) > SETTINGS.most_lines, min(SETTINGS.most_lines / max(sum(driven), 1.0), 1.0)
    blocks, rng = [], np.random.default_rng(0)
    for record in campaign.records:
        for piece in record.pieces(max(SETTINGS.longest_piece, record.header.period_samples or 0)):
            if piece.header.duration_s * width > 10:
                blocks.append(_fewer(record_block(piece, model, band_Hz), share, crowded, rng))
    if not blocks:
        raise InputError("expected a band with more than 10 lines of a record", field="band_Hz", value=band_Hz)
    # A record without input or measured floor contains no information on the response.
    useful = [block for block in blocks if np.any(block.U)]
    if not useful:
        raise InputError("expected a record that drives an actuator, or one with the floor measured", field="records")
    quiet = sorted({b.name for b in blocks} - {b.name for b in useful})
    said = (
        [f"records at rest without measured floor motion ({', '.join(quiet)}) are used for the noise only"]
        if quiet
        else []
    )
    if crowded:
        chosen = f", of which {100 * share:.3g} % were drawn at random" if share < 1 else ""
        said.append(
            f"{sum(len(block.omega) for block in useful)} of {sum(lines):.0f} spectral lines are fitted: the "
            f"excited ones{chosen}"
        )
    return useful, said


def weighted(
    blocks: Sequence[SpectralBlock], campaign: Campaign, band_Hz: tuple[float, float]
) -> tuple[list[SpectralBlock], str, bool]:
    """The blocks with noise measured by a local model, independent of the rig's; a sentence, and whether it
    succeeded."""
    try:
        found = measured_noise(blocks, campaign, band_Hz)
    except AvisError as error:
        why = error.expected if isinstance(error, InputError) else str(error)
        said = f"the records show no noise covariance ({why}); the first fit gives all lines equal weight"
        return relative_noise(blocks), said, False
    said = f"noise covariance estimated with a local polynomial model, {found[0].dof:.0f} degrees of freedom per line"
    return found, said, True


def measured_noise(
    blocks: Sequence[SpectralBlock], campaign: Campaign, band_Hz: tuple[float, float]
) -> list[SpectralBlock]:
    """Blocks with the noise covariance of a local polynomial model of the campaign's records of their kind.

    Records at rest are used if there are any, otherwise all records.

    Raises
    ------
    InputError, ComputationError : records that do not allow it.
    """
    found: dict[str, tuple[np.ndarray, np.ndarray, float]] = {}
    for kind in dict.fromkeys(block.kind for block in blocks):
        floor = kind == "floor measured"
        alike = [record.header for record in campaign.records if (len(record.header.floor_names) > 0) == floor]
        # A record at rest contains noise alone; in any other record all inputs must be separated first.
        rest = [header for header in alike if header.excitation == "rest"]
        records = campaign.only(tuple(header.name for header in rest or alike))
        lines = np.unique(np.concatenate([one.omega for one in blocks if one.kind == kind])) / (2 * np.pi)
        at = np.unique(np.clip(np.linspace(lines[0], lines[-1], min(len(lines), 1500)), *band_Hz))
        noise = noise_covariance(
            records, at, band_Hz=band_Hz, floor=floor, smooth_Hz=0.3, longest_piece=SETTINGS.longest_piece
        )
        found[kind] = at, noise.covariance, float(np.median(noise.dof))

    def with_noise(block: SpectralBlock) -> SpectralBlock:
        at, covariance, dof = found[block.kind]
        above = np.clip(np.searchsorted(at, block.omega / (2 * np.pi)), 0, len(at) - 1)
        return block.with_noise(covariance[above], dof)

    return [with_noise(block) for block in blocks]


@dataclass(frozen=True, eq=False)
class CampaignFit:
    """A fit to a campaign.

    fit : with the noise of its own residuals. first : with the noise measured without a model of the rig, if
        `measured`; its chi-square per degree of freedom is then a rough figure (somewhat below 1 for a correct model,
        because local models take some of the response's curvature for noise), and meaningless otherwise. The held-out
        chi-square is the criterion.
    start : the model before the fit. notes : sentences.
    tolerances : values of the rig file that were fitted within their tolerance, those that moved most first; they are
        among the parameters of `fit`, and `first` is the fit that takes them as exact. Empty if they were not free.
    """

    fit: LikelihoodFit[ResponseModel]
    first: LikelihoodFit[ResponseModel]
    band_Hz: tuple[float, float]
    notes: tuple[str, ...]
    start: ResponseModel
    measured: bool = True
    tolerances: tuple[Tolerance, ...] = ()

    @property
    def model(self) -> ResponseModel:
        """Model of the fit with the identified parameters free, and the tolerances at their fitted values."""
        return replace(self.fit.model, names=self.start.names)

    @property
    def structure(self) -> ResponseModel:
        """Model that shows which combinations of the identified parameters can be determined: with the geometry of the
        file."""
        return self.first.model if self.tolerances else self.model

    @cached_property
    def information(self) -> Information:
        """Information on the identified parameters, with the tolerances marginalised.

        If the file's own geometry leaves something undetermined (how a stiffness is divided between mounts),
        information from positions moved within their tolerance is not counted.
        """
        if not self.tolerances:
            return self.fit.information
        return self.fit.information.of_some(self.start.names).along(self.first.information)


def fits_tolerances(measured: Campaign | FrequencyResponse, rig: Rig) -> bool:
    """Whether `fit_campaign` can fit the tolerances of the rig file: those of records of a table on isolators, whose
    channels can be separated."""
    return isinstance(measured, Campaign) and isinstance(rig, IsolatorTable)


def fit_campaign(
    campaign: Campaign | FrequencyResponse,
    model: ResponseModel,
    band_Hz: tuple[float, float],
    priors: Mapping[str, Prior] | None = None,
    starts: int = 1,
    seed: int = 1,
    reweights: int = 2,
    progress: Progress | None = None,
    tolerances: Tolerances | None = None,
) -> CampaignFit:
    """The most likely parameters, first with measured noise, then with the noise of the residuals.

    tolerances : of the values of the rig file, which are then fitted together with the parameters; only for records of
        a rig whose channels can be separated.

    Raises
    ------
    InputError, ComputationError : as `fit`, `record_block`, `response_block`.
    """
    say = progress or (lambda text: None)
    if isinstance(campaign, FrequencyResponse):
        found = fit(
            model, [response_block(campaign.between(*band_Hz), model)], priors, starts, seed=seed, progress=progress
        )
        return CampaignFit(
            found, found, band_Hz, (f"frequency responses: {campaign.method or 'as measured'}", *_bounds(found)), model
        )
    raw, notes = campaign_blocks(campaign, model, band_Hz)
    blocks, said, known = weighted(raw, campaign, band_Hz)
    within = tolerances if fits_tolerances(campaign, model.rig) else None
    fitted = blocks
    if within is not None:
        blocks = [thinned(block, FIT.residual_lines) for block in blocks]
        fitted = [thinned(block, FIT.lines) for block in blocks]
    # First, the rig file is taken as exact.
    first = fit(model, fitted, priors, starts, seed=seed, progress=progress)
    turning, added = chosen_turning(campaign, blocks, first.model)
    turned = replace(first.model, turning=turning)
    notes += [said, f"{turning.sentence}: {_share(blocks, added)}"]
    if within is not None:
        if not known:
            blocks = noise_from_residuals(first.residuals, blocks, first.model)
        levels = levels_of(campaign.records)
        begun = begin(turned, without(blocks, added), levels, within, priors or {})
        say(
            f"fit with {int(np.sum(~begun.flat))} values of the rig file free, with their tolerances: "
            f"{begun.fitted.iterations} iterations"
        )
        linear = without(blocks, [one[0] for one in terms(campaign, blocks, begun.fitted.model)])
        ended = end(begun, linear, levels)
        say(f"fit with their second-order terms: {ended.fitted.iterations} iterations")
        found = as_likelihood_fit(ended, linear, first)
        moved = ended.fitted.moved([name for name in found.model.names if name not in model.names])
        return CampaignFit(found, first, band_Hz, tuple(notes), model, known, moved)
    found = fit(turned, without(blocks, added), priors, seed=seed, about=model)
    say(f"second-order terms of the table's rotations: {found.iterations} iterations")
    first = replace(found, starts=first.starts)
    for k in range(reweights):
        weighed = noise_from_residuals(found.residuals, [one.block for one in found.residuals], found.model)
        if k == reweights - 1:
            added = terms(campaign, blocks, found.model)
            weighed = [
                replace(block, Y=one.Y)
                for block, one in zip(weighed, without(blocks, [one[0] for one in added]), strict=True)
            ]
        found = fit(found.model, weighed, priors, seed=seed, about=model)
        say(f"weights from the residuals, {k + 1} of {reweights}: {found.iterations} iterations")
    return CampaignFit(replace(found, starts=first.starts), first, band_Hz, (*notes, *_bounds(found)), model, known)


def _share(blocks: Sequence[SpectralBlock], added: Sequence[np.ndarray]) -> str:
    """Size of the second-order terms relative to the outputs, in words."""
    share = [
        np.linalg.norm(one, axis=(0, 2)) / np.linalg.norm(block.Y, axis=(0, 2))
        for block, one in zip(blocks, added, strict=True)
    ]
    return f"they contribute up to {100 * float(np.max(share)):.2g} % of a sensor's signal in a record"


def _bounds(found: LikelihoodFit[ResponseModel]) -> tuple[str, ...]:
    """Sentences about parameters that ended at a physical limit."""
    moments = [name for name in found.held if any(name in names for names in MOMENTS)]
    low = [name for name in found.held if name not in moments]
    said = []
    if low:
        said.append(
            f"the best fit would need values below the physical limit for {', '.join(low)}; they are held just "
            "above zero, where their standard deviations are not meaningful"
        )
    if moments:
        said.append(
            f"the best fit would need a larger {', '.join(moments)} than a rigid body can have; the value is "
            "held at the sum of the other two moments of inertia. Either a value that was taken as known is "
            "wrong, or these data hardly determine this moment of inertia"
        )
    return tuple(said)
