"""A linear model of any order with common poles, from a frequency response matrix.

Vector fitting (Gustavsen and Semlyen, IEEE T-PWRD 14 (1999) 1052) with the fast elimination of the residues
(Deschrijver et al., IEEE MWCL 18 (2008) 383): G(s) = sum_k R_k / (s - p_k) + E, p_k in the left half plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError

ITERATIONS = 12
START_DAMPING = 0.01


@dataclass(frozen=True, eq=False)
class LinearModel:
    """poles (order,) rad/s, conjugate pairs; coefficients (order + 1, n_entries) of the real basis."""

    poles: np.ndarray
    coefficients: np.ndarray

    def response(self, frequency_Hz: np.ndarray) -> np.ndarray:
        """(n, n_entries)."""
        return np.hstack([_basis(2j * np.pi * frequency_Hz, self.poles), np.ones((len(frequency_Hz), 1))]
                         ) @ self.coefficients


def vector_fit(frequency_Hz: np.ndarray, G: np.ndarray, weight: np.ndarray, order: int) -> LinearModel:
    """Least squares of weight (G - model).

    Parameters
    ----------
    G, weight : (n, n_entries). order : even number of poles.

    Raises
    ------
    InputError : an odd order, or too few lines for it.
    """
    n, count = G.shape
    if order < 2 or order % 2 or n <= 2 * (order + 1):
        raise InputError(f"expected an even order and more than {2 * (order + 1)} lines", field="order", value=order)
    s = 2j * np.pi * np.asarray(frequency_Hz, float)
    turn = np.linspace(abs(s[0]), abs(s[-1]), order // 2)
    poles = np.repeat((-START_DAMPING + 1j) * turn, 2)
    poles[1::2] = poles[::2].conj()
    for _ in range(ITERATIONS):
        poles = _moved(s, G, weight, poles)
    basis = np.hstack([_basis(s, poles), np.ones((n, 1))])
    coefficients = np.column_stack([_solved(_parts(basis * weight[:, j:j + 1]), _parts(G[:, j] * weight[:, j]))
                                    for j in range(count)])
    return LinearModel(poles, coefficients)


def _moved(s: np.ndarray, G: np.ndarray, weight: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """Zeros of sigma in sigma G = sum of residues over the same poles: the next poles."""
    basis, order = _basis(s, poles), len(poles)
    own = np.hstack([basis, np.ones((len(s), 1))])
    rows, sides = [], []
    for j in range(G.shape[1]):
        w = weight[:, j:j + 1]
        A = _parts(np.hstack([own, -basis * G[:, j:j + 1]]) * w)
        Q, R = np.linalg.qr(A)
        rows.append(R[order + 1:, order + 1:])
        sides.append(Q[:, order + 1:].T @ _parts(G[:, j] * weight[:, j]))
    c = _solved(np.vstack(rows), np.concatenate(sides))
    A, b = np.zeros((order, order)), np.zeros(order)
    for k in range(0, order, 2):
        p = poles[k]
        A[k:k + 2, k:k + 2] = [[p.real, p.imag], [-p.imag, p.real]]
        b[k] = 2.0
    found = np.linalg.eigvals(A - np.outer(b, c))
    found = np.where(found.real > 0, -found.conj(), found)  # a stable system
    upper = found[found.imag > 0]
    real = np.sort(found[found.imag == 0].real)
    if len(real):  # two real poles become a close pair, so that the order is kept
        middle = real.reshape(-1, 2).mean(axis=1)
        upper = np.r_[upper, middle + 1e-3j * np.abs(middle)]
    poles = np.repeat(upper, 2)
    poles[1::2] = poles[::2].conj()
    return poles


def _basis(s: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """(n, order) with real coefficients: sum and j times difference of each pair."""
    p = poles[::2]
    one, other = 1 / (s[:, None] - p), 1 / (s[:, None] - p.conj())
    found = np.empty((len(s), len(poles)), complex)
    found[:, ::2], found[:, 1::2] = one + other, 1j * (one - other)
    return found


def _parts(z: np.ndarray) -> np.ndarray:
    return np.concatenate([z.real, z.imag])


def _solved(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    size = np.maximum(np.linalg.norm(A, axis=0), np.finfo(float).tiny)
    return np.linalg.lstsq(A / size, b, rcond=None)[0] / size
