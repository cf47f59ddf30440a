"""The extended Kalman filter beside filterpy's on the same model, data and settings: time per sample, and estimates.

    python -m benchmarks.ekf_vs_filterpy            # filterpy on 2000 samples, ours on these and on 10^6
    python -m benchmarks.ekf_vs_filterpy 20000 100000

The problem is that of Rademakers' chapter 3: 12 states and 26 parameters, 6 velocities, records of 100 s at 1 kHz.
filterpy's ExtendedKalmanFilter leaves the prediction to its user. Here the user computes it as ours does: the Taylor
polynomial of fourth order and its exact derivatives by the parameters, in numpy, with the covariance F P F^T + Q. Its
update is filterpy's own. The ratio is that of one compiled square-root filter to a general-purpose Python library; the
part that is filterpy's own (its update) is timed apart. One thread; compilation, prefilter and data are not counted.
"""

from __future__ import annotations

import resource
import sys
import time

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from threadpoolctl import threadpool_limits

from avis_ctrl.identification.ekf import ParameterFilter, identify_ekf, noise_root
from avis_ctrl.identification.ekf_model import LinearModel, linear_model, source_parameters
from avis_ctrl.identification.ekf_settings import SOURCE_SETTINGS, measurement_variance
from avis_ctrl.identification.prefilter import prefilter, sensor_inverse
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.rig import Rig
from benchmarks.rademakers_records import source_campaign

PERIOD_s, SETS = 1e-3, 10


def wrong_rig(rig: Rig, seed: int = 5) -> Rig:
    """The source's 26 parameters off by up to 25 %."""
    draw = np.random.default_rng(seed)
    return rig.with_parameters(
        {name: rig.parameters()[name].value * (1 + draw.uniform(-0.25, 0.25)) for name in source_parameters(rig)}
    )


def flow(
    model: LinearModel, x: np.ndarray, s: np.ndarray, u: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x after a sample, Phi and Psi: terms (A h)^k / k! of state and sensitivities together."""
    theta, n = model.values * s, model.n_q
    M, C, K = model.matrices(theta)
    A = np.vstack([np.eye(n, 2 * n, n), np.linalg.solve(M, np.hstack([-K, -C]))])
    drive = np.concatenate([np.zeros(n), np.linalg.solve(M, model.T @ u)])
    term, total, Phi, power = x, x.copy(), np.eye(2 * n), np.eye(2 * n)
    sensitivity, Psi = np.zeros((2 * n, len(s))), np.zeros((2 * n, len(s)))
    for k in range(1, 5):
        slope = A @ term + (drive if k == 1 else 0)
        dM, dC, dK = (np.moveaxis(part, 2, 0) for part in model.slopes)
        moved = dM @ slope[n:] + dC @ term[n:] + dK @ term[:n]
        sensitivity = A @ sensitivity
        sensitivity[n:] -= np.linalg.solve(M, moved.T) * model.values
        term, sensitivity, power = slope * h / k, sensitivity * h / k, A @ power * h / k
        total, Psi, Phi = total + term, Psi + sensitivity, Phi + power
    return total, Phi, Psi


def by_filterpy(ours: ParameterFilter, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Estimates s and their variances, seconds in all, and seconds in filterpy's update."""
    model, n_p = ours.model, len(ours.model.names)
    other = ExtendedKalmanFilter(dim_x=n_p + 12, dim_z=y.shape[1])
    H = np.hstack([np.zeros((y.shape[1], n_p)), model.H])
    other.x, other.P = np.concatenate([ours.state.s, ours.state.x]), ours.covariance
    other.R, other.Q = np.diag(ours.R), np.zeros((n_p + 12, n_p + 12))
    noise = np.zeros((12, 12))
    noise[6:, 6:] = SOURCE_SETTINGS.Q * np.eye(6)
    root = noise_root(model.system(ours.theta)[0], noise, PERIOD_s)
    other.Q[n_p:, n_p:] = root.T @ root
    F, updating, began = np.eye(n_p + 12), 0.0, time.process_time()
    for k in range(len(y)):
        before = time.process_time()
        other.update(y[k], lambda x: H, lambda x: H @ x)
        updating += time.process_time() - before
        if k < len(y) - 1:
            x, F[n_p:, n_p:], F[n_p:, :n_p] = flow(model, other.x[n_p:], other.x[:n_p], u[k], PERIOD_s)
            other.x = np.concatenate([other.x[:n_p], x])
            other.P = F @ other.P @ F.T + other.Q
    return other.x[:n_p], np.diag(other.P)[:n_p], time.process_time() - began, updating


def compare(rig: Rig, start: Rig, samples: int) -> None:
    """Both filters on the first samples of one record."""
    record = source_campaign(rig, sets=1, duration_s=samples * PERIOD_s).records[0].load()
    names = record.header.y_names
    u, y = prefilter(record, sensor_inverse(start, names, "V"), start.loop_delay_s)
    R = measurement_variance(SOURCE_SETTINGS, start, names, "V")
    # The first, on ten samples, is for the compiler.
    for count in (10, samples):
        ours = ParameterFilter(linear_model(start, source_parameters(start)), SOURCE_SETTINGS, R, PERIOD_s)
        ours.begin(y[0])
        if count == samples:
            theirs_s, theirs_variance, theirs, updating = by_filterpy(ours, u, y)
        began = time.process_time()
        ours.filter(u[:count], y[:count], count)
        seconds = time.process_time() - began
    variance = np.diag(ours.covariance)[: len(ours.state.s)]
    print(f"{samples} samples, 12 + 26 states, 6 measurements")
    print(f"{'':<30}{'us per sample':>14}{'ratio':>8}")
    print(f"{'filterpy and numpy':<30}{theirs / samples * 1e6:>14.1f}{theirs / seconds:>8.1f}")
    print(f"{'  of which filterpy.update':<30}{updating / samples * 1e6:>14.1f}{updating / seconds:>8.1f}")
    print(f"{'ours':<30}{seconds / samples * 1e6:>14.1f}{1.0:>8.1f}")
    print(
        "largest difference of estimates, in their standard deviations: "
        f"{np.max(np.abs(ours.state.s - theirs_s) / np.sqrt(variance)):.2e}"
    )
    print(f"largest relative difference of variances: {np.max(np.abs(theirs_variance / variance - 1)):.2e}")


def campaign(rig: Rig, start: Rig, samples: int) -> None:
    """Ours through the source's ten records."""
    duration = samples * PERIOD_s / SETS
    data = source_campaign(rig, SETS, duration)
    # Prefilter and statistics included; the compiler has run.
    began, wall = time.process_time(), time.perf_counter()
    result = identify_ekf(start, data, SOURCE_SETTINGS)
    seconds, wall = time.process_time() - began, time.perf_counter() - wall
    found = dict(zip(result.names, result.values, strict=True))
    error = max(abs(found[name] / rig.parameters()[name].value - 1) for name in ("mass", "J1", "J2", "J3"))
    print(
        f"{SETS} records of {duration:g} s: {seconds:.1f} s of processor ({wall:.1f} s of clock), "
        f"{seconds / samples * 1e6:.1f} us per sample; mass and inertias to {error:.1e}"
    )
    print(f"peak memory of the process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def main(arguments: list[str]) -> None:
    """Print both."""
    few, many = (int(word) for word in arguments) if arguments else (2000, 1_000_000)
    rig = load_rig("avis")
    start = wrong_rig(rig)
    with threadpool_limits(1):
        compare(rig, start, few)
        campaign(rig, start, many)


if __name__ == "__main__":
    main(sys.argv[1:])
