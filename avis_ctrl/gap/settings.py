"""Every tuning value of the search for missing effects, with its unit, its meaning and the reason for it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from avis_ctrl.identification.fit_settings import FitSettings


@dataclass(frozen=True)
class GapSettings(FitSettings):
    """Values that no data determine, beside those of a fit; all of them are part of a result's provenance.

    fewest_lines : lines of a record in the band below which a fit with its transient determines nothing.
    few_clipped : share of a channel's samples beyond its limits from which repaired samples are predicted anew.
    repairs : how often, each time with the better model that the last repair allowed.
    second_order_percent : prior standard deviation of the second-order terms of rotations [%]: Newton and Euler have
        them, and they hang on a geometry known to some per cent.
    turning_percent : the same of the share of the rotation that turns the axes of motors and sensors [%], which a rig
        file does not state.
    beyond_tolerance : prior standard deviation of a value that may be beyond its tolerance, in tolerances: a gain 10 %
        off, a sensor tilted by 3 degrees, a centre of mass by 10 mm; what is further off shows all the same.
    beyond_least : tolerances by which a value must differ from the rig file's to be beyond its tolerance.
    determined : part of a tolerance's prior variance that the data must take away for the value to be one that they
        determine [1].
    least_spread : smallest spread of these values, in tolerances, that is believed [1]: there are some tens of them,
        and the model errs by as much.
    narrow : spread below which values are searched for that stand out from it [1]: an outlier gains log evidence of
        half its square over the spread's.
    held : standard deviation, over its tolerance, of a value that is beyond it [1]: the effect alone has it then.
    effect_sizes : prior standard deviation of an effect's strength, in units of its parameter's size; broad, so that it
        costs some nats and bends nothing.
    shape_spread : prior standard deviation of a parameter that shapes an effect (a frequency), relative to its start.
    resonance_share : of the largest fall of the sum of squares, that a resonance of any shape must bring for effects
        with a resonance to be looked for [1].
    refits : effects that are refitted at each step of the search, the best by the score test.
    starts : values with which the fit of a candidate may begin, the best by the score test. To first order a narrow
        resonance at a wrong frequency promises as much as one at the right frequency.
    first_iterations : of each of these, after which only the best is followed.
    rough_iterations : most of a first fit of every candidate's own parameters, which cost little; a sharp resonance
        that begins half its width away needs more than a few.
    not_far_behind : fraction of the best candidate's gain of log evidence by that fit with which another one is fitted
        on.
    least_promised : fraction of the fall of the sum of squares that the score test promises, below which a fit of a
        candidate's own parameters has failed [1]: the fit of all parameters then begins at the seed, too.
    quick_rounds, quick_iterations, quick_converged : `rounds`, `iterations` and `converged` of a fit that only compares
        candidates, or gives the residual of a stage.
    longest : most effects that are named together.
    revisions : how often an effect may be replaced by a rival that is better beside what was found after it; twice, for
        a pair that was named wrong both times.
    certain : gain of log evidence [nats] that a name needs beside the logarithm of the number of candidates: odds of
        fifty, for one false name in fifty campaigns at most.
    outside_odds : how many times as probable an effect of the library is beforehand as one that has no name in it [1].
    rival : probability from which another name cannot be ruled out [1]; one in twenty.
    sure : probability up to which an effect is compared with its rivals again, beside what was found after it [1].
    headline : probability below which a name is an alternative only [1].
    most_sure : largest probability that is reported [1]: what nobody thought of leaves so much.
    trace : share of the gap's power below which an effect is a trace [1].
    minor : share of what the model with tolerances leaves below which a trace ends the search [1].
    law_p_value, law_change : an effect is refuted where one of its parameters from half of the data (by band, by level)
        differs from the whole with a smaller p-value than this [1] and by more than this fraction of itself [1]; real
        elements follow their textbook law to some per cent only, which no p-value knows.
    least_difference : of the variance of a difference between a half and the whole over the whole's, below which it is
        round-off [1].
    most_of_half : variance of a half over the whole's, above which that half says nothing of a direction [1].
    within_noise : chi-square per degree of freedom up to which what remains counts as noise [1]: a tenth in r.m.s.,
        which is what the noise's own estimate leaves open.
    small : r.m.s. of what remains over the response below which nothing is missing [1] (contract).
    explained : share of the baseline's excess power that must be gone for a gap to count as explained [1] (contract).
    known_noise : chi-square per degree of freedom up to which what remains tells the level of floor and sensors [1].
    shown_runners_up : runners-up that are reported.
    """

    fewest_lines: int = 60
    few_clipped: float = 1e-5
    repairs: int = 3
    second_order_percent: float = 20.0
    turning_percent: float = 50.0
    beyond_tolerance: float = 10.0
    beyond_least: float = 3.0
    determined: float = 0.5
    least_spread: float = 0.2
    narrow: float = 0.7
    held: float = 1e-3
    effect_sizes: float = 100.0
    shape_spread: float = 1.0
    resonance_share: float = 0.5
    refits: int = 8
    starts: int = 4
    first_iterations: int = 4
    rough_iterations: int = 16
    not_far_behind: float = 0.3
    least_promised: float = 0.5
    quick_rounds: int = 4
    quick_iterations: int = 4
    quick_converged: float = 1e-4
    longest: int = 5
    revisions: int = 2
    certain: float = 3.9
    outside_odds: float = 10.0
    rival: float = 0.05
    sure: float = 0.9
    headline: float = 0.5
    most_sure: float = 0.99
    trace: float = 0.01
    minor: float = 0.1
    law_p_value: float = 1e-4
    law_change: float = 0.2
    least_difference: float = 1e-3
    most_of_half: float = 20.0
    within_noise: float = 1.21
    small: float = 0.01
    explained: float = 0.9
    known_noise: float = 2.25
    shown_runners_up: int = 12

    @property
    def quick(self) -> GapSettings:
        """Of a fit that only compares candidates, or only gives a figure."""
        return replace(self, rounds=self.quick_rounds, iterations=self.quick_iterations,
                       converged=self.quick_converged)


SETTINGS = GapSettings()
