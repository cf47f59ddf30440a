"""Methods by which the results were computed, and their sources."""

from __future__ import annotations

from avis_ctrl.report.pieces import Bullets, Heading, Section, prose
from avis_ctrl.study.design_result import DesignResult

METHOD = """
Rig. The equations of motion in the payload's velocity v and its displacement r relative to the floor, with floor
velocity v_f, actuator voltages u, forces f, and matrices that depend on the uncertain parameters:

$ dot(r) = v - v_f, quad M(delta) dot(v) + C(delta)(v - v_f) + K(delta) r = T(delta) u + f $
r dot equals v minus v_f; M v dot plus C times v minus v_f plus K r equals T u plus f

The dependence on the parameters is exact, as a linear fractional transformation: no matrix is linearised in them, and
every member of the set is the rig with these parameter values.

$ F_u (P, Delta) = P_22 + P_21 Delta (I - P_11 Delta)^(-1) P_12 $
upper linear fractional transformation of P and Delta

Neglected dynamics of a channel are multiplicative uncertainty that increases with frequency:

$ G_"true" = G (1 + W_"chain" Delta), quad norm(Delta)_oo <= 1 $
the true channel is G times one plus W Delta

Controller. u = K y closes the loop; gamma is the H-infinity norm of the closed loop. The synthesis uses a controller
slightly above the optimum, so that its poles stay slow enough for the sample rate:

$ N = F_l (P, K), quad gamma = norm(N)_oo = sup_omega overline(sigma)(N(j omega)) $
gamma is the supremum over frequency of the largest singular value of N

Structured singular value. mu is the inverse of the size of the smallest perturbation of the given structure that makes
the loop singular. With the performance as an additional block, mu below 1 means that the loop is stable and meets every
weighted requirement for every plant of the set:

$ mu_Delta (N) = 1 / (min { overline(sigma)(Delta) : det(I - N Delta) = 0 }), quad max_(Delta) abs(lambda(N Delta)) <=
mu_Delta (N) <= inf_D overline(sigma)(D N D^(-1)) $
definition of mu, with its lower and upper bound

The upper bound is found by scalings D (and G for real blocks), the lower bound by a perturbation that is checked to
make the loop singular. D-K iteration minimises the upper bound over K and D(s) in turn:

$ min_(K, D) norm(D thin F_l (P, K) thin D^(-1))_oo $
minimum over K and D of the norm of the scaled loop

Worst-case gain is the largest transmissibility over the whole set. Transmissibility is the largest singular value from
floor velocity to payload velocity, with rotations as displacement at the edge lever of EDGE m. Third octaves follow
IEC 61260 with base-ten midbands.
"""
SOURCES = (
    "B. M. Beadle, S. Hurlebaus, U. Stöbener, L. Gaul: Modeling and Parameter Identification of an Active "
    "Anti-Vibration System (the Halcyonics table).",
    "N. G. M. Rademakers: Modelling, Identification and Multivariable Control of an Active Vibration Isolation System, "
    "report DCT 2005.63, Eindhoven University of Technology, 2005 (the AVIS).",
    "S. Skogestad, I. Postlethwaite: Multivariable Feedback Control, 2nd ed., Wiley, 2005 (weights, uncertainty, mu).",
    "K. Zhou, J. C. Doyle, K. Glover: Robust and Optimal Control, Prentice Hall, 1996 (H-infinity, mu, D-K iteration).",
    "A. Packard, J. C. Doyle: The complex structured singular value, Automatica 29 (1993) 71-109.",
    "S. O. Rice: Mathematical Analysis of Random Noise, Bell System Technical Journal 23 (1944) (level crossings).",
    "P. D. Welch: The use of fast Fourier transform for the estimation of power spectra, IEEE Trans. Audio "
    "Electroacoust. AU-15 (1967).",
    "IEC 61260-1:2014: Octave-band and fractional-octave-band filters.",
    "C. G. Gordon: Generic criteria for vibration-sensitive equipment, Proc. SPIE 1619 (1991).",
    "H. Amick, M. Gendreau, T. Busch, C. Gordon: Evolving criteria for research facilities, Proc. SPIE 5933 (2005).",
)


def method(result: DesignResult) -> Section:
    """Summary of the method with its formulas."""
    told = prose(METHOD.replace("EDGE", f"{result.rig.edge_m:.3g}"))
    return Section("Method", "method", (*told, Heading("Sources"), Bullets(SOURCES)))
