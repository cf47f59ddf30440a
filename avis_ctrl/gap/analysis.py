"""The gap between a rig and a campaign, from signals to verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, reduce

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.data import Halves, blocks_of, divide, thinned, with_noise
from avis_ctrl.gap.detectable import detectable
from avis_ctrl.gap.each import Each, one_by_one
from avis_ctrl.gap.effects.base import Effect
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.judgement import effects_of, judge, undetermined
from avis_ctrl.gap.record_motion import motion_of, origin, with_large_motion
from avis_ctrl.gap.refit import Refit, anew, judged, likelihood, refit, scattered, try_refit
from avis_ctrl.gap.result import Detectable, Gap
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.search import CLOSED, LONGEST, NOISE, Found, Rival, contested, definite, known_noise, search
from avis_ctrl.gap.show import shown
from avis_ctrl.gap.signal_effects import (
    SignalFaults,
    converter_faults,
    left_by,
    levels,
    predicted,
    without_hum,
)
from avis_ctrl.gap.signals.converter import ConverterFinding
from avis_ctrl.gap.signals.hum import HumFinding, find_hum, polluted
from avis_ctrl.gap.signals.leftover import Leftover
from avis_ctrl.gap.signals.repair import repair
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.campaign_fit import excited_band
from avis_ctrl.identification.maximum_likelihood import fit
from avis_ctrl.identification.noise import relative_noise
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import SpectralBlock
from avis_ctrl.measurement.campaign import Campaign, Record
from avis_ctrl.rigs.rig import Rig

Progress = Callable[[str], None]
# Share of a channel's samples beyond its limits from which repaired samples are predicted anew.
REPAIRED = 1e-5
# How often, each time with the better model that the last repair allowed, and iterations of its fit in between.
REPAIRS, ITERATIONS = 3, 10
# Lines of a record in the band below which a fit with its transient tells nothing.
FEWEST_LINES = 60
# Second-order terms as Newton and Euler have them, with sensors fixed to the payload and forces along earth axes.
BY_PHYSICS = (1.0, 0.0, 1.0)


# Lines of each record that the reported model is fitted to, and iterations from where the search left it.
FINAL_LINES, FINAL_ITERATIONS = 1500, 8
# Probability of a competitor below which a better knowledge of the noise does not bring it back.
NO_CHANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Prepared:
    """A campaign made ready: halves, blocks with noise on all lines, and the re-identified model.

    unmasked : held-out blocks as they came, hum and all. nominal : the rig as its file has it. faults : of the signals.
    clipped : the campaign with its clipped samples, where more than a few are repaired in `campaign`; else None.
    """

    campaign: Campaign
    halves: Halves
    band_Hz: tuple[float, float]
    fitted: list[SpectralBlock]
    held_out: list[SpectralBlock]
    unmasked: list[SpectralBlock]
    noise: str
    nominal: TableModel
    base: Refit
    faults: SignalFaults
    clipped: Campaign | None = None

    @cached_property
    def thin(self) -> list[SpectralBlock]:
        return [thinned(block) for block in self.fitted]

    @cached_property
    def thin_held(self) -> list[SpectralBlock]:
        return [thinned(block) for block in self.held_out]

    def measured_with(self, model: TableModel, left: tuple[Leftover, ...]) -> Prepared:
        """The same with the noise that a model's residual in time gives, and the re-identified model refitted."""
        groups = (self.fitted, self.held_out, self.unmasked)
        (fitted, held_out, unmasked), how = _noise(groups, self.halves, left, model, self.band_Hz)
        made = replace(self, fitted=fitted, held_out=held_out, unmasked=unmasked, noise=how)
        return replace(made, base=refit(self.base.model, made.thin, made.thin_held))

    def repaired_with(self, model: TableModel, each: Each = one_by_one) -> Prepared:
        """The same with clipped samples as a model expects them, which has more than the re-identified one."""
        made, clipped, converter = self, self.clipped, self.faults.converter
        assert clipped is not None
        for k in range(REPAIRS):
            mended = repair(clipped, model.rig, predicted(clipped, model, each), converter).campaign
            made = _ready(mended, made.nominal, replace(made.base.model, effects=()), made.band_Hz, converter, clipped,
                          lambda text: None, each)
            better = (try_refit(replace(model, motion=made.nominal.motion), made.thin, made.thin_held, ITERATIONS)
                      if k < REPAIRS - 1 else None)
            if better is None:
                break
            model = better.model
        return made


def analyse(campaign: Campaign, rig: Rig, seed: int = 1, band_Hz: tuple[float, float] | None = None,
            amplifier_corner_Hz: float | None = None, effects: Sequence[Effect] | None = None,
            progress: Progress = lambda text: None, each: Each = one_by_one) -> Gap:
    """Find, name and close the gap.

    Parameters
    ----------
    campaign : records in the rig's own words, driven ones among them. rig : as its file has it.
    band_Hz : of the comparison; the excited one where None. effects : candidates; the library where None.
    each : how independent refits are done; one after the other by default.

    Raises
    ------
    InputError : a campaign that drives nothing, or tells no noise.
    ComputationError : a fit that does not come to an end.
    """
    began = time.monotonic()
    prepared = prepare(campaign, rig, band_Hz, amplifier_corner_Hz, progress, each)
    # What stands in the place of clipped samples lacks whatever the model lacks: the first search is a rough one then.
    found = search(prepared.base, prepared.thin, prepared.thin_held, progress, effects, each=each,
                   longest=LONGEST if prepared.clipped is None else 1)
    if prepared.clipped is not None and (nearest := _nearest(found)) is not None:
        progress("clipped samples: what the model expects behind the limits with "
                 + " and ".join(one.effect.name for one in effects_of(nearest)))
        try:
            prepared = prepared.repaired_with(nearest, each)
        except ComputationError:  # it was fitted on lines, and in time leaves every bound
            progress("clipped samples: left as the re-identified model expects them")
        found = search(prepared.base, prepared.thin, prepared.thin_held, progress, effects, each=each)
    progress("noise of floor and sensors, with what was found")
    left = left_by(prepared.campaign, found.best.model, each)
    prepared = prepared.measured_with(found.best.model, left)
    found = _contested(_again(prepared, found, effects, progress, each), prepared)
    progress("the last fit, and what is left of all lines of the held-out records")
    base, updated, left_out = _final(prepared, found)
    if left_out:
        rest = reduce(TableModel.without, set(found.best.labels) - set(updated.labels), found.best.model)
        found = _shortened(found, refit(rest, prepared.thin, prepared.thin_held))
    faults = replace(prepared.faults, noise=levels(left, updated.model, prepared.faults.hum, prepared.faults.converter))
    judgement = judge(prepared.thin, found, base, updated, faults, left_out)
    limits: tuple[Detectable, ...] = ()
    if judgement.verdict == "none":
        progress("how large an effect would have had to be to be seen")
        score = Score(base.model, prepared.thin)
        limits = detectable(score, effects, max(1.0, score.chi2 / score.dof) * known_noise(prepared.thin))
    gap = shown(prepared, found, base, updated, judgement, seed, time.monotonic() - began, faults.noise)
    return replace(gap, detectable=limits)


def _nearest(found: Found) -> TableModel | None:
    """The best model with effects that a search has refitted, where the re-identified one leaves more than noise."""
    tried = [one for stage in found.pool for one in stage
             if one.held_per_dof < found.chain[0].held_per_dof and not one.implausible()]
    if found.chain[0].held_per_dof <= NOISE or not tried:
        return None
    return min(tried, key=lambda one: one.criterion).model


def _weighed(found: Found, prepared: Prepared) -> Found:
    """What was found, compared and told by the noise as it is known in the end."""
    @cache  # a rival stands against one of the pool, and the one that beat it is one of the rivals
    def of(one: Refit) -> Refit:
        return anew(one, prepared.thin, prepared.thin_held)

    def told(rival: Rival) -> Rival:
        return replace(rival, refit=of(rival.refit), against=of(rival.against))
    return replace(found, pool=tuple(tuple(map(of, stage)) for stage in found.pool),
                   passed_over=tuple(judged(one.fit, prepared.thin_held) for one in found.passed_over),
                   rivals=tuple(map(told, found.rivals)), beaten=found.beaten and told(found.beaten))


def _again(prepared: Prepared, found: Found, effects: Sequence[Effect] | None, progress: Progress, each: Each
           ) -> Found:
    """What was found, against the noise that is known now; searched on where only that shows that more is left."""
    if len(found.chain) == 1 and found.reached_noise and prepared.base.held_per_dof > NOISE:
        return search(prepared.base, prepared.thin, prepared.thin_held, progress, effects, each=each)
    found = _weighed(found, prepared)
    if len(found.chain) == 1:
        return replace(found, chain=(prepared.base,), reached_noise=prepared.base.held_per_dof <= NOISE)
    best = _without_spare(refit(found.best.model, prepared.thin, prepared.thin_held), prepared)
    if len(effects_of(best.model)) < len(found.chain) - 1:
        found = _shortened(found, best)
    between = [judged(one.fit, prepared.thin_held) for one in found.chain[1:-1]]
    chain = (prepared.base, *between, best)
    longer = replace(found, chain=chain, reached_noise=best.held_per_dof <= CLOSED)
    if found.best.held_per_dof > CLOSED or len(chain) > LONGEST or (longer.reached_noise and not definite(best)):
        return longer
    on = search(prepared.base, prepared.thin, prepared.thin_held, progress, effects, chain, each)
    return replace(on, pool=(*found.pool, *on.pool), passed_over=(*found.passed_over, *on.passed_over),
                   rivals=(*found.rivals, *on.rivals))


def _shortened(found: Found, best: Refit) -> Found:
    """What was found with one effect less than its chain; a stage of its own, for the search may have no refit with
    what is left alone."""
    return replace(found, chain=(found.chain[0], best), pool=(*found.pool, (best,)))


def _contested(found: Found, prepared: Prepared) -> Found:
    """Competitors that came near, fitted to the noise that is known now as what was found is; what then wins, wins.
    A name that was taken away is given back where it came near and is not to be given up by that noise."""
    def again(one: Refit) -> Refit:
        return try_refit(one.model, prepared.thin, prepared.thin_held) or one

    def told(one: Rival) -> Rival:
        if set(one.against.labels) != set(found.best.labels) or one.left > 1 - NO_CHANCE:
            return one
        return replace(one, refit=again(one.refit), against=found.best)
    if (rival := found.beaten) is not None:
        if rival.left < NO_CHANCE:
            return found
        rival = replace(rival, refit=again(rival.refit), against=again(rival.against))
        if rival.wins:
            return replace(found, beaten=rival)
        return replace(found, chain=(found.chain[0], rival.against), beaten=None, rivals=(rival,),
                       reached_noise=rival.against.held_per_dof <= CLOSED)
    return contested(replace(found, rivals=tuple(map(told, found.rivals))))


def _without_spare(best: Refit, prepared: Prepared) -> Refit:
    """The first of two effects left out, where the second closes the gap by itself."""
    own = effects_of(best.model)
    if len(own) < 2:
        return best
    alone = try_refit(best.model.without(own[0].label), prepared.thin, prepared.thin_held)
    return alone if alone is not None and alone.held_per_dof <= min(CLOSED, best.held_per_dof + 0.05) else best


def prepare(campaign: Campaign, rig: Rig, band_Hz: tuple[float, float] | None = None,
            amplifier_corner_Hz: float | None = None, progress: Progress = lambda text: None,
            each: Each = one_by_one) -> Prepared:
    """From records to blocks with noise and the re-identified model."""
    progress("converters, and what is held out")
    converter = converter_faults(campaign, rig)
    mended = repair(campaign, rig, None, converter) if campaign.y_unit == "V" and rig.acquisition else None
    campaign = mended.campaign if mended else campaign
    halves = divide(campaign)
    low, high = excited_band(halves.fitted)
    band = band_Hz or (low, high)
    if not 0 <= band[0] < band[1]:
        raise InputError("expected 0 <= LOW < HIGH", field="band_Hz", value=band)
    if band[1] <= low or band[0] >= high:
        raise InputError(f"expected a band in which the records are excited, {low:.3g} to {high:.3g} Hz",
                         field="band_Hz", value=band)
    if amplifier_corner_Hz is not None and not 0 < amplifier_corner_Hz < np.inf:
        raise InputError("expected a frequency above zero", field="amplifier corner", value=amplifier_corner_Hz)
    base = ResponseModel.of(rig, default_parameters(rig), campaign.y_unit, campaign.y_names, campaign.u_names, True,
                            amplifier_corner_Hz)
    nominal = TableModel(base, nominal=base)
    progress(f"re-identification of {len(nominal.names)} parameters, {band[0]:.3g} to {band[1]:.3g} Hz; {halves.how}")
    for record in halves.fitted.records:
        lines = int((band[1] - band[0]) * record.header.duration_s)
        if lines < FEWEST_LINES:
            raise InputError(f"expected a wider band or longer records: {lines} lines of record {record.header.name} "
                             f"lie in it, and a fit needs {FEWEST_LINES}", field="band_Hz", value=band)
    rough = _rough(nominal, halves, band)
    original = campaign if mended and max(mended.clipped.values()) > REPAIRED else None
    if original is not None:
        progress("clipped samples: what the model expects behind the limits")
        for _ in range(REPAIRS):
            campaign = repair(original, rig, predicted(original, rough, each), converter).campaign
            halves = divide(campaign)
            rough = _rough(rough, halves, band)
    return _ready(campaign, nominal, rough, band, converter, original, progress, each)


def _ready(campaign: Campaign, nominal: TableModel, rough: TableModel, band: tuple[float, float],
           converter: tuple[ConverterFinding, ...], clipped: Campaign | None, progress: Progress,
           each: Each) -> Prepared:
    """Hum taken out, blocks with noise, second-order terms, and the re-identified model, from a rough one."""
    halves = divide(campaign)
    left = left_by(campaign, rough, each)
    raw_held = blocks_of(halves.held_out, rough, band)
    hum = find_hum(left)
    if hum is not None:
        progress(f"hum of {hum.frequency_Hz.value:.5g} Hz taken out")
        campaign = without_hum(campaign, hum, left)
        halves = divide(campaign)
        rough = _rough(rough, halves, band)
        left = left_by(campaign, rough, each)
    fitted = _masked(blocks_of(halves.fitted, rough, band), halves.fitted, hum)
    held_out = _masked(blocks_of(halves.held_out, rough, band), halves.held_out, hum)
    progress("noise, and second-order terms of large rotations")
    (fitted, held_out, unmasked), how = _noise((fitted, held_out, raw_held), halves, left, rough, band)
    motion = with_large_motion(motion_of(_parts(halves), rough, campaign, each), rough)
    model = replace(rough, motion=motion)
    # The large motion's own coefficients are physics; they are free because the source leaves open what turns.
    again = refit(model.with_effect(active(LargeMotion(), model, "payload", BY_PHYSICS)),
                  [thinned(block) for block in fitted], [thinned(block) for block in held_out])
    return Prepared(campaign, halves, band, fitted, held_out, unmasked, how, replace(nominal, motion=motion), again,
                    SignalFaults(converter, hum), clipped)


def _noise(groups: Sequence[list[SpectralBlock]], halves: Halves, left: tuple[Leftover, ...], model: TableModel,
           band: tuple[float, float]) -> tuple[list[list[SpectralBlock]], str]:
    """Groups of blocks with the noise of the fitted records, from what a model leaves of them in time; a sentence."""
    of = {one.header.name: one for one in left}
    records = []
    for source in halves.fitted.records:
        whole, start, stop = origin(source)
        e = of[whole.header.name].e[start:stop]
        record = source.load()
        records.append(Record(record.header, record.u, e, record.floor))
    every = [block for group in groups for block in group]
    made, how = with_noise(every, halves.fitted, replace(halves.fitted, records=tuple(records)), model, band)
    ends = np.cumsum([len(group) for group in groups])
    return [made[end - len(group):end] for group, end in zip(groups, ends, strict=True)], how


def _parts(halves: Halves) -> Campaign:
    """Fitted and held-out records, or parts of records, together, each under the name of its block."""
    return replace(halves.fitted, records=(*halves.fitted.records, *halves.held_out.records))


def _rough(model: TableModel, halves: Halves, band: tuple[float, float]) -> TableModel:
    """A first fit, each line weighted alike."""
    blocks = [thinned(block) for block in relative_noise(blocks_of(halves.fitted, model, band))]
    return replace(model, base=fit(model.base, blocks).model)


def _masked(blocks: Sequence[SpectralBlock], campaign: Campaign, hum: HumFinding | None) -> list[SpectralBlock]:
    """Blocks without the lines that hum has spoiled."""
    if hum is None:
        return list(blocks)
    found = []
    for block in blocks:
        h = campaign.named(block.name).header
        spoiled = polluted(hum, h.samples, h.sample_rate_Hz)
        lines = np.rint(block.omega * h.samples / (2 * np.pi * h.sample_rate_Hz)).astype(int)
        found.append(block.lines(np.flatnonzero(~spoiled[lines])))
    return found


def _final(prepared: Prepared, found: Found) -> tuple[Refit, Refit, list[str]]:
    """Re-identified and updated model with what they leave of all held-out lines, the last one fitted to many lines;
    and why effects were left out that these many lines do not tell from none beside others."""
    many = [thinned(block, FINAL_LINES) for block in prepared.fitted]

    def fitted(model: TableModel) -> Refit:
        return scattered(judged(likelihood(model.with_late_free(), many, FINAL_ITERATIONS), prepared.held_out), many)
    best, left_out = fitted(found.best.model), []
    while len(effects_of(best.model)) > 1:
        label, why = undetermined(best)
        if not label:
            break
        left_out.append(why)
        best = fitted(best.model.without(label))
    return (judged(found.chain[0].fit, prepared.held_out) if len(found.chain) > 1 else best), best, left_out
