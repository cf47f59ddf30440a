"""Dynamic D-scalings D(s) of a block structure: stable, minimum phase, with stable inverse.

A full block or a single scalar has a scalar d(s); a repeated scalar has a square matrix D(s). All scalings are relative
to the performance block, whose scaling is one. They leave mu unchanged: mu(N) = mu(D N D^-1) <= sigma_max(D N D^-1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, gain
from avis_ctrl.lti.rational import log_modulus
from avis_ctrl.uncertainty.blocks import BlockStructure

Matrices = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class DScalingSettings:
    """max_order : largest order of d(s): beyond it, the decrease of mu is not worth the additional controller states.
    rank : relative size [1] below which a combination of the signals of a group is round-off.
    """

    max_order: int = 6
    rank: float = 1e-10


SETTINGS = DScalingSettings()


@dataclass(frozen=True, eq=False)
class ScalarScaling:
    """d(s) = g prod(zero factors) / prod(pole factors), all roots in the open left half plane.

    `theta` has 1 + 2 n entries: log g, then n for the zeros, then n for the poles. A pair of roots, real or complex, is
    represented by (log w, log zeta) of s^2 + 2 zeta w s + w^2. This parametrisation is smooth where two real roots
    meet. For odd n the last root -a is real and represented by log a. Every theta gives a stable d(s) with stable
    inverse: an optimiser needs no constraint.
    """

    theta: np.ndarray

    def __post_init__(self) -> None:
        theta = np.atleast_1d(np.asarray(self.theta, float)).copy()
        if theta.ndim != 1 or theta.size % 2 == 0 or not np.all(np.isfinite(theta)):
            raise InputError("a scaling needs 1 + 2 n finite parameters", field="theta", value=self.theta)
        theta.setflags(write=False)
        object.__setattr__(self, "theta", theta)

    @staticmethod
    def constant(d: float) -> ScalarScaling:
        """d(s) = d > 0."""
        return ScalarScaling(np.array([np.log(d)]))

    @staticmethod
    def from_roots(
        g: float, zeros: Sequence[complex] | np.ndarray, poles: Sequence[complex] | np.ndarray
    ) -> ScalarScaling:
        """From the gain at infinite frequency and equal numbers of zeros and poles, conjugates included."""
        if len(zeros) != len(poles) or g <= 0:
            raise InputError(f"expected g > 0 and as many zeros as poles, not {g}, {len(zeros)} and {len(poles)}")
        return ScalarScaling(
            np.concatenate([[np.log(g)], _pair(np.asarray(zeros, complex)), _pair(np.asarray(poles, complex))])
        )

    @property
    def order(self) -> int:
        """Number of poles, and of zeros."""
        return (self.theta.size - 1) // 2

    @property
    def scalar(self) -> ScalarScaling:
        """The scalar part, which has the free parameters: here the whole scaling."""
        return self

    def with_scalar(self, d: ScalarScaling) -> ScalarScaling:
        """The scaling with its scalar part replaced."""
        return d

    @property
    def zeros(self) -> np.ndarray:
        """Zeros [rad/s]."""
        return _roots(self.theta[1 : 1 + self.order])

    @property
    def poles(self) -> np.ndarray:
        """Poles [rad/s]."""
        return _roots(self.theta[1 + self.order :])

    def inverse(self) -> ScalarScaling:
        """1 / d(s)."""
        n = self.order
        return ScalarScaling(np.concatenate([[-self.theta[0]], self.theta[1 + n :], self.theta[1 : 1 + n]]))

    def within(self, band: tuple[float, float]) -> ScalarScaling:
        """Move roots beyond the band [rad/s] to its edges; the magnitude far inside the band is unchanged."""
        n, theta = self.order, self.theta.copy()
        for start in (1, 1 + n):
            sign = 1.0 if start == 1 else -1.0
            for k in range(start, start + n):
                is_damping = k < start + 2 * (n // 2) and (k - start) % 2 == 1
                if is_damping:
                    theta[k] = np.clip(theta[k], np.log(0.05), np.log(50.0))
                    continue
                moved = np.clip(theta[k], np.log(band[0]), np.log(band[1]))
                # A factor (s + a) is about a below its corner: lowering a fast root changes the gain.
                if moved < theta[k]:
                    theta[0] += sign * (theta[k] - moved) * (1 if k == start + n - 1 and n % 2 else 2)
                theta[k] = moved
        return ScalarScaling(theta)

    def with_neutral_pair(self, omega: float, split: float = 0.0) -> ScalarScaling:
        """Add a zero at -omega e^split and a pole at -omega e^-split; for split = 0 d(s) is unchanged."""
        return ScalarScaling.from_roots(
            np.exp(self.theta[0]),
            np.append(self.zeros, -omega * np.exp(split)),
            np.append(self.poles, -omega * np.exp(-split)),
        )

    def log_magnitude(self, omega: np.ndarray) -> np.ndarray:
        """log |d(j omega)| (n_omega,), omega in rad/s, finite."""
        n = self.order
        return (
            self.theta[0] + _log_modulus(self.theta[1 : 1 + n], omega)[0] - _log_modulus(self.theta[1 + n :], omega)[0]
        )

    def jacobian(self, omega: np.ndarray) -> np.ndarray:
        """Derivative of `log_magnitude` with respect to theta (n_omega, 1 + 2 n)."""
        n = self.order
        return np.hstack(
            [
                np.ones((np.size(omega), 1)),
                _log_modulus(self.theta[1 : 1 + n], omega)[1],
                -_log_modulus(self.theta[1 + n :], omega)[1],
            ]
        )

    @cached_property
    def matrices(self) -> Matrices:
        """A, B, C, D of a cascade of first- and second-order sections, slow sections first."""
        n = self.order
        A, B, C, D = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((1, n)), np.exp(self.theta[:1])[:, None]
        zeros, poles = np.exp(self.theta[1 : 1 + n]), np.exp(self.theta[1 + n :])
        for k in range(0, n, 2):
            section = slice(k, min(k + 2, n))
            # Fast states first: A is block upper triangular like a Schur form, which is accurate over eight decades.
            here, before = slice(n - section.stop, n - k), slice(n - k, n)
            a, b, c = _section(zeros[section], poles[section])
            A[here, here], A[here, before], B[here] = a, b @ C[:, before], b @ D
            C[:, here] = c
        return A, B, C, D

    def as_dict(self) -> dict[str, Any]:
        """Content for a JSON file."""
        return {"theta": self.theta.tolist()}


def _pair(roots: np.ndarray) -> np.ndarray:
    """(log w, log zeta) of each pair of roots in order of increasing w, then log a of a single real root."""
    if np.any(roots.real >= 0):
        raise InputError("roots must lie in the open left half plane", value=float(np.max(roots.real)))
    real = np.sort(-roots[np.abs(roots.imag) <= 1e-12 * np.abs(roots)].real)
    upper = roots[roots.imag > 1e-12 * np.abs(roots)]
    pairs = [(abs(s), -s.real / abs(s)) for s in upper]
    pairs += (
        [(np.sqrt(a * b), (a + b) / (2 * np.sqrt(a * b))) for a, b in zip(real[0:-1:2], real[1::2], strict=True)]
        if real.size > 1
        else []
    )
    pairs.sort()
    lone = [np.log(real[-1])] if real.size % 2 else []
    if 2 * len(pairs) + len(lone) != roots.size:
        raise InputError(f"roots are not closed under conjugation: {roots}")
    return np.array([*np.log(np.array(pairs).reshape(-1)), *lone])


def _roots(theta: np.ndarray) -> np.ndarray:
    roots: list[complex] = []
    for log_w, log_zeta in zip(theta[0:-1:2], theta[1::2], strict=True) if theta.size > 1 else ():
        w, zeta = np.exp(log_w), np.exp(log_zeta)
        if zeta >= 1:
            fast = w * (zeta + np.sqrt(zeta**2 - 1))
            roots += [-fast, -w * w / fast]
        else:
            roots += [w * complex(-zeta, sign * np.sqrt(1 - zeta**2)) for sign in (1, -1)]
    if theta.size % 2:
        roots.append(-np.exp(theta[-1]))
    return np.array(roots, complex)


def _log_modulus(theta: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`log_modulus` of the zeros or of the poles: pairs, then a single real root if their number is odd."""
    n = theta.size // 2
    return log_modulus(theta[: 2 * n].reshape(n, 2), theta[2 * n :], np.atleast_1d(omega))


def _section(zeros: np.ndarray, poles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, b, c of 1 + c inv(s I - A) b for pairs (w, zeta) of zeros and of poles, or for single real roots (a,)."""
    if zeros.size == 1:
        a, b, c = np.array([[-poles[0]]]), np.ones((1, 1)), np.array([[zeros[0] - poles[0]]])
    else:
        (wz, zz), (wp, zp) = zeros, poles
        a, b = np.array([[0.0, wp], [-wp, -2 * zp * wp]]), np.array([[0.0], [1.0]])
        c = np.array([[(wz**2 - wp**2) / wp, 2 * zz * wz - 2 * zp * wp]])
    # b and c of similar size, as a smooth function of the roots even if they cancel
    root = (np.sum(c**2) + (0.01 * poles[0]) ** 2) ** 0.25
    return a, b * root, c / root


@dataclass(frozen=True, eq=False)
class MatrixScaling:
    """Square D(s) = d(s) F(s) of a repeated scalar block; F is a system with stable zeros and poles.

    A constant F is usually sufficient. The factor d has few parameters, which are refined jointly with the scalings of
    the other blocks.
    """

    system: StateSpace
    factor: ScalarScaling = field(default_factory=lambda: ScalarScaling.constant(1.0))

    def __post_init__(self) -> None:
        F = self.system
        if F.ninputs != F.noutputs or np.linalg.matrix_rank(F.D) < F.ninputs:
            raise InputError("a matrix scaling is square with an invertible direct term", value=F.D.shape)
        zeros = np.linalg.eigvals(_inverse(F)[0])
        if not F.is_stable() or np.any(zeros.real >= 0):
            raise InputError("a matrix scaling needs stable poles and zeros", value=[*F.poles(), *zeros])

    @property
    def order(self) -> int:
        """States of D(s)."""
        return self.system.nstates + self.system.ninputs * self.factor.order

    @property
    def scalar(self) -> ScalarScaling:
        """The scalar factor d(s), which has the free parameters."""
        return self.factor

    def with_scalar(self, d: ScalarScaling) -> MatrixScaling:
        """The scaling with its scalar factor replaced."""
        return replace(self, factor=d)

    def inverse(self) -> MatrixScaling:
        """D(s)^-1."""
        return MatrixScaling(StateSpace(*_inverse(self.system)), self.factor.inverse())

    def response(self, omega: np.ndarray) -> np.ndarray:
        """|d| F (n_omega, n, n) at omega [rad/s], without the phase of d, which changes no singular value."""
        return np.exp(self.factor.log_magnitude(omega))[:, None, None] * self.system.frequency_response(omega)

    @property
    def matrices(self) -> Matrices:
        """A, B, C, D of D(s)."""
        F, copies = self.system, np.eye(self.system.ninputs)
        a, b, c, d = (np.kron(one, copies) for one in self.factor.matrices)
        A = np.block([[a, b @ F.C], [np.zeros((F.nstates, a.shape[0])), F.A]])
        return A, np.vstack([b @ F.D, F.B]), np.hstack([c, d @ F.C]), d @ F.D

    def as_dict(self) -> dict[str, Any]:
        """Content for a JSON file."""
        return {**{key: getattr(self.system, key).tolist() for key in "ABCD"}, "factor": self.factor.theta.tolist()}


def _inverse(system: StateSpace) -> Matrices:
    A, B, C, D = system.A, system.B, system.C, np.linalg.inv(system.D)
    return A - B @ D @ C, B @ D, -D @ C, D


Part = ScalarScaling | MatrixScaling


@dataclass(frozen=True, eq=False)
class Scalings:
    """One scaling per block of the structure; the last block is the performance block and has d = 1.

    groups : group number of each block. The scalings of a group are scalar and have the same roots; linearly dependent
        signals of a group share states. Empty: every block is a group of its own.
    """

    structure: BlockStructure
    parts: tuple[Part, ...]
    groups: tuple[int, ...] = ()

    @staticmethod
    def identity(structure: BlockStructure) -> Scalings:
        """All scalings equal to one."""
        return Scalings(
            structure,
            tuple(
                MatrixScaling(gain(np.eye(b.rows))) if b.repeated else ScalarScaling.constant(1.0)
                for b in structure.blocks
            ),
        )

    @staticmethod
    def uniform(structure: BlockStructure, d: float) -> Scalings:
        """The constant d > 0 for every block except performance."""
        parts = [
            MatrixScaling(gain(d * np.eye(b.rows))) if b.repeated else ScalarScaling.constant(d)
            for b in structure.blocks[:-1]
        ]
        return Scalings(structure, (*parts, ScalarScaling.constant(1.0)))

    @property
    def orders(self) -> tuple[int, ...]:
        """Order of each block's d(s) or D(s)."""
        return tuple(part.order for part in self.parts)

    @property
    def members(self) -> tuple[tuple[int, ...], ...]:
        """The blocks of each group, without the performance block."""
        found: dict[int, list[int]] = {}
        for k in range(len(self.parts) - 1):
            found.setdefault(self.groups[k] if self.groups else k, []).append(k)
        return tuple(tuple(blocks) for blocks in found.values())

    def places(self) -> list[np.ndarray]:
        """Indices of each block's parameters (without performance) in the vector of all parameters: the gain of the
        block, then the roots of its group."""
        found: list[np.ndarray] = [np.zeros(0, int)] * (len(self.parts) - 1)
        first = {k: blocks[0] for blocks in self.members for k in blocks}
        size = 0
        for k, part in enumerate(self.parts[:-1]):
            own = 1 if first[k] != k else part.scalar.theta.size
            found[k] = np.arange(size, size + own)
            if first[k] != k:
                found[k] = np.concatenate([found[k], found[first[k]][1:]])
            size += own
        return found

    @property
    def added_states(self) -> int:
        """Maximum number of states that the scalings add to the plant."""
        return sum(
            part.order * (2 if isinstance(part, MatrixScaling) else block.rows + block.cols)
            for part, block in zip(self.parts, self.structure.blocks, strict=True)
        )

    def replace(self, index: int, part: Part) -> Scalings:
        """The same scalings with that of one block replaced."""
        return replace(self, parts=(*self.parts[:index], part, *self.parts[index + 1 :]))

    def left(self) -> StateSpace:
        """D_z(s) (n_z, n_z), to the left of N."""
        return StateSpace(*self._diagonal(inverse=False))

    def right_inverse(self) -> StateSpace:
        """D_w(s)^-1 (n_w, n_w), to the right of N."""
        return StateSpace(*self._diagonal(inverse=True))

    def response(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """D_z (n_omega, n_z, n_z) and D_w^-1 (n_omega, n_w, n_w) at omega [rad/s], scalar d(s) without their phase.

        The phase of a scalar d(s) changes no singular value of D N D^-1.
        """
        omega = np.atleast_1d(omega)
        left = np.zeros((omega.size, self.structure.n_z, self.structure.n_z), complex)
        right = np.zeros((omega.size, self.structure.n_w, self.structure.n_w), complex)
        for (_, w, z), part in zip(self.structure.slices(), self.parts, strict=True):
            if isinstance(part, MatrixScaling):
                left[:, z, z] = part.response(omega)
                right[:, w, w] = np.linalg.inv(left[:, z, z])
            else:
                d = np.exp(part.log_magnitude(omega))
                left[:, range(z.start, z.stop), range(z.start, z.stop)] = d[:, None]
                right[:, range(w.start, w.stop), range(w.start, w.stop)] = 1 / d[:, None]
        return left, right

    def scale(self, P: StateSpace) -> StateSpace:
        """diag(D_z, I) P diag(D_w^-1, I): the plant of the H-infinity problem in the K-step."""
        z, w = self.structure.n_z, self.structure.n_w
        Al, Bl, Cl, Dl = self._diagonal(inverse=False, through=np.hstack([P.C, P.D])[:z])
        Ar, Br, Cr, Dr = self._diagonal(inverse=True, through=np.vstack([P.B, P.D])[:, :w].T)
        C = np.vstack([Dl @ P.C[:z], P.C[z:]])
        B = np.hstack([P.B[:, :w] @ Dr, P.B[:, w:]])
        D = P.D.copy()
        D[:z] = Dl @ D[:z]
        through = D[:, :w] @ Cr
        D[:, :w] = D[:, :w] @ Dr
        n_l, n, n_r = Al.shape[0], P.nstates, Ar.shape[0]
        A = np.zeros((n_l + n + n_r,) * 2)
        left, own, right = slice(0, n_l), slice(n_l, n_l + n), slice(n_l + n, None)
        A[left, left], A[left, own], A[left, right] = Al, Bl @ P.C[:z], Bl @ P.D[:z, :w] @ Cr
        A[own, own], A[own, right], A[right, right] = P.A, P.B[:, :w] @ Cr, Ar
        Bl_all = Bl @ P.D[:z]
        Bl_all[:, :w] = Bl_all[:, :w] @ Dr
        Br_all = np.hstack([Br, np.zeros((n_r, P.ninputs - w))])
        Cl_all = np.vstack([Cl, np.zeros((P.noutputs - z, n_l))])
        return StateSpace(
            A, np.vstack([Bl_all, B, Br_all]), np.hstack([Cl_all, C, through]), D, 0.0, P.inputs, P.outputs
        )

    def as_dicts(self) -> list[dict[str, Any]]:
        """JSON form of the parts."""
        groups = [{"group": number} for number in self.groups] or [{} for _ in self.parts]
        return [part.as_dict() | group for part, group in zip(self.parts, groups, strict=True)]

    @staticmethod
    def from_dicts(structure: BlockStructure, items: Sequence[dict[str, Any]]) -> Scalings:
        """Inverse of `as_dicts`."""

        def part(item: dict[str, Any]) -> Part:
            if "theta" in item:
                return ScalarScaling(np.array(item["theta"]))
            D = np.array(item["D"], float)
            n = len(item["A"])
            return MatrixScaling(
                StateSpace(
                    np.reshape(item["A"], (n, n)),
                    np.reshape(item["B"], (n, D.shape[1])),
                    np.reshape(item["C"], (D.shape[0], n)),
                    D,
                ),
                ScalarScaling(np.array(item["factor"])),
            )

        return Scalings(
            structure,
            tuple(part(item) for item in items),
            tuple(int(item["group"]) for item in items if "group" in item),
        )

    def _diagonal(self, inverse: bool, through: np.ndarray | None = None) -> Matrices:
        """Block-diagonal A, B, C, D of D_z, or of the inverse of D_w.

        through (n_signals, n) : matrix that generates the signals. If those of a group are linearly dependent, d(s) is
        realised once for each independent combination, which is exact for these signals only.
        """
        stack: list[tuple[np.ndarray, Matrices]] = []
        at = [
            np.arange(w.start, w.stop) if inverse else np.arange(z.start, z.stop) for _, w, z in self.structure.slices()
        ]
        parts = [part.inverse() if inverse else part for part in self.parts]
        for blocks in (*self.members, (len(parts) - 1,)):
            first = parts[blocks[0]]
            if isinstance(first, MatrixScaling):
                stack.append((at[blocks[0]], first.matrices))
            elif len(blocks) == 1 or through is None:
                stack += [(np.array([signal]), parts[k].matrices) for k in blocks for signal in at[k]]
            else:
                # d_k(s) = g_k d(s) with d(inf) = 1
                signals = np.concatenate([at[k] for k in blocks])
                gains = np.exp(np.concatenate([np.full(at[k].size, parts[k].scalar.theta[0]) for k in blocks]))
                U, sizes, _ = np.linalg.svd(gains[:, None] * through[signals], full_matrices=False)
                U = U[:, sizes > SETTINGS.rank * sizes[0]]
                common = ScalarScaling(np.concatenate([[0.0], first.scalar.theta[1:]])).matrices
                a, b, c = (np.kron(one, np.eye(U.shape[1])) for one in common[:3])
                own = (
                    (a, b @ (U.T * gains), U @ c, np.diag(gains))
                    if not inverse
                    else (a, b @ U.T, gains[:, None] * (U @ c), np.diag(gains))
                )
                stack.append((signals, own))
        states, signals_all = sum(one[0].shape[0] for _, one in stack), sum(len(to) for to, _ in stack)
        A, B, C, D = (
            np.zeros(shape)
            for shape in ((states, states), (states, signals_all), (signals_all, states), (signals_all, signals_all))
        )
        x = 0
        for to, (a, b, c, d) in stack:
            x_to = np.arange(x, x + a.shape[0])
            A[np.ix_(x_to, x_to)], B[np.ix_(x_to, to)], C[np.ix_(to, x_to)], D[np.ix_(to, to)] = a, b, c, d
            x += a.shape[0]
        return A, B, C, D
