"""Methods by which a gap is analysed, and their sources."""

from __future__ import annotations

from avis_ctrl.gap.result import Gap
from avis_ctrl.report.pieces import Bullets, Heading, Paragraph, Section, prose

METHOD = """
Model of a record. On line k, with spectra Y of the outputs and U of drives and floor:

$ Y_k = G(omega_k, theta, t, a) U_k + T_k x + (E circle.small G) U_k + n_k $
output is response times input, plus transient, plus relative path errors, plus noise

theta are mass, inertia, stiffness and damping (normal priors of 5 %, damping 20 %), t the tolerances of the rig file, a
the parameters of effects. x are the states at the ends of the record; they are projected out. E are relative errors of
every path from a drive to a sensor, constant over a third of an octave and the same at every level: unexplained errors
of the model. Their variance is estimated for each sensor and band, that of an additional noise (distortion) for each
level too, and the path errors are integrated out. Where octaves or levels differ by more than these variances explain,
the standard deviations cover it.

Evidence. The evidence of a model with given effects is computed by Laplace's method. J is the penalised sum of squares
at the estimate, C the covariance of path errors and noise, and H the information including the priors; the constant
accounts for the states at the ends of the records:

$ ln p(Y) = -J/2 - 1/2 ln det C - 1/2 ln det H + "const." $
log evidence is minus half the sum of squares, less half the log determinants

Search. A score test with priors predicts, to first order, by how much each effect at each place would reduce J. The
best candidates of each kind of effect are fitted together with all parameters and tolerances. The candidate with the
largest evidence is accepted if it raises the log evidence by more than 3.9 plus the logarithm of the number of
candidates. The search continues with this effect in the model, until an effect explains less than 1 % of the gap.

Names. An effect that was found is named if it is more probable than not, if its parameters from the lower and the
upper half of the band, and from low and high levels, agree with the whole, if its values are physically possible, and
if the held-out records have a higher likelihood with it. Its probability is relative to all that was fitted in its
place, including faults that are not in the library. Two kinds of odds are computed, from the evidence and from how
evenly the difference d_g of the log-likelihoods is spread over bands and levels g. The less certain odds are used,
because real elements do not follow textbook laws exactly:

$ z = sum_g d_g slash (sum_g (d_g - overline(d))^2)^(1 slash 2), quad P = Phi(z) $
z is the sum of the differences over their spread; the probability is the normal distribution of z

Errors and noise in per cent, on records that no fit has seen:

$ op("n.r.m.s.") = (1 / n_y sum_i sum_k abs(e_(k i))^2 slash sum_k abs(Y_(k i))^2)^(1 slash 2) $
the normalised error is the root of the mean over outputs of the residual's power over the output's

Held-out records. No parameter is fitted to them, but they help to decide whether an effect is named; their errors after
naming are therefore not a fully independent test. Hum, faults of a converter, and the levels of floor and sensors are
found in all records, and hum is removed from all. Where a channel clips, the clipped samples are replaced by the
model's prediction, in held-out records too: these samples test nothing. Forces that depend on amplitude or time are
computed from the modelled motion of the mounts, corrected with the sensor signals of the same record; avis predict uses
drives and floor motion only.
"""
SOURCES = (
    "C. R. Rao: Large sample tests of statistical hypotheses concerning several parameters with applications to "
    "problems of estimation, Proc. Camb. Phil. Soc. 44 (1948) 50-57 (score test).",
    "G. H. Golub, V. Pereyra: The differentiation of pseudo-inverses and nonlinear least squares problems whose "
    "variables separate, SIAM J. Numer. Anal. 10 (1973) 413-432 (variable projection).",
    "H. Zhou, L. Hu, J. Zhou, K. Lange: MM algorithms for variance components models, J. Comput. Graph. Stat. 28 "
    "(2019) 350-361 (variance components).",
    "D. J. C. MacKay: Bayesian interpolation, Neural Computation 4 (1992) 415-447 (evidence, Laplace's method).",
    "Q. H. Vuong: Likelihood ratio tests for model selection and non-nested hypotheses, Econometrica 57 (1989) 307-333 "
    "(significance of the difference between two laws).",
    "J. A. Hausman: Specification tests in econometrics, Econometrica 46 (1978) 1251-1271 (halves of the data).",
    "R. Pintelon, J. Schoukens: System Identification: A Frequency Domain Approach, 2nd ed., Wiley, 2012 (likelihood "
    "on spectral lines, nonparametric noise).",
)


def method(gap: Gap) -> Section:
    """Summary of the method with its formulas."""
    held_out = Paragraph(f"Held out: {gap.held_out.rstrip('.')}.")
    pieces = (*prose(METHOD), held_out, Heading("Sources"), Bullets(SOURCES))
    return Section("Method", "method", pieces)
