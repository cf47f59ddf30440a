"""Parameter uncertainty of a fit as a few real blocks of a plant, with bounds on the part that has no block.

    theta = theta_0 + S z,  z standard normal in r numbers;   row a of N = [M, C, K, -T]:  n_a = n_a0 + z' Q_a

The equation of motion of each coordinate a is treated separately. z is rotated so that its first component changes the
response most, through this equation alone; the second component changes the residual most, and so on. Changes of an
equation by multiples of the nominal equations do not change the response. The smallest sufficient set of components,
over all equations, becomes blocks |delta| <= 1. No block is repeated: products of changes are neglected, and all
scalings are scalars. The residual is below a fraction of the neglected dynamics of the design. It is not in the plant,
but its size is reported.

Coverage: each component of each of the n equations is within k standard deviations with probability p^(1/(r n)). All
components together are within their limits with probability p or more, for any correlation (Sidak 1967), if the errors
of the fit are normal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.directions import SETTINGS as DIRECTIONS
from avis_ctrl.identification.directions import KeptMatrices, kept_matrices, matrix_slopes, relative_changes
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.plant import Wiring, neglected_dynamics
from avis_ctrl.uncertainty.uncertain_rig import UncertainEquation


@dataclass(frozen=True)
class FitUncertaintySettings:
    """Criteria for a block of a combination of parameters.

    left_out : the combinations without a block may add up to this fraction of the drives' neglected dynamics. A loop
        that tolerates the neglected dynamics tolerates a tenth more, with hardly any increase of mu.
    without_dynamics : the same as a fraction of the response, for a design without neglected dynamics.
    band_Hz, points : frequency grid of the comparison: the range of transmissibility, fine compared with the modes'
        width.
    rcond : relative cut-off below which combinations of drives are not used to represent changes of sensors. Adjacent
        drives would otherwise oppose each other with many times their force to represent a tilt.
    draws : number of tables drawn from the covariance to estimate products of changes.
    """

    left_out: float = 0.1
    without_dynamics: float = DIRECTIONS.negligible
    band_Hz: tuple[float, float] = (0.1, 100.0)
    points: int = 200
    rcond: float = 0.02
    draws: int = 64

    @property
    def omega(self) -> np.ndarray:
        """(n,) frequencies [rad/s]."""
        return 2 * np.pi * np.geomspace(*self.band_Hz, self.points)


SETTINGS = FitUncertaintySettings()


@dataclass(frozen=True, eq=False)
class FitUncertainty:
    """Blocks of a fit, and bounds on what they omit, all relative to the response at omega (n,) [rad/s].

    Attributes
    ----------
    design : its ranges are used in addition to the blocks. blocks : for `plant_of`. effect : (q,) largest change of the
        response by each block at delta = 1.
    n_parameters : number of parameters in the covariance without a range in the design. confidence : p of all
        components together.
    rest, rest_floor : (n,) bound on the part without a block, for the response to the drives and to the floor.
    elsewhere : (n,) bound on changes that the plant's equations do not contain, for the response from the drives to the
        measurements of the controller with all six coordinates: sensor dynamics, effects, locked coordinates.
    products : largest change by products of changes, over tables drawn from the covariance.
    dynamics : (n,) neglected dynamics of the design's drives.
    """

    design: Design
    blocks: tuple[UncertainEquation, ...]
    effect: np.ndarray
    n_parameters: int
    confidence: float
    omega: np.ndarray
    rest: np.ndarray
    rest_floor: np.ndarray
    elsewhere: np.ndarray
    products: float
    dynamics: np.ndarray

    def to_json(self) -> dict[str, Any]:
        """Figures, as fractions of the response."""
        return {
            "confidence": self.confidence,
            "parameters": self.n_parameters,
            "blocks": {one.name: float(size) for one, size in zip(self.blocks, self.effect, strict=True)},
            "left_out_drives": float(np.max(self.rest)),
            "left_out_floor": float(np.max(self.rest_floor)),
            "left_out_over_neglected_dynamics": float(np.max(self.rest / self.dynamics)),
            "products": self.products,
            "not_in_equations": float(np.max(self.elsewhere)),
        }

    def sentences(self) -> tuple[str, str]:
        """What is uncertain, and which part of it has no block."""
        own = self.to_json()
        sizes = ", ".join(f"{name} {_percent(size)}" for name, size in own["blocks"].items())
        blocks = (
            f"{len(self.blocks)} real blocks (largest change of the response: {sizes})"
            if sizes
            else "too little for a block of its own"
        )
        share = f" ({_percent(own['left_out_over_neglected_dynamics'])} of the drives' neglected dynamics)"
        return (
            f"All loops include the uncertainty of the {self.n_parameters} fitted parameters at "
            f"{_percent(self.confidence)}: {blocks}. "
            "For later changes of the table, give a design with ranges.",
            "The loops omit combinations of parameters that change the response to the drives by at most "
            f"{_percent(own['left_out_drives'])}{share} and the response to the floor by at most "
            f"{_percent(own['left_out_floor'])}. They also omit second-order terms ({_percent(own['products'])} in "
            "random samples) and changes through sensors, effects and locked coordinates (at most "
            f"{_percent(own['not_in_equations'])}). These figures do not include effects that depend on amplitude.",
        )


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def fit_uncertainty(
    design: Design,
    model: TableModel,
    covariance: np.ndarray,
    wiring: Wiring,
    settings: FitUncertaintySettings = SETTINGS,
) -> FitUncertainty:
    """The uncertainty of a fit, in addition to the ranges of a design.

    Parameters
    ----------
    model : at the estimate. covariance : (n_p, n_p) of `model.names`, in their units.
    wiring : of the controller; the response is evaluated on its axes.
    """
    rig, omega, confidence = model.effective.rig, settings.omega, design.uncertainty.confidence_percent / 100
    ranged = {one.name for one in design.uncertainty.of(rig)}
    free = [k for k, name in enumerate(model.names) if name not in ranged]
    names, S = [model.names[k] for k in free], _root(covariance[np.ix_(free, free)])
    own = [k for k, name in enumerate(names) if name in rig.parameters()]
    base, slopes = kept_matrices(rig, design.keep), matrix_slopes(rig, [names[k] for k in own], design.keep)
    felt = [(k, slope) for k, slope in zip(own, slopes, strict=True) if any(np.any(part) for part in slope)]
    held, others = [k for k, _ in felt], [k for k in range(len(names)) if k not in dict(felt)]
    dynamics, allowed = _allowed(design, omega, settings)
    actuators = list(rig.equations_of_motion().actuators)
    A = np.zeros((len(actuators), len(base[0])))
    A[[actuators.index(name) for name in wiring.actuators]] = wiring.allocation
    seen, inside = _seen(model, names, wiring, omega), np.zeros((len(names), len(omega), *base[0].shape), complex)
    inside[held] = relative_changes(base, [slope for _, slope in felt], omega, A)[0]
    # The records determine only the product of force constant and sensitivity, and the loop depends only on this
    # product.
    drives = [k for k in held if names[k] in {f"actuator.{name}" for name in wiring.actuators}]
    alike = _nearest(inside[drives] / allowed[:, None, None], seen[others] / allowed[:, None, None], settings.rcond)
    inside[others] = np.tensordot(alike, inside[drives], 1)
    elsewhere = _box(_turned(np.tensordot(S.T, seen - inside, 1)), confidence)
    root = S.copy()
    root[drives] += alike.T @ S[others]
    k, n_u = len(base[0]), len(A)
    Q = np.reshape([np.hstack([*slope[:3], -slope[3]]) for _, slope in felt], (len(held), k, 3 * k + n_u))
    blocks, effect, rest, rest_floor = _by_equation(
        base, np.tensordot(root[held].T, Q, 1), design.keep, A, omega, allowed, confidence
    )
    products = _products(
        rig, [names[k] for k in held], S[held], [slope for _, slope in felt], base, design.keep, A, omega, settings
    )
    return FitUncertainty(
        design, blocks, effect, len(free), confidence, omega, rest, rest_floor, elsewhere, products, dynamics
    )


def _by_equation(
    base: KeptMatrices,
    Q: np.ndarray,
    keep: Sequence[str],
    A: np.ndarray,
    omega: np.ndarray,
    allowed: np.ndarray,
    confidence: float,
) -> tuple[tuple[UncertainEquation, ...], np.ndarray, np.ndarray, np.ndarray]:
    """Blocks, their effects, and bounds (n,) on the residual; Q (r, k, 3 k + n_u) changes of N by each z."""
    n, k, found = len(Q), len(keep), []
    for a, name in enumerate(keep):
        own = np.zeros_like(Q)
        own[:, a] = Q[:, a]
        driven, floor = relative_changes(base, [_split(one) for one in own], omega, A)
        weighted = np.stack([driven, floor], axis=1) / allowed[:, None, None]
        V = _rotation(weighted)
        driven, floor, row = (np.tensordot(V, one, 1) for one in (driven, floor, Q[:, a]))
        found += [(name, row[j], driven[j], floor[j]) for j in range(n)]
    # Each component of each equation separately.
    box = _quantile(n * k, confidence)
    sizes = [
        box * np.stack([np.linalg.norm(one, 2, axis=(1, 2)) for one in (driven, floor)])
        for _, _, driven, floor in found
    ]
    order = sorted(range(len(sizes)), key=lambda j: -float(np.max(sizes[j] / allowed)))
    left = np.reshape([sizes[j] for j in order[::-1]], (len(order), 2, len(omega)))
    rests = np.concatenate([np.zeros((1, 2, len(omega))), np.cumsum(left, axis=0)])[::-1]
    q = next(j for j, rest in enumerate(rests) if np.all(rest <= allowed))
    count: dict[str, int] = {}
    blocks = []
    for j in order[:q]:
        name, row, *_ = found[j]
        count[name] = count.get(name, 0) + 1
        blocks.append(UncertainEquation(f"fit {count[name]} of {name}", name, box * row))
    return tuple(blocks), np.array([np.max(sizes[j]) for j in order[:q]]), rests[q][0], rests[q][1]


def _split(N: np.ndarray) -> KeptMatrices:
    """M, C, K, T of N (k, 3 k + n_u)."""
    k = len(N)
    return N[:, :k], N[:, k : 2 * k], N[:, 2 * k : 3 * k], -N[:, 3 * k :]


def _root(covariance: np.ndarray) -> np.ndarray:
    """S (n, r) with S S^T the covariance, of rank r."""
    sizes = np.sqrt(np.diag(covariance))
    unit = np.where(sizes > 0, sizes, 1.0)
    values, V = np.linalg.eigh(covariance / np.outer(unit, unit))
    there = values > len(values) * np.finfo(float).eps * values[-1]
    return sizes[:, None] * V[:, there] * np.sqrt(values[there])


def _real(parts: np.ndarray) -> np.ndarray:
    """Complex responses (m, ...) as real vectors (m, N)."""
    flat = parts.reshape(len(parts), int(np.prod(parts.shape[1:])))
    return np.concatenate([flat.real, flat.imag], axis=1)


def _nearest(basis: np.ndarray, parts: np.ndarray, weakest: float) -> np.ndarray:
    """(n, m) real minimum-norm least-squares coefficients of n responses (n, ...) in terms of m responses (m, ...).

    weakest : relative cut-off of the singular values.
    """
    return np.linalg.lstsq(_real(basis).T, _real(parts).T, rcond=weakest)[0].T


def _rotation(parts: np.ndarray) -> np.ndarray:
    """Orthonormal V (r, r): the first component of V parts is the largest, the second largest in the residual, ..."""
    return np.linalg.eigh((J := _real(parts)) @ J.T)[1].T[::-1]


def _turned(parts: np.ndarray) -> np.ndarray:
    return np.tensordot(_rotation(parts), parts, 1)


def _quantile(n: int, confidence: float) -> float:
    """k with P(|x| <= k)^n = p for standard normal x."""
    return float(norm.ppf((1 + confidence ** (1 / max(n, 1))) / 2))


def _box(parts: np.ndarray, confidence: float) -> np.ndarray:
    """(n,) bound on the gain of sum_i z_i parts_i (r, n, k, k) over a box of this probability."""
    return _quantile(len(parts), confidence) * np.sum(np.linalg.norm(parts, 2, axis=(2, 3)), axis=0)


def _allowed(design: Design, omega: np.ndarray, settings: FitUncertaintySettings) -> tuple[np.ndarray, np.ndarray]:
    """(n,) neglected dynamics of the drives, and the allowed residual; for a design without them relative to 1."""
    chains = design.uncertainty.actuator_chains
    if chains is None:
        return np.ones(len(omega)), np.full(len(omega), settings.without_dynamics)
    dynamics = neglected_dynamics(chains).magnitude(omega)
    return dynamics, settings.left_out * dynamics


def _seen(model: TableModel, names: Sequence[str], wiring: Wiring, omega: np.ndarray) -> np.ndarray:
    """(n_p, n, k, k) relative sensitivity of the response from commanded forces to measured velocities.

    With six coordinates, per unit of each parameter; zero for parameters of effects that depend on amplitude.
    """
    model = model.linear
    sensors = list(model.sensors.names)
    A = np.zeros((len(omega), len(model.inputs), wiring.allocation.shape[1]), complex)
    A[:, [model.inputs.index(name) for name in wiring.actuators]] = wiring.allocation
    D = np.zeros((len(wiring.decoding), len(sensors)))
    D[:, [sensors.index(name) for name in wiring.sensors]] = wiring.decoding
    answer = model.driven(omega, A)
    rows = {name: k for k, name in enumerate(model.names)}
    known = [k for k, name in enumerate(names) if name in rows]
    Y = D @ answer.Y
    found = np.zeros((len(names), *Y.shape), complex)
    found[known] = np.linalg.solve(Y[None], D @ answer.dY[[rows[names[k]] for k in known]])
    return found


def _products(
    rig: Rig,
    names: Sequence[str],
    S: np.ndarray,
    slopes: Sequence[KeptMatrices],
    base: KeptMatrices,
    keep: Sequence[str],
    A: np.ndarray,
    omega: np.ndarray,
    settings: FitUncertaintySettings,
) -> float:
    """Largest relative change that is not linear in the parameters, over tables drawn from the covariance."""
    known, beyond = rig.parameters(), []
    if not names:
        return 0.0
    for z in np.random.default_rng(0).standard_normal((settings.draws, S.shape[1])):
        change = S @ z
        moved = rig.with_parameters({name: known[name].value + float(d) for name, d in zip(names, change, strict=True)})
        M, C, K, T = (
            one - old - np.tensordot(change, np.array(slope), 1)
            for one, old, slope in zip(
                kept_matrices(moved, keep, rig.edge_m), base, zip(*slopes, strict=True), strict=True
            )
        )
        beyond.append((M, C, K, T))
    return max(float(np.max(np.linalg.norm(one, 2, axis=(2, 3)))) for one in relative_changes(base, beyond, omega, A))
