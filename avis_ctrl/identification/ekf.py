"""Continuous-discrete extended Kalman filter for a rig's parameters (Rademakers, TU/e 2005, chapter 3).

States are (q, q', theta) of eq. 3.3, with theta' = 0; measurements are velocities along the sensors, prefiltered
(section 3.2). Records are filtered one after another, parameters handed on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.ekf_kernel import Filter, ModelArrays, Scaling, Trace, run, step_room
from avis_ctrl.identification.ekf_model import LinearModel, linear_model, source_parameters
from avis_ctrl.identification.ekf_result import EkfHistory, EkfResult, innovation_statistics
from avis_ctrl.identification.ekf_settings import (
    SOURCE_SETTINGS,
    EkfSettings,
    FloorNoise,
    density_matrix,
    floor_noise,
    measurement_variance,
)
from avis_ctrl.identification.prefilter import SensorInverse, prefilter, sensor_inverse
from avis_ctrl.measurement.campaign import Campaign, RecordHeader, RecordSource
from avis_ctrl.rigs.rig import Rig


@dataclass(eq=False)
class ParameterFilter:
    """The filter between records: where its parameters are and how well they are known.

    Units of s are those of the starting values: theta = start s, or start exp(s) with settings.parametrisation "log".

    model : its `values` are the start. R : (n_y,). Q : as the settings' (zero where None). period_s : of the samples.
    floor, rig : floor motion as a disturbance, and the rig whose parameters say how it comes through.
    """

    model: LinearModel
    settings: EkfSettings
    R: np.ndarray
    period_s: float
    floor: FloorNoise | None = None
    rig: Rig | None = None

    def __post_init__(self) -> None:
        self.n_f = 0 if self.floor is None else 3
        n_p, n_x = len(self.model.names), 2 * self.model.n_q + self.n_f
        log = self.settings.parametrisation == "log"
        self.scaling = Scaling(np.array(self.model.values), np.full(n_p, self.settings.lowest), log)
        self.Q = density_matrix(0.0 if self.settings.Q is None else self.settings.Q, self.model.n_q)
        self.state = Filter(np.zeros(n_p) if log else np.ones(n_p), np.zeros(n_x), np.zeros((n_p + n_x,) * 2),
                            np.zeros(n_p, np.int64))
        self.forget()

    @property
    def theta(self) -> np.ndarray:
        """(n_p,) estimate."""
        return self.of(self.state.s)

    def of(self, s: np.ndarray) -> np.ndarray:
        """theta of scaled parameters (..., n_p)."""
        return self.scaling.reference * (np.exp(s) if self.scaling.logarithmic else s)

    @property
    def covariance(self) -> np.ndarray:
        """(n_p + n_x square) of (s, q, q')."""
        return self.state.W.T @ self.state.W

    def forget(self) -> None:
        """The prior covariance about the present estimate."""
        n_p = len(self.model.names)
        self.state.W[:] = 0.0
        self.state.W[:n_p, :n_p] = self.settings.prior_share * np.eye(n_p)

    def begin(self, y0: np.ndarray) -> None:
        """Start of a record: payload at rest or at the measured velocity, uncorrelated with the parameters."""
        n_p, n_q = len(self.model.names), self.model.n_q
        if self.settings.reset:
            self.forget()
        W = self.state.W
        W[:, n_p:] = 0.0
        f_sigma = 0.0 if self.floor is None else np.sqrt(self.floor.density / (2 * self.floor.rate))
        W[n_p:, n_p:] = np.diag(np.repeat([self.settings.q_sigma, self.settings.v_sigma, f_sigma],
                                          [n_q, n_q, self.n_f]))
        self.state.x[:] = 0.0
        if self.settings.velocity_from_data and np.any(self.model.H[:, n_q:]):
            self.state.x[n_q:2 * n_q] = np.linalg.pinv(self.model.H[:, n_q:]) @ y0

    def filter(self, u: np.ndarray, y: np.ndarray, keep: int) -> tuple[Trace, int]:
        """One record from its state at hand: what happened, and how many samples were filtered before it failed."""
        n, n_p, n_x = len(y), len(self.model.names), len(self.state.x)
        kept = -(-n // keep)
        trace = Trace(np.zeros((n, y.shape[1])), np.zeros((kept, n_p)), np.zeros((kept, n_p)), np.zeros((kept, n_x)))
        arrays, A, noise = self._shaped()
        done = run(arrays, self.scaling, self.state, noise_root(A, noise, self.period_s), self.R,
                   np.ascontiguousarray(u), np.ascontiguousarray(y), self.period_s, keep,
                   step_room(self.model.n_q, n_p, self.n_f), trace)
        return trace, done

    def _shaped(self) -> tuple[ModelArrays, np.ndarray, np.ndarray]:
        """Model with its disturbance, and A and the density of the noise on (q, q', f), at the present parameters.

        How the floor comes through is taken from the parameters at the start of a record and kept for its length: it
        colours the noise, and is no source of knowledge about the parameters.
        """
        A, _ = self.model.system(self.theta)
        n_q, n_x = self.model.n_q, len(A)
        noise = np.zeros((n_x + self.n_f, n_x + self.n_f))
        noise[n_q:n_x, n_q:n_x] = self.Q
        if self.floor is None or self.rig is None:
            return self.model.arrays(), A, noise
        G, direct = self.floor.acceleration(
            self.rig.with_parameters(dict(zip(self.model.names, self.theta.tolist(), strict=True))))
        entry = np.vstack([np.zeros((n_q, 3)), direct, np.eye(3)])
        whole = np.zeros(noise.shape)
        whole[:n_x, :n_x], whole[n_q:n_x, n_x:] = A, G
        whole[n_x:, n_x:] = -self.floor.rate * np.eye(3)
        noise += self.floor.density * entry @ entry.T
        return self.model.arrays(G, float(np.exp(-self.floor.rate * self.period_s))), whole, noise


def noise_root(A: np.ndarray, noise: np.ndarray, h: float) -> np.ndarray:
    """Upper triangular W_Q with W_Q^T W_Q = integral over h of e^(A t) noise e^(A^T t) (Van Loan 1978), all (n_x, n_x).

    The filter computes it once for a record, with the parameters at its start: over a sample they hardly move it.
    """
    n_x = len(A)
    power = la.expm(np.block([[-A, noise], [np.zeros((n_x, n_x)), A.T]]) * h)
    covariance = power[n_x:, n_x:].T @ power[:n_x, n_x:]
    # Displacements are smaller than velocities by h; the root is taken of what has a unit diagonal.
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size[size == 0] = 1.0
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2 / np.outer(size, size))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return np.ascontiguousarray(np.linalg.qr(root * size, mode="r"))


def identify_ekf(rig0: Rig, records: Campaign | Sequence[RecordSource], settings: EkfSettings = SOURCE_SETTINGS,
                 names: Sequence[str] | None = None, progress: Callable[[str], None] | None = None) -> EkfResult:
    """Parameters of a rig from its records, by the filter of chapter 3.

    Parameters
    ----------
    rig0 : structure and starting values.
    records : of that rig, filtered in order; u in V.
    names : parameters to estimate, by default the source's 26.

    Raises
    ------
    InputError : records that differ in channels, unit or rate, or that are not of this rig; parameters that the filter
        cannot take; settings out of range.
    ComputationError : the filter diverged; it names record and time.
    """
    campaign = records if isinstance(records, Campaign) else Campaign(rig0.name, tuple(records))
    header = campaign.records[0].header
    names = source_parameters(rig0) if names is None else tuple(names)
    kalman, inverse = _prepare(rig0, header, settings, names)
    keep = max(1, round(settings.history_s * header.sample_rate_Hz))
    for source in campaign.records[:settings.warm_up]:
        _through(kalman, source, inverse, rig0.loop_delay_s, keep)
    kalman.forget()
    pieces, statistics, ends = [], [], [0.0]
    for source in campaign.records:
        trace = _through(kalman, source, inverse, rig0.loop_delay_s, keep)
        pieces.append(_history(kalman, trace, ends[-1], keep))
        statistics.append(innovation_statistics(trace.innovation))
        ends.append(ends[-1] + len(trace.innovation) * kalman.period_s)
        if progress:
            progress(f"record {source.header.name}: normalised innovation squared "
                     f"{statistics[-1].nis_per_output:.3g} per output (1 expected)")
    time, theta, lower, upper = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    history = EkfHistory(time, theta, lower, upper, np.array(ends))
    n_p = len(names)
    units = tuple(rig0.parameters()[name].unit for name in names)
    return EkfResult(names, units, kalman.model.values, kalman.theta, kalman.covariance[:n_p, :n_p],
                     kalman.scaling.logarithmic, settings.prior_share, history, tuple(statistics),
                     kalman.state.guarded.copy(), settings)


def _prepare(rig: Rig, header: RecordHeader, settings: EkfSettings, names: tuple[str, ...]
             ) -> tuple[ParameterFilter, SensorInverse]:
    """The filter for records like this one, and what makes motion of their y."""
    if header.u_unit != "V":
        raise InputError("expected commanded voltages in V", field=f"record {header.name}: u_unit", value=header.u_unit)
    inverse = sensor_inverse(rig, header.y_names, header.y_unit, settings.undo_chain)
    model = linear_model(rig, names, header.y_names, header.u_names, inverse.motion)
    R = measurement_variance(settings, rig, header.y_names, header.y_unit)
    return ParameterFilter(model, settings, R, 1 / header.sample_rate_Hz, floor_noise(settings, rig), rig), inverse


def _through(kalman: ParameterFilter, source: RecordSource, inverse: SensorInverse, delay_s: float, keep: int) -> Trace:
    """One record, prefiltered."""
    record, settings = source.load(), kalman.settings
    data = prefilter(record, inverse, delay_s, settings.highpass_Hz, settings.highpass_order, settings.settle_s)
    kalman.begin(data.y[0])
    trace, done = kalman.filter(data.u, data.y, keep)
    _check(record.header.name, done, len(data.y), kalman)
    return trace


def _check(name: str, done: int, samples: int, kalman: ParameterFilter) -> None:
    if done == samples and np.all(np.isfinite(kalman.theta)):
        return
    worst = int(np.argmax(np.abs(np.nan_to_num(kalman.theta / kalman.scaling.reference, nan=np.inf) - 1))) \
        if len(kalman.theta) else -1
    moved = f", {kalman.model.names[worst]} at {kalman.theta[worst]:.3g}" if worst >= 0 else ""
    raise ComputationError(
        f"the extended Kalman filter diverged in record {name}",
        measured=f"after {done * kalman.period_s:.4g} s of {samples * kalman.period_s:.4g} s{moved}",
        cause="R or Q too small for the errors at the start, or records of another rig",
        next_step="raise R or Q, or take parametrisation = log")


def _history(kalman: ParameterFilter, trace: Trace, begin_s: float, keep: int) -> tuple[np.ndarray, ...]:
    time = begin_s + np.arange(len(trace.s)) * keep * kalman.period_s
    sigma = np.sqrt(trace.variance)
    if kalman.scaling.logarithmic:
        band = [kalman.of(trace.s + sign * 2 * sigma) for sign in (-1, 1)]
    else:
        band = [kalman.of(trace.s) + sign * 2 * sigma * kalman.scaling.reference for sign in (-1, 1)]
    return time, kalman.of(trace.s), *band
