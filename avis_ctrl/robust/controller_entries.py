"""A controller as a vector of its normalised free entries: the variables of the descent."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as la

from avis_ctrl.lti import StateSpace
from avis_ctrl.robust.mu_lmi import Array


@dataclass(frozen=True)
class ModalSettings:
    """defective : condition number of the eigenvectors of the balanced A above which A counts as defective [1]: they
        lose twelve of sixteen digits.
    changes : relative changes of A that are tried in turn, the first being none, until A is not defective [1].
    """

    defective: float = 1e12
    changes: tuple[float, ...] = (0.0, 1e-8, 1e-6, 1e-4, 1e-2)


SETTINGS = ModalSettings()


@dataclass(frozen=True, eq=False)
class ControllerEntries:
    """K with tridiagonal A (modal blocks), and its free entries, each normalised by its typical size.

    rows, cols : indices of the free entries of [A B; C D]; size : typical sizes; start : normalised values.
    """

    K: StateSpace
    rows: Array
    cols: Array
    size: Array
    start: Array

    @staticmethod
    def of(K: StateSpace, decentralised: bool = False) -> ControllerEntries:
        """K in modal form, with its free entries; decentralised: u_k depends on y_k only."""
        A, B, C, rate, channel = _modal(K)
        n = rate.size
        whole = np.block([[A, B], [C, K.D]])
        free = np.ones(whole.shape, bool)
        free[:n, :n] = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 1
        if decentralised:
            label = np.r_[channel, np.arange(K.ninputs)], np.r_[channel, np.arange(K.noutputs)]
            free &= np.equal.outer(label[1], label[0])
        unit = np.empty(whole.shape)
        unit[:n, :n] = np.sqrt(np.outer(rate, rate))
        unit[:n, n:] = np.linalg.norm(B, axis=1, keepdims=True)
        unit[n:, :n] = np.linalg.norm(C, axis=0)
        unit[n:, n:] = np.linalg.norm(K.D) + np.max(np.abs(C).sum(axis=0) * np.abs(B).sum(axis=1) / rate, initial=0.0)
        unit[unit == 0] = 1.0
        rows, cols = np.nonzero(free)
        return ControllerEntries(K, rows, cols, unit[rows, cols], whole[rows, cols] / unit[rows, cols])

    def matrix(self, x: Array) -> Array:
        """[A B; C D] for the normalised entries x."""
        n = self.K.nstates
        whole = np.zeros((n + self.K.noutputs, n + self.K.ninputs))
        whole[self.rows, self.cols] = x * self.size
        return whole

    def controller(self, x: Array) -> StateSpace:
        """The controller with the normalised entries x."""
        n, whole = self.K.nstates, self.matrix(x)
        return StateSpace(
            whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:], 0.0, self.K.inputs, self.K.outputs
        )

    def slope(self, whole: Array) -> Array:
        """Derivatives with respect to x from those with respect to [A B; C D]."""
        return whole[self.rows, self.cols] * self.size


def _diagonalisable(K: StateSpace) -> tuple[StateSpace, Array, Array]:
    """K with the eigenvalues and eigenvectors of its A, which is changed slightly if it has too few eigenvectors."""
    size = 1e-6 * float(np.max(np.abs(K.poles()), initial=0.0)) or 1.0
    _, (scale, _) = la.matrix_balance(K.A, permute=False, separate=True)
    for change in SETTINGS.changes:
        # A different relative change of every row separates repeated poles and keeps decoupled channels decoupled.
        rows = change * np.linspace(-1, 1, K.nstates)[:, None]
        made = replace(K, A=K.A + rows * (K.A + size * np.eye(K.nstates)))
        values, V = la.eig(made.A)
        balanced = V / scale[:, None]
        if not V.size or np.linalg.cond(balanced / np.linalg.norm(balanced, axis=0)) < SETTINGS.defective:
            break
    return made, values, V


def _modal(K: StateSpace) -> tuple[Array, Array, Array, Array, Array]:
    """Modal A (1 x 1 and 2 x 2 blocks), B and C with rows of B and columns of C of equal norm, |poles|, and outputs.

    The outputs (n,) are those that each state affects most; the states are ordered by them.
    """
    n, vectors, sizes, channels = K.nstates, [], [], []
    K, values, V = _diagonalisable(K)
    output = np.argmax(np.abs(K.C @ V), axis=0)
    for k in np.lexsort((np.abs(values), output)):
        if values[k].imag > 0:
            vectors += [V[:, k].real, V[:, k].imag]
            sizes += [abs(values[k])] * 2
            channels += [output[k]] * 2
        elif values[k].imag == 0:
            vectors.append(V[:, k].real)
            sizes.append(abs(values[k]))
            channels.append(output[k])
    S = np.array(vectors).T.reshape(n, n)
    A, B, C = np.linalg.solve(S, K.A @ S), np.linalg.solve(S, K.B), K.C @ S
    rows, cols = np.linalg.norm(B, axis=1), np.linalg.norm(C, axis=0)
    # A common scale for both states of a pair keeps its block normal.
    scale = np.sqrt(np.where((rows > 0) & (cols > 0), rows, 1.0) / np.where((rows > 0) & (cols > 0), cols, 1.0))
    for k in range(n - 1):
        if A[k, k + 1] * A[k + 1, k] < 0 and sizes[k] == sizes[k + 1]:
            scale[k : k + 2] = np.sqrt(scale[k] * scale[k + 1])
    rate = np.maximum(np.array(sizes), 1e-6 * max(sizes, default=1.0))
    return A / scale[:, None] * scale, B / scale[:, None], C * scale, rate, np.array(channels, int)
