"""Robust stability and performance of an uncertain system, by the peak of mu over all frequencies.

Zhou, Doyle and Glover, Robust and Optimal Control, 1996, theorems 11.8 and 11.9: a nominally stable loop is stable for
every Delta of norm below 1/mu(M11), and its gain is also at most mu(M) for every Delta of norm below 1/mu(M).
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.bilinear import continuous_image, image_frequency, sampled_frequency
from avis_ctrl.lti.interchange import as_system
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.robust import mu_peak as peaks
from avis_ctrl.robust.mu_peak import ALL_FREQUENCIES, MuPeak, mu_peak
from avis_ctrl.robust.mu_realise import realise_delta
from avis_ctrl.summary import Shown
from avis_ctrl.uncertainty.blocks import Block, BlockStructure, ComplexFull, ComplexScalar
from avis_ctrl.uncertainty.uncertain_system import UncertainSystem


@dataclass(frozen=True, eq=False, repr=False)
class Robustness(Shown):
    """Size of the uncertainty that a loop tolerates, relative to the declared uncertainty.

    lower : the loop is robust for all uncertainty below `lower` times the declared uncertainty (at every frequency if
        `guaranteed`, otherwise at the computed frequencies). covers : where that is proved, and why not elsewhere.
    upper : the perturbation `delta` of this size violates robustness at `omega` [rad/s]; inf if none was found, or only
        one with an infinite parameter.
    worst : `delta` as values for `system.substitute`: numbers for real parameters; for complex ones and dynamics,
        stable systems of constant norm, equal to `delta` at `omega` (a matrix of rank above one stays a matrix). With
        `blocks`: normalised, by the names of the blocks ("block 0" and so on if they have none).
    mu : the underlying bounds of mu.
    """

    in_line = ("lower", "upper", "omega", "guaranteed", "covers", "worst")

    lower: float
    upper: float
    omega: float
    guaranteed: bool
    covers: str
    worst: dict[str, Any]
    delta: np.ndarray | None
    mu: MuPeak

    @property
    def robust(self) -> bool | None:
        """True if proved for the declared uncertainty, False if a counterexample was found, otherwise None."""
        if self.lower > 1 and self.guaranteed:
            return True
        return False if self.upper <= 1 else None


@dataclass(frozen=True, eq=False, repr=False)
class WorstCaseGain(MuPeak):
    """Bounds of the largest gain over the declared uncertainty; fields of `MuPeak`.

    worst : the perturbation that attains `lower` at `omega`, as for `Robustness`.
    """

    in_line = ("upper", "lower", "omega", "guaranteed", "covers", "worst")

    worst: dict[str, Any]


@dataclass(frozen=True)
class RobustnessSettings:
    """beside : frequency used instead of 0, relative to the slowest pole; its inverse is used instead of
        infinity, relative to the fastest pole [1]: the response there differs by this fraction.
    real : imaginary part, relative to delta, below which delta is taken as real at 0 and infinity [1]: the phase that
        the search leaves undetermined, since the gain depends on its square.
    """

    beside: float = 1e-5
    real: float = 1e-3


SETTINGS = RobustnessSettings()


def robust_stability(
    system: Any, blocks: BlockStructure | Sequence[Block] | None = None, *, slack: float = peaks.SETTINGS.slack
) -> Robustness:
    """Size of the uncertainty, relative to the declared uncertainty, up to which a loop is stable.

    The size is that of the normalised delta. If the range of a real parameter is not symmetric about its nominal value,
    its value is a fractional function of delta (see `real`), so 0.73 times the uncertainty is not 0.73 times the range.

    Parameters
    ----------
    system : an `UncertainSystem`, or an LFT (w_delta, d -> z_delta, e) as StateSpace (avis_ctrl or python-control) with
        its `blocks`; channels beyond the blocks are ignored. slack : as for `mu_peak`.

    Raises
    ------
    InputError : a system without uncertainty, blocks that do not fit. ComputationError : an unstable nominal loop.

    Examples
    --------
    25 k/(s^3 + 10 s^2 + 10 s + 10) with unity feedback is stable for -0.4 < k < 3.6 (Routh); k = 3 +- 20 %:

    >>> loop = (ac.real("k", 3.0, percent=20) * ac.tf([25.0], [1.0, 10.0, 10.0, 10.0])).feedback()
    >>> found = ac.robust_stability(loop)
    >>> round(found.worst["k"], 3), round(found.upper, 3), round(found.omega, 2)        # at sqrt(10) rad/s
    (3.6, 1.0, 3.16)
    """
    P, structure, elements = opened(system, blocks)
    inner = P.select(slice(structure.n_z), slice(structure.n_w))
    return _robustness(mu_peak(inner, structure, slack=slack), P, structure, elements)


def robust_performance(
    system: Any, blocks: BlockStructure | Sequence[Block] | None = None, *, slack: float = peaks.SETTINGS.slack
) -> Robustness:
    """Largest a for which the gain from d to e is at most 1/a with a times the declared uncertainty.

    `lower` is the largest proved a: above 1 the gain is below 1 for more than the declared uncertainty; 0.65 means that
    for 0.65 times the declared uncertainty the loop is stable and its gain at most 1/0.65.
    Arguments and errors as for `robust_stability`; the system needs inputs d and outputs e beyond the uncertainty.

    Examples
    --------
    >>> k, c = ac.real("k", 4.0, percent=20), ac.real("c", 0.4, percent=20)
    >>> plant = ac.ss([[0, 1], [-k, -c]], [[0], [1]], [[1, 0]])
    >>> found = ac.robust_performance(plant)           # at 0.65 times 20 % the gain reaches 1/0.65
    >>> found.robust, round(found.lower, 2), round(found.upper, 2)
    (False, 0.65, 0.65)
    """
    P, structure, elements = opened(system, blocks)
    n_d, n_e = P.ninputs - structure.n_w, P.noutputs - structure.n_z
    if n_d < 1 or n_e < 1:
        raise InputError("expected inputs d and outputs e beside the uncertainty", field="system", value=P.D.shape)
    whole = structure.with_performance(n_d, n_e)
    return _robustness(mu_peak(P, whole, slack=slack), P, structure, elements)


def worst_case_gain(
    system: Any,
    blocks: BlockStructure | Sequence[Block] | None = None,
    *,
    band: tuple[float, float] = ALL_FREQUENCIES,
    slack: float = peaks.SETTINGS.slack,
) -> WorstCaseGain:
    """Largest gain from d to e over the declared uncertainty; `avis_ctrl.robust.mu_peak.worst_case_gain`.

    system, blocks : as for `robust_stability`. band : (low, high) in rad/s. slack : as for `mu_peak`.
    `upper` is proved, `lower` is attained by `system.substitute(result.worst)`; both are inf if a perturbation
    destabilises the loop. Raises the errors of `robust_performance`, and InputError for an empty band.

    Examples
    --------
    The peak of 1/(s^2 + c s + k) is about 1/(c sqrt(k)), so the worst case has the smallest c and k:

    >>> k, c = ac.real("k", 4.0, percent=20), ac.real("c", 0.4, percent=20)
    >>> plant = ac.ss([[0, 1], [-k, -c]], [[0], [1]], [[1, 0]])
    >>> found = ac.worst_case_gain(plant)
    >>> peak = 1 / (0.32 * np.sqrt(3.2 - 0.16**2))
    >>> bool(peak <= found.upper < 1.001 * peak), round(found.upper, 2)
    (True, 1.75)
    >>> found.worst
    {'k': 3.2, 'c': 0.32}
    >>> round(ac.hinf_norm(plant.substitute(found.worst)).gain, 2)
    1.75
    """
    P, structure, elements = opened(system, blocks)
    found = peaks.worst_case_gain(P, structure, band=band, slack=slack)
    facts = {one.name: getattr(found, one.name) for one in fields(found)}
    return WorstCaseGain(**facts, worst=worst_values(found, P, structure, elements))


def opened(
    system: Any, blocks: BlockStructure | Sequence[Block] | None
) -> tuple[StateSpace, BlockStructure, dict[str, Any]]:
    """(P, blocks, uncertain elements by name) of an uncertain system, or of a system with its blocks."""
    if isinstance(system, UncertainSystem):
        if blocks is not None:
            raise InputError("expected no blocks: the system has its own", field="blocks")
        P, structure = system.lft()
        elements: dict[str, Any] = system.uncertain
    elif blocks is None:
        raise InputError("expected an UncertainSystem, or a system with its blocks", field="blocks")
    else:
        P, structure, elements = as_system(system), BlockStructure.of(blocks), {}
    if not structure.blocks:
        raise InputError("expected something uncertain", field="system")
    if P.ninputs < structure.n_w or P.noutputs < structure.n_z:
        raise InputError(
            f"the blocks need {structure.n_w} inputs and {structure.n_z} outputs", field="system", value=P.D.shape
        )
    return P, structure, elements


def _robustness(peak: MuPeak, P: StateSpace, structure: BlockStructure, elements: dict[str, Any]) -> Robustness:
    worst = worst_values(peak, P, structure, elements)
    # A parameter with an asymmetric range is infinite at a finite delta: that is no counterexample.
    reached = peak.lower > 0 and all(np.isfinite(one) for one in worst.values() if isinstance(one, float))
    return Robustness(
        1 / peak.upper if peak.upper > 0 else np.inf,
        1 / peak.lower if reached else np.inf,
        peak.omega,
        peak.guaranteed,
        peak.covers,
        worst if reached else {},
        peak.delta if reached else None,
        peak,
    )


def worst_values(peak: MuPeak, P: StateSpace, structure: BlockStructure, elements: dict[str, Any]) -> dict[str, Any]:
    """`delta` by name: numbers for real blocks, systems of constant norm for complex ones."""
    if peak.delta is None:
        return {}
    # The response of a real system is real at 0 and infinity; a complex delta is therefore realised close to them.
    sizes = np.abs(continuous_image(P).poles())
    sizes = sizes[sizes > 0] if np.any(sizes) else np.ones(1)
    at = image_frequency(peak.omega, P.dt)
    inside = np.clip(at, SETTINGS.beside * sizes.min(), sizes.max() / SETTINGS.beside)
    omega = float(sampled_frequency(inside, P.dt))
    worst: dict[str, Any] = {}
    values = structure.values(peak.delta[: structure.n_w, : structure.n_z])
    for k, (block, value) in enumerate(zip(structure.blocks, values, strict=True)):
        if inside != at and np.max(np.abs(np.imag(value))) <= SETTINGS.real * np.max(np.abs(value)):
            value = np.real(value)
        name = block.name or f"block {k}"
        if block.kind == "real":
            delta: Any = float(np.real(value))
        else:
            delta, one = value, ComplexFull(block.rows, block.cols) if block.kind == "full" else ComplexScalar()
            with contextlib.suppress(ComputationError):  # a full block of rank above one
                delta = realise_delta(np.atleast_2d(value), omega, [one], P.dt)
        worst[name] = elements[name].value(delta) if name in elements else delta
    return worst
