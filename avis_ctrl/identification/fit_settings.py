"""Every tuning value of a fit within priors, with its unit, its meaning and the reason for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FitSettings:
    """Values that no data determine; all of them are part of a result's provenance.

    stiffness_percent : prior standard deviation of mass, moments of inertia and stiffnesses [%]; a rig file is drawn
        from scales and data sheets.
    damping_percent : the same of dampings [%], which data sheets hardly state.
    unknown_percent : standard deviation [%] about where a fit begins, of parameters of which nothing is stated: far
        more than data leave open of what they determine, and little enough that the rest stays where it was (Levenberg
        and Marquardt's damping, as a prior).
    lines : spectral lines of a record that are fitted; with 8 drives and 6 sensors the response needs about 100, and
        twice as many make the estimate of the unexplained part precise.
    residual_lines : lines of a record from whose residuals an identification estimates the noise. Not all of them are
        fitted: path errors are independent from band to band in the model, unexplained effects are not, and with
        all lines the fit moved tolerances by seven standard deviations instead of two.
    final_rounds : `rounds` of the fit after the second-order terms were formed anew; it begins where the other ended.
    bands_per_octave : bands over which the relative error of a path counts as constant; a third of an octave is what a
        mode's flank takes to change by a factor of two.
    least_error : relative error of every path that nobody can exclude [1], the scale of its prior: cables, threads and
        glue change a response by 0.1 % from day to day.
    error_weight : degrees of freedom of the priors of the variances; two, the least with a finite mean of the
        precision.
    first_error : relative error of the paths in the first fit [1], before any residual is known.
    climbs : steps up the likelihood of the variances in each estimate.
    rounds, settled : most estimates of the variances, each from the fit before it, and rise of the log-likelihood
        [nats] below which they end: well below what decides between two effects.
    iterations : Gauss-Newton steps between two estimates of the variances.
    first_distortion : distortion in the first fit, over the square of `first_error` [1].
    least_distortion : distortion that nobody can exclude, over the noise [1], the scale of its prior: the noise's own
        estimate leaves as much open.
    least_eigenvalue : of the path errors' covariance over that of the noise, below which a direction is left out [1].
    least_elsewhere : fraction of the information on a combination of parameters that an octave or a level must leave
        to others to be compared with them [1]: of what one octave alone determines, the others say nothing, and
        round-off of the fit would count a hundredfold.
    damping : factor between the dampings that are tried until a step descends [1].
    shortest_step : part of a Gauss-Newton step, along what the data determine best, below which no shorter one is
        tried [1].
    converged : change of the penalised sum of squares, relative to the number of data, below which a fit has converged.
    """

    stiffness_percent: float = 5.0
    damping_percent: float = 20.0
    unknown_percent: float = 10.0
    lines: int = 200
    residual_lines: int = 800
    final_rounds: int = 3
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
    least_elsewhere: float = 0.05
    damping: float = 10.0
    shortest_step: float = 1e-3
    converged: float = 1e-5


SETTINGS = FitSettings()
