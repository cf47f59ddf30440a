"""Methods by which an identification was computed, and their sources."""

from __future__ import annotations

from avis_ctrl.report.pieces import Bullets, Heading, Section, prose
from avis_ctrl.study.identification import Identification

FIT = """
Model. The spectra of the sensor signals follow from the rig's equations of motion with their physical parameters theta,
the hold and delay h of the drives, and the response s of the sensor chains:

$ Y_k = underbrace(s(omega_k) R (j omega_k)^p D^(-1)(omega_k, theta) [T h space F_"floor"], G(omega_k, theta)) vec(U_k,
V_k) + t_k + e_k, quad D = K + j omega C - omega^2 M $
Y equals G times inputs and floor velocity plus transient plus noise, D the dynamic stiffness

Transient. If the state of the table at the beginning of a record differs from that at the end, the record contains a
transient. In the spectrum the transient is linear in real unknowns x: an impulse and a step at the payload, the states
of the sensor chains, and a constant and a slope. It is fitted together with the parameters:

$ t_k = B(omega_k, theta) x $
the transient on line k is B times x

Large rotations. The second-order terms of the nonlinear table (Newton and Euler, finite angles) are simulated in time
with the current parameters and subtracted from the records, in the fit and in the validation. Time-domain predictions
and closed-loop simulations include them, too. The records decide whether the axes of motors and sensors turn with the
table.

Likelihood. With circular complex normal noise of covariance C_k on line k, minus twice the logarithm of the likelihood
is, up to a constant,

$ chi^2(theta) = min_x 2 sum_k e_k^H C_k^(-1) e_k + sum_j (theta_j - theta_j^0)^2 / sigma_j^2 $
chi-square is twice the sum of e C inverse e over lines, plus the priors

where the second sum is over the parameters with a prior, if any. It is minimised by Levenberg-Marquardt steps in
relative parameters from several starts, with analytic derivatives. The noise covariance is first estimated from the
records and then from the residuals.
"""
TOLERANCES = """
Tolerances. Every value of the rig file that has a tolerance (positions, directions, gains, corners and damping ratios
of geophones, centre of mass, products of inertia) is fitted beside the parameters, with its tolerance as the standard
deviation of a normal prior. The residual is weighted by noise, by a relative error of each path from an input to a
sensor that is constant over a third of an octave, and by distortion; the variances of the last two are estimated from
the residual in turn with the fit. The information on the parameters alone is the Schur complement of H with respect to
the tolerances.
"""
INFORMATION = """
Information. With J the derivative of the whitened residuals, the Cramér-Rao bound of every unbiased estimate is

$ H = J^T J, quad op("cov") hat(theta) >= S V_1 Lambda_1^(-1) V_1^T S, quad S H S = V Lambda V^T $
the information H is J transposed J; the covariance is its inverse on the determined directions

over the directions V_1 whose relative standard deviation is below 1; S contains the magnitudes of the parameters. Along
directions without information the starting values are kept; a parameter that contributes to such a direction is known
only in combination.

Validation. Chi-square of the held-out data uses a noise covariance estimated from the fitted records alone; its
interval allows for the number of lines, the parameters' uncertainty and the error of the noise estimate itself.

$ op("E") chi^2 / n = 1 + 1/n op("tr") (J_v op("cov") hat(theta) thin J_v^T) $
the expected chi-square per number is one plus the trace of the predicted variance
"""
SOURCES = (
    "R. Pintelon, J. Schoukens: System Identification: A Frequency Domain Approach, 2nd ed., Wiley, 2012 (sections "
    "2.7, 7.2 and 9.11: frequency responses, local models, maximum likelihood).",
    "G. H. Golub, V. Pereyra: The differentiation of pseudo-inverses and nonlinear least squares problems whose "
    "variables separate, SIAM J. Numer. Anal. 10 (1973) 413-432 (transient projected out).",
    "L. Ljung: System Identification: Theory for the User, 2nd ed., Prentice Hall, 1999 (section 16.6: tests of "
    "residuals).",
    "N. G. M. Rademakers: Modelling, Identification and Multivariable Control of an Active Vibration Isolation System, "
    "report DCT 2005.63, Eindhoven University of Technology, 2005 (the AVIS; extended Kalman filter, section 3.3).",
    "B. M. Beadle, S. Hurlebaus, U. Stöbener, L. Gaul: Modeling and Parameter Identification of an Active "
    "Anti-Vibration System (the Halcyonics table; sequential fit, section 3).",
)


def method(found: Identification) -> Section:
    """Summary of the method with its formulas."""
    told = prose(FIT + (TOLERANCES if found.campaign_fit.tolerances else "") + INFORMATION)
    return Section("Method", "method", (*told, Heading("Sources"), Bullets(SOURCES)))
