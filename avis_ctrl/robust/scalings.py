"""Dynamic scalings D(s) of a block structure: stable, minimum phase, with stable inverse.

A block that is a full matrix or a single scalar takes a scalar d(s); a repeated scalar takes a square
matrix D(s). Everything is relative to the performance block, whose scaling is one. Multiplied around
the plant they leave mu unchanged: mu(N) = mu(D N D^-1) <= sigma_max(D N D^-1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, gain
from avis_ctrl.uncertainty.blocks import Block, BlockStructure


@dataclass(frozen=True, eq=False)
class ScalarScaling:
    """d(s) = g prod(zero factors) / prod(pole factors), all roots in the open left half plane.

    `theta` has 1 + 2 n entries: log g, then n for the zeros, then n for the poles. Roots go in pairs
    s^2 + 2 zeta w s + w^2 described by (log w, log zeta), real or complex alike, so that the description
    is smooth where two real roots meet; with odd n the last is a real root -a described by log a.
    Every theta is a stable d(s) with stable inverse: an optimiser needs no constraint.
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
    def from_roots(g: float, zeros: Sequence[complex] | np.ndarray,
                   poles: Sequence[complex] | np.ndarray) -> ScalarScaling:
        """From the gain at infinite frequency and as many zeros as poles, conjugates included."""
        if len(zeros) != len(poles) or g <= 0:
            raise InputError(f"expected g > 0 and as many zeros as poles, not {g}, {len(zeros)} and {len(poles)}")
        return ScalarScaling(np.concatenate([[np.log(g)], _pair(np.asarray(zeros, complex)),
                                             _pair(np.asarray(poles, complex))]))

    @property
    def order(self) -> int:
        return (self.theta.size - 1) // 2

    @property
    def zeros(self) -> np.ndarray:
        return _roots(self.theta[1:1 + self.order])

    @property
    def poles(self) -> np.ndarray:
        return _roots(self.theta[1 + self.order:])

    def inverse(self) -> ScalarScaling:
        """1 / d(s)."""
        n = self.order
        return ScalarScaling(np.concatenate([[-self.theta[0]], self.theta[1 + n:], self.theta[1:1 + n]]))

    def within(self, band: tuple[float, float]) -> ScalarScaling:
        """Roots beyond the band [rad/s] moved to its edge, the magnitude kept as it was far inside."""
        n, theta = self.order, self.theta.copy()
        for start in (1, 1 + n):
            sign = 1.0 if start == 1 else -1.0
            for k in range(start, start + n):
                is_damping = k < start + 2 * (n // 2) and (k - start) % 2 == 1
                if is_damping:
                    theta[k] = np.clip(theta[k], np.log(0.05), np.log(50.0))
                    continue
                moved = np.clip(theta[k], np.log(band[0]), np.log(band[1]))
                # A factor (s + a) is about a below its corner: a faster root lowered takes gain with it.
                if moved < theta[k]:
                    theta[0] += sign * (theta[k] - moved) * (1 if k == start + n - 1 and n % 2 else 2)
                theta[k] = moved
        return ScalarScaling(theta)

    def with_neutral_pair(self, omega: float, split: float = 0.0) -> ScalarScaling:
        """One more zero at omega e^split and pole at omega e^-split: the same d(s) where split = 0."""
        return ScalarScaling.from_roots(np.exp(self.theta[0]), np.append(self.zeros, -omega * np.exp(split)),
                                        np.append(self.poles, -omega * np.exp(-split)))

    def log_magnitude(self, omega: np.ndarray) -> np.ndarray:
        """log |d(j omega)| (n_omega,), omega in rad/s, finite."""
        n = self.order
        return (self.theta[0] + _log_modulus(self.theta[1:1 + n], omega)[0]
                - _log_modulus(self.theta[1 + n:], omega)[0])

    def jacobian(self, omega: np.ndarray) -> np.ndarray:
        """Derivative of `log_magnitude` to theta (n_omega, 1 + 2 n)."""
        n = self.order
        return np.hstack([np.ones((np.size(omega), 1)), _log_modulus(self.theta[1:1 + n], omega)[1],
                          -_log_modulus(self.theta[1 + n:], omega)[1]])

    def realise(self) -> StateSpace:
        """A cascade of first- and second-order sections, slow ones first."""
        n = self.order
        zeros, poles = self.theta[1:1 + n], self.theta[1 + n:]
        system = gain(np.exp(self.theta[0]))
        for k in range(n // 2):
            system = _biquad(*np.exp(zeros[2 * k:2 * k + 2]), *np.exp(poles[2 * k:2 * k + 2])) @ system
        if n % 2:
            z, p = np.exp(zeros[-1]), np.exp(poles[-1])
            root = np.sqrt(p)
            system = StateSpace(-p, np.array([[root]]), np.array([[(z - p) / root]]), np.ones((1, 1))) @ system
        return system

    def as_dict(self) -> dict[str, Any]:
        return {"theta": self.theta.tolist()}


def _pair(roots: np.ndarray) -> np.ndarray:
    """(log w, log zeta) of each pair of roots by rising w, then log a of a lone real one."""
    if np.any(roots.real >= 0):
        raise InputError("roots must lie in the open left half plane", value=float(np.max(roots.real)))
    real = np.sort(-roots[np.abs(roots.imag) <= 1e-12 * np.abs(roots)].real)
    upper = roots[roots.imag > 1e-12 * np.abs(roots)]
    pairs = [(abs(s), -s.real / abs(s)) for s in upper]
    pairs += [(np.sqrt(a * b), (a + b) / (2 * np.sqrt(a * b)))
              for a, b in zip(real[0:-1:2], real[1::2], strict=True)] if real.size > 1 else []
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
            fast = w * (zeta + np.sqrt(zeta ** 2 - 1))
            roots += [-fast, -w * w / fast]
        else:
            roots += [w * complex(-zeta, sign * np.sqrt(1 - zeta ** 2)) for sign in (1, -1)]
    if theta.size % 2:
        roots.append(-np.exp(theta[-1]))
    return np.array(roots, complex)


def _log_modulus(theta: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log |product of factors at j omega| (n_omega,) and its derivative to theta (n_omega, n)."""
    omega = np.atleast_1d(np.asarray(omega, float))
    value, slope = np.zeros(omega.size), np.zeros((omega.size, theta.size))
    for k in range(theta.size // 2):
        w2, c = np.exp(2 * theta[2 * k]), 4 * np.exp(2 * theta[2 * k + 1])
        size = (w2 - omega ** 2) ** 2 + c * w2 * omega ** 2
        value += 0.5 * np.log(size)
        slope[:, 2 * k] = (2 * w2 * (w2 - omega ** 2) + c * w2 * omega ** 2) / size
        slope[:, 2 * k + 1] = c * w2 * omega ** 2 / size
    if theta.size % 2:
        a2 = np.exp(2 * theta[-1])
        value += 0.5 * np.log(omega ** 2 + a2)
        slope[:, -1] = a2 / (omega ** 2 + a2)
    return value, slope


def _biquad(wz: float, zz: float, wp: float, zp: float) -> StateSpace:
    """(s^2 + 2 zz wz s + wz^2) / (s^2 + 2 zp wp s + wp^2) with states of like size."""
    c = np.array([[(wz ** 2 - wp ** 2) / wp, 2 * zz * wz - 2 * zp * wp]])
    root = np.sqrt(wp)
    return StateSpace(np.array([[0.0, wp], [-wp, -2 * zp * wp]]), np.array([[0.0], [root]]), c / root, np.ones((1, 1)))


@dataclass(frozen=True, eq=False)
class MatrixScaling:
    """Square D(s) of a repeated scalar block, as a state space whose zeros and poles are stable."""

    system: StateSpace

    def __post_init__(self) -> None:
        D = self.system
        if D.ninputs != D.noutputs or np.linalg.matrix_rank(D.D) < D.ninputs:
            raise InputError("a matrix scaling is square with an invertible direct term", value=D.D.shape)
        if not (D.is_stable() and self.inverse().is_stable()):
            raise InputError("a matrix scaling needs stable poles and zeros", value=D.poles().real.max(initial=-1.0))

    @property
    def order(self) -> int:
        return self.system.nstates

    def inverse(self) -> StateSpace:
        """D(s)^-1."""
        A, B, C, D = self.system.A, self.system.B, self.system.C, self.system.D
        Di = np.linalg.inv(D)
        return StateSpace(A - B @ Di @ C, B @ Di, -Di @ C, Di)

    def as_dict(self) -> dict[str, Any]:
        return {key: getattr(self.system, key).tolist() for key in "ABCD"}


Part = ScalarScaling | MatrixScaling


@dataclass(frozen=True, eq=False)
class Scalings:
    """One scaling a block of the structure; the last block is the performance and has d = 1."""

    structure: BlockStructure
    parts: tuple[Part, ...]

    @staticmethod
    def identity(structure: BlockStructure) -> Scalings:
        return Scalings(structure, tuple(MatrixScaling(gain(np.eye(b.rows))) if b.repeated else
                                         ScalarScaling.constant(1.0) for b in structure.blocks))

    @property
    def orders(self) -> tuple[int, ...]:
        """Order of each block's d(s) or D(s)."""
        return tuple(part.order for part in self.parts)

    @property
    def added_states(self) -> int:
        """States the scaled plant has more than the plant."""
        return sum(part.order * (2 if isinstance(part, MatrixScaling) else block.rows + block.cols)
                   for part, block in zip(self.parts, self.structure.blocks, strict=True))

    def replace(self, index: int, part: Part) -> Scalings:
        """The same scalings with one block's changed."""
        return replace(self, parts=(*self.parts[:index], part, *self.parts[index + 1:]))

    def left(self) -> StateSpace:
        """D_z(s) (n_z, n_z), to the left of N."""
        return _side_by_side([self._copies(part, block.cols) for part, block in self._pairs()])

    def right_inverse(self) -> StateSpace:
        """D_w(s)^-1 (n_w, n_w), to the right of N."""
        return _side_by_side([part.inverse() if isinstance(part, MatrixScaling) else
                              self._copies(part.inverse(), block.rows) for part, block in self._pairs()])

    def response(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """D_z (n_omega, n_z, n_z) and D_w^-1 (n_omega, n_w, n_w) at omega [rad/s], scalar blocks without their phase.

        The phase of a scalar d(s) changes no singular value of D N D^-1.
        """
        omega = np.atleast_1d(omega)
        left = np.zeros((omega.size, self.structure.n_z, self.structure.n_z), complex)
        right = np.zeros((omega.size, self.structure.n_w, self.structure.n_w), complex)
        for (_, w, z), part in zip(self.structure.slices(), self.parts, strict=True):
            if isinstance(part, MatrixScaling):
                left[:, z, z] = part.system.frequency_response(omega)
                right[:, w, w] = np.linalg.inv(left[:, z, z])
            else:
                d = np.exp(part.log_magnitude(omega))
                left[:, range(z.start, z.stop), range(z.start, z.stop)] = d[:, None]
                right[:, range(w.start, w.stop), range(w.start, w.stop)] = 1 / d[:, None]
        return left, right

    def scale(self, P: StateSpace) -> StateSpace:
        """diag(D_z, I) P diag(D_w^-1, I): the plant whose H-infinity problem is the K-step."""
        nmeas, ncon = P.noutputs - self.structure.n_z, P.ninputs - self.structure.n_w
        left = _side_by_side([self.left(), gain(np.eye(nmeas))])
        right = _side_by_side([self.right_inverse(), gain(np.eye(ncon))])
        return (left @ P @ right).renamed(P.inputs, P.outputs)

    def as_dicts(self) -> list[dict[str, Any]]:
        """JSON form of the parts."""
        return [part.as_dict() for part in self.parts]

    @staticmethod
    def from_dicts(structure: BlockStructure, items: Sequence[dict[str, Any]]) -> Scalings:
        """Inverse of `as_dicts`."""
        def part(item: dict[str, Any]) -> Part:
            if "theta" in item:
                return ScalarScaling(np.array(item["theta"]))
            D = np.array(item["D"], float)
            n = len(item["A"])
            return MatrixScaling(StateSpace(np.reshape(item["A"], (n, n)), np.reshape(item["B"], (n, D.shape[1])),
                                            np.reshape(item["C"], (D.shape[0], n)), D))
        return Scalings(structure, tuple(part(item) for item in items))

    def _pairs(self) -> list[tuple[Part, Block]]:
        return list(zip(self.parts, self.structure.blocks, strict=True))

    @staticmethod
    def _copies(part: Part, count: int) -> StateSpace:
        if isinstance(part, MatrixScaling):
            return part.system
        return _side_by_side([part.realise()] * count)


def _side_by_side(systems: Sequence[StateSpace]) -> StateSpace:
    """Block-diagonal stack with numbered signals; the names of the parts may repeat."""
    return StateSpace(la.block_diag(*(s.A for s in systems)), la.block_diag(*(s.B for s in systems)),
                      la.block_diag(*(s.C for s in systems)), la.block_diag(*(s.D for s in systems)))
