"""Lower bound on ||F_l(P, K)|| over all stabilising K.

At any point s of the closed right half plane where P has no pole, F_l(P, K)(s) = P11 + P12 Q P21 with a finite matrix
Q(s). By Parrott's theorem no Q gives a norm below

    max( sigma(U' P11), sigma(P11 V) ),      U' P12 = 0,   P21 V = 0.

By the maximum principle each such value bounds the H-infinity norm. On the imaginary axis it is the gain in directions
that actuators do not affect or sensors do not measure. At a zero of u -> z or w -> y in the right half plane it is the
interpolation bound, such as |W(z)| for a weighted sensitivity (Zames and Francis 1983; Skogestad and Postlethwaite,
Multivariable Feedback Control, 2nd ed. 2005, section 5.6.1). If the plant needs no regularisation, the Riccati test
gives the sharp bound instead.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg as la

from avis_ctrl.robust.hinf_plant import Plant, in_usual_units, parrott_at_infinity, pointwise


def pointwise_bound(plant: Plant) -> float:
    """Largest Parrott bound over frequencies on the imaginary axis and the zeros in the right half plane.

    The frequencies are 400 over the range of the plant poles, with two decades beyond.
    """
    plant = in_usual_units(plant)
    poles = np.abs(plant.sample_points())
    points = [*(1j * np.geomspace(1e-2 * np.min(poles), 1e2 * np.max(poles), 400)), *right_zeros(plant)]
    return max(parrott_at_infinity(plant), *(pointwise(plant, s, at_zero=s.real > 0) for s in points))


def right_zeros(plant: Plant) -> np.ndarray:
    """Invariant zeros in the open right half plane of the channels u -> z and w -> y, if they are square."""
    found = []
    for B, C, D in ((plant.B2, plant.C1, plant.D12), (plant.B1, plant.C2, plant.D21)):
        if D.shape[0] != D.shape[1] or not plant.n:
            continue
        n, m = plant.n, D.shape[0]
        E = la.block_diag(np.eye(n), np.zeros((m, m)))
        alpha, beta = la.eigvals(np.block([[plant.A, B], [C, D]]), E, homogeneous_eigvals=True)
        finite = np.abs(beta) > 1e-10 * np.abs(alpha)
        zeros = alpha[finite] / beta[finite]
        found.append(zeros[(zeros.real > 1e-9 * np.abs(zeros)) & (zeros.imag >= 0)])
    return np.concatenate(found) if found else np.zeros(0, complex)
