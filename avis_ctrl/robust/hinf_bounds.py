"""What no controller can do: a lower bound on ||F_l(P, K)|| over every stabilising K.

At any point s of the closed right half plane where P has no pole, F_l(P, K)(s) = P11 + P12 Q P21 with
some finite matrix Q(s), and by Parrott's theorem no Q brings its norm below

    max( sigma(U' P11), sigma(P11 V) ),      U' P12 = 0,   P21 V = 0.

By the maximum principle each such value bounds the H-infinity norm. On the imaginary axis this is what
the directions of actuators and sensors leave; at a zero of u -> z or w -> y in the right half plane it is
the interpolation bound, such as |W(z)| for a weighted sensitivity (Zames and Francis 1983; Skogestad and
Postlethwaite, Multivariable Feedback Control, 2nd ed. 2005, section 5.6.1). The Riccati test, where
the plant needs no regularisation, gives the sharp bound.
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
class LowerBound:
    """No stabilising controller brings the norm below `gamma`.

    point : s [rad/s] where the bound is reached (of the bilinear image when P is sampled); nan for the Riccati test.
    source : the argument, in words.
    """

    gamma: float
    point: complex
    source: str


def hinf_lower_bound(P: Any, nmeas: int, ncon: int, omega: np.ndarray | None = None) -> LowerBound:
    """The best of the pointwise bounds and, where it applies, of the Riccati test (infeasible gamma, within 0.1 %).

    omega : frequencies [rad/s] to look at; by default 400 over the range of the plant's poles.
    Errors as in `hinfsyn`.
    """
    P = as_plant(P, nmeas, ncon)
    plant = posed_plant(P, nmeas, ncon)
    best = pointwise_bound(plant, omega)
    if min(rank_margins(plant)) >= SETTINGS.rank_tolerance:
        lower = find_gamma(normal_form(plant).plant, 1e-3).lower
        if lower > best.gamma:
            return LowerBound(float(lower), complex(np.nan), "the two-Riccati test fails there")
    return best


def pointwise_bound(plant: Plant, omega: np.ndarray | None = None) -> LowerBound:
    """Largest Parrott bound over the imaginary axis (sampled) and the zeros in the right half plane."""
    plant = in_usual_units(plant)
    if omega is None:
        poles = np.abs(plant.sample_points())
        omega = np.geomspace(1e-2 * np.min(poles), 1e2 * np.max(poles), 400)
    best = LowerBound(parrott_at_infinity(plant), complex(np.inf), "directions free at infinite frequency")
    for s, source in [*((1j * w, "directions free at one frequency") for w in omega),
                      *((z, "a right-half-plane zero of u -> z or w -> y") for z in right_zeros(plant))]:
        value = pointwise(plant, s, at_zero=s.real > 0)
        if value > best.gamma:
            best = LowerBound(value, complex(s), source)
    return best


def right_zeros(plant: Plant) -> np.ndarray:
    """Invariant zeros in the open right half plane of the square channels among u -> z and w -> y."""
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
