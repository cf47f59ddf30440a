"""Pade approximations of the loop delay and of the zero-order hold, in state space."""

from __future__ import annotations

from math import comb, factorial

import numpy as np
import scipy.linalg as la

from avis_ctrl.checks import is_whole, require_positive
from avis_ctrl.errors import InputError
from avis_ctrl.lti.statespace import StateSpace, gain, tf


def pade_coefficients(order: int) -> np.ndarray:
    """Coefficients of N(x), by descending power, where N(-x)/N(x) is the [n/n] Pade approximant of exp(-x).

    Raises InputError for an order outside 1..10.
    """
    if not (is_whole(order, 1) and order <= 10):
        raise InputError("a whole number from 1 to 10", field="pade_order", value=order)
    return np.array([comb(order, k) * factorial(2 * order - k) / factorial(2 * order) for k in range(order, -1, -1)])


def pade_delay(delay_s: float, order: int = 2, input_name: str = "u", output_name: str = "y") -> StateSpace:
    """All-pass Pade approximation of exp(-s T), in coordinates where both Gramians are the identity.

    The Gramians of an all-pass system are inverses of each other, so these coordinates are balanced. The realisation
    is well conditioned for any delay, unlike a companion form in powers of 1/T.

    Raises
    ------
    InputError : a negative or non-finite delay, an order outside 1..10.
    """
    require_positive(delay_s, "delay_s", zero_allowed=True)
    denominator = pade_coefficients(order)
    if delay_s == 0:
        return gain(1.0, [input_name], [output_name])
    numerator = denominator * (-1.0) ** np.arange(order, -1, -1)
    unit = tf(list(numerator), list(denominator))
    gramian = la.solve_continuous_lyapunov(unit.A, -unit.B @ unit.B.T)
    unit = unit.similar(la.cholesky(gramian, lower=True))
    root = np.sqrt(1.0 / delay_s)
    return StateSpace(unit.A / delay_s, unit.B * root, unit.C * root, unit.D, 0.0, (input_name,), (output_name,))


def zero_order_hold(sample_time_s: float, order: int = 2, input_name: str = "u", output_name: str = "y") -> StateSpace:
    """Continuous model (1 - exp(-s T))/(s T) of a zero-order hold, with the Pade approximant of the exponential.

    The factor s of the numerator is cancelled analytically, so that the gain at zero frequency is exactly 1.
    """
    require_positive(sample_time_s, "sample_time_s")
    denominator = pade_coefficients(order)
    # N(x) - N(-x) is twice the odd part of N; division by x lowers each power by one.
    odd = np.where(np.arange(order, -1, -1) % 2 == 1, 2.0 * denominator, 0.0)
    unit = tf(list(odd[:-1]), list(denominator))
    root = np.sqrt(1.0 / sample_time_s)
    return StateSpace(unit.A / sample_time_s, unit.B * root, unit.C * root, unit.D, 0.0, (input_name,), (output_name,))
