"""Settings of the search on one axis, in addition to those of the table."""

from __future__ import annotations

from dataclasses import dataclass

from avis_ctrl.gap.settings import GapSettings


@dataclass(frozen=True)
class AxisSettings(GapSettings):
    """Values that the data do not determine.

    spans : parts of a record, of which every third is held out; each contains several periods of the slowest motion.
    segments : half-overlapping windows of a span; with three, the middle of a span has the same weight as its ends.
    lines_per_band : lines of a segment in a third of an octave; more lines make the fit slower and hardly better.
    bands_per_octave : of the discrepancy; 0 is one variance for all lines. The residual of friction laws is largest
        where the force is: with a variance for each band, the evidence would reject the low bands as noise.
    floor : noise that is always assumed, over the response of a band [1]; good converters reach 80 dB.
    oversampled : sample rate of the motion over twice the end of the band [1]; avoids aliasing of the harmonics of
        nonlinear functions.
    refits : effects that are refitted at each step of the search, the best by the score test; a fit is short.
    pairs : pairs of effects that are fitted at each step, the best by the score test.
    bumps : splines of a function of unknown shape; enough to distinguish a stop from a cubic spring.
    no_model : residual over the response, above which the columns themselves are in doubt [1]; friction and springs
        seldom account for half of it.
    much_better : residual with exchanged columns over that without, below which they count as exchanged [1]; half of
        the power.
    coherent : minimum coherence of force and motion; the noise of the motion then biases a fit by at most a tenth [1].
    least_cutoff_Hz : minimum cutoff of a drive where the coherence ends earlier [Hz]; friction needs its harmonics.
    repeats : change of the motion between repetitions over its r.m.s., up to which it counts as periodic [1].
    alike : mean difference of log-likelihood below which the data cannot distinguish two effects [nats].
    right_shape : fraction of the power reduction by a free function that named effects must achieve [1]; with less,
        more than half of the r.m.s. remains: they are only close to the true effects.
    same_shape : modal assurance criterion above which two modes are the same [1] (R. Allemang, D. Brown, 1982; usual
        practice).
    static : scatter of a response between realisations over its change with the level, above which a static law causes
        the change [1]; a cubic law has 0.8, spread over the band and its harmonics, a gain that follows the level has
        none.
    apart : standard deviations, robust and widened, by which an effect's size must differ from zero [1]; the usual two.
    widened_p_value : p-value of the difference between half of the data and all of them, below which standard
        deviations are widened to cover it [1]; the usual level.
    frequencies : minimum number of frequencies of a stepped sine for a search.
    table : number of positions, and of speeds, in the table of forces that a simulation interpolates: odd, so that rest
        is in the middle; 1 % of the largest displacement apart.
    mode_damping : largest damping ratio of a mode of a sensor's mount [1]; one with 0.87 has the phase of a delay to
        fourth order, a real mount has less.
    least_angle : travel from which a position may be an angle with a nonlinear sine [rad].
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
    mode_damping: float = 0.2
    least_angle: float = 1.0


SETTINGS = AxisSettings()
