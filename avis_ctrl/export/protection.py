"""Protection around x+ = A x + B y, u = C x + D y: safe start, drive limits, inputs out of range.

    v = y, clipped to the converter's range; 0 where it is not finite
    w = g (C x + D v - b),   u = limit(w),   x+ = A x + B v,   b+ = keep b + feed (w - u)

The gain g rises from 0 to 1 after every input has been valid for a while, and falls to 0 as soon as one is invalid.
Start and recovery have no jump, because the states follow the inputs while g = 0. With g = 1 the controller is exactly
linear until a drive reaches its limit. The anti-windup b (`AntiWindup`) is outside the linear loop: once the limits
have been left, it only decays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.export.sampled_controller import SampledController
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.simulation.sampled_loop import NO_ANTI_WINDUP, AntiWindup


@dataclass(frozen=True)
class ProtectionSettings:
    """Times of start and fall-back.

    wait_s : valid inputs required before the gain rises; the switch-on step of a 1 Hz geophone has then decayed.
    rise_s : from gain 0 to 1; a few periods of a table's lowest resonances, so that the rise does not excite them.
    fall_s : from gain 1 to 0; short, because a wrong input drives the table until then.
    """

    wait_s: float = 0.5
    rise_s: float = 1.0
    fall_s: float = 0.1


@dataclass(frozen=True, eq=False)
class Protection:
    """Constants of the code in addition to those of the controller.

    input_limit_V : (n_y,) magnitude from which an input is out of the converter's range; inf for none.
    wait : samples of valid inputs before the gain rises. rise, fall : change of the gain per sample.
    """

    input_limit_V: np.ndarray
    wait: int
    rise: float
    fall: float
    anti_windup: AntiWindup


def protection(
    controller: SampledController,
    rig: Rig,
    anti_windup: AntiWindup = NO_ANTI_WINDUP,
    settings: ProtectionSettings = ProtectionSettings(),
) -> Protection:
    """Constants for this controller and the rig's converter."""
    rate, system, dtype = controller.sample_rate_Hz, controller.system, controller.dtype
    largest = np.inf if rig.converter is None else min(abs(volts) for volts in rig.converter.limits_V)
    return Protection(
        np.full(system.ninputs, dtype(largest), float),
        max(1, round(settings.wait_s * rate)),
        _exact_in_sums(1 / max(1.0, settings.rise_s * rate)),
        _exact_in_sums(1 / max(1.0, settings.fall_s * rate)),
        AntiWindup(*(float(dtype(one)) for one in anti_windup)),
    )


def _exact_in_sums(change: float) -> float:
    """Round up to a multiple of 2^-23; float32 has all of these up to 1, so that the gain has no rounding error."""
    return float(np.ceil(change * 2.0**23) / 2.0**23)


class Processor:
    """The code's arithmetic in double precision, sample by sample: the reference for the compiled code.

    dtype : another precision.

    Attributes
    ----------
    x : (n,) state. excess : (n_u,) b. gain : 0 to 1. wait : valid samples still required before the gain rises.
    """

    def __init__(self, controller: SampledController, guard: Protection, dtype: type[np.floating] = np.float64):
        self.limits_V, self.guard, self.dtype = controller.limits_V.astype(dtype), guard, dtype
        self.A, self.B, self.C, self.D = (matrix.astype(dtype) for matrix in controller.matrices().values())
        self.keep, self.feed = (dtype(one) for one in guard.anti_windup)
        self.fall, self.rise, self.wait = dtype(guard.fall), dtype(guard.rise), guard.wait
        self.x, self.excess = np.zeros(controller.system.nstates, dtype), np.zeros(controller.system.noutputs, dtype)
        self.gain: Any = dtype(0)

    def step(self, y: np.ndarray) -> np.ndarray:
        """Drive volts (n_u,) for sensor volts (n_y,)."""
        guard = self.guard
        valid = bool(np.all(np.abs(y) < guard.input_limit_V))
        v = np.clip(np.where(np.isfinite(y), y, 0.0), -guard.input_limit_V, guard.input_limit_V).astype(self.dtype)
        self.wait = guard.wait if not valid else max(self.wait - 1, 0)
        self.gain = (
            max(self.gain - self.fall, self.dtype(0)) if self.wait else min(self.gain + self.rise, self.dtype(1))
        )
        demanded = self.gain * (self.C @ self.x + self.D @ v - self.excess)
        u = np.clip(demanded, -self.limits_V, self.limits_V)
        self.excess = self.keep * self.excess + self.feed * (demanded - u)
        self.x = self.A @ self.x + self.B @ v
        return u
