"""Exact polynomial dependence of a matrix on normalised parameters, found by evaluation.

The matrices of a rig are polynomials of low degree in its physical parameters (stiffness enters K
linearly, a load's position enters M quadratically, its mass multiplies both). The coefficients are
computed from the rig's equations, so that there is no second, hand-written list of derivatives that
could disagree with the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from avis_ctrl.errors import ComputationError

Exponents = tuple[int, ...]
MatrixFunction = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class PolynomialSettings:
    """round_off : fraction of an entry [1] below which a coefficient is round-off: an entry takes a few hundred
    operations."""

    round_off: float = 1e3 * float(np.finfo(float).eps)


SETTINGS = PolynomialSettings()


def polynomial_coefficients(
    function: MatrixFunction, n: int, tolerance: float = 1e-11, seed: int = 0, cubic: bool = False
) -> dict[Exponents, np.ndarray]:
    """Coefficients N_a of function(delta) = sum_a delta^a N_a, delta in [-1, 1]^n.

    The degree is at most 2 in one parameter (3 if `cubic`, for a parameter that moves a mass and its position) and at
    most 3 in total. Entries smaller than `tolerance` times their largest variation, or than the round-off of the
    function, are set to zero. The result is checked at new random samples.

    Raises
    ------
    ComputationError : the function is not such a polynomial; the message states the error.
    """
    base = function(np.zeros(n))
    if n == 0:
        return {(): base}
    monomials = _monomials(function, n, base, 3 if cubic else 2)
    rng = np.random.default_rng(seed)
    samples = rng.uniform(-1, 1, (2 * len(monomials) + 2, n))
    powers = np.stack([np.prod(samples ** np.array(a), axis=1) for a in monomials], axis=1)
    values = np.stack([function(delta) - base for delta in samples])
    coefficients, *_ = np.linalg.lstsq(powers, values.reshape(len(samples), -1), rcond=None)
    # Each entry has its own unit, so it is compared with its own largest variation.
    size = np.max(np.abs(values), axis=0)
    # For an entry that hardly varies, the round-off of its terms would be taken for a dependence.
    least = np.maximum(tolerance * size, SETTINGS.round_off * np.abs(base))
    found = {(0,) * n: base}
    for exponents, coefficient in zip(monomials, coefficients, strict=True):
        matrix = coefficient.reshape(base.shape)
        matrix = np.where(np.abs(matrix) > least, matrix, 0.0)
        if np.any(matrix):
            found[exponents] = matrix
    _check(function, found, rng.uniform(-1, 1, (5, n)), size)
    return found


def _monomials(function: MatrixFunction, n: int, base: np.ndarray, highest: int) -> list[Exponents]:
    """Exponents that may occur: single parameters, and products of those that interact."""
    # About a generic point: at zero, a product of three parameters would not show that any two of them interact.
    origin = np.random.default_rng(n).uniform(0.2, 0.6, n)

    def moved(*which: int) -> np.ndarray:
        delta = origin.copy()
        delta[list(which)] -= 1.0
        return function(delta)

    reference = moved()
    single = [moved(i) - reference for i in range(n)]
    scale = np.max(np.abs(single), axis=0, initial=0.0) + np.abs(base)
    interacting = {
        (i, j)
        for i, j in combinations(range(n), 2)
        if np.any(np.abs(moved(i, j) - reference - single[i] - single[j]) > 1e-12 * scale)
    }
    exponents = []
    for i in range(n):
        exponents += [_exponent(n, {i: power}) for power in range(1, highest + 1)]
    for i, j in sorted(interacting):
        exponents += [_exponent(n, {i: 1, j: 1}), _exponent(n, {i: 2, j: 1}), _exponent(n, {i: 1, j: 2})]
    for i, j, k in combinations(range(n), 3):
        if {(i, j), (i, k), (j, k)} <= interacting:
            exponents.append(_exponent(n, {i: 1, j: 1, k: 1}))
    return exponents


def _exponent(n: int, powers: dict[int, int]) -> Exponents:
    return tuple(powers.get(k, 0) for k in range(n))


def evaluate(coefficients: dict[Exponents, np.ndarray], delta: np.ndarray) -> np.ndarray:
    """sum_a delta^a N_a."""
    return np.sum([np.prod(np.asarray(delta) ** np.array(a)) * N for a, N in coefficients.items()], axis=0)


def _check(function: MatrixFunction, found: dict[Exponents, np.ndarray], samples: np.ndarray, size: np.ndarray) -> None:
    for delta in samples:
        error = np.max(
            np.abs(function(delta) - evaluate(found, delta))
            / (np.abs(found[(0,) * len(delta)]) + size + np.finfo(float).tiny)
        )
        if error > 1e-10:
            raise ComputationError(
                "the rig's matrices are not polynomials of degree 3 in these parameters",
                measured=f"relative error {error:.1e} at a random sample",
                cause="a parameter that enters through a division or a trigonometric function",
                next_step="choose parameters such as mass, inertia, stiffness, damping or position",
            )
