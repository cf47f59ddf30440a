"""Tuning values of the search as a whole; those of its parts are the `SETTINGS` of their modules (`tuning_values`)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from avis_ctrl.identification.fit_settings import FitSettings


@dataclass(frozen=True)
class GapSettings(FitSettings):
    """Values that no data determine, in addition to those of a fit; all of them are part of a result's provenance.

    fewest_lines : minimum number of lines of a record in the band: with fewer, a fit with its transient determines
        nothing.
    few_clipped : fraction of a channel's samples at its limits above which these are replaced by a prediction.
    repairs : number of repairs, each with the better model that resulted from the last one.
    second_order_percent : prior standard deviation of the second-order terms of rotations [%]: they follow from
        Newton-Euler, with a geometry known to a few per cent.
    turning_percent : the same for the fraction of the rotation that turns the axes of motors and sensors [%], which a
        rig file does not state.
    beyond_tolerance : prior standard deviation of a value that may be beyond its tolerance, in tolerances: a gain 10 %
        off, a sensor tilted by 3 degrees, a centre of mass off by 10 mm; larger errors are found all the same.
    beyond_least : minimum difference from the rig file's value, in tolerances, for a value to be beyond its tolerance.
    determined : fraction of a tolerance's prior variance that the data must remove for the value to count as determined
        [1].
    credible : p-value of the sum of squares of all shifts in tolerances, below which the report says that they may
        imitate a missing effect [1].
    least_spread : smallest credible spread of these values, in tolerances [1]: there are some tens of them, and the
        model has errors of this size.
    narrow : spread below which outliers are searched for [1]: one of z tolerances raises the log evidence by
        z^2 / (2 spread^2).
    held : prior standard deviation of a value beyond its tolerance, over the tolerance [1]: the effect alone then
        represents it.
    effect_sizes : prior standard deviation of an effect's strength, in units of its parameter's size; broad, so that it
        costs a few nats and causes no bias.
    shape_spread : prior standard deviation of a shape parameter of an effect (a frequency), relative to its starting
        value.
    resonance_share : fraction of the largest reduction of the sum of squares that a resonance of any shape must reach
        for effects with a resonance to be searched [1].
    refits : number of effects fitted in each step of the search, the best by the score test.
    starts : number of starting values for the fit of a candidate, the best by the score test. To first order, a narrow
        resonance at a wrong frequency promises as much as one at the right frequency.
    first_iterations : iterations from each of these values, after which only the best is continued.
    rough_iterations : maximum iterations of the first fit of every candidate's own parameters, which cost little; a
        sharp resonance that starts half its width away needs more than a few.
    near_best : fraction of the best candidate's gain of log evidence, above which the other laws of a candidate are
        fitted, too: a law with fewer parameters can have the larger evidence [1].
    not_far_behind : fraction of the best candidate's gain of log evidence in that fit, above which another candidate is
        fitted further.
    least_promised : fraction of the reduction predicted by the score test, below which a fit of a candidate's own
        parameters has failed [1]: the fit of all parameters then starts from the seed, too.
    quick_rounds, quick_iterations, quick_converged : `rounds`, `iterations` and `converged` of a fit that only compares
        candidates, or gives the residual of a stage.
    near_tie : difference of log evidence [nats] up to which candidates are compared by fits to the end: such a fit
        raised the log evidence by up to 170, but by similar amounts for similar candidates.
    longest : maximum number of values beyond their tolerance in a model, and of other effects.
    revisions : how often an effect may be replaced by a rival that is better given the effects found later; twice, for
        a pair that was named wrongly both times.
    certain : gain of log evidence [nats] required for a name, in addition to the logarithm of the number of candidates:
        odds of fifty, for at most one false name in fifty campaigns.
    outside_odds : prior odds of an effect of the library against one without a name in it [1].
    rival : probability from which another name cannot be ruled out [1]; one in twenty.
    sure : probability up to which an effect is compared with its rivals again, given the effects found later [1].
    headline : probability below which a name is only an alternative [1].
    most_sure : largest probability that is reported [1]: the rest allows for explanations that are not in the library.
    trace : fraction of the gap's power below which an effect is a trace [1].
    law_p_value, law_change : an effect is refuted if one of its parameters from half of the data (by band, by level)
        differs from the whole with a smaller p-value than this [1] and by more than this fraction of itself [1]; real
        elements follow their textbook law only to a few per cent, which a p-value does not allow for.
    least_difference : variance of a difference between a half and the whole over that of the whole, below which it is
        round-off [1].
    most_of_half : variance of a half over that of the whole, above which the half carries no information on a direction
        [1].
    within_noise : chi-square per degree of freedom up to which the residual counts as noise [1]: a tenth in r.m.s., the
        uncertainty of the noise estimate itself.
    small : r.m.s. of the residual beyond noise over the response below which nothing is missing [1] (contract).
    explained : fraction of the baseline's excess power that must be removed for a gap to count as explained [1]
        (contract).
    known_noise : chi-square per degree of freedom up to which the residual shows the noise of floor and sensors [1].
    shown_runners_up : number of runners-up reported.
    """

    fewest_lines: int = 60
    few_clipped: float = 1e-5
    repairs: int = 3
    second_order_percent: float = 20.0
    turning_percent: float = 50.0
    beyond_tolerance: float = 10.0
    beyond_least: float = 3.0
    determined: float = 0.5
    credible: float = 1e-4
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
    near_best: float = 0.8
    not_far_behind: float = 0.3
    least_promised: float = 0.5
    quick_rounds: int = 4
    quick_iterations: int = 4
    quick_converged: float = 1e-4
    near_tie: float = 50.0
    longest: int = 5
    revisions: int = 2
    certain: float = 3.9
    outside_odds: float = 10.0
    rival: float = 0.05
    sure: float = 0.9
    headline: float = 0.5
    most_sure: float = 0.99
    trace: float = 0.01
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
        """Settings of a fit that only compares candidates, or only gives a figure."""
        return replace(self, rounds=self.quick_rounds, iterations=self.quick_iterations, converged=self.quick_converged)


SETTINGS = GapSettings()
