"""The bounds and uncertainties that limit mu, and what would help a design whose mu is not below 1.

The figures are upper bounds of mu of the given controller with one bound or uncertainty left out, or one bound wider;
no other controller is computed for them. Without uncertainty, they are H-infinity optima. They are rounded in the safe
direction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.robust.hinfsyn import hinf_suboptimal, hinfsyn
from avis_ctrl.robust.mu_peak import MuPeak, mu_peak
from avis_ctrl.robust.mu_upper import bound_for_goal, bound_of_peak
from avis_ctrl.study.design_result import ControllerResult
from avis_ctrl.study.identified_uncertainty import RESPONSE
from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.summary import joined, rounded_down, rounded_up
from avis_ctrl.uncertainty.blocks import BlockStructure
from avis_ctrl.uncertainty.weights import ControlEffort, TransmissibilityBound


@dataclass(frozen=True)
class LimitSettings:
    """worth : fraction of mu by which it must fall without a bound or uncertainty for this to be named; less changes
        no decision.
    most : largest number of uncertainties that are named; the first ones are worth reducing.
    idle : a controller whose mu is within this fraction of the passive table's mu is regarded as doing nothing.
    large_spread : uncertainty of an identified response [1] above which a better measurement is recommended.
    accuracy : relative accuracy of mu squared, small compared with `worth`.
    widest_dB : largest relaxation of a bound that is tried; with more, it would no longer be a bound.
    halvings : number of bisections of the interval from 0 to widest_dB; eight give 0.2 dB.
    """

    worth: float = 0.02
    most: int = 3
    idle: float = 0.01
    large_spread: float = 0.3
    accuracy: float = 1e-3
    widest_dB: float = 40.0
    halvings: int = 8


SETTINGS = LimitSettings()
# Prefixes of the weighted outputs of each bound.
BOUNDS = {"transmissibility bound": "e_", "control effort bound": "effort_", "compliance bound": "compliance_"}


def limiting(plant: DesignPlant, mu: ControllerResult) -> str:
    """Sentences: where the upper bound of mu peaks, and which bounds and uncertainties limit it there."""
    if mu.K is None or np.isnan(mu.mu.omega):
        return ""
    P, omega = plant.synthesis, _peak(mu.mu)
    closed = P.closed(mu.K)
    M = closed.frequency_response(np.array([omega]))
    worth = (1 - SETTINGS.worth) * _mu(M, P.all_blocks)[0]
    without = {name: _without_bound(plant, closed, name) for name in _bounds(plant)}
    bounds = sorted(
        (value, name)
        for name, (rest, blocks) in without.items()
        if blocks.blocks and (value := _mu(rest.frequency_response(np.array([omega])), blocks)[0]) < worth
    )
    shares = sorted((value, name) for name, value in _without_uncertainties(plant, M) if value < worth)
    text = f"The upper bound of mu peaks at {_hertz(omega)}."
    if bounds:
        value, name = bounds[0]
        rest = mu_peak(*without[name], slack=SETTINGS.worth)
        most = rest if rest.upper <= mu.mu.upper else mu.mu
        where = _unproved(most) or " over all frequencies"
        text += (
            f" The limiting bound there is the {name}{_part(plant, name, omega)}: without it, mu of this controller is "
            f"at most {rounded_up(value):g} at this frequency, and at most {rounded_up(most.upper):g}{where}; its "
            f"upper bound then peaks at {_hertz(_peak(rest))}."
        )
        others = [f"the {name} (mu at most {rounded_up(value):g} without it)" for value, name in bounds[1:]]
        text += f" Also limiting: {joined(others)}." if others else ""
    if shares:
        named = [f"{name} (mu at most {rounded_up(value):g} without it)" for value, name in shares[: SETTINGS.most]]
        text += f" The largest contributions of uncertainties there: {joined(named)}."
    if not bounds and not shares:
        return (
            f"{text} No single bound or uncertainty is limiting there: without any one of them, mu falls by less than "
            f"{100 * SETTINGS.worth:g} %."
        )
    return f"{text} These values are for this controller, without a new synthesis."


def best_found(plant: DesignPlant, mu: ControllerResult, others: Sequence[ControllerResult]) -> str:
    """Sentences on a design whose mu is not below 1: what was reached, what limits it, and what would help.

    That no controller has mu below 1 is proved only if the optimum without uncertainty is not below 1. Otherwise the
    synthesis may have stopped early, which the sentences then state.
    """
    if mu.K is None:
        return ""
    omega = _peak(mu.mu)
    spread = _spread_there(plant, omega)
    if no_better_than_none(mu, others):
        return (
            f"The synthesis found no controller better than none: with the best controller found mu is at most "
            f"{rounded_up(mu.mu.upper):g}, at {_hertz(omega)}; this bound is less than {100 * SETTINGS.idle:g} % "
            f"below that without control. No D-K iteration came closer to the bounds with this uncertainty. "
            f"{spread or _not_even_nominal(plant) or 'Specify less uncertainty or wider bounds'}".rstrip(".")
            + "."
        )
    limits = limiting(plant, mu)
    text = (
        f"The specification (weighted norm below 1 for all plants of the set) is not "
        f"{'met' if mu.mu.lower >= 1 else 'proved to be met'}: mu of the mu controller is between "
        f"{rounded_down(mu.mu.lower, 4):g} and {rounded_up(mu.mu.upper, 4):g}{_unproved(mu.mu)} and must be below 1. "
        f"{limits} {_not_even_nominal(plant) or _relief(plant, mu)}"
    )
    if spread and RESPONSE in limits:
        text += f" {spread}."
    if better := [c for c in others if c.mu.upper < mu.mu.upper]:
        best = min(better, key=lambda c: c.mu.upper)
        text += (
            f" The controller {best.title!r} has a smaller upper bound of mu, {rounded_up(best.mu.upper):g}: the "
            "iteration ended too early."
        )
    return text


def _not_even_nominal(plant: DesignPlant) -> str:
    """That no controller has a weighted norm below 1 even without uncertainty, and how far a bound would have to be
    relaxed; empty if this is not proved.

    The norm is that of all bounds from all disturbances together. Below 1 it is sufficient for each bound, but not
    necessary, so that this does not prove that the bounds cannot be met.
    """
    nominal = plant.synthesis.nominal()
    try:
        least = hinfsyn(nominal.P, nominal.nmeas, nominal.ncon).gamma_optimal_bounds[0]
    except ComputationError:
        return ""
    if least < 1:
        return ""

    def met(name: str, factor: float) -> bool:
        left = [1 / factor if one.startswith(BOUNDS[name]) else 1.0 for one in nominal.P.outputs]
        try:
            hinf_suboptimal(nominal.P.scaled(left=np.array(left)), nominal.nmeas, nominal.ncon, 1.0)
        except ComputationError:
            return False
        return True

    return (
        f"No controller has a weighted norm (all bounds and disturbances together) below 1, even without uncertainty: "
        f"it is at least {rounded_down(least, 4):g}. Each bound alone may still be met. "
        + _enough("Without uncertainty a controller reaches 1", _wider(plant, met))
    )


def _relief(plant: DesignPlant, mu: ControllerResult) -> str:
    """How far a bound, or all uncertainties, must be relaxed for this controller to meet the specification."""
    P, every = plant.synthesis, mu.mu.frequencies
    assert mu.K is not None
    # Where mu is below 1 with these bounds it is below 1 with wider ones.
    M = P.closed(mu.K).frequency_response(every[~(mu.mu.upper_curve < 1)])

    def below_one(rows: Sequence[int], factor: float) -> bool:
        left = np.ones(M.shape[1])
        left[rows] = 1 / factor
        scaled = M * left[:, None]
        return bool(np.all(bound_for_goal(scaled[:, None], P.all_blocks, SETTINGS.accuracy, 1.0).beta <= 1))

    def met(name: str, factor: float) -> bool:
        return below_one(_rows(plant, name), factor)

    text = (
        f"This controller meets the specification if every uncertainty is divided by {rounded_up(mu.mu.upper, 4):g} "
        "(which follows from mu) and every bound is relaxed by "
        f"{_decibel(20 * np.log10(mu.mu.upper))}{_unproved(mu.mu)}."
    )
    if not M.size:
        return text
    ways = _wider(plant, met)
    if (smaller := _least_dB(lambda factor: below_one(range(P.blocks.n_z), factor))) is not None:
        ways.append(
            f"all uncertainties are reduced to {rounded_down(100 * 10 ** (-smaller / 20), 2):g} % of their size"
        )
    return f"{_enough('At the computed frequencies this controller meets it', ways)} {text}"


def _wider(plant: DesignPlant, met: Callable[[str, float], bool]) -> list[str]:
    """For each bound that is shown to be enough alone: by how much it is relaxed. met : whether a bound wider by a
    factor is shown to be enough."""
    found = [(name, _least_dB(partial(met, name))) for name in _bounds(plant)]
    return [f"the {name} is relaxed by {_decibel(value)}" for name, value in found if value is not None]


def _least_dB(met: Callable[[float], bool]) -> float | None:
    """Smallest relaxation [dB] found to be enough, by bisection; None if the widest is not shown to be."""
    low, high = 0.0, SETTINGS.widest_dB
    if not met(10 ** (high / 20)):
        return None
    for _ in range(SETTINGS.halvings):
        middle = (low + high) / 2
        low, high = (low, middle) if met(10 ** (middle / 20)) else (middle, high)
    return high


def _enough(said: str, ways: list[str]) -> str:
    if not ways:
        return f"No single bound, relaxed by up to {SETTINGS.widest_dB:g} dB, is shown to be sufficient."
    return f"{said} if {joined(ways, 'or if')}{' (one of these is sufficient)' if len(ways) > 1 else ''}."


def _bounds(plant: DesignPlant) -> list[str]:
    """The bounds of this design."""
    return [name for name, prefix in BOUNDS.items() if any(one.startswith(prefix) for one in plant.synthesis.z)]


def _rows(plant: DesignPlant, name: str) -> list[int]:
    """Rows of the loop that belong to a bound."""
    P = plant.synthesis
    return [P.blocks.n_z + k for k, one in enumerate(P.z) if one.startswith(BOUNDS[name])]


def _without_bound(plant: DesignPlant, closed: StateSpace, name: str) -> tuple[StateSpace, BlockStructure]:
    """The loop without the outputs of a bound, and its blocks."""
    P, gone = plant.synthesis, _rows(plant, name)
    left = [k for k in range(closed.noutputs) if k not in gone]
    if len(gone) == len(P.z):
        return closed.select(left, slice(P.blocks.n_w)), P.blocks
    return closed.select(left, None), P.blocks.with_performance(len(P.w), len(P.z) - len(gone))


def _without_uncertainties(plant: DesignPlant, M: np.ndarray) -> list[tuple[str, float]]:
    """(name, upper bound of mu of M (1, n_z, n_w) without it) of each uncertainty."""
    P = plant.synthesis
    every = P.all_blocks.blocks
    found = []
    for k, (block, w, z) in enumerate(P.blocks.slices()):
        left = np.delete(np.delete(M, z, axis=1), w, axis=2)
        found.append((block.name, float(_mu(left, BlockStructure((*every[:k], *every[k + 1 :])))[0])))
    return found


def _mu(M: np.ndarray, blocks: BlockStructure) -> np.ndarray:
    return bound_of_peak(M[:, None], blocks, SETTINGS.accuracy).beta


def _part(plant: DesignPlant, name: str, omega: float) -> str:
    """The keys of the design file that set a bound at this frequency, in brackets; empty if they are not known."""
    for weight in plant.weights.values():
        if name == "transmissibility bound" and isinstance(weight, TransmissibilityBound):
            (low, high), f, beside = weight.band_Hz, omega / (2 * np.pi), 2.0**weight.transition_octaves
            if low <= f <= high:
                return " (band_dB)"
            # The weight may be stricter than peak_dB here.
            near = low / beside < f < high * beside
            return " (transition of band_dB)" if near else " (peak_dB)"
        if name == "control effort bound" and isinstance(weight, ControlEffort):
            # Below this frequency the weight is raised to bound the voltage for the offset.
            offset = omega < 2 * np.pi * weight.offset_corner_Hz * weight.offset
            return " (offset_percent: the drive voltage that the offset of the electronics needs)" if offset else ""
    return ""


def _peak(bound: MuPeak) -> float:
    """Frequency [rad/s] of the largest upper bound; `omega` is that of the lower bound."""
    return float(bound.frequencies[np.argmax(bound.upper_curve)])


def _unproved(bound: MuPeak) -> str:
    """Words for an upper bound that is not proved between the computed frequencies."""
    return "" if bound.guaranteed else " at the computed frequencies"


def _decibel(value: float) -> str:
    """Rounded up to 0.1 dB."""
    return f"{np.ceil(10 * value - 1e-9) / 10:.1f} dB"


def _hertz(omega: float) -> str:
    return f"{omega / (2 * np.pi):.3g} Hz" if np.isfinite(omega) else "infinite frequency"


def no_better_than_none(mu: ControllerResult, others: Sequence[ControllerResult]) -> bool:
    """Whether the mu controller misses its target and reduces mu by less than 1 % relative to the passive table."""
    at_rest = min((c.mu.upper for c in others if c.K is None), default=np.inf)
    return bool(mu.mu.upper >= 1 and np.isfinite(at_rest) and mu.mu.upper > (1 - SETTINGS.idle) * at_rest)


def _spread_there(plant: DesignPlant, omega: float) -> str:
    """The size of the uncertainty of an identified response, and how to reduce it; empty if it is small."""
    if plant.identified is None:
        return ""
    weight = plant.identified.weight
    size = float(weight.magnitude(np.array([omega]))[0])
    if size < SETTINGS.large_spread:
        return ""
    nearest = int(np.argmin(np.abs(np.log(weight.omega / omega))))
    drowned = plant.identified.spread.drowned(plant.identified.confidence)
    if not weight.omega[0] <= omega <= weight.omega[-1]:
        beside = "outside the measured band; the value at its end is used"
    elif drowned[nearest]:
        beside = "assumed, because noise hides the response there"
    else:
        beside = f"{100 * weight.data[nearest]:.3g} % in the data there"
    return (
        f"The uncertainty of the identified response is {100 * size:.3g} % at {omega / (2 * np.pi):.3g} Hz "
        f"({beside}). To reduce it, record longer, at a higher level or with more records; or relax the "
        "requirements at this frequency"
    )
