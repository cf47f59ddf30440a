"""The motion of the mounts in a measured record: simulated with a model, corrected by the sensor signals.

    d = d_model + G q_e,    q_e = K (y - y_model)

y - y_model is modelled as the response to a missing force e, white within each third of an octave, plus white sensor
noise. The most likely q_e is then given by the Wiener filter K = D^-1 S H^H (H S H^H + N)^-1, with H from force to y, S
the variance of the force and N that of the noise. K inverts the sensor response where the signal exceeds the noise and
is zero where it does not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.fft

from avis_ctrl.gap.line_response import LineResponse, line_response
from avis_ctrl.gap.operators import Assembled, mount_geometry
from avis_ctrl.gap.record_motion import SETTINGS, RecordMotion
from avis_ctrl.gap.run import Mapper, sequential_map
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.large_motion import second_order
from avis_ctrl.identification.predictor import model_inputs
from avis_ctrl.identification.response import N_Q
from avis_ctrl.measurement.campaign import Campaign, Portion, Record, RecordSource


def motion_of(
    campaign: Campaign, model: TableModel, whole: Campaign | None = None, each: Mapper = sequential_map
) -> dict[str, RecordMotion]:
    """Motion of every record of a campaign, by record name, from its measured y.

    Parameters
    ----------
    campaign : records may be portions of longer ones: these are simulated as a whole, so that the portion starts in
        motion.
    model : effects that depend on amplitude or time are left out of the simulation; the sensor signals contain them.
    whole : the campaign that sets the clock, if `campaign` is a part of it. each : runs the records.

    Raises
    ------
    InputError : channels or sample rates other than the model's, or a record too long for one piece.
    """
    campaign_s = clock_of(whole or campaign)
    linear = model.linear
    sources = list({id(source): source for source, _, _ in map(origin, campaign.records)}.values())
    known = dict(zip(map(id, sources), each(lambda source: _in_time(source.load(), linear), sources), strict=True))
    found = {}
    for record in campaign.records:
        source, begin, stop = origin(record)
        volts, deflection, y = known[id(source)]
        h = record.header
        found[h.name] = RecordMotion(
            h.name,
            h.sample_rate_Hz,
            h.start_s,
            campaign_s,
            volts[:stop],
            deflection[:stop],
            *mount_rows(model),
            begin,
            actuators=model.actuators,
            sensors=model.sensors.names,
            y=y[:stop],
        )
    return found


def clock_of(campaign: Campaign) -> tuple[float, float]:
    """Start of the first record and end of the last record [s]."""
    headers = [one.header for one in campaign.records]
    return min(h.start_s for h in headers), max(h.start_s + h.duration_s for h in headers)


def origin(record: RecordSource) -> tuple[RecordSource, int, int]:
    """The whole record, and the range of its samples (begin, stop) that a record covers."""
    begin, stop = 0, record.header.samples
    while isinstance(record, Portion):
        begin, stop = begin + record.start, stop + record.start
        record = record.whole
    return record, begin, stop


def mount_rows(model: TableModel) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rows from q (n_g, 6), stiffness (n_g,) N/m, mask of the vertical rows (n_g,), row of each motor (n_u,)."""
    mounts = mount_geometry(model.effective.rig)
    found = map(getattr(model.rig, "mount_of", lambda name: None), model.actuators)
    rows = [mounts.names.index(one[0]) for one in found if one and one[0] in mounts.names]
    return mounts.payload, mounts.stiffness, mounts.along("z"), np.array(rows, int)


def _in_time(record: Record, linear: TableModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Volts (samples, n_u), deflection (samples, n_g), and y (samples, n_y), empty unless every sensor was measured."""
    h = record.header
    u, floor = model_inputs(linear.base, record)
    limit = linear.rig.limits_of(linear.actuators)
    u = np.clip(u, -limit, limit)
    lines = line_response(linear, h.samples, h.sample_rate_Hz)
    predicted, deflection = lines.record_response(u, floor)
    rows = [h.y_names.index(name) for name in linear.sensors.names if name in h.y_names]
    if not rows or not deflection.size:  # nothing measured, or no individual mounts
        return u, deflection, np.zeros((0, 0))
    measured = np.array([name in h.y_names for name in linear.sensors.names])
    residual = record.y[:, rows] - predicted[:, measured]
    residual = residual - residual.mean(0)
    if np.any(residual):
        deflection = deflection + _unmodelled(residual, lines, measured)
    return u, deflection, record.y[:, rows] if np.all(measured) else np.zeros((0, 0))


def _unmodelled(residual: np.ndarray, lines: LineResponse, measured: np.ndarray) -> np.ndarray:
    """(samples, n_g) deflection that explains the difference between the measured and the modelled outputs.

    Nothing is measured beyond the ends of the record. The margins start at zero and are then filled with the response
    to the force found so far. After the record this is a decaying motion, so that no artificial step distorts the last
    seconds.
    """
    samples, fs = len(residual), lines.sample_rate_Hz
    margin = min(round(SETTINGS.margin_s * fs), (lines.padded - samples) // 2, samples - 1)
    inside = slice(margin, margin + samples)
    frequency = lines.omega / (2 * np.pi)
    fade = _fade(frequency)
    at = np.flatnonzero(fade)
    if "corrected" not in lines.kept:
        lines.kept["corrected"] = lines.at(at)
    table: Assembled = lines.kept["corrected"]
    # A force on the payload; its moments are scaled with the r.m.s. lever arms of the mounts.
    size = np.array([1.0, 1.0, 1.0, *np.sqrt(np.mean(table.G[:, 3:N_Q] ** 2, axis=0))])
    H = table.left[:, measured, :N_Q] * size

    def in_time(spectrum: np.ndarray) -> np.ndarray:
        whole = np.zeros((len(frequency), spectrum.shape[1]), complex)
        whole[at] = spectrum
        return scipy.fft.irfft(whole, lines.padded, axis=0)

    continued = np.pad(residual, ((margin, margin), (0, 0)))
    for k in range(SETTINGS.passes):
        spectrum = scipy.fft.rfft(continued, lines.padded, axis=0)[: len(frequency)]
        e = _force(spectrum, H, at, frequency) * fade[at, None]
        if k < SETTINGS.passes - 1:
            force = in_time(e)
            force[margin + samples :] = 0
            response = in_time((H @ scipy.fft.rfft(force, axis=0)[at][:, :, None])[:, :, 0])
            continued += SETTINGS.relaxation * (response[: len(continued)] - continued)
            continued[inside] = residual
    x = table.inverse[:, :, :N_Q] @ (size * e)[:, :, None]
    return in_time(table.deflection(x, np.zeros((len(x), 3, 1)))[:, :, 0])[inside]


def _force(spectrum: np.ndarray, H: np.ndarray, at: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """(n_at, 6) most likely force that causes y (n, n_y), on the lines `at`; H (n_at, n_y, 6)."""
    noise = np.median(np.abs(spectrum[frequency > SETTINGS.noise_from * frequency[-1]]) ** 2, axis=0) / np.log(2)
    noise = np.maximum(noise, 1e-8 * np.mean(np.abs(spectrum) ** 2))
    white, H = spectrum[at] / np.sqrt(noise), H / np.sqrt(noise)[:, None]
    strength = _strength(frequency[at], white, H)[:, None, None]
    HH = np.conj(np.swapaxes(H, 1, 2))
    inner = strength * (H @ HH) + np.eye(white.shape[1])
    return (strength * (HH @ np.linalg.solve(inner, white[:, :, None])))[:, :, 0]


def _fade(frequency: np.ndarray) -> np.ndarray:
    """(n,) weight that rises from zero to one over `low_Hz` and falls to zero over `high_Hz`."""
    up, down = np.interp(frequency, SETTINGS.low_Hz, (0.0, 1.0)), np.interp(frequency, SETTINGS.high_Hz, (1.0, 0.0))
    return np.sin(np.pi / 2 * up) ** 2 * np.sin(np.pi / 2 * down) ** 2


def _strength(frequency: np.ndarray, white: np.ndarray, H: np.ndarray) -> np.ndarray:
    """(n,) variance of the force, per third of an octave, that explains the power in excess of unit noise."""
    band = np.floor(3 * np.log2(frequency / frequency[0])).astype(int)
    lines = np.bincount(band) * white.shape[1]
    excess = np.bincount(band, np.sum(np.abs(white) ** 2, axis=1)) - lines
    made = np.bincount(band, np.sum(np.abs(H) ** 2, axis=(1, 2)))
    least = SETTINGS.least_excess * np.sqrt(np.maximum(lines, 1))
    strength = np.maximum(excess, least) / np.maximum(made, np.finfo(float).tiny)
    return strength[band]


def with_large_motion(motion: dict[str, RecordMotion], model: TableModel) -> dict[str, RecordMotion]:
    """The records with the second-order terms of large rotations, computed from their motion."""
    found = {}
    for name, one in motion.items():
        back = np.linalg.pinv(one.rows)
        q = one.deflection @ back.T
        q_dot = np.gradient(q, 1 / one.sample_rate_Hz, axis=0)
        late = round(model.delay_s * one.sample_rate_Hz)
        u = np.concatenate([np.zeros((late, one.volts.shape[1])), one.volts])[: len(one.volts)]
        large, turned, reading = second_order(model.effective.rig, q, q_dot, u, model.sensors.names)
        found[name] = replace(one, large_force=large, turned_force=turned, turned_reading=reading)
    return found
