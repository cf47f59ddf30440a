"""How the figures of a gap were computed, and where it is written down."""

from __future__ import annotations

from avis_ctrl.gap.result import Gap
from avis_ctrl.gap.search import GIVEN_UP, PRIOR
from avis_ctrl.report.pieces import Bullets, Formula, Heading, Paragraph, Piece, Section

SOURCES = (
    "C. R. Rao: Large sample tests of statistical hypotheses concerning several parameters with applications to "
    "problems of estimation, Proc. Camb. Phil. Soc. 44 (1948) 50-57 (score test).",
    "J. Neyman: Optimal asymptotic tests of composite statistical hypotheses, in Probability and Statistics, Almqvist "
    "& Wiksell, 1959, 213-234 (score orthogonal to nuisance parameters).",
    "G. H. Golub, V. Pereyra: The differentiation of pseudo-inverses and nonlinear least squares problems whose "
    "variables separate, SIAM J. Numer. Anal. 10 (1973) 413-432 (variable projection).",
    "G. Schwarz: Estimating the dimension of a model, Ann. Statist. 6 (1978) 461-464 (Bayesian information "
    "criterion).",
    "M. Stone: Cross-validatory choice and assessment of statistical predictions, J. R. Statist. Soc. B 36 (1974) "
    "111-147 (held-out data).",
    "R. Pintelon, J. Schoukens: System Identification: A Frequency Domain Approach, 2nd ed., Wiley, 2012 (likelihood "
    "on spectral lines, nonparametric noise, best linear approximation).",
)


def method(gap: Gap) -> Section:
    """Short account of the method with its formulas."""
    pieces: list[Piece] = [
        Paragraph("Residual. On line k of a record, with spectra Y of the outputs and U of drives and floor, model G "
                  "and measured noise covariance C, the transient t of the record's ends is linear in unknowns that "
                  "are projected out (variable projection):"),
        Formula("e_k = Y_k - G(omega_k, theta) U_k - t_k, quad chi^2(theta) = min_t 2 sum_k e_k^H C_k^(-1) e_k",
                "chi-square is the smallest sum over lines of the whitened squared residual"),
        Paragraph("Score. An effect with parameters psi, none of them at psi = 0, is judged by what it would take off "
                  "chi-square to first order, once everything that the rig's own parameters theta could absorb is "
                  "taken out of it (score test orthogonal to nuisance parameters). With r the whitened residual and J "
                  "the derivatives:"),
        Formula("tilde(J)_psi = (I - J_theta J_theta^+) J_psi, quad S = r^T tilde(J)_psi "
                "(tilde(J)_psi^T tilde(J)_psi)^(-1) tilde(J)_psi^T r tilde.op chi^2_q",
                "the score S is the squared projection of the residual on the effect's orthogonalised derivatives"),
        Paragraph("Under the model as it is, S is chi-square distributed with as many degrees of freedom as "
                  "directions; its significance allows for the number of effects and places that were tried."),
        Paragraph("Selection. Significant candidates are refitted together with all parameters of the rig, and "
                  "compared by the Bayesian information criterion of the fit, with p combinations of parameters that n "
                  "data determine, and by the likelihood of data that no fit has seen. Probabilities follow from the "
                  "sum, over the candidates that were refitted, all equal beforehand, but what has no name in the "
                  f"library {PRIOR:g} times less likely than an effect of it. A factor m divides the criteria: "
                  "the chi-square per degree of freedom of the best one, at least 1, for where that leaves more than "
                  "noise, times what the noise's own uncertainty adds to a difference. What explains the data and has "
                  "no name takes its share, and the name from a probability of "
                  f"{1 - GIVEN_UP:.0%} on; none is stated above 99 %:"),
        Formula("kappa = chi_\"fit\"^2 + p ln n + chi_\"held out\"^2, quad P_i = e^(-kappa_i slash 2 m) "
                "slash sum_j e^(-kappa_j slash 2 m)",
                "the probability of candidate i is its share of the exponentials of minus half the criterion"),
        Paragraph("An effect of the table is named only if the held-out data confirm it; hum, converters and the "
                  "floor's motion are judged in all records together. Effects are added one by one, up to "
                  "two, until the held-out residual is noise or nothing that was tried helps enough. Error and noise "
                  "in per cent:"),
        Formula("op(\"n.r.m.s.\") = (1 / n_y sum_i sum_k abs(e_(k i))^2 slash sum_k abs(Y_(k i))^2)^(1 slash 2)",
                "the normalised error is the root of the mean over outputs of the residual's power over the output's"),
        Paragraph("What held out means. No parameter is fitted to the held-out records, but they have their say in "
                  "which candidate is chosen and when to stop, so that their figures after naming are no independent "
                  "test. The noise is that of the fitted records; hum, what is wrong with a converter, and the levels "
                  "of floor and sensors are found in all records, and hum is taken out of all. Where a channel clips, "
                  "what the model expects behind the limit stands in place of the clipped samples, of held-out records "
                  "too: these samples test nothing. Forces that depend on amplitude or time, the second-order terms "
                  "of large rotations among them, act on the motion of the mounts as the model has it, corrected by "
                  "each record's own sensors, of the held-out records too; avis predict goes from drives and floor "
                  "alone."),
        Paragraph(f"Held out: {gap.held_out.rstrip('.')}." if gap.held_out else
                  "How the records were divided is not stated."),
        Heading("Sources"), Bullets(SOURCES)]
    return Section("Method", "method", tuple(pieces))
