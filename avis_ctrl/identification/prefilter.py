"""High-pass filter of voltages and measurements, with the sensors' chain inverted (Rademakers 2005, 3.2).

Near the corner of a geophone its voltage is not proportional to velocity, and a Kalman filter with velocity
measurements takes this for dynamics of the table. The source filters its data with a sixth-order high-pass of 1 Hz and
regards the problem as solved; a corner of 0.5 Hz and damping 0.7 still shifts the phase by 0.35 rad at 2 Hz. The chain
is known, and after the high-pass its inverse is proper and stable: the double pole of 1/chain at zero frequency cancels
two of the six zeros of the high-pass.

The same discrete high-pass acts on u and on y, and identical filters commute with a sampled linear system: the filtered
data obey the unfiltered model. The chain's inverse is discretised by Tustin's rule; at 1 kHz the remaining phase error
is about 1e-5 rad between 2 and 10 Hz.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.signal as signal

from avis_ctrl.checks import is_whole, places, require, require_positive
from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Record
from avis_ctrl.rigs.rig import Rig


class SensorInverse(NamedTuple):
    """(s - zeros) / (s - poles) / gain, from the measured quantity to the motion that the model measures.

    gain : (n_y,) of each channel. poles lie at zero or in the open left half plane. low_pass : poles of the anti-alias
        filter, which no proper filter inverts: u passes it, too.
    """

    motion: str
    zeros: np.ndarray
    poles: np.ndarray
    gain: np.ndarray
    low_pass: np.ndarray


def sensor_inverse(rig: Rig, y_names: tuple[str, ...], unit: str) -> SensorInverse:
    """Conversion of a rig's records to velocity, or to displacement if they are in m.

    Raises
    ------
    InputError : a unit other than V, m, m/s, m/s^2; volts of a rig without sensors; unknown channels.
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
        raise InputError(
            "expected geophones or accelerometers of one kind: the filter inverts a single sensor chain",
            field="y names",
            value=list(y_names),
        )
    # Velocity is the voltage over the chain. Poles at zero: the chain's zeros, and an accelerometer's integration.
    first = sensors[0]
    at_rest = len(first.zeros) + (first.quantity == "acceleration")
    own = np.array([pole for pole in first.poles if pole not in first.low_pass], complex)
    return SensorInverse(
        "velocity",
        own,
        np.zeros(at_rest, complex),
        np.array([one.gain for one in sensors]),
        np.array(first.low_pass, complex),
    )


def prefilter(
    record: Record, inverse: SensorInverse, delay_s: float, corner_Hz: float = 1.0, order: int = 6
) -> tuple[np.ndarray, np.ndarray]:
    """u (n, n_u) V, delayed as it acts on the actuators, and y (n, n_y) as motion, both after a high-pass.

    Parameters
    ----------
    record : from rest. delay_s : loop delay. A fraction of a sample is represented by the mean of the voltages held
        during the sample, which keeps the force impulse of each sample exact.
    corner_Hz, order : Butterworth, by the bilinear map with its corner prewarped.

    Raises
    ------
    InputError : an order for which the inverse is not stable, a corner beyond half the sample rate.
    """
    rate = record.header.sample_rate_Hz
    at_rest = int(np.count_nonzero(inverse.poles == 0))
    if not (is_whole(order, at_rest + 1) and order <= 12):
        raise InputError(f"expected a whole number from {at_rest + 1} to 12", field="highpass_order", value=order)
    require(corner_Hz, "highpass_Hz", 0, rate / 2)
    require_positive(delay_s, "loop_delay_s", zero_allowed=True)
    zeros, poles, gain = signal.butter(order, corner_Hz, "highpass", fs=rate, output="zpk")

    def filtered(samples: np.ndarray, of: np.ndarray, by: np.ndarray, k: float) -> np.ndarray:
        """Apply the high-pass and k (s - of) / (s - by); poles at z = 1 cancel zeros of the high-pass."""
        z, p, k = signal.bilinear_zpk(of, by, k, rate)
        cancelled = int(np.count_nonzero(by == 0))
        sections = signal.zpk2sos([*zeros[cancelled:], *z], [*poles, *p[by != 0]], gain * k)
        return signal.sosfilt(sections, samples, axis=0)

    u = filtered(
        delayed(record.u, delay_s * rate), np.zeros(0), inverse.low_pass, float(np.prod(-inverse.low_pass).real)
    )
    return u, filtered(record.y / inverse.gain, inverse.zeros, inverse.poles, 1.0)


def delayed(u: np.ndarray, samples: float) -> np.ndarray:
    """Held voltages (n, n_u), `samples` later, zero before; the mean over each sample if it is not a whole number."""
    whole = int(np.floor(samples + 1e-9))
    part = max(samples - whole, 0.0)

    def shifted(by: int) -> np.ndarray:
        return np.vstack([np.zeros((min(by, len(u)), u.shape[1])), u[: max(len(u) - by, 0)]])

    return shifted(whole) if part < 1e-9 else (1 - part) * shifted(whole) + part * shifted(whole + 1)
