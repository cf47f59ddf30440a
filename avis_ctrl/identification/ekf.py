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
from avis_ctrl.identification.ekf_kernel import Filter, Scaling, Trace, run, step_room
from avis_ctrl.identification.ekf_model import LinearModel, linear_model, source_parameters
from avis_ctrl.identification.ekf_result import EkfHistory, EkfResult, innovation_statistics
from avis_ctrl.identification.ekf_settings import (
    SOURCE_SETTINGS,
    EkfSettings,
    density_matrix,
    measurement_variance,
    process_density,
)
from avis_ctrl.identification.prefilter import prefilter, sensor_inverse
from avis_ctrl.measurement.campaign import Campaign, RecordSource
from avis_ctrl.rigs.rig import Rig


@dataclass(eq=False)
class ParameterFilter:
    """The filter between records: where its parameters are and how well they are known.

    Units of s are those of the starting values: theta = start s, or start exp(s) with settings.parametrisation "log".

    model : its `values` are the start. R : (n_y,). Q : (n_q, n_q). period_s : of the samples.
    """

    model: LinearModel
    settings: EkfSettings
    R: np.ndarray
    Q: np.ndarray
    period_s: float

    def __post_init__(self) -> None:
        n_p, n_x = len(self.model.names), 2 * self.model.n_q
        log = self.settings.parametrisation == "log"
        self.scaling = Scaling(np.array(self.model.values), np.full(n_p, self.settings.lowest), log)
        self.Q = density_matrix(self.Q, self.model.n_q)
        self.state = Filter(np.zeros(n_p) if log else np.ones(n_p), np.zeros(n_x), np.zeros((n_p + n_x,) * 2),
                            np.zeros(n_p, np.int64))
        self._prior()

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

    def _prior(self) -> None:
        n_p = len(self.model.names)
        self.state.W[:] = 0.0
        self.state.W[:n_p, :n_p] = self.settings.prior_share * np.eye(n_p)

    def begin(self, y0: np.ndarray) -> None:
        """Start of a record: payload at rest or at the measured velocity, uncorrelated with the parameters."""
        n_p, n_q = len(self.model.names), self.model.n_q
        if self.settings.reset:
            self._prior()
        W = self.state.W
        W[:, n_p:] = 0.0
        W[n_p:, n_p:] = np.diag(np.repeat([self.settings.q_sigma, self.settings.v_sigma], n_q))
        self.state.x[:] = 0.0
        if self.settings.velocity_from_data and np.any(self.model.H[:, n_q:]):
            self.state.x[n_q:] = np.linalg.pinv(self.model.H[:, n_q:]) @ y0

    def filter(self, u: np.ndarray, y: np.ndarray, keep: int) -> tuple[Trace, int]:
        """One record from its state at hand: what happened, and how many samples were filtered before it failed."""
        n, n_p, n_x = len(y), len(self.model.names), len(self.state.x)
        kept = -(-n // keep)
        trace = Trace(np.zeros((n, y.shape[1])), np.zeros((kept, n_p)), np.zeros((kept, n_p)), np.zeros((kept, n_x)))
        W_Q = noise_root(*self.model.system(self.theta)[:1], self.Q, self.period_s)
        done = run(self.model.arrays(), self.scaling, self.state, W_Q, self.R, np.ascontiguousarray(u),
                   np.ascontiguousarray(y), self.period_s, keep, step_room(self.model.n_q, n_p), trace)
        return trace, done


def noise_root(A: np.ndarray, Q: np.ndarray, h: float) -> np.ndarray:
    """Upper triangular W_Q with W_Q^T W_Q = integral over h of e^(A t) [0 0; 0 Q] e^(A^T t) (Van Loan 1978).

    Computed once for a record, with the parameters at its start: they move it by less than the damping over a sample.
    """
    n_x, n_q = len(A), len(Q)
    scale = np.repeat([h, 1.0], n_q)  # over a sample, q moves by h q'
    A = A * scale / scale[:, None]
    noise = np.zeros((n_x, n_x))
    noise[n_q:, n_q:] = Q
    power = la.expm(np.block([[-A, noise], [np.zeros((n_x, n_x)), A.T]]) * h)
    covariance = power[n_x:, n_x:].T @ power[:n_x, n_x:]
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return np.ascontiguousarray(np.linalg.qr(root * scale, mode="r"))


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
    first = campaign.records[0].header
    if first.u_unit != "V":
        raise InputError("expected commanded voltages in V", field=f"record {first.name}: u_unit", value=first.u_unit)
    inverse = sensor_inverse(rig0, first.y_names, first.y_unit, settings.undo_chain)
    names = source_parameters(rig0) if names is None else tuple(names)
    model = linear_model(rig0, names, first.y_names, first.u_names, inverse.motion)
    R = measurement_variance(settings, rig0, first.y_names, first.y_unit)
    kalman = ParameterFilter(model, settings, R, process_density(settings, rig0), 1 / first.sample_rate_Hz)
    keep = max(1, round(settings.history_s * first.sample_rate_Hz))
    pieces, statistics, ends, begun = [], [], [0.0], kalman.theta
    for source in campaign.records:
        record = source.load()
        data = prefilter(record, inverse, rig0.loop_delay_s, settings.highpass_Hz, settings.highpass_order,
                         settings.settle_s)
        kalman.begin(data.y[0])
        trace, done = kalman.filter(data.u, data.y, keep)
        _check(record.header.name, done, len(data.y), kalman)
        pieces.append(_history(kalman, trace, ends[-1], keep))
        statistics.append(innovation_statistics(trace.innovation))
        ends.append(ends[-1] + len(data.y) * kalman.period_s)
        if progress:
            progress(f"record {record.header.name}: normalised innovation squared "
                     f"{statistics[-1].nis_per_output:.3g} of 1 per output")
    history = EkfHistory(*(np.concatenate(parts) for parts in zip(*pieces, strict=True)), np.array(ends))
    n_p = len(names)
    units = tuple(rig0.parameters()[name].unit for name in names)
    return EkfResult(names, units, begun, kalman.theta, kalman.covariance[:n_p, :n_p], kalman.scaling.logarithmic,
                     settings.prior_share, history, tuple(statistics), kalman.state.guarded.copy(), settings)


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
