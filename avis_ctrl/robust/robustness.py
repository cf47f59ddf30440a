"""Robust stability and performance of an uncertain system, by the peak of mu over all frequencies.

Zhou, Doyle and Glover, Robust and Optimal Control, 1996, theorems 11.8 and 11.9: a nominally stable loop is stable for
every Delta of norm below 1/mu(M11), and its gain is also at most mu(M) for every Delta of norm below 1/mu(M).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.interchange import as_system
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.robust import mu_peak as peaks
from avis_ctrl.robust.mu_peak import ALL_FREQUENCIES, SLACK, MuPeak, mu_peak
from avis_ctrl.summary import Shown
from avis_ctrl.uncertainty.blocks import Block, BlockStructure
from avis_ctrl.uncertainty.elements import RealParameter
from avis_ctrl.uncertainty.uncertain_system import UncertainSystem


@dataclass(frozen=True, eq=False, repr=False)
class Robustness(Shown):
    """Size of the uncertainty that a loop tolerates, relative to the declared uncertainty.

    lower : the loop is robust for all uncertainty below `lower` times the declared uncertainty (at every frequency if
        `guaranteed`, otherwise at the computed frequencies). upper : the perturbation `delta` of this size violates
        robustness at `omega` [rad/s]; inf if none was found.
    worst : `delta` by name: values of real parameters, normalised matrices of other elements.
    mu : the underlying bounds of mu.
    """

    in_line = ("lower", "upper", "omega", "guaranteed", "worst")

    lower: float
    upper: float
    omega: float
    guaranteed: bool
    worst: dict[str, Any]
    delta: np.ndarray | None
    mu: MuPeak

    @property
    def robust(self) -> bool | None:
        """True if proved for the declared uncertainty, False if a counterexample was found, otherwise None."""
        if self.lower > 1 and self.guaranteed:
            return True
        return False if self.upper <= 1 else None


def robust_stability(
    system: Any, blocks: BlockStructure | Sequence[Block] | None = None, *, slack: float = SLACK
) -> Robustness:
    """Size of the uncertainty, relative to the declared uncertainty, up to which a loop is stable.

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
    P, structure, elements = _opened(system, blocks)
    inner = P.select(slice(structure.n_z), slice(structure.n_w))
    return _robustness(mu_peak(inner, structure, slack=slack), structure, elements)


def robust_performance(
    system: Any, blocks: BlockStructure | Sequence[Block] | None = None, *, slack: float = SLACK
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
    P, structure, elements = _opened(system, blocks)
    n_d, n_e = P.ninputs - structure.n_w, P.noutputs - structure.n_z
    if n_d < 1 or n_e < 1:
        raise InputError("expected inputs d and outputs e beside the uncertainty", field="system", value=P.D.shape)
    whole = structure.with_performance(n_d, n_e)
    return _robustness(mu_peak(P, whole, slack=slack), structure, elements)


def worst_case_gain(
    system: Any,
    blocks: BlockStructure | Sequence[Block] | None = None,
    *,
    band: tuple[float, float] = ALL_FREQUENCIES,
    slack: float = SLACK,
) -> MuPeak:
    """Largest gain from d to e over the declared uncertainty; `avis_ctrl.robust.mu_peak.worst_case_gain`.

    system, blocks : as for `robust_stability`. band : (low, high) in rad/s. slack : as for `mu_peak`.
    `upper` is proved, `lower` is attained by `delta`; both are inf if a perturbation destabilises the loop. Raises the
    errors of `robust_performance`, and InputError for an empty band.

    Examples
    --------
    The peak of 1/(s^2 + c s + k) is about 1/(c sqrt(k)), so the worst case has the smallest c and k:

    >>> k, c = ac.real("k", 4.0, percent=20), ac.real("c", 0.4, percent=20)
    >>> found = ac.worst_case_gain(ac.ss([[0, 1], [-k, -c]], [[0], [1]], [[1, 0]]))
    >>> peak = 1 / (0.32 * np.sqrt(3.2 - 0.16**2))
    >>> bool(peak <= found.upper < 1.001 * peak), round(found.upper, 2)
    (True, 1.75)
    """
    P, structure, _ = _opened(system, blocks)
    return peaks.worst_case_gain(P, structure, band=band, slack=slack)


def _opened(
    system: Any, blocks: BlockStructure | Sequence[Block] | None
) -> tuple[StateSpace, BlockStructure, dict[str, Any]]:
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


def _robustness(peak: MuPeak, structure: BlockStructure, elements: dict[str, Any]) -> Robustness:
    worst: dict[str, Any] = {}
    if peak.delta is not None:
        part = peak.delta[: structure.n_w, : structure.n_z]
        for block, value in zip(structure.blocks, structure.values(part), strict=True):
            one = elements.get(block.name)
            worst[block.name] = (
                one.value(float(np.real(value)))
                if isinstance(one, RealParameter)
                else float(np.real(value))
                if block.kind == "real"
                else value
            )
    return Robustness(
        1 / peak.upper if peak.upper > 0 else np.inf,
        1 / peak.lower if peak.lower > 0 else np.inf,
        peak.omega,
        peak.guaranteed,
        worst,
        peak.delta,
        peak,
    )
