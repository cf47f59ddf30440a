"""The frequency-domain maximum likelihood fit: 48 frequency responses x 1000 lines x 42 parameters, against a peer.

The peer is scipy.optimize.least_squares on the same whitened residual, with the Jacobian by differences, as one would
write it without an analytic Jacobian. Both start from the same parameters, 5 % off, and must reach the same chi-square.

    python -m benchmarks.maximum_likelihood [--peer]     the peer takes minutes
"""

from __future__ import annotations

import resource
import sys
import time

import numpy as np
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from avis_ctrl.identification.maximum_likelihood import fit
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs import load_rig

LINES, SEED = 1000, 1


def data(model: ResponseModel, rng: np.random.Generator) -> SpectralBlock:
    """All responses of a table with 1 % of noise."""
    omega = 2 * np.pi * np.linspace(0.5, 80.0, LINES)
    n_u, n_y = len(model.actuators), len(model.sensors.names)
    U = np.zeros((LINES, len(model.inputs), n_u), complex)
    U[:, :n_u] = np.eye(n_u)
    Y = model.driven(omega, U, derivative=False).Y
    sigma = 0.01 * np.sqrt(np.mean(np.abs(Y) ** 2, axis=(1, 2)))
    noise = (rng.normal(size=Y.shape) + 1j * rng.normal(size=Y.shape)) / np.sqrt(2)
    return SpectralBlock("responses", omega, U, Y + sigma[:, None, None] * noise).with_noise(
        sigma[:, None, None] ** 2 * np.eye(n_y)
    )


def peer(model: ResponseModel, block: SpectralBlock):
    """The same problem for a general optimiser."""
    assert block.noise is not None
    sigma, scale = np.sqrt(block.noise[:, 0, 0, 0].real), model.values

    def residual(x: np.ndarray) -> np.ndarray:
        e = block.Y - model.at(x * scale).driven(block.omega, block.U, derivative=False).Y
        white = np.sqrt(2) * e / sigma[:, None, None]
        return np.concatenate([white.real.ravel(), white.imag.ravel()])

    # Without bounds its steps along what is not determined leave the parameters that a rig can have.
    return least_squares(residual, np.ones(len(scale)), bounds=(0.5, 1.5))


def main() -> None:
    rig, rng = load_rig("avis"), np.random.default_rng(SEED)
    names = (
        "mass",
        "J1",
        "J2",
        "J3",
        *(f"isolator{i}.{kind}_{axis}" for i in (1, 2, 3, 4) for kind in "kc" for axis in "xyz"),
        *(f"actuator.{motor.name}" for motor in rig.motors),
        *(f"sensor.{name}" for name in rig.geophones.names),
    )
    start = ResponseModel.of(rig, names)
    true = start.at(start.values * (1 + 0.05 * rng.uniform(-1, 1, len(names))))
    block = data(true, rng)
    with threadpool_limits(1):
        fit(start, [block.lines(np.arange(0, LINES, 50))])  # warm caches
        times = []
        for _ in range(5):
            began = time.perf_counter()
            found = fit(start, [block])
            times.append(time.perf_counter() - began)
        print(
            f"{block.Y[0].size} responses x {LINES} lines x {len(names)} parameters, seed {SEED}: "
            f"{np.median(times):.2f} s ({min(times):.2f} to {max(times):.2f}), {found.iterations} iterations, rank "
            f"{found.information.rank}, chi-square per degree of freedom {found.chi2_per_dof:.4f}"
        )
        print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")
        if "--peer" in sys.argv:
            began = time.perf_counter()
            other = peer(start, block)
            seconds = time.perf_counter() - began
            print(
                f"scipy least_squares with differences: {seconds:.1f} s, chi-square {2 * other.cost:.6g} against "
                f"{found.chi2:.6g}; ratio {seconds / np.median(times):.0f}"
            )


if __name__ == "__main__":
    main()
