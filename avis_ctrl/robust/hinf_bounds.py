"""Lower bound on ||F_l(P, K)|| over all stabilising K.

At any point s of the closed right half plane where P has no pole, F_l(P, K)(s) = P11 + P12 Q P21 with a finite matrix
Q(s). By Parrott's theorem no Q gives a norm below

    max( sigma(U' P11), sigma(P11 V) ),      U' P12 = 0,   P21 V = 0.

By the maximum principle each such value bounds the H-infinity norm. On the imaginary axis it is the gain in directions
that actuators do not affect or sensors do not measure. At a zero of u -> z or w -> y in the right half plane it is the
interpolation bound, such as |W(z)| for a weighted sensitivity (Zames and Francis 1983; Skogestad and Postlethwaite,
Multivariable Feedback Control, 2nd ed. 2005, section 5.6.1). The Riccati test gives the sharp bound if the plant needs
no regularisation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from avis_ctrl.robust.hinf_plant import (
    Plant,
    as_plant,
    in_usual_units,
    normal_form,
    parrott_at_infinity,
    pointwise,
    posed_plant,
    rank_margins,
)
from avis_ctrl.robust.hinf_riccati import find_gamma
from avis_ctrl.robust.hinf_settings import SETTINGS


@dataclass(frozen=True)
class HinfLowerBound:
    """No stabilising controller achieves a norm below `gamma`.

    point : s [rad/s] where the bound is attained (of the bilinear image if P is sampled); nan for the Riccati test.
    source : description of the argument.
    """

    gamma: float
    point: complex
    source: str


def hinf_lower_bound(P: Any, nmeas: int, ncon: int, omega: np.ndarray | None = None) -> HinfLowerBound:
    """The largest of the pointwise bounds and, if applicable, the bound of the Riccati test (within 0.1 %).

    omega : frequencies [rad/s] to evaluate; default: 400 over the range of the plant poles, with two decades beyond.
    Raises the errors of `hinfsyn`.
    """
    P, nmeas, ncon = as_plant(P, nmeas, ncon)
    plant = posed_plant(P, nmeas, ncon)
    best = pointwise_bound(plant, omega)
    if min(rank_margins(plant)) >= SETTINGS.rank_tolerance:
        lower = find_gamma(normal_form(plant).plant, 1e-3).lower
        if lower > best.gamma:
            return HinfLowerBound(float(lower), complex(np.nan), "the two-Riccati test fails there")
    return best


def pointwise_bound(plant: Plant, omega: np.ndarray | None = None) -> HinfLowerBound:
    """Largest Parrott bound over frequencies on the imaginary axis and the zeros in the right half plane."""
    plant = in_usual_units(plant)
    if omega is None:
        poles = np.abs(plant.sample_points())
        omega = np.geomspace(1e-2 * np.min(poles), 1e2 * np.max(poles), 400)
    best = HinfLowerBound(parrott_at_infinity(plant), complex(np.inf), "directions free at infinite frequency")
    for s, source in [
        *((1j * w, "directions free at one frequency") for w in omega),
        *((z, "a right-half-plane zero of u -> z or w -> y") for z in right_zeros(plant)),
    ]:
        value = pointwise(plant, s, at_zero=s.real > 0)
        if value > best.gamma:
            best = HinfLowerBound(value, complex(s), source)
    return best


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
