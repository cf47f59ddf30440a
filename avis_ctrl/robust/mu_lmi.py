"""Convex upper bound of the structured singular value, for many frequencies at once.

w = Delta z, z = M w has only the zero solution for all ||Delta|| <= 1/beta if scalings that commute with Delta satisfy

    F(X, G, lambda) = lambda X_w - M^H X_z M - j (G M - M^H G^H) > 0,   X > 0,   lambda = beta^2

(Fan, Tits and Doyle, IEEE TAC 36, 1991). X_z and X_w have the same parameters on the two sides of a block; G is
non-zero on real blocks only. The minimum lambda is a generalized eigenvalue problem, solved here by following the
analytic centres of {F > 0, X > 0} as lambda decreases (Boyd and El Ghaoui, Linear Algebra and its Applications
188/189, 1993), with a tangent step in lambda between the Newton steps (compiled, see `mu_kernel`).

Several matrices may share one set of scalings (axis 1 of M); the bound is then valid for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np

from avis_ctrl.robust.mu_kernel import SETTINGS, Entries, follow_path
from avis_ctrl.uncertainty.blocks import BlockStructure

Array = np.ndarray
# Named tuple of arrays (and of such tuples) with the problems of a batch along their first axis.
Batch = TypeVar("Batch", bound=tuple[Any, ...])


class LmiScalings(NamedTuple):
    """X_z (B, n_z, n_z), X_w (B, n_w, n_w), G (B, n_w, n_z): one set per problem of a batch."""

    X_z: Array
    X_w: Array
    G: Array


def selected(batch: Batch, which: Array | int) -> Batch:
    """Part of a batch, by index along the first axis of its arrays."""
    return type(batch)(*(selected(one, which) if isinstance(one, tuple) else one[which] for one in batch))


def joined(batches: Sequence[Batch]) -> Batch:
    """One batch of several."""
    columns = zip(*batches, strict=True)
    return type(batches[0])(*(joined(ones) if isinstance(ones[0], tuple) else np.concatenate(ones) for ones in columns))


class LinearForm:
    """Hermitian matrix linear in real parameters, K(theta) = sum_k theta_k K_k, stored by its non-zero entries."""

    def __init__(self, size: int, parameters: int, entries: list[tuple[int, int, complex, int]]):
        order = sorted(entries, key=lambda entry: entry[3])  # the compiled code relies on this order
        self.size, self.parameters = size, parameters
        self.row = np.array([e[0] for e in order], int)
        self.col = np.array([e[1] for e in order], int)
        self.value = np.array([e[2] for e in order], complex)
        self.parameter = np.array([e[3] for e in order], int)
        self.incidence = np.zeros((parameters, len(order)))
        self.incidence[[e[3] for e in order], np.arange(len(order))] = 1.0
        self._dense = np.zeros((parameters, size * size), complex)
        self._dense[[e[3] for e in order], self.row * size + self.col] = self.value

    def matrix(self, theta: Array) -> Array:
        """K(theta), shape (B, size, size)."""
        return (theta @ self._dense).reshape(-1, self.size, self.size)

    def gradient(self, T: Array, weight: Array | float = 1.0) -> Array:
        """tr(T K_k) for each parameter, shape (B, p); T is (B, size, size), weight (B, entries)."""
        flat = T.reshape(T.shape[0], -1)
        return (flat[:, self.col * self.size + self.row] * (self.value * weight)).real @ self.incidence.T

    def entries(self, on_level: Array) -> Entries:
        """The entries in the form of the compiled code; `on_level` marks the entries multiplied by lambda."""
        return Entries(self.row, self.col, self.value, self.parameter, on_level, self.size)


@dataclass(frozen=True)
class ScalingSpace:
    """Real coordinates theta of the scalings that commute with a block structure."""

    structure: BlockStructure
    form: LinearForm
    core: LinearForm
    is_level: Array
    trace: Array
    is_g: Array

    @staticmethod
    def of(structure: BlockStructure) -> ScalingSpace:
        """Scalings of a structure."""
        n_w, n_z = structure.n_w, structure.n_z
        form: list[tuple[int, int, complex, int]] = []
        core: list[tuple[int, int, complex, int]] = []
        p = c = 0
        for block, w, z in structure.slices():
            if block.kind == "full":
                form += [(k, k, 1.0, p) for k in range(w.start, w.stop)]
                form += [(n_w + k, n_w + k, -1.0, p) for k in range(z.start, z.stop)]
                core.append((c, c, 1.0, p))
                p, c = p + 1, c + 1
                continue
            for entries in _hermitian_basis(block.rows):
                for a, b, value in entries:
                    form += [(w.start + a, w.start + b, value, p), (n_w + z.start + a, n_w + z.start + b, -value, p)]
                    core.append((c + a, c + b, value, p))
                p += 1
            c += block.rows
            if block.kind == "real":
                for entries in _hermitian_basis(block.rows):
                    for a, b, value in entries:
                        form += [
                            (w.start + a, n_w + z.start + b, -1j * value, p),
                            (n_w + z.start + b, w.start + a, 1j * np.conj(value), p),
                        ]
                    p += 1
        kform, kcore = LinearForm(n_w + n_z, p, form), LinearForm(c, p, core)
        on_level = (kform.row < n_w) & (kform.col < n_w)
        in_core = np.any(kcore.incidence > 0, axis=1)
        return ScalingSpace(structure, kform, kcore, on_level, kcore.gradient(np.eye(c)[None])[0], ~in_core)

    def scalings(self, theta: Array) -> LmiScalings:
        """Matrices of the parameters theta (B, p)."""
        n_w = self.structure.n_w
        K = self.form.matrix(theta)
        return LmiScalings(-K[:, n_w:, n_w:], K[:, :n_w, :n_w], 1j * K[:, :n_w, n_w:])

    def theta(self, scalings: LmiScalings) -> Array:
        """Coordinates of scalings that have the structure (inverse of `scalings`)."""
        K = np.zeros((scalings.X_w.shape[0], self.form.size, self.form.size), complex)
        n_w = self.structure.n_w
        K[:, :n_w, :n_w], K[:, n_w:, n_w:], K[:, :n_w, n_w:] = scalings.X_w, -scalings.X_z, -1j * scalings.G
        K[:, n_w:, :n_w] = np.conj(np.swapaxes(K[:, :n_w, n_w:], 1, 2))
        gram = (self.form.incidence * np.abs(self.form.value) ** 2).sum(axis=1)
        return self.form.gradient(K) / gram

    def identity(self, batch: int) -> Array:
        """theta of X = I, G = 0."""
        n_w, n_z = self.structure.n_w, self.structure.n_z
        one = self.theta(LmiScalings(np.eye(n_z)[None], np.eye(n_w)[None], np.zeros((1, n_w, n_z))))
        return np.repeat(one, batch, axis=0)


def _hermitian_basis(n: int) -> list[list[tuple[int, int, complex]]]:
    basis: list[list[tuple[int, int, complex]]] = [[(i, i, 1.0)] for i in range(n)]
    for i in range(n):
        for k in range(i):
            basis += [[(i, k, 1.0), (k, i, 1.0)], [(i, k, 1j), (k, i, -1j)]]
    return basis


def dagger(A: Array) -> Array:
    """Conjugate transpose of each matrix."""
    return np.conj(np.swapaxes(A, -1, -2))


def residual(M: Array, scalings: LmiScalings, lam: Array, level: Array) -> Array:
    """F (B, n_shared, n_w, n_w) for M (B, n_shared, n_z, n_w), lam (B,): positive definite if the bound is proved."""
    Mh = dagger(M)
    GM = scalings.G[:, None] @ M
    weight = np.where(level, lam[:, None], 1.0)
    F = (scalings.X_w * weight[:, None, :])[:, None] - Mh @ (scalings.X_z[:, None] @ M) - 1j * (GM - dagger(GM))
    return (F + dagger(F)) / 2


def least_level(M: Array, scalings: LmiScalings, level: Array) -> Array:
    """Minimum lambda (B,) for which the scalings make F >= 0, by an eigenvalue computation; inf if there is none."""
    F = residual(M, scalings, np.zeros(M.shape[0]), level)
    p, r = np.flatnonzero(level), np.flatnonzero(~level)
    Fpp = F[..., p[:, None], p]
    if r.size:
        Frr, Frp = F[..., r[:, None], r], F[..., r[:, None], p]
        feasible = np.all(np.linalg.eigvalsh(Frr)[..., 0] > 0, axis=1)
        Frr = np.where(feasible[:, None, None, None], Frr, np.eye(r.size))
        Fpp = Fpp - dagger(Frp) @ np.linalg.solve(Frr, Frp)
    inverse = np.linalg.inv(np.linalg.cholesky(scalings.X_w[:, p[:, None], p]))[:, None]
    pencil = inverse @ Fpp @ dagger(inverse)
    lam = -np.min(np.linalg.eigvalsh((pencil + dagger(pencil)) / 2)[..., 0], axis=1)
    return np.where(feasible, lam, np.inf) if r.size else lam


def follow(
    space: ScalingSpace, M: Array, theta: Array, lam: Array, goal: Array | float = 0.0, tolerance: float = 1e-5
) -> tuple[Array, Array]:
    """Follow the analytic centres from a feasible (theta, lam) down to the minimum lambda, or to `goal`.

    M (B, n_shared, n_z, n_w). Returns a feasible pair theta (B, p) and lambda (B,). Problems whose lambda reaches a
    positive `goal` stop at the analytic centre there.
    """
    theta, lam = theta.copy(), lam.copy()
    floor = np.broadcast_to(np.asarray(goal, float), lam.shape).copy()
    follow_path(
        np.ascontiguousarray(M, complex),
        theta,
        lam,
        floor,
        space.form.entries(space.is_level),
        space.core.entries(np.zeros(space.core.row.size, bool)),
        space.trace,
        space.is_g,
        tolerance,
        SETTINGS,
    )
    return theta, lam
