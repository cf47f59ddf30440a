"""H-infinity synthesis beside SLICOT's SB10AD (what python-control's hinfsyn calls).

    python -m benchmarks.hinfsyn [--limit SECONDS]

For each plant: seconds, the gamma each claims, and the norm that its closed loop is measured to have by
SLICOT's AB13DD (inf: unstable). A claim counts only where the norm confirms it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable

import control
import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.lti import StateSpace, connect, gain, lft_lower, summing_junction, tf
from avis_ctrl.robust.hinfsyn import hinfsyn

TWO_PI = 2 * np.pi


def disturbance_process() -> tuple[StateSpace, int, int]:
    """S/KS problem of Skogestad and Postlethwaite, example 2.17 (4 states)."""
    G = tf([200], np.polymul([10, 1], np.polymul([0.05, 1], [0.05, 1])), ["u"], ["g"])
    return (
        connect(
            [
                G,
                summing_junction("e", ["r", "-g"]),
                tf([1 / 1.5, 10], [1, 1e-3], ["e"], ["wp"]),
                gain([[1.0]], ["u"], ["wu"]),
                gain([[1.0]], ["e"], ["y"]),
            ],
            ["r", "u"],
            ["wp", "wu", "y"],
        ),
        1,
        1,
    )


def mounted_axis(axis: str, w0: float, zeta: float) -> StateSpace:
    """x = (2 zeta w0 s + w0^2) / d floor + w0^2 / d force, d = s^2 + 2 zeta w0 s + w0^2, in observer form."""
    A, B = [[0.0, -(w0**2)], [1.0, -2 * zeta * w0]], [[w0**2, w0**2], [2 * zeta * w0, 0.0]]
    return StateSpace(A, B, [[0.0, 1.0]], [[0.0, 0.0]], 0.0, [f"floor_{axis}", f"force_{axis}"], [f"x_{axis}"])


def isolation_table() -> tuple[StateSpace, int, int]:
    """A table of two degrees of freedom, z and phi_x, on soft mounts: actuator lags, geophones, weights (18 states)."""
    parts: dict[str, StateSpace] = {}
    for axis, f0, zeta in (("z", 2.1, 0.05), ("phi", 3.4, 0.06)):
        parts[f"table_{axis}"] = mounted_axis(axis, TWO_PI * f0, zeta)
        parts[f"lag_{axis}"] = tf([TWO_PI * 150], [1, TWO_PI * 150], [f"drive_{axis}"], [f"lagged_{axis}"])
        parts[f"sum_{axis}"] = summing_junction(f"force_{axis}", [f"lagged_{axis}", f"wd_{axis}"])
        parts[f"unc_{axis}"] = tf([1, TWO_PI * 8], [0.1, TWO_PI * 80], [f"drive_{axis}"], [f"zd_{axis}"])
        parts[f"geo_{axis}"] = tf([1, 0, 0], [1, 1.4 * TWO_PI, TWO_PI**2], [f"x_{axis}"], [f"seen_{axis}"])
        parts[f"mix_{axis}"] = summing_junction(f"y_{axis}", [f"seen_{axis}", f"n_{axis}"])
        parts[f"noise_{axis}"] = gain([[0.01]], [f"wn_{axis}"], [f"n_{axis}"])
        parts[f"floor_{axis}"] = gain([[1.0]], [f"w_{axis}"], [f"floor_{axis}"])
        parts[f"wp_{axis}"] = tf(
            [0.5, 0, TWO_PI**2 * 4], [1, TWO_PI * 1.0, TWO_PI**2 * 0.5], [f"x_{axis}"], [f"zp_{axis}"]
        )
        parts[f"wu_{axis}"] = tf([1, TWO_PI * 10], [1, TWO_PI * 1000], [f"u_{axis}"], [f"zu_{axis}"])
        parts[f"in_{axis}"] = gain([[1.0]], [f"u_{axis}"], [f"drive_{axis}"])
    axes = ("z", "phi")
    inputs = [f"{name}_{axis}" for name in ("wd", "w", "wn", "u") for axis in axes]
    outputs = [f"{name}_{axis}" for name in ("zd", "zp", "zu", "y") for axis in axes]
    return connect(parts, inputs, outputs), 2, 2


def random_modes(n: int, n_w: int, ncon: int, seed: int) -> tuple[StateSpace, int, int]:
    """Lightly damped modes with random shapes, every signal weighted by a constant."""
    rng = np.random.default_rng(seed)
    w0, zeta = TWO_PI * 10.0 ** rng.uniform(-0.5, 2, n // 2), rng.uniform(0.005, 0.2, n // 2)
    A = np.zeros((n, n))
    for k, (w, d) in enumerate(zip(w0, zeta, strict=True)):
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[0, w], [-w, -2 * d * w]]
    root = np.sqrt(np.repeat(w0, 2))
    B, C = rng.standard_normal((n, n_w + ncon)) * root[:, None], rng.standard_normal((n_w + ncon, n)) * root / 10
    B[::2] = 0
    D = np.zeros((n_w + ncon, n_w + ncon))
    D[n_w - ncon : n_w, n_w:] = np.eye(ncon)
    D[n_w:, n_w - ncon : n_w] = np.eye(ncon)
    D[:n_w, :n_w] = 0.2 * rng.standard_normal((n_w, n_w))
    return StateSpace(A, B, C, D), ncon, ncon


PLANTS: dict[str, Callable[[], tuple[StateSpace, int, int]]] = {
    "disturbance process": disturbance_process,
    "isolation table z/phi_x": isolation_table,
    "10 modes, 6 exogenous": lambda: random_modes(20, 6, 2, 1),
    "30 modes, 16 exogenous": lambda: random_modes(60, 16, 4, 2),
}


def measured(P: StateSpace, K: StateSpace) -> float:
    """Closed-loop norm by SLICOT's AB13DD; inf where a closed-loop pole is not in the left half plane."""
    closed = lft_lower(P, K)
    return float(control.linfnorm(closed.to_control(), tol=1e-8)[0]) if closed.is_stable() else np.inf


def slicot(name: str, queue: multiprocessing.Queue) -> None:
    """SB10AD on one plant, its answer put in the queue (a process of its own, since it cannot be interrupted)."""
    P, nmeas, ncon = PLANTS[name]()
    with threadpool_limits(1):
        began = time.perf_counter()
        try:
            K, _, gamma, _ = control.hinfsyn(P.to_control(), nmeas, ncon)
        except Exception as error:  # any of slycot's own errors is a result here
            queue.put((time.perf_counter() - began, np.nan, np.nan, str(error)[:60]))
            return
        queue.put((time.perf_counter() - began, gamma, measured(P, StateSpace.from_control(K)), ""))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limit", type=float, default=60.0, help="seconds allowed to SB10AD on each plant")
    limit = parser.parse_args().limit
    print(
        f"{'plant':26s} {'states':>6s} | {'avis s':>7s} {'optimum':>9s} {'claimed':>9s} {'measured':>9s} "
        f"{'fastest rad/s':>13s} | {'sb10ad s':>8s} {'claimed':>9s} {'measured':>9s} | {'time ratio':>10s}"
    )
    for name, build in PLANTS.items():
        P, nmeas, ncon = build()
        with threadpool_limits(1):
            hinfsyn(P, nmeas, ncon)
            began = time.perf_counter()
            ours = hinfsyn(P, nmeas, ncon)
            seconds = time.perf_counter() - began
        queue: multiprocessing.Queue = multiprocessing.Queue()
        process = multiprocessing.Process(target=slicot, args=(name, queue))
        process.start()
        try:
            theirs = queue.get(timeout=limit)
        except Exception:  # queue.Empty: the limit was reached
            theirs = (limit, np.nan, np.nan, "time limit")
            process.terminate()
        process.join()
        print(
            f"{name:26s} {P.nstates:6d} | {seconds:7.3f} {ours.gamma_optimal_bounds[1]:9.5g} {ours.gamma:9.5g} "
            f"{measured(P, ours.K):9.5g} {ours.fastest_pole:13.4g} | {theirs[0]:8.3f} {theirs[1]:9.5g} "
            f"{theirs[2]:9.5g} | {theirs[0] / seconds:10.3g} {theirs[3]}"
        )


if __name__ == "__main__":
    main()
