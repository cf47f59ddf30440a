"""Disk margins: gain and phase variations that a feedback loop tolerates, in one channel or in all at once.

Each channel is multiplied by f = (1 + (1 - sigma)/2 delta)/(1 - (1 + sigma)/2 delta), |delta| < alpha, a disk of gains
and phases about 1 with skew sigma. The largest alpha is 1/mu of S + (sigma - 1)/2 I, which is (S - T)/2 at sigma = 0
(Seiler, Packard and Gahinet, An introduction to disk margins, IEEE Control Systems 40(5), 2020).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace
from avis_ctrl.lti.interchange import as_system
from avis_ctrl.robust.mu_peak import SETTINGS as PEAK
from avis_ctrl.robust.mu_peak import MuPeak, mu_peak
from avis_ctrl.summary import Shown
from avis_ctrl.uncertainty.blocks import BlockStructure
from avis_ctrl.uncertainty.elements import Dynamics
from avis_ctrl.uncertainty.uncertain_models import matrix
from avis_ctrl.uncertainty.uncertain_system import UncertainSystem

At = Literal["outputs", "inputs", "both"]


@dataclass(frozen=True)
class DiskMarginSettings:
    """resolution : relative width of the interval to which the bisection of a worst-case margin reduces alpha.
    largest : alpha at which the search for a worst-case margin ends, the disk then being almost the whole plane or its
        complement; it also ends at the inverse, where the loop is almost unstable.
    """

    resolution: float = 1e-3
    largest: float = 1e3


SETTINGS = DiskMarginSettings()


@dataclass(frozen=True, eq=False, repr=False)
class DiskMargin(Shown):
    """Bounds of alpha, and the corresponding gain and phase margins.

    lower : every loop with |delta| < lower in all channels is stable; proved at all frequencies if `guaranteed`.
    upper : `delta` (n, n), diagonal, of this size makes the loop unstable at `omega` [rad/s]; inf if none was found.
    gain : (low, high) gain factors of all channels for `lower`. phase_deg : phase lag or lead for `lower` [degrees].
    mu : the underlying bounds of mu.
    """

    lower: float
    upper: float
    omega: float
    gain: tuple[float, float]
    phase_deg: float
    guaranteed: bool
    skew: float
    delta: np.ndarray | None
    mu: MuPeak

    @property
    def gain_dB(self) -> float:
        """The smaller of the allowed gain reduction and gain increase [dB]."""
        low, high = self.gain
        return float(20 * np.log10(min(high, 1 / low if low > 0 else np.inf)))


def disk_margin(
    L: Any, K: Any = None, *, at: At = "outputs", skew: float = 0.0, slack: float = PEAK.slack
) -> DiskMargin:
    """Disk margin of a loop with negative feedback, for all its channels at once.

    Parameters
    ----------
    L : the open loop, as many inputs as outputs, continuous or sampled; or the plant, if a controller K is given.
        An `UncertainSystem` gives the worst case over its uncertainty.
    K : controller with negative feedback, u = -K y (for a K of `musyn`, with u = K y, give -K).
    at : location of the factors: plant outputs, plant inputs, or both simultaneously.
    skew : sigma in f = (1 + (1 - sigma)/2 delta)/(1 - (1 + sigma)/2 delta), the factor of each channel; 0 for equal
        gain increase and reduction. slack : as for `mu_peak`.

    Raises
    ------
    InputError : shapes that do not fit. ComputationError : an unstable loop, or a loop that is not proved stable for
        all of its uncertainty.

    Examples
    --------
    The published example of Seiler, Packard and Gahinet: 0.46, gains of 0.63 to 1.59, 26 degrees:

    >>> margin = ac.disk_margin(ac.tf([25.0], [1.0, 10.0, 10.0, 10.0]))
    >>> round(margin.lower, 2), [round(gain, 2) for gain in margin.gain], round(margin.phase_deg)
    (0.46, [0.63, 1.59], 26)
    """
    if not np.isfinite(skew) or at not in ("outputs", "inputs", "both"):
        raise InputError("expected a finite skew, and outputs, inputs or both", field="skew, at", value=(skew, at))
    plant = L if isinstance(L, UncertainSystem) else matrix([[as_system(L, "L")]])
    n_y, n_u = plant.shape
    controller = K if isinstance(K, UncertainSystem) or K is None else as_system(K, "K")
    if K is None and n_y != n_u:
        raise InputError("expected a square loop", field="L", value=plant.shape)
    loop, names = plant, list[str]()
    if at in ("outputs", "both"):
        factor, own = _factors("margin, output", n_y, skew)
        loop, names = factor @ loop, names + own
    if at in ("inputs", "both"):
        factor, own = _factors("margin, input", n_u, skew)
        loop, names = loop @ factor, names + own
    P, blocks = loop.feedback(np.eye(n_y) if controller is None else controller).lft()
    N = P.select(slice(blocks.n_z), slice(blocks.n_w))
    if not N.is_stable():
        poles = N.poles()
        worst = poles[np.argmax(np.abs(poles) if N.dt else poles.real)]
        raise ComputationError(
            "the nominal loop is not stable, so it has no margin",
            measured=f"pole {worst:.4g}",
            cause="the sign of K: the loop has negative feedback, u = -K y"
            if K is not None
            else "the sign of the loop: it has negative feedback, 1 + L",
            next_step="for a K of hinfsyn or musyn, which has u = K y, give -K"
            if K is not None
            else "give -L if its controller has u = K y",
        )
    places = {block.name: w.start for block, w, _ in blocks.slices() if block.name in names}
    place = np.array(list(places.values()), int)
    if place.size == blocks.n_w:
        peak = _peak(N, blocks, slack)
        lower, upper = (1 / bound if bound > 0 else np.inf for bound in (peak.upper, peak.lower))
        found = _margin(lower, upper, peak.omega, peak.delta, peak, skew)
    else:
        found = _worst_case(N, blocks, place, skew, slack)
    return _with_open_channels(found, names, list(places), skew)


def _peak(N: StateSpace, blocks: BlockStructure, slack: float) -> MuPeak:
    """`mu_peak`; zero if no factor is part of a loop."""
    if blocks.blocks:
        return mu_peak(N, blocks, slack=slack)
    none = np.zeros(0)
    return MuPeak(0.0, 0.0, 0.0, None, True, "no factor is part of a loop", none, none, none)


def _with_open_channels(found: DiskMargin, names: list[str], closed: list[str], skew: float) -> DiskMargin:
    """The margin with the factors of all channels. A factor in no loop has no limit but its own pole, 2/(1 + sigma)."""
    if len(closed) == len(names):
        return found
    delta = None
    if found.delta is not None:
        delta = np.zeros((len(names), len(names)), found.delta.dtype)
        at = [names.index(name) for name in closed]
        delta[np.ix_(at, at)] = found.delta
    own = 2 / (1 + skew) if skew > -1 else np.inf
    if own > found.lower:
        return replace(found, delta=delta)
    delta = np.diag([0.0 if name in closed else own for name in names])
    return _margin(own, own, 0.0, delta, found.mu, skew)


def _factors(name: str, n: int, skew: float) -> tuple[UncertainSystem, list[str]]:
    """diag(f_1 .. f_n): f = 1 + w, w = delta (v + (1 + sigma)/2 w), as f - 1 = delta/(1 - (1 + sigma)/2 delta)."""
    names = [f"{name} {k}" for k in range(n)]
    I = np.eye(n)
    return UncertainSystem((1 + skew) / 2 * I, I, I, I, tuple(Dynamics(one) for one in names), (1,) * n), names


def _margin(
    lower: float, upper: float, omega: float, delta: np.ndarray | None, proof: MuPeak, skew: float
) -> DiskMargin:
    """The margins for bounds of alpha; proof : the bounds of mu that prove the lower one."""
    low, high = _gains(lower, skew)
    return DiskMargin(lower, upper, omega, (low, high), _phase(low, high), proof.guaranteed, skew, delta, proof)


def _gains(alpha: float, skew: float) -> tuple[float, float]:
    """Interval of real factors in the disk; an end is infinite if the disk is a half plane or larger."""
    below = 2 + alpha * (1 + skew) if np.isfinite(alpha) else 1.0
    low = -np.inf if below <= 0 else 0.0 if np.isinf(alpha) else (2 - alpha * (1 - skew)) / below
    room = 2 - alpha * (1 + skew)
    high = (2 + alpha * (1 - skew)) / room if room > 0 else np.inf
    return float(low), float(high)


def _phase(low: float, high: float) -> float:
    """Phase of a factor of gain 1 on the edge of the disk [degrees]: cos = (1 + low high)/(low + high)."""
    if np.isinf(low) or np.isinf(high):
        cosine = high if np.isinf(low) else low
    else:
        cosine = (1 + low * high) / (low + high) if low + high > 0 else -1.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _worst_case(N: Any, blocks: BlockStructure, place: np.ndarray, skew: float, slack: float) -> DiskMargin:
    """The largest alpha for which mu, with the channels of the factors scaled by alpha, is proved below 1."""
    rows = [k for block, w, z in blocks.slices() if w.start in place for k in range(z.start, z.stop)]

    def scaled(alpha: float) -> MuPeak:
        left = np.ones(blocks.n_z)
        left[rows] = alpha
        return mu_peak(N.scaled(left=left), blocks, slack=slack)

    peak = scaled(0.0)
    if peak.upper >= 1:
        raise ComputationError(
            "the loop is not proved stable for all of its uncertainty, so it has no margin",
            measured=f"mu of the uncertainty is between {peak.lower:.4g} and {peak.upper:.4g}",
            next_step="reduce the uncertainty; robust_stability says by how much",
        )
    proved, unproved, alpha = 0.0, np.inf, 1.0
    counter: tuple[float, MuPeak] | None = None
    while 1 / SETTINGS.largest <= alpha <= SETTINGS.largest and unproved > (1 + SETTINGS.resolution) * proved:
        found = scaled(alpha)
        if found.upper < 1:
            proved, peak = alpha, found
        else:
            unproved = alpha
            if found.lower >= 1:
                counter = alpha, found
        alpha = (proved + unproved) / 2 if np.isfinite(unproved) else 2 * alpha
    if counter is None:
        return _margin(proved, np.inf, peak.omega, None, peak, skew)
    broken, found = counter
    delta = None if found.delta is None else broken * np.diag(found.delta[place, rows])
    return _margin(proved, broken, found.omega, delta, peak, skew)
