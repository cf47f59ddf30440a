"""A rig with uncertain physical parameters, as an exact linear fractional transformation.

With the velocity v of the payload, its displacement r relative to the floor, and a floor that moves with
velocity v_f, the equations of motion (eq. 15 of the Halcyonics source, eq. 2.36 of the AVIS source with the
chassis motion kept) need neither a derivative nor an integral of the floor motion:

    r' = v - v_f
    M(delta) v' + C(delta) (v - v_f) + K(delta) r - T(delta) u = f

so that one matrix N(delta) = [M, C, K, -T], acting on s = (v', v - v_f, r, u), contains all uncertainty.
The coefficient of each monomial delta^a of its polynomial is factored into L_a R_a of minimal rank and pulled
out: z = R_a s, w = delta z, force -L_a w. No inverse of M is expanded, so there is no approximation: the loop
closed with any delta is the rig with the perturbed parameters. The velocities of payload and floor have the
same ratio as the displacements, so the transmissibility is the response from v_f to v.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.uncertainty.blocks import BlockStructure, RealScalar
from avis_ctrl.uncertainty.lft_reduction import reduce_copies
from avis_ctrl.uncertainty.polynomial import Exponents, polynomial_coefficients


@dataclass(frozen=True)
class UncertainParameter:
    """A physical parameter known to within +- spread (a fraction of its value below 1, or absolute in its unit)."""

    name: str
    spread: float
    absolute: bool = False

    def half_range(self, nominal: float) -> float:
        """Half width of the interval in the parameter's unit."""
        if not self.absolute and nominal == 0.0:
            raise InputError(
                f"the nominal value of {self.name} is zero: give its uncertainty in absolute terms",
                field=self.name,
                value=nominal,
            )
        return self.spread if self.absolute else self.spread * abs(nominal)

    def half_ranges(self, nominal: Mapping[str, float]) -> dict[str, float]:
        """Change of each affected parameter at delta = 1, in the parameter's unit."""
        return {self.name: self.half_range(nominal[self.name])}

    def words(self, delta: float, nominal: Mapping[str, float], units: Mapping[str, str]) -> str:
        """A value of delta in physical terms: "isolator2.k_z at +15 %"."""
        if self.absolute:
            return f"{self.name} at {nominal[self.name] + delta * self.spread:.4g} {units[self.name]}".rstrip()
        return f"{self.name} at {100 * delta * self.spread:+.3g} %"


@dataclass(frozen=True)
class DirectionSettings:
    """named : largest number of parameters in the description of a direction, so that it stays a line; the model
    contains all of them."""

    named: int = 4


SETTINGS = DirectionSettings()


@dataclass(frozen=True)
class UncertainDirection:
    """Several parameters that change together with one delta in [-1, 1]: a principal axis of correlated parameters.

    changes : (parameter, half-range in its unit, with sign) of each of these parameters.
    """

    name: str
    changes: tuple[tuple[str, float], ...]

    def half_ranges(self, nominal: Mapping[str, float]) -> dict[str, float]:
        """Change of each affected parameter at delta = 1, in the parameter's unit."""
        return dict(self.changes)

    def words(self, delta: float, nominal: Mapping[str, float], units: Mapping[str, str]) -> str:
        """Such as "identified direction 1 at +0.8: isolator1.k_z +0.3 %, and 5 parameters by less"."""
        sizes = {name: change / abs(nominal[name]) if nominal[name] else np.inf for name, change in self.changes}
        most = sorted(self.changes, key=lambda one: -abs(sizes[one[0]]))
        words = [
            f"{name} {100 * delta * sizes[name]:+.2g} %"
            if nominal[name]
            else f"{name} {delta * change:+.2g} {units[name]}"
            for name, change in most[: SETTINGS.named]
        ]
        if len(most) > SETTINGS.named:
            words.append(f"and {len(most) - SETTINGS.named} parameters by less")
        return f"{self.name} at {delta:+.2g}: {', '.join(words)}"

    def stretch(self, nominal: Mapping[str, float], change: float) -> float:
        """Factor >= 1 that raises the largest relative change to `change`, since tiny changes would lose digits."""
        largest = max(abs(change) / (abs(nominal[name]) or 0.1) for name, change in self.changes)
        return max(1.0, change / largest)


@dataclass(frozen=True, eq=False)
class UncertainEquation:
    """Uncertain equation of motion of one coordinate: delta times a row is added to it, with one copy of delta.

    change : (3 n + n_u,) row added at delta = 1 to the coordinate's row of N = [M, C, K, -T], for the kept coordinates,
        rotations as displacement of the edge, and all actuators.
    """

    name: str
    coordinate: str
    change: np.ndarray

    def half_ranges(self, nominal: Mapping[str, float]) -> dict[str, float]:
        """Empty: no physical parameter corresponds to one row alone."""
        return {}

    def words(self, delta: float, nominal: Mapping[str, float], units: Mapping[str, str]) -> str:
        """Such as "fit 1 of z at +0.8"."""
        return f"{self.name} at {delta:+.2g}"


Uncertain = UncertainParameter | UncertainDirection | UncertainEquation


@dataclass(frozen=True)
class UncertainRig:
    """The rig's LFT, from w_delta, actuators, floor and forces to z_delta and motion.

    Attributes
    ----------
    system : inputs "w:NAME", actuators [V], "floor_COORD_dot" [m/s], "force_COORD" [N]; outputs "z:NAME",
        "COORD_rel" relative to the floor [m], "COORD_dot" [m/s] and "COORD_ddot" [m/s^2], both absolute.
    blocks : one repeated real scalar per parameter, direction or equation, in the order of w_delta.
    parameters : meaning of each delta. nominal, units : of every parameter that depends on a delta.
    coordinates : names of the kept coordinates; rotations are displacements of the edge [m] and end in "_edge".
    """

    system: StateSpace
    blocks: BlockStructure
    parameters: tuple[Uncertain, ...]
    nominal: dict[str, float]
    units: dict[str, str]
    coordinates: tuple[str, ...]

    def values(self, deltas: Sequence[float]) -> dict[str, float]:
        """Physical values at normalised deltas, for `rig.with_parameters`; changes by several deltas add up."""
        return _moved(self.parameters, deltas, self.nominal)


def _moved(
    parameters: Sequence[Uncertain], deltas: Sequence[float] | np.ndarray, nominal: Mapping[str, float]
) -> dict[str, float]:
    found: dict[str, float] = {}
    for parameter, delta in zip(parameters, deltas, strict=True):
        for name, half in parameter.half_ranges(nominal).items():
            found[name] = found.get(name, nominal[name]) + float(delta) * half
    return found


def edge_name(coordinate: str) -> str:
    """Name of a coordinate once rotations are expressed as displacements of the edge."""
    return f"{coordinate}_edge" if coordinate.startswith("phi") else coordinate


def uncertain_rig(rig: Rig, parameters: Sequence[Uncertain], keep: Sequence[str] = ("z", "phi_x")) -> UncertainRig:
    """LFT of a rig with its uncertain parameters pulled out; coordinates that are not kept are locked.

    Parameters
    ----------
    parameters : uncertain parameters, directions and equations, with the names of `rig.parameters()`; a parameter may
        also be part of directions.
    keep : coordinates that move.

    Raises
    ------
    InputError : unknown coordinate, a relative range about zero, chassis points that differ from payload points.
    """
    known = rig.parameters()
    moved = list(dict.fromkeys(name for p in parameters for name in _names(p)))
    equations = rig.equations_of_motion()
    if unknown := [name for name in keep if name not in equations.coordinates]:
        raise InputError(f"expected some of {list(equations.coordinates)}", field="keep", value=unknown)
    if not (np.allclose(equations.K, equations.K_floor) and np.allclose(equations.C, equations.C_floor)):
        raise InputError(
            "expected chassis points equal to payload points, so that relative motion is q - q_floor",
            field="chassis points",
        )
    kept = [equations.coordinates.index(name) for name in keep]
    nominal = {name: float(known[name].value) for name in moved}
    for parameter in parameters:
        parameter.half_ranges(nominal)  # raises for a relative range about zero
    scale = np.array([1.0 / rig.edge_m if name.startswith("phi") else 1.0 for name in keep])
    stretch = _stretches(parameters, nominal)

    rows = {
        k: (list(keep).index(p.coordinate), p.change)
        for k, p in enumerate(parameters)
        if isinstance(p, UncertainEquation)
    }

    def N(delta: np.ndarray) -> np.ndarray:
        values = _moved(parameters, delta * stretch, nominal)
        found = _stacked(rig.with_parameters(values).equations_of_motion() if values else equations, kept, scale)
        for k, (row, change) in rows.items():
            found[row] += delta[k] * change
        return found

    coefficients = {
        exponents: matrix / np.prod(stretch ** np.array(exponents, float))
        for exponents, matrix in polynomial_coefficients(
            N, len(parameters), cubic=any(isinstance(p, UncertainDirection) for p in parameters)
        ).items()
    }
    names = tuple(edge_name(name) for name in keep)
    lft = _pull_out(coefficients, len(parameters))
    system = _realise(lft, names, equations.actuators, [p.name for p in parameters])
    # A parameter that acts only on locked coordinates has no copies.
    felt = [(p, copies) for p, copies in zip(parameters, lft.copies, strict=True) if copies]
    blocks = BlockStructure(tuple(RealScalar(copies, p.name) for p, copies in felt))
    moving = tuple(p for p, _ in felt)
    return UncertainRig(system, blocks, moving, nominal, {name: known[name].unit for name in moved}, names)


def _names(parameter: Uncertain) -> list[str]:
    if isinstance(parameter, UncertainEquation):
        return []
    return [name for name, _ in parameter.changes] if isinstance(parameter, UncertainDirection) else [parameter.name]


def _stretches(parameters: Sequence[Uncertain], nominal: Mapping[str, float]) -> np.ndarray:
    """Factors that enlarge each delta while the polynomial is computed; their relative changes add up to 0.4."""
    change = 0.4 / max(sum(isinstance(p, UncertainDirection) for p in parameters), 1)
    return np.array([p.stretch(nominal, change) if isinstance(p, UncertainDirection) else 1.0 for p in parameters])


def _stacked(equations: Any, kept: list[int], scale: np.ndarray) -> np.ndarray:
    """N(delta) = [M, C, K, -T], rotations in edge displacements."""
    S = np.diag(scale)
    squares = [S @ X[np.ix_(kept, kept)] @ S for X in (equations.M, equations.C, equations.K)]
    return np.hstack([*squares, -S @ equations.T[kept]])


def _factor(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """L and R with L R = matrix, of minimal rank and equal norm."""
    rows = np.linalg.norm(matrix, axis=1, keepdims=True)
    rows[rows == 0] = 1.0
    U, sigma, Vt = np.linalg.svd(matrix / rows, full_matrices=False)
    rank = int(np.sum(sigma > 1e-10 * sigma[0]))
    root = np.sqrt(sigma[:rank])
    L, R = rows * U[:, :rank] * root, (Vt[:rank].T * root).T
    size = np.sqrt(np.linalg.norm(L) / np.linalg.norm(R))
    return L / size, R * size


@dataclass(frozen=True, eq=False)
class _StaticLft:
    """N(delta) s = N0 s + L Delta inv(I - W Delta) R s with `copies` of each delta."""

    N0: np.ndarray
    L: np.ndarray
    R: np.ndarray
    W: np.ndarray
    copies: list[int]


def _pull_out(coefficients: dict[Exponents, np.ndarray], n_parameters: int) -> _StaticLft:
    """The polynomial as an LFT: each monomial is a chain of links, one link per power of a parameter."""
    N0 = coefficients[(0,) * n_parameters]
    # The first link of a chain reads s, each further link reads the previous one, the last one acts on the equations.
    chains = []
    for exponents, matrix in coefficients.items():
        powers = [k for k, exponent in enumerate(exponents) for _ in range(exponent)]
        if powers:
            chains.append((powers, *_factor(matrix)))
    # Links of the same parameter are adjacent, so that its delta is one repeated scalar.
    links = sorted(
        (parameter, chain, position)
        for chain, (powers, _, _) in enumerate(chains)
        for position, parameter in enumerate(powers)
    )
    widths = [chains[chain][1].shape[1] for _, chain, _ in links]
    ends = np.cumsum([0, *widths])
    place = {(chain, position): slice(ends[k], ends[k + 1]) for k, (_, chain, position) in enumerate(links)}
    L, R = np.zeros((N0.shape[0], ends[-1])), np.zeros((ends[-1], N0.shape[1]))
    W = np.zeros((ends[-1], ends[-1]))
    for chain, (powers, left, right) in enumerate(chains):
        R[place[chain, 0]] = right
        for position in range(1, len(powers)):
            W[place[chain, position], place[chain, position - 1]] = np.eye(left.shape[1])
        L[:, place[chain, len(powers) - 1]] += left
    copies = [
        sum(width for width, link in zip(widths, links, strict=True) if link[0] == k) for k in range(n_parameters)
    ]
    M, copies = reduce_copies(np.block([[W, R], [L, N0]]), copies)
    total = sum(copies)
    return _StaticLft(M[total:, total:], M[total:, :total], M[:total, total:], M[:total, :total], copies)


def _realise(
    lft: _StaticLft, coordinates: tuple[str, ...], actuators: Sequence[str], parameters: list[str]
) -> StateSpace:
    """State space of the LFT with x = (r, v) and inputs e = (w_delta, u, v_f, f)."""
    n, m, total = len(coordinates), len(actuators), sum(lft.copies)
    M, N_rest = lft.N0[:, :n], lft.N0[:, n:]
    n_e, Mi = total + m + 2 * n, np.linalg.inv(M)
    w, u, v_f, f = np.split(np.arange(n_e), [total, total + m, total + m + n])
    # s = S_x x + S_e e; its first rows solve for v'.
    S_x, S_e = np.zeros((3 * n + m, 2 * n)), np.zeros((3 * n + m, n_e))
    S_x[n : 2 * n, n:], S_x[2 * n : 3 * n, :n] = np.eye(n), np.eye(n)
    S_e[n : 2 * n, v_f], S_e[3 * n :, u] = -np.eye(n), np.eye(m)
    S_x[:n] = -Mi @ N_rest @ S_x[n:]
    S_e[:n] = -Mi @ N_rest @ S_e[n:]
    S_e[:n, w] -= Mi @ lft.L
    S_e[:n, f] += Mi
    # v = (v - v_f) + v_f
    velocity_x, velocity_e = S_x[n : 2 * n], S_e[n : 2 * n].copy()
    velocity_e[:, v_f] += np.eye(n)
    z_e = lft.R @ S_e
    z_e[:, w] += lft.W
    A, B = np.vstack([S_x[n : 2 * n], S_x[:n]]), np.vstack([S_e[n : 2 * n], S_e[:n]])
    C = np.vstack([lft.R @ S_x, S_x[2 * n : 3 * n], velocity_x, S_x[:n]])
    D = np.vstack([z_e, S_e[2 * n : 3 * n], velocity_e, S_e[:n]])

    # python-control forbids dots in signal names.
    tags = [
        name.replace(".", "_") + (f"[{c}]" if copies > 1 else "")
        for name, copies in zip(parameters, lft.copies, strict=True)
        for c in range(copies)
    ]
    inputs = [
        *(f"w:{tag}" for tag in tags),
        *actuators,
        *(f"floor_{name}_dot" for name in coordinates),
        *(f"force_{name}" for name in coordinates),
    ]
    outputs = [
        *(f"z:{tag}" for tag in tags),
        *(f"{name}_rel" for name in coordinates),
        *(f"{name}_dot" for name in coordinates),
        *(f"{name}_ddot" for name in coordinates),
    ]
    states = [*(f"{name}_rel" for name in coordinates), *(f"{name}_dot" for name in coordinates)]
    return StateSpace(A, B, C, D, 0.0, tuple(inputs), tuple(outputs), tuple(states))
