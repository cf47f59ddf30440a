"""Geophones and accelerometers with what stands between them and the controller.

    case velocity -> geophone -> compensation filter -> preamplifier -> converter -> volts as the controller reads them

A geophone is a velocity sensor above its suspension frequency and a jerk sensor below it (Rademakers 2005,
section 2.1.1); the compensation filter moves that corner down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.lti.rational import cascade
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.converter import Converter, require_positive, white_density

BOLTZMANN_J_per_K = 1.380649e-23
ROOM_TEMPERATURE_K = 293.15


def second_order_roots(corner_Hz: float, damping: float) -> np.ndarray:
    """Roots of s^2 + 2 zeta w s + w^2 [rad/s]."""
    w = 2 * np.pi * corner_Hz
    return np.roots([1.0, 2 * damping * w, w * w]).astype(complex)


@dataclass(frozen=True)
class Geophone:
    """Coil voltage over case velocity, S s^2 / (s^2 + 2 zeta w s + w^2).

    Parameters
    ----------
    corner_Hz, damping : suspension frequency and damping ratio (with the shunt in place).
    sensitivity_Vs_per_m : volts per m/s well above the corner.
    coil_ohm, shunt_ohm : coil resistance and shunt (None: unknown, and open circuit).

    Raises
    ------
    InputError : a value that is not a finite positive number.
    """

    corner_Hz: float
    damping: float
    sensitivity_Vs_per_m: float
    coil_ohm: float | None = None
    shunt_ohm: float | None = None

    def __post_init__(self) -> None:
        for field in ("corner_Hz", "damping", "sensitivity_Vs_per_m"):
            require_positive(getattr(self, field), field)
        for field in ("coil_ohm", "shunt_ohm"):
            if getattr(self, field) is not None:
                require_positive(getattr(self, field), field)

    def poles(self) -> np.ndarray:
        """The two suspension poles [rad/s]."""
        return second_order_roots(self.corner_Hz, self.damping)

    def system(self, velocity_name: str = "velocity", voltage_name: str = "voltage") -> StateSpace:
        """Case velocity [m/s] -> coil voltage [V], two states."""
        return cascade(np.zeros(2), self.poles(), self.sensitivity_Vs_per_m, velocity_name, voltage_name)

    def johnson_density_V_rtHz(self, temperature_K: float = ROOM_TEMPERATURE_K) -> float:
        """Thermal noise sqrt(4 k T R) of the coil in parallel with its shunt; 0 where the coil is unknown."""
        if self.coil_ohm is None:
            return 0.0
        conductance = 1 / self.coil_ohm + (1 / self.shunt_ohm if self.shunt_ohm else 0.0)
        return float(np.sqrt(4 * BOLTZMANN_J_per_K * temperature_K / conductance))


@dataclass(frozen=True)
class CompensationFilter:
    """(s^2 + 2 zn wn s + wn^2) / (s^2 + 2 zc wc s + wc^2): takes the corner it assumes to the one wanted."""

    from_Hz: float
    from_damping: float
    to_Hz: float
    to_damping: float

    def __post_init__(self) -> None:
        for field in ("from_Hz", "from_damping", "to_Hz", "to_damping"):
            require_positive(getattr(self, field), field)

    def zeros(self) -> np.ndarray:
        return second_order_roots(self.from_Hz, self.from_damping)

    def poles(self) -> np.ndarray:
        return second_order_roots(self.to_Hz, self.to_damping)

    def system(self, input_name: str = "voltage", output_name: str = "compensated") -> StateSpace:
        """Voltage -> voltage, two states, unit gain at high frequency."""
        return cascade(self.zeros(), self.poles(), 1.0, input_name, output_name)


@dataclass(frozen=True)
class SensorChain:
    """Geophone, compensation filter, preamplifier and converter of one channel.

    Where the filter assumes exactly the geophone's corner and damping, its zeros cancel the geophone's poles on paper
    and the chain has two states; otherwise all four are kept, because the mismatch is what matters.

    Parameters
    ----------
    preamplifier_gain : V/V, positive.
    noise_rms_V : ambient noise of the channel after the preamplifier, white from 0 to half the sample rate.
    """

    geophone: Geophone
    compensation: CompensationFilter | None
    preamplifier_gain: float
    converter: Converter
    noise_rms_V: float = 0.0

    def __post_init__(self) -> None:
        require_positive(self.preamplifier_gain, "preamplifier_gain")
        require_positive(self.noise_rms_V, "noise_rms_V", zero_allowed=True)

    @property
    def compensation_is_exact(self) -> bool:
        """Whether the filter assumes the geophone's own corner and damping."""
        c, g = self.compensation, self.geophone
        return c is not None and (c.from_Hz, c.from_damping) == (g.corner_Hz, g.damping)

    def system(self, velocity_name: str = "velocity", voltage_name: str = "voltage") -> StateSpace:
        """Case velocity [m/s] -> voltage at the converter [V]."""
        zeros, poles = [np.zeros(2)], [self.geophone.poles()]
        if self.compensation is not None:
            if self.compensation_is_exact:
                poles = [self.compensation.poles()]
            else:
                zeros.append(self.compensation.zeros())
                poles.append(self.compensation.poles())
        return cascade(np.concatenate(zeros), np.concatenate(poles), self.passband_gain_Vs_per_m,
                       velocity_name, voltage_name)

    @property
    def passband_gain_Vs_per_m(self) -> float:
        """Volts at the converter per m/s, well above every corner."""
        return self.geophone.sensitivity_Vs_per_m * self.preamplifier_gain

    def noise_density(self, omega: np.ndarray) -> np.ndarray:
        """One-sided noise density at the converter [V/sqrt(Hz)], (n_omega,).

        Thermal noise of the coil, shaped by filter and preamplifier; the channel's ambient noise and the converter's
        rounding, both white to half the sample rate. Independent sources add in power.
        """
        omega = np.atleast_1d(np.asarray(omega, float))
        electronics = np.ones(omega.shape) * self.preamplifier_gain
        if self.compensation is not None:
            electronics *= np.abs(self.compensation.system().frequency_response(omega)[:, 0, 0])
        white = np.hypot(self.converter.noise_density_V_rtHz,
                         white_density(self.noise_rms_V, self.converter.sample_rate_Hz))
        return np.hypot(self.geophone.johnson_density_V_rtHz() * electronics, white)

    def velocity_noise_density(self, omega: np.ndarray) -> np.ndarray:
        """The case velocity [m/s/sqrt(Hz)] that would make the same voltage noise, (n_omega,); omega > 0."""
        return self.noise_density(omega) / np.abs(self.system().frequency_response(omega)[:, 0, 0])
