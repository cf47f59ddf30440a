"""Tuning values of the search on one axis, beside those of the table's."""

from __future__ import annotations

from dataclasses import dataclass

from avis_ctrl.gap.settings import GapSettings


@dataclass(frozen=True)
class AxisSettings(GapSettings):
    """Values that no data determine.

    spans : parts of a record, of which every third is held out; each holds several periods of what moves slowly.
    segments : half-overlapping windows of a span; three give a span's middle the same weight as its ends.
    lines_per_band : lines of a segment in a third of an octave; more make the fit longer and hardly better.
    bands_per_octave : of the discrepancy; none, one variance for all lines. What laws of friction leave is largest
        where the force is: with a variance for each band the evidence would give the low ones up as noise.
    floor : noise that nobody can exclude, over the response of a band [1]; 80 dB is what good converters have.
    oversampled : sample rate of the motion over twice the end of the band [1], for functions whose harmonics would fold
        back.
    refits : effects that are refitted at each step of the search, the best by the score test; a fit is short.
    pairs : pairs of effects that are fitted at each step, the best by the score test.
    bumps : splines of a function of unknown shape; as many as tell a stop from a cubic spring.
    no_model : part of the response that a model may leave before the columns themselves are in doubt [1]; friction and
        springs are seldom half of it.
    much_better : part of that which exchanged columns may leave to be believed [1]; half of the power.
    coherent : coherence of force and motion up to which the noise of the motion bends a fit by a tenth at most [1].
    least_cutoff_Hz : of a drive's data where the coherence ends earlier [Hz]; friction needs its harmonics.
    repeats : change of the motion from one repetition to the next, over its r.m.s., up to which it repeats [1].
    alike : mean difference of log-likelihood below which two effects are one for the data [nats].
    right_shape : part of what a free function takes off the power that named effects must take [1]; with less, more
        than half of the r.m.s. stays: they are neighbours of the truth.
    same_shape : modal assurance criterion above which two modes are one [1] (R. Allemang, D. Brown, 1982; usual
        practice).
    static : scatter of a response between realisations over its change with the level, from which the change is that of
        a static law [1]; a cubic one has 0.8 of it, spread over the band and its harmonics, a gain that is set by the
        level none.
    apart : standard deviations, robust and widened, by which an effect's size must differ from zero [1]; the usual two.
    widened_p_value : p-value of the difference between a half of the data and the whole below which standard deviations
        are widened to cover it [1]: the usual level.
    frequencies : of a stepped sine that a search needs.
    table : values of position, and of speed, in the table of forces that a simulation interpolates: an odd number, with
        rest in the middle, 0.5 % of the reach apart.
    least_angle : travel from which a position may be an angle whose sine bends [rad].
    """

    spans: int = 6
    segments: int = 3
    lines_per_band: int = 24
    bands_per_octave: int = 0
    floor: float = 1e-4
    oversampled: int = 4
    refits: int = 12
    pairs: int = 3
    bumps: int = 12
    no_model: float = 0.5
    much_better: float = 0.7
    coherent: float = 0.9
    least_cutoff_Hz: float = 60.0
    repeats: float = 1e-3
    alike: float = 1.0
    right_shape: float = 0.75
    same_shape: float = 0.9
    static: float = 0.2
    apart: float = 2.0
    widened_p_value: float = 0.05
    frequencies: int = 8
    table: int = 801
    least_angle: float = 1.0


SETTINGS = AxisSettings()
