"""Every tuning value of the search for missing effects, with its unit, its meaning and the reason for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GapSettings:
    """Values that no data determine; all of them are part of a result's provenance.

    stiffness_percent : prior standard deviation of mass, moments of inertia and stiffnesses [%]; a rig file is drawn
        from scales and data sheets.
    damping_percent : the same of dampings [%], which data sheets hardly state.
    lines : spectral lines of a record that are fitted; with 8 drives and 6 sensors the response needs about 100, and
        twice as many make the estimate of the unexplained part precise.
    fewest_lines : lines of a record in the band below which a fit with its transient determines nothing.
    few_clipped : share of a channel's samples beyond its limits from which repaired samples are predicted anew.
    repairs : how often, each time with the better model that the last repair allowed.
    bands_per_octave : bands over which the relative error of a path counts as constant; a third of an octave is what a
        mode's flank takes to change by a factor of two.
    least_error : relative error of every path that nobody can exclude [1], the scale of its prior: cables, threads and
        glue change a response by 0.1 % from day to day.
    error_weight : degrees of freedom of that prior; two, the least with a finite mean of the precision.
    first_error : relative error of the paths in the first fit [1], before any residual is known.
    climbs : steps up the likelihood of the variances in each estimate.
    rounds, settled : most estimates of the variances, each from the fit before it, and rise of the log-likelihood
        [nats] below which they end: well below what decides between two effects.
    iterations : Gauss-Newton steps between two estimates of the variances.
    first_distortion : distortion in the first fit, over the square of `first_error` [1].
    least_distortion : distortion that nobody can exclude, over the noise [1]; below it an estimate is round-off.
    least_eigenvalue : of the path errors' covariance over that of the noise, below which a direction is left out [1].
    second_order_percent : prior standard deviation of the second-order terms of rotations [%]: Newton and Euler have
        them, and they hang on a geometry known to some per cent.
    turning_percent : the same of the share of the rotation that turns the axes of motors and sensors [%], which a rig
        file does not state.
    shortest_step : part of a Gauss-Newton step below which no shorter one is tried [1].
    beyond_tolerance : prior standard deviation of a value that may be beyond its tolerance, in tolerances: as wide as
        faults of wiring, mounting and data sheets are.
    beyond_least : tolerances by which a value must differ from the rig file's to be beyond its tolerance.
    effect_sizes : prior standard deviation of an effect's strength, in units of its parameter's size; broad, so that it
        costs some nats and bends nothing.
    shape_spread : prior standard deviation of a parameter that shapes an effect (a frequency), relative to its start.
    resonance_share : of the largest fall of the sum of squares, that a resonance of any shape must bring for effects
        with a resonance to be looked for [1].
    refits : effects that are refitted at each step of the search, the best by the score test.
    rough_iterations : most of a first fit of every candidate, at the variances as they are; a sharp resonance that
        begins half its width away needs more than a few.
    not_far_behind : share of the best candidate's gain of log evidence by that fit with which another one is fitted on.
    quick_rounds, quick_iterations : `rounds` and `iterations` of a fit that only compares candidates.
    longest : most effects that are named together.
    certain : gain of log evidence [nats] that a name needs beside the logarithm of the number of candidates: odds of
        a hundred.
    outside_odds : how many times as probable an effect of the library is beforehand as one that has no name in it [1].
    rival : probability from which another name cannot be ruled out [1]; one in twenty.
    sure : probability up to which an effect is compared with its rivals again, beside what was found after it [1].
    headline : probability below which a name is an alternative only [1].
    most_sure : largest probability that is reported [1]: what nobody thought of leaves so much.
    trace : share of the gap's power below which an effect is a trace [1].
    minor : share of what the model with tolerances leaves below which a trace ends the search [1].
    law_p_value, law_change : an effect is refuted where its parameters from half of the data (by band, by level) differ
        from the whole with a smaller p-value than this [1] and by more than this share [1]; real elements follow their
        textbook law to some per cent only, which no p-value knows.
    least_difference : of the variance of a difference between a half and the whole over the whole's, below which it is
        round-off [1].
    most_of_half : variance of a half over the whole's, above which that half says nothing of a direction [1].
    within_noise : chi-square per degree of freedom up to which what remains counts as noise [1]: a tenth in r.m.s.,
        which is what the noise's own estimate leaves open.
    small : r.m.s. of what remains over the response below which nothing is missing [1] (contract).
    explained : share of the baseline's excess power that must be gone for a gap to count as explained [1] (contract).
    known_noise : chi-square per degree of freedom up to which what remains tells the level of floor and sensors [1].
    shown_runners_up : runners-up that are reported.
    converged : change of the penalised sum of squares, relative to the number of data, below which a fit has converged.
    """

    stiffness_percent: float = 5.0
    damping_percent: float = 20.0
    lines: int = 200
    fewest_lines: int = 60
    few_clipped: float = 1e-5
    repairs: int = 3
    bands_per_octave: int = 3
    least_error: float = 1e-3
    error_weight: float = 2.0
    first_error: float = 0.05
    climbs: int = 60
    rounds: int = 12
    settled: float = 1.0
    iterations: int = 6
    first_distortion: float = 0.01
    least_distortion: float = 0.02
    least_eigenvalue: float = 1e-8
    second_order_percent: float = 20.0
    turning_percent: float = 50.0
    shortest_step: float = 1e-3
    beyond_tolerance: float = 20.0
    beyond_least: float = 3.0
    effect_sizes: float = 100.0
    shape_spread: float = 1.0
    resonance_share: float = 0.1
    refits: int = 8
    rough_iterations: int = 8
    not_far_behind: float = 0.3
    quick_rounds: int = 4
    quick_iterations: int = 4
    longest: int = 5
    certain: float = 4.6
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
    converged: float = 1e-5


SETTINGS = GapSettings()
