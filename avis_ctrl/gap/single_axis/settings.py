"""Tuning values of the search on one axis, with unit, meaning and reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AxisSettings:
    """Values that no data determine.

    most_sure : largest probability that is reported [1] (contract). headline : probability below which a name is an
    alternative only [1] (contract). same : difference of two predictions over what is left, below which they are one
    [1]; a thousandth, far below any scatter.
    no_model : part of the response that a base model leaves, beyond which the columns themselves are in doubt [1];
    friction and springs are seldom half of it. much_better : part of that which exchanged columns may leave to be
    believed [1]; half of the power.
    coherent : coherence of force and motion up to which the noise of the motion bends a fit by a tenth at most [1].
    least_cutoff_Hz : of a drive's data where the coherence ends earlier [Hz]; friction needs its harmonics.
    """

    most_sure: float = 0.99
    headline: float = 0.5
    same: float = 1e-3
    no_model: float = 0.5
    much_better: float = 0.7
    coherent: float = 0.9
    least_cutoff_Hz: float = 60.0


SETTINGS = AxisSettings()
