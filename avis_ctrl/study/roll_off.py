"""Limit on a controller's gain above half the sample rate, for the stability proof of the exported code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.robust.mu_descent import GainLimit
from avis_ctrl.robust.mu_upper import skewed_upper_bound
from avis_ctrl.study.plant import DesignPlant


@dataclass(frozen=True)
class RollOffSettings:
    """Settings of the gain limit.

    beyond, points : the limit is computed at `points` frequencies from half the sample rate to `beyond` times this
        rate; the table's gain decreases smoothly there. held : gain of the hold at half the sample rate.
    """

    beyond: float = 30.0
    points: int = 10
    held: float = 2 / np.pi


def gain_limit(plant: DesignPlant, sample_rate_Hz: float, settings: RollOffSettings = RollOffSettings()) -> GainLimit:
    """Largest gains [N s/m] for which the loop gain of the certificate stays below one.

    The sampled controller is represented by the continuous-time one and an error of any phase. The error is at most the
    gain of the continuous-time controller plus `held` times this gain, the part that passes the hold. At half the
    sample rate the image coincides with the signal and counts twice.

    Raises ComputationError: a table without a bounded gain over the uncertainty set.
    """
    blocks, P, u, y = plant.full.blocks, plant.full.P, plant.full.u, plant.full.y
    omega = np.geomspace(1.0, settings.beyond, settings.points) * np.pi * sample_rate_Hz
    table = P.select([*P.outputs[: blocks.n_z], *y], [*P.inputs[: blocks.n_w], *u]).frequency_response(omega)
    gain = skewed_upper_bound(table[:, None], blocks.with_performance(len(u), len(y))).beta
    if not np.all(np.isfinite(gain)):
        raise ComputationError(
            "the table above half the sample rate has no bounded gain over the uncertainty set",
            next_step="design with smaller uncertainty",
        )
    images = np.where(np.arange(omega.size) == 0, 2.0, 1.0)
    return GainLimit(omega, 1 / ((2 + settings.held) * images * gain))
