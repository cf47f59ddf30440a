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

from dataclasses import dataclass

import numpy as np
import scipy.signal as signal

from avis_ctrl.checks import places
from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Record
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True)
class SensorInverse:
    """(s - zeros) / (s - poles) / gain, from the measured quantity to the motion that the model measures.

    gain : (n_y,) of each channel. poles lie at zero or in the open left half plane.
    """

    motion: str
    zeros: np.ndarray
    poles: np.ndarray
    gain: np.ndarray


@dataclass(frozen=True, eq=False)
class Filtered:
    """u (n, n_u) V, delayed as the actuators see it; y (n, n_y) m/s (or m); start: samples dropped at the front."""

    u: np.ndarray
    y: np.ndarray
    start: int


def sensor_inverse(rig: Rig, y_names: tuple[str, ...], unit: str, undo_chain: bool = True) -> SensorInverse:
    """How the records of a rig become velocity, or displacement where they are in m.

    undo_chain=False divides by the passband gain only, as the source does.

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
        return SensorInverse(motion, none, poles, one)
    if unit != "V":
        raise InputError("expected V, m, m/s or m/s^2", field="unit of y", value=unit)
    sensors = [one for name in y_names for one in rig.sensors() if one.name == name]
    kinds = {(one.quantity, one.zeros, one.poles) for one in sensors}
    if len(kinds) != 1 or not sensors[0].inertial:
        raise InputError("expected geophones or accelerometers of one kind: the filter inverts a single sensor chain",
                         field="y names", value=list(y_names))
    # Of the chain's poles and zeros alone; without them, in the passband.
    gain = np.array([one.gain * (one.leading if undo_chain else 1.0) for one in sensors])
    chain = np.array(sensors[0].poles, complex) if undo_chain else none
    # Velocity is the voltage over the chain: of an accelerometer its zero at rest and the integration.
    at_rest = len(sensors[0].zeros) if undo_chain else 0
    integration = 1 if sensors[0].quantity == "acceleration" else 0
    return SensorInverse("velocity", chain, np.zeros(at_rest + integration, complex), gain)


def prefilter(record: Record, inverse: SensorInverse, delay_s: float, corner_Hz: float = 1.0, order: int = 6,
              settle_s: float = 0.0) -> Filtered:
    """High-pass u and y of a record, y as motion, u delayed.

    Parameters
    ----------
    delay_s : loop delay. A part of a sample is met by the mean of the voltages held during the sample, which leaves
        the force impulse of each sample exact.
    corner_Hz, order : Butterworth, by the bilinear map with its corner prewarped.
    settle_s : seconds dropped at the front, for records that do not start at rest: their start passes the high-pass
        as a transient that is not a motion of the model.

    Raises
    ------
    InputError : an order that leaves the inverse unstable, a corner beyond half the sample rate, nothing left.
    """
    rate = record.header.sample_rate_Hz
    at_rest = int(np.count_nonzero(inverse.poles == 0))
    if not (isinstance(order, int) and at_rest < order <= 12):
        raise InputError(f"expected a whole number from {at_rest + 1} to 12", field="highpass_order", value=order)
    if not 0 < corner_Hz < rate / 2:
        raise InputError(f"expected a frequency in Hz between 0 and half the sample rate, {rate / 2:g}",
                         field="highpass_Hz", value=corner_Hz)
    if not (np.isfinite(delay_s) and delay_s >= 0):
        raise InputError("expected a delay in s, zero or positive", field="loop_delay_s", value=delay_s)
    start = round(settle_s * rate)
    if not 0 <= start < record.header.samples - 2:
        raise InputError(f"expected seconds, less than the record's {record.header.duration_s:g}", field="settle_s",
                         value=settle_s)
    zeros, poles, gain = signal.butter(order, corner_Hz, "highpass", fs=rate, output="zpk")
    u = signal.sosfilt(signal.zpk2sos(zeros, poles, gain), delayed(record.u, delay_s * rate), axis=0)
    z, p, k = _tustin(inverse, rate)
    # Poles at z = 1 of the inverse cancel zeros of the high-pass.
    sections = signal.zpk2sos(np.concatenate([zeros[at_rest:], z]), np.concatenate([poles, p[p != 1.0]]), gain * k)
    y = signal.sosfilt(sections, record.y / inverse.gain, axis=0)
    return Filtered(np.ascontiguousarray(u[start:]), np.ascontiguousarray(y[start:]), start)


def delayed(u: np.ndarray, samples: float) -> np.ndarray:
    """Held voltages (n, n_u), `samples` later, zero before; the mean over each sample where that is no whole number."""
    whole = int(np.floor(samples + 1e-9))
    part = max(samples - whole, 0.0)

    def shifted(by: int) -> np.ndarray:
        return np.vstack([np.zeros((min(by, len(u)), u.shape[1])), u[:max(len(u) - by, 0)]])
    return shifted(whole) if part < 1e-9 else (1 - part) * shifted(whole) + part * shifted(whole + 1)


def _tustin(inverse: SensorInverse, rate: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Zeros, poles and gain in z of the inverse without its channels' gains."""
    def mapped(roots: np.ndarray) -> np.ndarray:
        return (2 * rate + roots) / (2 * rate - roots)
    excess = len(inverse.poles) - len(inverse.zeros)
    gain = np.real(np.prod(2 * rate - inverse.zeros) / np.prod(2 * rate - inverse.poles))
    zeros = np.concatenate([mapped(inverse.zeros), -np.ones(max(excess, 0))])
    return zeros, np.where(inverse.poles == 0, 1.0, mapped(inverse.poles)), float(gain)
