"""What the processor does beside x+ = A x + B y, u = C x + D y: safe start, drive limits, inputs out of range.

    v = y, clipped to the converter's range; 0 where it is not finite
    u = limit(g (C x + D v)),   x+ = A x + B v + L (u - g (C x + D v))

The gain g rises from 0 to 1 after every input has been valid for a while, and falls to 0 as soon as one is not: a
start and a recovery without a jump, because the states follow the inputs while g = 0. With g = 1 and no drive at its
limit the controller is exactly the linear one. L is the gain of the Kalman predictor of x from u, for y white: it
drives the state to one that explains the voltages which really act (without the noise assumed and for a square,
minimum-phase D it is B D^-1, the conditioning of Hanus, Kinnaert and Henrotte, Automatica 23, 1987); A - L C is stable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg as la

from avis_ctrl.export.sampled_controller import SampledController
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True)
class ProtectionSettings:
    """Times of start and fall-back, and the noise that makes the anti-windup gain well posed.

    wait_s : valid inputs required before the gain rises; a geophone of 1 Hz forgets the step of switching on.
    rise_s : from gain 0 to 1; a few periods of a table's lowest resonances, so that the rise excites none.
    fall_s : from gain 1 to 0; short, because a wrong input drives the table meanwhile.
    output_noise : standard deviation of each drive voltage that L assumes beside what y = 1 V causes, relative to the
        largest of these. Far above 1, L corrects only what many limited samples agree on: the slow states that wind up.
        Near 0 it inverts the controller at every limited sample, and a short limit then becomes a long one.
    digits : significant digits of L; more would only differ between numerical libraries.
    """

    wait_s: float = 0.5
    rise_s: float = 1.0
    fall_s: float = 0.1
    output_noise: float = 30.0
    digits: int = 4


@dataclass(frozen=True, eq=False)
class Protection:
    """Constants of the code beside the controller's.

    input_limit_V : (n_y,) a magnitude from which on an input is out of the converter's range; inf for none.
    wait : samples of valid inputs before the gain rises. rise, fall : change of the gain per sample.
    anti_windup : (n, n_u) L, from what the limits cut off to the states.
    """

    input_limit_V: np.ndarray
    wait: int
    rise: float
    fall: float
    anti_windup: np.ndarray


def protection(controller: SampledController, rig: Rig, settings: ProtectionSettings = ProtectionSettings()
               ) -> Protection:
    """For this controller and the rig's converter."""
    rate, system, dtype = controller.sample_rate_Hz, controller.system, controller.dtype
    largest = np.inf if rig.converter is None else min(abs(volts) for volts in rig.converter.limits_V)
    L = _significant(_predictor_gain(system, settings.output_noise), settings.digits)
    return Protection(np.full(system.ninputs, dtype(largest), float), max(1, round(settings.wait_s * rate)),
                      float(dtype(1 / max(1.0, settings.rise_s * rate))),
                      float(dtype(1 / max(1.0, settings.fall_s * rate))), L.astype(dtype).astype(float))


def _predictor_gain(system: StateSpace, noise: float) -> np.ndarray:
    """(n, n_u) steady-state gain of the Kalman predictor of x from u with y white of 1 V."""
    A, B, C, D = system.A, system.B, system.C, system.D
    if not system.nstates:
        return np.zeros((0, system.noutputs))
    reach = la.solve_discrete_lyapunov(A, B @ B.T)
    variance = C @ reach @ C.T + D @ D.T
    R = D @ D.T + (noise ** 2 * np.max(np.diag(variance)) or 1.0) * np.eye(system.noutputs)
    # States scaled to unit variance: the equation is badly scaled in sensor volts.
    scale = np.sqrt(np.where(np.diag(reach) > 0, np.diag(reach), 1.0))
    As, Bs, Cs = A / scale[:, None] * scale, B / scale[:, None], C * scale
    size = np.sqrt(np.trace(R) / system.noutputs)
    P = la.solve_discrete_are(As.T, Cs.T / size, Bs @ Bs.T, R / size ** 2, s=Bs @ D.T / size)
    gain = (As @ P @ Cs.T + Bs @ D.T) @ np.linalg.inv(Cs @ P @ Cs.T + R)
    return scale[:, None] * gain


def _significant(values: np.ndarray, digits: int) -> np.ndarray:
    return np.array([float(f"{one:.{digits - 1}e}") for one in values.ravel()]).reshape(values.shape)


class Processor:
    """The code's arithmetic in double precision, sample by sample: what the compiled code is compared with.

    dtype : another precision.

    Attributes
    ----------
    x : (n,) state. gain : 0 to 1. wait : samples of valid inputs still to come before the gain rises.
    """

    def __init__(self, controller: SampledController, guard: Protection, dtype: type[np.floating] = np.float64):
        self.limits_V, self.guard, self.dtype = controller.limits_V.astype(dtype), guard, dtype
        self.A, self.B, self.C, self.D = (matrix.astype(dtype) for matrix in controller.matrices().values())
        self.L, self.fall, self.rise = guard.anti_windup.astype(dtype), dtype(guard.fall), dtype(guard.rise)
        self.x, self.wait = np.zeros(controller.system.nstates, dtype), guard.wait
        self.gain: Any = dtype(0)

    def step(self, y: np.ndarray) -> np.ndarray:
        """Drive volts (n_u,) for sensor volts (n_y,)."""
        guard = self.guard
        valid = bool(np.all(np.abs(y) < guard.input_limit_V))
        v = np.clip(np.where(np.isnan(y), 0.0, y), -guard.input_limit_V, guard.input_limit_V).astype(self.dtype)
        self.wait = guard.wait if not valid else max(self.wait - 1, 0)
        self.gain = max(self.gain - self.fall, self.dtype(0)) if self.wait else min(self.gain + self.rise,
                                                                                   self.dtype(1))
        demanded = self.gain * (self.C @ self.x + self.D @ v)
        u = np.clip(demanded, -self.limits_V, self.limits_V)
        self.x = self.A @ self.x + self.B @ v + self.L @ (u - demanded)
        return u
