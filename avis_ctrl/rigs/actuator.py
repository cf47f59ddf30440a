"""Actuator chains: from the voltage that the controller computes to the force on the payload.

Loop delay (computation and sampling), amplifier lag, force constant, and back-EMF as a damper between payload
and chassis. The voltage limit is a number for the simulation and for control-effort weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, factorial

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import cascade
from avis_ctrl.lti.statespace import StateSpace, append, gain, tf
from avis_ctrl.rigs.converter import require_positive


def pade_coefficients(order: int) -> np.ndarray:
    """Coefficients, by descending power of x, of N with N(-x)/N(x) the [n/n] Pade approximant of exp(-x)."""
    return np.array([comb(order, k) * factorial(2 * order - k) / factorial(2 * order)
                     for k in range(order, -1, -1)])


def pade_delay(delay_s: float, order: int = 2, input_name: str = "u", output_name: str = "y") -> StateSpace:
    """All-pass Pade approximation of exp(-s T), in coordinates where both Gramians are the identity.

    An all-pass system has equal Gramians up to scale, so these coordinates are balanced: the realisation stays
    well conditioned at any delay, where a companion form in powers of 1/T would not.

    Raises
    ------
    InputError : a negative or non-finite delay, an order outside 1..10.
    """
    require_positive(delay_s, "delay_s", zero_allowed=True)
    if not (isinstance(order, int) and 1 <= order <= 10):
        raise InputError("a whole number from 1 to 10", field="pade_order", value=order)
    if delay_s == 0:
        return gain(1.0, [input_name], [output_name])
    denominator = pade_coefficients(order)
    numerator = denominator * (-1.0) ** np.arange(order, -1, -1)
    unit = tf(list(numerator), list(denominator))
    gramian = la.solve_continuous_lyapunov(unit.A, -unit.B @ unit.B.T)
    unit = unit.similar(la.cholesky(gramian, lower=True))
    root = np.sqrt(1.0 / delay_s)
    return StateSpace(unit.A / delay_s, unit.B * root, unit.C * root, unit.D, 0.0, (input_name,), (output_name,))


def zero_order_hold(sample_time_s: float, order: int = 2, input_name: str = "u",
                    output_name: str = "y") -> StateSpace:
    """Continuous model (1 - exp(-s T))/(s T) of a zero-order hold, the exponential by its Pade approximant.

    The zero of the numerator at s = 0 cancels on paper, so that the gain at rest is exactly 1.
    """
    require_positive(sample_time_s, "sample_time_s")
    if not (isinstance(order, int) and 1 <= order <= 10):
        raise InputError("a whole number from 1 to 10", field="pade_order", value=order)
    denominator = pade_coefficients(order)
    # N(x) - N(-x) keeps twice the odd powers; divided by x they move down by one.
    odd = np.where(np.arange(order, -1, -1) % 2 == 1, 2.0 * denominator, 0.0)
    unit = tf(list(odd[:-1]), list(denominator))
    root = np.sqrt(1.0 / sample_time_s)
    return StateSpace(unit.A / sample_time_s, unit.B * root, unit.C * root, unit.D, 0.0, (input_name,), (output_name,))


@dataclass(frozen=True)
class ActuatorChain:
    """Delay, amplifier, motor.

    Parameters
    ----------
    constant_N_per_V : force per volt.
    amplifier_corner_Hz : first-order lag of the amplifier; None for none.
    back_emf_Ns_per_m : force opposing the velocity of payload against chassis, per m/s; 0 for a current amplifier.
    limit_V : largest voltage, either sign.
    delay_s, pade_order : delay between measurement and drive, and the order of its Pade approximant.

    Raises
    ------
    InputError : a value out of its range, by name.
    """

    constant_N_per_V: float
    amplifier_corner_Hz: float | None = None
    back_emf_Ns_per_m: float = 0.0
    limit_V: float = 10.0
    delay_s: float = 0.0
    pade_order: int = 2

    def __post_init__(self) -> None:
        require_positive(self.constant_N_per_V, "constant_N_per_V")
        require_positive(self.back_emf_Ns_per_m, "back_emf_Ns_per_m", zero_allowed=True)
        require_positive(self.limit_V, "limit_V")
        require_positive(self.delay_s, "delay_s", zero_allowed=True)
        if self.amplifier_corner_Hz is not None:
            require_positive(self.amplifier_corner_Hz, "amplifier_corner_Hz")

    def system(self, voltage_name: str = "voltage", force_name: str = "force",
               velocity_name: str | None = None) -> StateSpace:
        """Voltage [V] (and velocity of payload against chassis [m/s]) -> force [N].

        Raises InputError when there is back-EMF but no velocity signal to feel it.
        """
        if self.back_emf_Ns_per_m and velocity_name is None:
            raise InputError("back-EMF needs the velocity of the payload against the chassis: give velocity_name",
                             field="back_emf_Ns_per_m", value=self.back_emf_Ns_per_m)
        drive = pade_delay(self.delay_s, self.pade_order)
        if self.amplifier_corner_Hz is not None:
            corner = 2 * np.pi * self.amplifier_corner_Hz
            drive = cascade([], [-corner], corner) @ drive
        motor = drive.scaled(left=self.constant_N_per_V).renamed([voltage_name], [force_name])
        if velocity_name is None:
            return motor
        both = append(motor, gain(-self.back_emf_Ns_per_m, [velocity_name], ["back_emf_force"]))
        return gain([[1.0, 1.0]], both.outputs, [force_name]) @ both

    @property
    def limit_N(self) -> float:
        """Largest force at rest."""
        return self.constant_N_per_V * self.limit_V
