"""High-pass filter of voltages and measurements alike, the sensors' chain undone on the way (Rademakers 2005, 3.2).

A geophone's voltage is not proportional to velocity near its corner, which a Kalman filter with velocity measurements
takes for dynamics of the table. The source filters its data with a sixth-order high-pass of 1 Hz and calls the problem
solved; a corner of 0.5 Hz and damping 0.7 still turns the phase by 0.35 rad at 2 Hz. The chain is known, and behind
the high-pass its inverse is proper and stable: the double pole of 1/chain at zero frequency cancels two of the six
zeros of the high-pass.

The same discrete high-pass acts on u and on y, and filters that are alike commute with a sampled linear system: the
filtered data obey the unfiltered model. The chain's inverse is discretised by Tustin's rule; what that leaves at
1 kHz is some 1e-5 rad of phase between 2 and 10 Hz.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.signal as signal

from avis_ctrl.checks import places, require, require_positive
from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Record
from avis_ctrl.rigs.rig import Rig


class SensorInverse(NamedTuple):
    """(s - zeros) / (s - poles) / gain, from the measured quantity to the motion that the model measures.

    gain : (n_y,) of each channel. poles lie at zero or in the open left half plane. low_pass : poles of the anti-alias
    filter, which no proper filter undoes: u passes it, too.
    """

    motion: str
    zeros: np.ndarray
    poles: np.ndarray
    gain: np.ndarray
    low_pass: np.ndarray


def sensor_inverse(rig: Rig, y_names: tuple[str, ...], unit: str) -> SensorInverse:
    """How the records of a rig become velocity, or displacement where they are in m.

    Raises
    ------
    InputError : a unit that is none of V, m, m/s, m/s^2; volts of a rig without sensors; unknown channels.
    """
    names, _ = rig.sensor_rows()
    places(y_names, names, f"the sensors of the rig {rig.name} are", "y names")
    none, one = np.zeros(0, complex), np.ones(len(y_names))
    plain = {"m": ("displacement", none), "m/s": ("velocity", none), "m/s^2": ("velocity", np.zeros(1, complex))}
    if unit in plain:
        motion, poles = plain[unit]
        return SensorInverse(motion, none, poles, one, none)
    if unit != "V":
        raise InputError("expected V, m, m/s or m/s^2", field="unit of y", value=unit)
    sensors = [one for name in y_names for one in rig.sensors() if one.name == name]
    kinds = {(one.quantity, one.zeros, one.poles) for one in sensors}
    if len(kinds) != 1 or not sensors[0].inertial:
        raise InputError("expected geophones or accelerometers of one kind: the filter inverts a single sensor chain",
                         field="y names", value=list(y_names))
    # Velocity is the voltage over the chain: of an accelerometer its zero at rest and the integration.
    first = sensors[0]
    at_rest = len(first.zeros) + (first.quantity == "acceleration")
    own = np.array([pole for pole in first.poles if pole not in first.low_pass], complex)
    return SensorInverse("velocity", own, np.zeros(at_rest, complex), np.array([one.gain for one in sensors]),
                         np.array(first.low_pass, complex))


def prefilter(record: Record, inverse: SensorInverse, delay_s: float, corner_Hz: float = 1.0, order: int = 6
              ) -> tuple[np.ndarray, np.ndarray]:
    """u (n, n_u) V, delayed as the actuators see it, and y (n, n_y) as motion, both behind a high-pass.

    Parameters
    ----------
    record : from rest. delay_s : loop delay. A part of a sample is met by the mean of the voltages held during the
        sample, which leaves the force impulse of each sample exact.
    corner_Hz, order : Butterworth, by the bilinear map with its corner prewarped.

    Raises
    ------
    InputError : an order that leaves the inverse unstable, a corner beyond half the sample rate.
    """
    rate = record.header.sample_rate_Hz
    at_rest = int(np.count_nonzero(inverse.poles == 0))
    if not (isinstance(order, int) and at_rest < order <= 12):
        raise InputError(f"expected a whole number from {at_rest + 1} to 12", field="highpass_order", value=order)
    require(corner_Hz, "highpass_Hz", 0, rate / 2)
    require_positive(delay_s, "loop_delay_s", zero_allowed=True)
    zeros, poles, gain = signal.butter(order, corner_Hz, "highpass", fs=rate, output="zpk")

    def filtered(samples: np.ndarray, of: np.ndarray, by: np.ndarray, k: float) -> np.ndarray:
        """Behind the high-pass and k (s - of) / (s - by); poles at z = 1 cancel zeros of the high-pass."""
        z, p, k = signal.bilinear_zpk(of, by, k, rate)
        cancelled = int(np.count_nonzero(by == 0))
        sections = signal.zpk2sos([*zeros[cancelled:], *z], [*poles, *p[by != 0]], gain * k)
        return signal.sosfilt(sections, samples, axis=0)
    u = filtered(delayed(record.u, delay_s * rate), np.zeros(0), inverse.low_pass,
                 float(np.prod(-inverse.low_pass).real))
    return u, filtered(record.y / inverse.gain, inverse.zeros, inverse.poles, 1.0)


def delayed(u: np.ndarray, samples: float) -> np.ndarray:
    """Held voltages (n, n_u), `samples` later, zero before; the mean over each sample where that is no whole number."""
    whole = int(np.floor(samples + 1e-9))
    part = max(samples - whole, 0.0)

    def shifted(by: int) -> np.ndarray:
        return np.vstack([np.zeros((min(by, len(u)), u.shape[1])), u[:max(len(u) - by, 0)]])
    return shifted(whole) if part < 1e-9 else (1 - part) * shifted(whole) + part * shifted(whole + 1)
