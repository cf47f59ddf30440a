"""Continuous-discrete extended Kalman filter for a rig's parameters (Rademakers, TU/e 2005, chapter 3).

States are (q, q', theta) of eq. 3.3, with theta' = 0; measurements are velocities along the sensors, prefiltered
(section 3.2). Records are filtered one after another; the parameters carry over.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.ekf_kernel import Filter, Plant, Trace, run
from avis_ctrl.identification.ekf_model import LinearModel, linear_model, source_parameters
from avis_ctrl.identification.ekf_result import EkfHistory, EkfResult, innovation_statistics
from avis_ctrl.identification.ekf_settings import (
    SOURCE_SETTINGS,
    EkfSettings,
    FloorNoise,
    floor_noise,
    measurement_variance,
)
from avis_ctrl.identification.prefilter import SensorInverse, prefilter, sensor_inverse
from avis_ctrl.measurement.campaign import Campaign, RecordSource
from avis_ctrl.rigs.rig import Rig


@dataclass(eq=False)
class ParameterFilter:
    """The filter between records: its parameters and their covariance, both relative to the starting values.

    model : its `values` are the start. R : (n_y,). period_s : sample period. floor, rig : floor motion as a
        disturbance, and the rig whose parameters determine its transmission.
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
        self.state = Filter(np.ones(n_p), np.zeros(n_x), np.zeros((n_p + n_x,) * 2), np.zeros(n_p, np.int64))
        self.forget()

    @property
    def theta(self) -> np.ndarray:
        """(n_p,) estimate."""
        return self.model.values * self.state.s

    @property
    def covariance(self) -> np.ndarray:
        """(n_p + n_x square) covariance of (theta over its start, x)."""
        return self.state.W.T @ self.state.W

    def forget(self) -> None:
        """Reset to the prior covariance about the present estimate."""
        n_p = len(self.model.names)
        self.state.W[:] = 0.0
        self.state.W[:n_p, :n_p] = self.settings.prior_share * np.eye(n_p)

    def begin(self, y0: np.ndarray) -> None:
        """Start of a record: payload at rest or at the measured velocity, uncorrelated with the parameters."""
        n_p, n_q, settings = len(self.model.names), self.model.n_q, self.settings
        if settings.reset:
            self.forget()
        W = self.state.W
        W[:, n_p:] = 0.0
        f_sigma = 0.0 if self.floor is None else np.sqrt(self.floor.density / (2 * self.floor.rate))
        W[n_p:, n_p:] = np.diag(np.repeat([settings.q_sigma, settings.v_sigma, f_sigma], [n_q, n_q, self.n_f]))
        self.state.x[:] = 0.0
        self.state.x[n_q : 2 * n_q] = np.linalg.pinv(self.model.H[:, n_q:]) @ y0

    def filter(self, u: np.ndarray, y: np.ndarray, keep: int) -> tuple[Trace, int]:
        """Filter one record from the present state: its trace, and how many samples were filtered before a failure."""
        n, n_p, n_x, kept = len(y), len(self.model.names), len(self.state.x), -(-len(y) // keep)
        trace = Trace(np.zeros((n, y.shape[1])), np.zeros((kept, n_p)), np.zeros((kept, n_p)), np.zeros((kept, n_x)))
        plant, A, noise = self._shaped()
        done = run(
            plant,
            self.state,
            noise_root(A, noise, self.period_s),
            self.R,
            np.ascontiguousarray(u),
            np.ascontiguousarray(y),
            self.period_s,
            keep,
            trace,
        )
        return trace, done

    def _shaped(self) -> tuple[Plant, np.ndarray, np.ndarray]:
        """Model with its disturbance, and A and the density of the noise on (q, q', f), at the present parameters.

        The transmission of the floor motion is computed from the parameters at the start of a record and kept for its
        length: it colours the noise, and is not used as information about the parameters.
        """
        model, n_q, n_x, n_f = self.model, self.model.n_q, 2 * self.model.n_q, self.n_f
        A, noise, G, decay = np.zeros((n_x + n_f,) * 2), np.zeros((n_x + n_f,) * 2), np.zeros((n_q, n_f)), 1.0
        A[:n_x, :n_x] = model.system(self.theta)[0]
        noise[n_q:n_x, n_q:n_x] = (self.settings.Q or 0.0) * np.eye(n_q)
        if self.floor is not None and self.rig is not None:
            G, direct = self.floor.acceleration(
                self.rig.with_parameters(dict(zip(model.names, self.theta.tolist(), strict=True)))
            )
            A[n_q:n_x, n_x:], A[n_x:, n_x:] = G, -self.floor.rate * np.eye(n_f)
            entry = np.vstack([np.zeros((n_q, n_f)), direct, np.eye(n_f)])
            noise += self.floor.density * entry @ entry.T
            decay = float(np.exp(-self.floor.rate * self.period_s))
        H = np.hstack([model.H, np.zeros((len(model.H), n_f))])
        # Copies, because numba compiles the filter again for a read-only array or another memory layout.
        arrays = (*model[2:4], model.values, model.T, H, G)
        constant, slopes, reference, T, H, G = (np.array(one, order="C") for one in arrays)
        return Plant(constant, slopes, reference, T, H, G, decay, self.settings.lowest), A, noise


def noise_root(A: np.ndarray, noise: np.ndarray, h: float) -> np.ndarray:
    """Upper triangular W_Q with W_Q^T W_Q = integral over h of e^(A t) noise e^(A^T t) (Van Loan 1978), all (n_x, n_x).

    The filter computes it once per record, with the parameters at its start, which hardly affect it over one sample.
    """
    n_x = len(A)
    power = la.expm(np.block([[-A, noise], [np.zeros((n_x, n_x)), A.T]]) * h)
    covariance = power[n_x:, n_x:].T @ power[:n_x, n_x:]
    # Displacements are smaller than velocities by h: scale to a unit diagonal before taking the root.
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size[size == 0] = 1.0
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2 / np.outer(size, size))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return np.ascontiguousarray(np.linalg.qr(root * size, mode="r"))


def identify_ekf(
    rig0: Rig,
    records: Campaign | Sequence[RecordSource],
    settings: EkfSettings = SOURCE_SETTINGS,
    names: Sequence[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> EkfResult:
    """Parameters of a rig from its records, by the filter of chapter 3.

    Parameters
    ----------
    rig0 : structure and starting values.
    records : of that rig, filtered in order, from rest; u in V.
    names : parameters to estimate, by default the source's 26.

    Raises
    ------
    InputError : records that differ in channels, unit or rate, or that are not of this rig; parameters that the filter
        cannot estimate; settings out of range.
    ComputationError : the filter diverged; the message gives record and time.
    """
    campaign = records if isinstance(records, Campaign) else Campaign(rig0.name, tuple(records))
    header = campaign.records[0].header
    if header.u_unit != "V":
        raise InputError("expected commanded voltages in V", field=f"record {header.name}: u_unit", value=header.u_unit)
    inverse = sensor_inverse(rig0, header.y_names, header.y_unit)
    model = linear_model(
        rig0, source_parameters(rig0) if names is None else names, header.y_names, header.u_names, inverse.motion
    )
    R = measurement_variance(settings, rig0, header.y_names, header.y_unit)
    kalman = ParameterFilter(model, settings, R, 1 / header.sample_rate_Hz, floor_noise(settings, rig0), rig0)
    keep = max(1, round(settings.history_s * header.sample_rate_Hz))
    for source in campaign.records[: settings.warm_up]:
        _through(kalman, source, inverse, rig0.loop_delay_s, keep)
    kalman.forget()
    kalman.state.guarded[:] = 0
    pieces, statistics, ends = [], [], [0.0]
    for source in campaign.records:
        trace = _through(kalman, source, inverse, rig0.loop_delay_s, keep)
        theta, band = model.values * trace.s, 2 * np.sqrt(trace.variance) * model.values
        time = ends[-1] + np.arange(len(theta)) * keep * kalman.period_s
        pieces.append((time, theta, theta - band, theta + band))
        statistics.append(innovation_statistics(trace.innovation))
        ends.append(ends[-1] + len(trace.innovation) * kalman.period_s)
        if progress:
            progress(
                f"record {source.header.name}: normalised innovation squared "
                f"{statistics[-1].nis_per_output:.3g} per output (1 expected)"
            )
    time, theta, lower, upper = (np.concatenate(parts) for parts in zip(*pieces, strict=True))
    history = EkfHistory(time, theta, lower, upper, np.array(ends))
    n_p = len(model.names)
    units = tuple(rig0.parameters()[name].unit for name in model.names)
    return EkfResult(
        model.names,
        units,
        model.values,
        kalman.theta,
        kalman.covariance[:n_p, :n_p],
        history,
        tuple(statistics),
        kalman.state.guarded.copy(),
        settings,
    )


def _through(kalman: ParameterFilter, source: RecordSource, inverse: SensorInverse, delay_s: float, keep: int) -> Trace:
    """Prefilter and filter one record."""
    settings, names = kalman.settings, kalman.model.names
    u, y = prefilter(source.load(), inverse, delay_s, settings.highpass_Hz, settings.highpass_order)
    kalman.begin(y[0])
    trace, done = kalman.filter(u, y, keep)
    if done < len(y) or not np.all(np.isfinite(kalman.theta)):
        far = np.abs(np.nan_to_num(kalman.state.s, nan=np.inf) - 1)
        moved = f", {names[far.argmax()]} at {kalman.theta[far.argmax()]:.3g}" if names else ""
        raise ComputationError(
            f"the extended Kalman filter diverged in record {source.header.name}",
            measured=f"after {done * kalman.period_s:.4g} s of {len(y) * kalman.period_s:.4g} s{moved}",
            cause="R or Q too small for the errors at the start, or records of another rig",
            next_step="raise R or Q",
        )
    return trace
