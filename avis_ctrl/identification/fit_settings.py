"""All tuning values of a fit with priors, with unit, meaning and reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FitSettings:
    """Values that no data determine; all of them are part of a result's provenance.

    stiffness_percent : prior standard deviation of mass, moments of inertia and stiffnesses [%]; a rig file is based on
        scales and data sheets.
    damping_percent : the same for dampings [%], which data sheets hardly state.
    unknown_percent : standard deviation [%] about the start of a fit, for parameters without a stated prior: much
        larger than the uncertainty of what the data determine, and small enough that the rest stays where it was
        (Levenberg-Marquardt damping, as a prior).
    lag_percent : standard deviation of the amplifiers' time constant [%], which no rig file states: amplifiers without
        a lag are within three standard deviations, and a lag of more than twice the expected one is beyond them.
    least_lag_s : minimum of that standard deviation [s]: cables, filters and converters lag by as much, even if the
        amplifiers do not.
    shortest_lag : time constant below which amplifiers have no lag, relative to the expected one [1].
    lines : spectral lines per record that are fitted; with 8 drives and 6 sensors the response needs about 100, and
        twice as many give a precise estimate of the unexplained part.
    residual_lines : lines per record from whose residuals an identification estimates the noise. Not all of them are
        fitted: path errors are independent between bands in the model, unexplained effects are not, and with all lines
        the fit moved tolerances by seven standard deviations instead of two.
    final_rounds : `rounds` of the fit after the second-order terms were recomputed; it starts where the previous fit
        ended.
    bands_per_octave : bands over which the relative error of a path is taken as constant; over a third of an octave the
        flank of a mode changes by a factor of two.
    least_error : relative error that cannot be excluded for any path [1], the scale of its prior: cables, threads and
        glue change a response by 0.1 % from day to day.
    error_weight : degrees of freedom of the priors of the variances: two, as if two squares of their scale had been
        observed.
    first_error : relative error of the paths in the first fit [1], before any residual is known.
    variance_steps : maximum number of scoring steps from each start of an estimate of the variances; on average,
        six suffice.
    variance_settled : expected rise of the log-likelihood of one sensor in one band [nats] below which they stop.
    longest_step : maximum change of the logarithm of a variance in one step [1], a factor of twenty.
    rounds, settled : maximum number of estimates of the variances, each from the fit before it, and rise of the
        log-likelihood [nats] below which they stop: well below what decides between two effects. A step that is
        expected to decrease the sum of squares by less keeps the transients of the step before.
    iterations : Gauss-Newton steps between two estimates of the variances.
    first_distortion : distortion in the first fit, relative to the square of `first_error` [1].
    least_distortion : distortion that cannot be excluded, relative to the noise [1], the scale of its prior: the
        estimate of the noise has about this uncertainty.
    least_eigenvalue : eigenvalue of the path errors' covariance, relative to the noise, below which a direction is
        omitted [1].
    least_elsewhere : minimum fraction of the information on a combination of parameters that must lie outside an octave
        or a level for a comparison [1]: if one octave alone determines a combination, the others say nothing about it,
        and round-off of the fit would count a hundredfold.
    damping : factor between successive dampings that are tried until a step descends [1].
    shortest_step : minimum length of a step that is tried, relative to the Gauss-Newton step, along the best determined
        direction [1].
    converged : change of the penalised sum of squares, relative to the number of data, below which a fit has converged.
    """

    stiffness_percent: float = 5.0
    damping_percent: float = 20.0
    unknown_percent: float = 10.0
    lag_percent: float = 35.0
    least_lag_s: float = 1e-4
    shortest_lag: float = 1e-3
    lines: int = 200
    residual_lines: int = 800
    final_rounds: int = 3
    bands_per_octave: int = 3
    least_error: float = 1e-3
    error_weight: float = 2.0
    first_error: float = 0.05
    variance_steps: int = 40
    variance_settled: float = 1e-3
    longest_step: float = 3.0
    rounds: int = 12
    settled: float = 1.0
    iterations: int = 6
    first_distortion: float = 0.01
    least_distortion: float = 0.02
    least_eigenvalue: float = 1e-8
    least_elsewhere: float = 0.05
    damping: float = 10.0
    shortest_step: float = 1e-3
    converged: float = 1e-5


SETTINGS = FitSettings()
