"""The generalized plant of an H-infinity problem: partition, assumptions, normal form.

    x' = A  x + B1  w + B2  u
    z  = C1 x + D11 w + D12 u          u = K y  (positive feedback)
    y  = C2 x + D21 w + D22 u

Solvability requires (A, B2) stabilisable and (A, C2) detectable. The Riccati solution also requires D12 of full column
rank, D21 of full row rank, and no zero of the channels u -> z and w -> y on the imaginary axis (Zhou, Doyle and Glover,
Robust and Optimal Control, 1996, section 16.2.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg as la

from avis_ctrl.checks import is_whole
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, balance, minimal
from avis_ctrl.lti.bilinear import continuous_image
from avis_ctrl.lti.interchange import as_system
from avis_ctrl.lti.statespace import Names, positions
from avis_ctrl.robust.hinf_settings import SETTINGS
from avis_ctrl.uncertainty.uncertain_system import UncertainSystem

# Number of measurements or controls, which are the last signals of the plant, or their names.
Signals = int | str | Sequence[str]


@dataclass(frozen=True)
class Plant:
    """Partitioned continuous-time plant; names of u and y for messages."""

    A: np.ndarray
    B1: np.ndarray
    B2: np.ndarray
    C1: np.ndarray
    C2: np.ndarray
    D11: np.ndarray
    D12: np.ndarray
    D21: np.ndarray
    D22: np.ndarray
    u: tuple[str, ...] = ()
    y: tuple[str, ...] = ()

    @staticmethod
    def of(P: StateSpace, nmeas: int, ncon: int) -> Plant:
        """Balance P (w, u -> z, y) and split it by its last nmeas outputs and last ncon inputs."""
        return Plant.split(balance(P), nmeas, ncon)

    @staticmethod
    def split(P: StateSpace, nmeas: int, ncon: int) -> Plant:
        """Like `of`, with the states as they are."""
        w, z = P.ninputs - ncon, P.noutputs - nmeas
        return Plant(
            P.A,
            P.B[:, :w],
            P.B[:, w:],
            P.C[:z],
            P.C[z:],
            P.D[:z, :w],
            P.D[:z, w:],
            P.D[z:, :w],
            P.D[z:, w:],
            P.inputs[w:],
            P.outputs[z:],
        )

    @property
    def n(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    def sample_points(self) -> np.ndarray:
        """Points in the right half plane, off the imaginary axis, at the magnitudes of the poles."""
        sizes = np.abs(la.eigvals(self.A)) if self.n else np.zeros(0)
        sizes = np.unique(np.concatenate([sizes[sizes > 0], [1.0]]))
        return sizes * np.exp(0.25j * np.pi)

    def at(self, s: complex, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> np.ndarray:
        """Transfer matrix of one channel at the point s."""
        return C @ np.linalg.solve(s * np.eye(self.n) - self.A, B.astype(complex)) + D if self.n else D.astype(complex)

    def size(self, B: np.ndarray, C: np.ndarray, D: np.ndarray, axis: int | None = None) -> np.ndarray:
        """Typical size of one channel, overall or by column (axis 0) or row (axis 1); 1 where it is zero.

        It is a geometric mean over the sample points, so that neither the static gain nor the roll-off of a weight
        dominates.
        """
        sizes = [la.norm(self.at(s, B, C, D), axis=axis) for s in self.sample_points()]
        logs = np.mean([np.log(np.maximum(size, 1e-300)) for size in sizes if np.any(size)] or [0.0], axis=0)
        size = np.exp(logs) * np.ones(() if axis is None else D.shape[1 - axis])
        return np.where(size > 1e-100, size, 1.0)


def as_plant(P: Any, nmeas: Signals, ncon: Signals) -> tuple[StateSpace, int, int]:
    """The generalized plant with y and u last, and their numbers; InputError for a wrong partition.

    P : an avis_ctrl or python-control system; of an `UncertainSystem` the nominal system is used.
    nmeas, ncon : numbers, or names of the measurements and controls, which become the last signals in this order.
    """
    if isinstance(P, UncertainSystem):
        P = as_system(P.nominal).renamed(P.inputs, P.outputs)
    if not isinstance(P, StateSpace):
        if not hasattr(P, "A") and not hasattr(P, "num"):
            raise InputError("expected a system of avis_ctrl or python-control", field="P", value=type(P).__name__)
        P = StateSpace.from_control(P)
    rows, n_y = _order("nmeas", nmeas, P.outputs, "output", "outputs (z, y)")
    cols, n_u = _order("ncon", ncon, P.inputs, "input", "inputs (w, u)")
    return P if rows == sorted(rows) and cols == sorted(cols) else P.select(rows, cols), n_y, n_u


def _order(field: str, given: Signals, names: Names, kind: str, what: str) -> tuple[list[int], int]:
    """Positions of all signals, the named ones last, and the number of these."""
    every, total = list(range(len(names))), len(names)
    count: Any = given
    if isinstance(given, (str, list, tuple)):
        last = positions(names, given, kind)
        every, count = [k for k in every if k not in last] + last, len(last)
        if len(set(last)) != count:
            raise InputError("expected different names", field=field, value=given)
    if not is_whole(count, 1):
        raise InputError("expected a whole number of at least 1, or names", field=field, value=given)
    if count >= total:
        raise InputError(
            f"expected less than {total}: the plant has {total} {what} and one must be left "
            "for the performance channel",
            field=field,
            value=given,
        )
    return every, int(count)


def check_stabilisable(plant: Plant) -> None:
    """Raise ComputationError if an unstable mode, which is named, is uncontrollable or unobservable (PBH test)."""
    for A, B, names, verb, who in (
        (plant.A, plant.B2, plant.u, "not moved by any of the inputs", "an actuator or input"),
        (plant.A.T, plant.C2.T, plant.y, "not seen by any of the measurements", "a sensor"),
    ):
        for pole in np.unique(la.eigvals(A)) if plant.n else ():
            size = la.norm(np.hstack([A, B]), 2)
            if pole.imag < 0 or pole.real < -1e-15 * size:
                continue
            margin = la.svdvals(np.hstack([A - pole * np.eye(plant.n), B]))[-1] / size
            if margin < SETTINGS.pbh_tolerance:
                raise ComputationError(
                    f"mode at {abs(pole.imag) / (2 * np.pi):.4g} Hz is {verb} {list(names)}: no controller exists",
                    measured=f"pole {pole.real:.4g} {pole.imag:+.4g}j rad/s, rank margin {margin:.1e} "
                    f"of the PBH matrix (at least {SETTINGS.pbh_tolerance:.0e} is needed)",
                    cause="an integrator or unstable weight outside the loop, or a missing channel",
                    next_step=f"make the mode stable, or give {who} that reaches it",
                )


def posed_plant(P: StateSpace, nmeas: int, ncon: int) -> Plant:
    """Continuous plant of the problem without hidden states; ComputationError if it cannot be stabilised."""
    continuous = continuous_image(P)
    plant = Plant.of(continuous, nmeas, ncon)
    check_stabilisable(plant)
    small = without_hidden_states(continuous, nmeas, ncon)
    return plant if small.nstates == plant.n else Plant.of(small, nmeas, ncon)


def without_hidden_states(P: StateSpace, nmeas: int, ncon: int) -> StateSpace:
    """P without its hidden (uncontrollable or unobservable) states, if this leaves its response unchanged; else P.

    Stable hidden states, for example of a weight realised twice, do not change the problem, but X and Y are singular or
    ill conditioned on them. The responses are compared block by block off the imaginary axis, because on the axis the
    response near a lightly damped pole is not accurate to `response_tolerance`.
    """
    small = minimal(P)
    if small.nstates == P.nstates:
        return P
    old, new = Plant.of(P, nmeas, ncon), Plant.of(small, nmeas, ncon)
    sizes = np.abs(old.sample_points())
    sizes = np.unique(np.concatenate([sizes, np.sqrt(sizes[:-1] * sizes[1:]), sizes[[0]] / 100, sizes[[-1]] * 100]))
    for s in np.concatenate([sizes * np.exp(0.1j), sizes * np.exp(0.25j * np.pi)]):
        for B, C, D in (("B1", "C1", "D11"), ("B2", "C1", "D12"), ("B1", "C2", "D21"), ("B2", "C2", "D22")):
            try:
                a, b = (one.at(s, getattr(one, B), getattr(one, C), getattr(one, D)) for one in (old, new))
            except np.linalg.LinAlgError:
                return P
            if not la.norm(a - b) <= SETTINGS.response_tolerance * la.norm(a):
                return P
    return small


@dataclass(frozen=True)
class NormalForm:
    """Plant with D12 = [0; I], D21 = [0 I], D22 = 0, and the inverse maps: K = S K_n T, then D22 is restored."""

    plant: Plant
    S: np.ndarray
    T: np.ndarray
    D22: np.ndarray


def normal_form(plant: Plant) -> NormalForm:
    """Scale u and y, rotate z and w, remove D22; D12 and D21 must have full rank (see `rank_margins`)."""
    m2, p2 = plant.D12.shape[1], plant.D21.shape[0]
    U, s, Vt = la.svd(plant.D12)
    Q, S = np.hstack([U[:, m2:], U[:, :m2]]), Vt.T / s
    V, t, Wt = la.svd(plant.D21)
    W, T = np.hstack([Wt[p2:].T, Wt[:p2].T]), (V / t).T
    normal = replace(
        plant,
        B1=plant.B1 @ W,
        B2=plant.B2 @ S,
        C1=Q.T @ plant.C1,
        C2=T @ plant.C2,
        D11=Q.T @ plant.D11 @ W,
        D12=Q.T @ plant.D12 @ S,
        D21=T @ plant.D21 @ W,
        D22=np.zeros_like(plant.D22),
    )
    return NormalForm(normal, S, T, plant.D22)


def channel_scales(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """Typical size of the effect of each input on z, and of w on each measurement: the scale of extra channels."""
    return plant.size(plant.B2, plant.C1, plant.D12, 0), plant.size(plant.B1, plant.C2, plant.D21, 1)


def in_usual_units(plant: Plant) -> Plant:
    """The same problem with inputs and measurements scaled so that all `channel_scales` are one.

    No bound depends on the units of u and y, but a rank test relative to the largest channel would.
    """
    of_u, of_y = channel_scales(plant)
    return replace(
        plant,
        B2=plant.B2 / of_u,
        D12=plant.D12 / of_u,
        C2=plant.C2 / of_y[:, None],
        D21=plant.D21 / of_y[:, None],
        D22=plant.D22 / of_u / of_y[:, None],
    )


def rank_margins(plant: Plant) -> tuple[float, float]:
    """Smallest singular values of D12 (columns of unit length) and D21 (rows of unit length).

    A column below `no_column` times the typical effect of its input on z counts as zero; 0 if there are too few rows.
    """
    of_u, of_y = channel_scales(plant)

    def margin(D: np.ndarray, sizes: np.ndarray) -> float:
        length = la.norm(D, axis=0)
        if D.shape[0] < D.shape[1] or np.any(length <= SETTINGS.no_column * sizes):
            return 0.0
        return float(la.svdvals(D / length)[-1])

    return margin(plant.D12, of_u), margin(plant.D21.T, of_y)


def regularised(plant: Plant, epsilon: float, of_D12: bool, of_D21: bool, of_states: bool) -> Plant:
    """The plant with small extra outputs (epsilon u, and epsilon x) or inputs (noise on y, and on x)."""
    of_u, of_y = channel_scales(plant)
    C1, D11, D12, B1, D21 = plant.C1, plant.D11, plant.D12, plant.B1, plant.D21
    n, w = plant.n, plant.D11.shape[1]
    state_C = epsilon * np.eye(n) * _typical(C1) if of_states else np.zeros((0, n))
    state_B = epsilon * np.eye(n) * _typical(B1) if of_states else np.zeros((n, 0))
    if of_D12 or of_states:
        extra = epsilon * np.diag(of_u) if of_D12 else np.zeros((0, of_u.size))
        rows = state_C.shape[0]
        C1 = np.vstack([C1, state_C, np.zeros((extra.shape[0], n))])
        D11 = np.vstack([D11, np.zeros((rows + extra.shape[0], w))])
        D12 = np.vstack([D12, np.zeros((rows, of_u.size)), extra])
    if of_D21 or of_states:
        noise = epsilon * np.diag(of_y) if of_D21 else np.zeros((of_y.size, 0))
        cols = state_B.shape[1]
        B1 = np.hstack([B1, state_B, np.zeros((n, noise.shape[1]))])
        D11 = np.hstack([D11, np.zeros((D11.shape[0], cols + noise.shape[1]))])
        D21 = np.hstack([D21, np.zeros((of_y.size, cols)), noise])
    return replace(plant, B1=B1, C1=C1, D11=D11, D12=D12, D21=D21)


def _typical(matrix: np.ndarray) -> float:
    return float(la.norm(matrix, 2)) if np.any(matrix) else 1.0


def parrott(P11: np.ndarray, of_u: np.ndarray, of_y: np.ndarray) -> float:
    """min over Q of sigma_max(P11 + P12 Q P21), exact (Parrott 1978).

    of_u, of_y : orthonormal bases of the directions of z not affected by u, and of those of w not measured in y.
    """
    left, right = of_u.conj().T @ P11, P11 @ of_y
    return float(max(la.norm(left, 2) if left.size else 0.0, la.norm(right, 2) if right.size else 0.0))


def parrott_at_infinity(plant: Plant) -> float:
    """Parrott's bound of the direct terms, for a plant `in_usual_units`."""
    bases = []
    for rows in (plant.D12.T, plant.D21):
        there = rows[la.norm(rows, axis=1) > SETTINGS.no_column]
        bases.append(_kernel(there / la.norm(there, axis=1)[:, None], SETTINGS.no_column))
    return parrott(plant.D11, *bases)


def pointwise(plant: Plant, s: complex, at_zero: bool = False) -> float:
    """Parrott's bound at one point of the closed right half plane (see `hinf_bounds`).

    0 if P has a pole at s, or if round-off makes the directions affected by u or measured in y uncertain.

    at_zero : s is a computed zero of u -> z or w -> y, where that channel loses rank.
    """
    resolvent = s * np.eye(plant.n) - plant.A
    if plant.n and 1 / np.linalg.cond(resolvent) < 1e-13:
        return 0.0
    R = np.linalg.inv(resolvent) if plant.n else np.zeros((0, 0))
    x1, x2 = (np.linalg.solve(resolvent, B) if plant.n else np.zeros(B.shape) for B in (plant.B1, plant.B2))
    P12, P21 = plant.C1 @ x2 + plant.D12, plant.C2 @ x1 + plant.D21
    bases = []
    for rows, noise in (
        (P12.conj().T, _rounding(plant.C1, R, resolvent, plant.B2, x2, plant.D12).T),
        (P21, _rounding(plant.C2, R, resolvent, plant.B1, x1, plant.D21)),
    ):
        basis = _kernel_at_zero(rows, noise) if at_zero else _known_kernel(rows, noise)
        if basis is None:
            return 0.0
        bases.append(basis)
    return parrott(plant.C1 @ x1 + plant.D11, *bases)


def _rounding(
    C: np.ndarray, R: np.ndarray, resolvent: np.ndarray, B: np.ndarray, x: np.ndarray, D: np.ndarray
) -> np.ndarray:
    """Bound of the round-off in the entries of C x + D, x = R B (Higham 2002, section 7.2)."""
    of_x = np.abs(R) @ (np.abs(resolvent) @ np.abs(x) + np.abs(B))
    return (len(R) + 1) * np.finfo(float).eps * (np.abs(C) @ (np.abs(x) + of_x) + np.abs(D))


def _known_kernel(rows: np.ndarray, noise: np.ndarray) -> np.ndarray | None:
    """Null space of rows with error bound `noise`; None if it is not accurate to `known_direction`."""
    length, error = la.norm(rows, axis=1), la.norm(noise, axis=1)
    there = (length > 0) | (error > 0)
    rows, length, error = rows[there], length[there], error[there]
    if np.any(error > SETTINGS.known_direction * length):
        return None
    rows = rows / length[:, None]
    least = float(la.svdvals(rows)[-1]) if len(rows) else 1.0
    if len(rows) < rows.shape[1] and la.norm(error / length) > SETTINGS.known_direction * least:
        return None
    return _kernel(rows, 0.0)


def _kernel_at_zero(rows: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Null space of rows at one of their zeros: rows at the level of round-off count as zero."""
    length = la.norm(rows, axis=1)
    there = length > SETTINGS.rank_at_zero / np.finfo(float).eps * la.norm(noise, axis=1)
    return _kernel(rows[there] / length[there, None], SETTINGS.rank_at_zero)


def _kernel(rows: np.ndarray, least: float) -> np.ndarray:
    """Orthonormal basis of the null space of rows; singular values up to `least` count as zero."""
    if not len(rows):
        return np.eye(rows.shape[1])
    _, s, Vh = la.svd(rows)
    return Vh[int(np.sum(s > least)) :].conj().T
