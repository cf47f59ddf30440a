"""Fit of a Hermitian positive definite X(j omega) by D(s)^H D(s): matrix scalings of repeated blocks.

X is approximated by P(j omega) / q(omega^2) with a positive matrix polynomial P and a positive scalar q, both
represented by Gram matrices, in the sense

    1/t X q <= P <= t X q   (in the order of Hermitian matrices) at the points:

the matrix form of the log-Chebyshev fit of `dscale_fit`, again a semidefinite feasibility problem inside a
bisection. The stable square D(s) with stable inverse follows from the stabilising solution of a Riccati
equation (Zhou, Doyle and Glover, Robust and Optimal Control, 1996, section 13.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import clarabel
import numpy as np
import scipy.linalg as la
import scipy.sparse as sp

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti import StateSpace, gain
from avis_ctrl.robust.dscale_fit import (
    SETTINGS,
    Fit,
    basis_scale,
    bisection,
    gram_cone,
    half_line_coefficients,
    half_line_rows,
    initial_roots,
    maximise_last,
    stable_roots,
    triangle,
)
from avis_ctrl.robust.scalings import MatrixScaling


def fit_hermitian(
    omega: np.ndarray, X: np.ndarray, degree: int, weight: np.ndarray | None = None, tolerance: float = 1e-2
) -> Fit[MatrixScaling]:
    """Log-Chebyshev fit of X (n_omega, n, n) at omega [rad/s] by D^H D, where D has n * degree states.

    weight (n_omega,) in 0..1; the bisection ends when error and bound differ by at most the tolerance. Raises
    LinAlgError if an X is not positive definite.
    """
    X, weight = (X + np.conj(np.swapaxes(X, 1, 2))) / 2, np.ones(omega.size) if weight is None else weight
    C = la.cholesky(np.mean(X.real, axis=0))
    whitened = _congruence(X, np.linalg.inv(C))
    unit = float(np.exp(np.mean(np.log(omega))))
    problem = _Feasibility.of(omega / unit, whitened, weight, degree)
    best = _with_right_factor(gain(np.eye(C.shape[0])), C)

    def attempt(level: float) -> tuple[MatrixScaling, float] | None:
        found = problem.solve(2 * level)
        if found is None:
            return None
        candidate = _with_right_factor(_spectral_factor(*found, problem.e, unit), C)
        return candidate, _error(candidate, omega, X, weight)

    return bisection(best, _error(best, omega, X, weight), attempt, tolerance)


def _congruence(X: np.ndarray, T: np.ndarray) -> np.ndarray:
    return np.conj(np.swapaxes(T, -1, -2)) @ X @ T


def _error(D: MatrixScaling, omega: np.ndarray, X: np.ndarray, weight: np.ndarray) -> float:
    response = D.system.frequency_response(omega)
    inverse = np.linalg.inv(np.conj(np.swapaxes(np.linalg.cholesky(X), 1, 2)))
    eigenvalues = np.linalg.eigvalsh(_congruence(_congruence(np.eye(X.shape[1]), response), inverse))
    return float(np.max(weight[:, None] * np.abs(np.log(eigenvalues)) / 2))


@dataclass(frozen=True)
class _Feasibility:
    """Rows of the semidefinite problem in the Gram matrices of P (n (m + 1) square) and q."""

    size: int
    weight: np.ndarray
    e: np.ndarray
    rows_P: np.ndarray
    rows_q: np.ndarray
    gram_q: tuple[int, int]
    identity: np.ndarray
    margin_P: np.ndarray

    @staticmethod
    def of(omega: np.ndarray, X: np.ndarray, weight: np.ndarray, degree: int) -> _Feasibility:
        n = X.shape[1]
        spread = np.log(np.linalg.eigvalsh(X)) / 2
        e = basis_scale(initial_roots(omega, spread[:, -1] + np.sum(np.abs(spread), axis=1), degree))
        log_scale = np.log(np.polyval(e[::-1], omega**2))
        rows_q, gram_q = half_line_rows(omega**2, log_scale, e)
        power = np.arange(degree + 1)
        v = 1j**power * np.exp(0.5 * np.log(e) + np.log(omega)[:, None] * power - 0.5 * log_scale[:, None])
        # X = L L^H; the constraints are expressed in coordinates where X is the identity.
        inverse = np.linalg.inv(np.linalg.cholesky(X))
        V = np.kron(v[:, None, :], np.eye(n))  # (n_omega, n, n (m + 1))
        W = inverse @ np.conj(V)
        i, j = triangle(n * (degree + 1))
        # entry (i, j) of the Gram matrix contributes w_i w_j^H + w_j w_i^H
        product = np.einsum("kap,kbp->kpab", W[:, :, i], np.conj(W[:, :, j]))
        product = product + np.conj(np.swapaxes(product, 2, 3))
        product = product * np.where(i == j, 0.5, 1 / np.sqrt(2.0))[None, :, None, None]
        rows_P = np.swapaxes(_real_vectors(product), 1, 2)
        identity = _real_vectors(np.eye(n)[None, None])[0, 0]
        return _Feasibility(
            n,
            weight,
            e,
            rows_P,
            rows_q,
            gram_q,
            identity,
            SETTINGS.positivity * _real_vectors((W @ np.conj(np.swapaxes(W, 1, 2)))[:, None])[:, 0],
        )

    def solve(self, log_t: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Gram matrix of P and coefficients of q in the scaled basis, or None if the level is infeasible."""
        log_t_k = np.divide(log_t, self.weight, out=np.full(self.weight.size, np.inf), where=self.weight > 0)
        kept = np.flatnonzero(log_t_k < SETTINGS.slack)
        inverse_t = np.exp(-log_t_k[kept])[:, None, None]
        P, cone = self.rows_P[kept], self.identity.size
        q = self.rows_q[kept][:, None, :] * self.identity[None, :, None]
        s = np.broadcast_to(self.identity[None, :, None], (kept.size, cone, 1))
        # q I - P / t >= s I and P - q I / t >= s I
        upper = np.concatenate([inverse_t * P, -q, s], axis=2).reshape(-1, P.shape[2] + q.shape[2] + 1)
        lower = np.concatenate([-P, inverse_t * q, s], axis=2).reshape(-1, P.shape[2] + q.shape[2] + 1)
        margin, unit = self.margin_P[kept], SETTINGS.positivity * self.identity
        bound = np.concatenate(
            [(unit - inverse_t[:, :, 0] * margin).ravel(), (margin - inverse_t[:, :, 0] * unit).ravel()]
        )
        n_P, n_q = P.shape[2], q.shape[2]
        normal = np.r_[np.zeros(n_P), np.mean(self.rows_q[kept], axis=0), 0.0][None, :]
        cones = [clarabel.ZeroConeT(1)] + [gram_cone(2 * self.size)] * (2 * kept.size)
        cones += [gram_cone(size) for size in (self.size * self.e.size, *self.gram_q) if size]
        A = sp.csc_matrix(np.vstack([normal, upper, lower, -np.eye(n_P + n_q, n_P + n_q + 1)]))
        x = maximise_last(A, np.r_[1.0, bound, np.zeros(n_P + n_q)], cones)
        if x[-1] <= 0:
            return None
        gram = np.zeros((self.size * self.e.size,) * 2)
        i, j = triangle(gram.shape[0])
        gram[i, j] = gram[j, i] = x[:n_P] * np.where(i == j, 1.0, 1 / np.sqrt(2.0))
        return (
            gram + SETTINGS.positivity * np.eye(gram.shape[0]),
            half_line_coefficients(x[n_P:-1], self.gram_q, self.e),
        )


def _real_vectors(H: np.ndarray) -> np.ndarray:
    """Hermitian (.., n, n) as the solver's vectors of [Re -Im; Im Re], upper triangle by columns."""
    real = np.block([[H.real, -H.imag], [H.imag, H.real]])
    i, j = triangle(real.shape[-1])
    return real[..., i, j] * np.where(i == j, 1.0, np.sqrt(2.0))


def _spectral_factor(gram: np.ndarray, q: np.ndarray, e: np.ndarray, unit: float) -> StateSpace:
    """Stable D(s) with stable inverse and D^H D = P / q, from the scaled Gram matrix of P.

    The states are sqrt(e_k) s^k / f(s), with f the stable factor of q.
    """
    degree, n = e.size - 1, gram.shape[0] // e.size
    root_gain = np.sqrt(q[-1])
    if degree == 0:
        return gain(la.cholesky(gram) / root_gain)
    # the Gram matrix belongs to s^k sqrt(e_k), so f is scaled likewise
    f = np.poly(stable_roots(q)).real[::-1]
    scale = np.sqrt(e)
    A = np.diag(scale[:-2] / scale[1:-1], 1) if degree > 1 else np.zeros((1, 1))
    A[-1] = -f[:-1] * scale[-2] / scale[:-1]
    B = np.r_[np.zeros(degree - 1), scale[-2]][:, None]
    # top power: s^m sqrt(e_m) / f = sqrt(e_m) (1 - sum f_k s^k / f)
    T = np.vstack([np.eye(degree, degree + 1), scale[-1] * np.r_[-f[:-1] / scale[:-1], 1.0][None, :]])
    T = np.kron(T, np.eye(n))
    W = T.T @ gram @ T / q[-1]
    A, B = np.kron(A, np.eye(n)), np.kron(B, np.eye(n))
    Q, S, R = W[: n * degree, : n * degree], W[: n * degree, n * degree :], W[n * degree :, n * degree :]
    try:
        X = la.solve_continuous_are(A, B, Q, R, s=S)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ComputationError(
            "the spectral factorisation of a matrix scaling failed",
            cause=str(error),
            measured=f"condition of the direct term {np.linalg.cond(R):.1e}",
            next_step="a lower degree",
        ) from error
    half = la.cholesky(R)
    C = half @ np.linalg.solve(R, B.T @ X + S.T)
    return StateSpace(A * unit, B * np.sqrt(unit), C * np.sqrt(unit), half)


def _with_right_factor(D: StateSpace, C: np.ndarray) -> MatrixScaling:
    return MatrixScaling(StateSpace(D.A, D.B @ C, D.C, D.D @ C))
