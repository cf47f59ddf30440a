"""Bounds of mu: time and value against LMI bisection (cvxpy, Clarabel) and SLICOT's AB13MD.

python -m benchmarks.mu_upper
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.robust.mu import mu
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.slycot_adapter import mu_upper_slicot
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull, ComplexScalar, RealScalar
from benchmarks.mu_by_bisection import mu_upper_by_bisection

CASES = {
    "4 complex scalars": [ComplexScalar()] * 4,
    "8 complex scalars": [ComplexScalar()] * 8,
    "4 real, 4 complex scalars": [RealScalar()] * 4 + [ComplexScalar()] * 4,
    "12 complex scalars, full 4x4": [ComplexScalar()] * 12 + [ComplexFull(4)],
    "real repeated 3, complex, full 2x2": [RealScalar(3), ComplexScalar(), ComplexFull(2)],
    "complex repeated 3, full 2x3": [ComplexScalar(3), ComplexFull(2, 3)],
}


SCALARS = (4, 8, 16, 24)


def both_bounds(batch: int = 20, repeats: int = 5) -> None:
    """Both bounds for complex scalar blocks beside AB13MD, which gives the upper one: the least of some times, ms."""
    print(
        f"{'complex scalars':>15s} {'one':>8s} {'its upper':>9s} {'of a batch':>10s} {'AB13MD':>8s} "
        f"{'ratio one':>9s} {'batch':>6s} {'upper / AB13MD - 1':>24s} {'lower / upper':>16s}"
    )
    rng = np.random.default_rng(0)
    for n in SCALARS:
        blocks = [ComplexScalar()] * n
        M = rng.standard_normal((batch, n, n)) + 1j * rng.standard_normal((batch, n, n))
        one, upper, many, slicot = (
            min(_seconds(call) for _ in range(repeats)) * 1e3 / batch
            for call in (
                lambda M=M, blocks=blocks: [mu(m, blocks) for m in M],
                lambda M=M, blocks=blocks: [upper_bound(m[None, None], BlockStructure.of(blocks)) for m in M],
                lambda M=M, blocks=blocks: mu(M, blocks),
                lambda M=M, blocks=blocks: [mu_upper_slicot(m, blocks) for m in M],
            )
        )
        found, peer = mu(M, blocks), np.array([mu_upper_slicot(m, blocks) for m in M])
        above, ratio = np.asarray(found.upper) / peer - 1, np.asarray(found.lower) / found.upper
        print(
            f"{n:15d} {one:8.2f} {upper:9.2f} {many:10.2f} {slicot:8.2f} {slicot / one:9.1f} {slicot / many:6.1f} "
            f"{above.min():11.1e} .. {above.max():8.1e} {ratio.min():7.4f} .. {ratio.max():6.4f}"
        )


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def main(frequencies: int = 60, compared: int = 3) -> None:
    """Times per matrix; the LMI and SLICOT on the first `compared` matrices only."""
    rng = np.random.default_rng(0)
    print(f"{'blocks':38s} {'own':>9s} {'LMI':>9s} {'ratio':>7s} {'SLICOT':>9s} {'largest difference':>19s}")
    # Compiled code is loaded before the clock starts.
    mu(np.eye(2), [ComplexScalar()] * 2)
    with threadpool_limits(1):
        for name, blocks in CASES.items():
            structure = BlockStructure.of(blocks)
            shape = (frequencies, structure.n_z, structure.n_w)
            M = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
            start = time.perf_counter()
            upper = upper_bound(M[:, None], structure).beta
            own = (time.perf_counter() - start) / frequencies
            start = time.perf_counter()
            lmi = np.array([mu_upper_by_bisection(m, blocks) for m in M[:compared]])
            slow = (time.perf_counter() - start) / compared
            slicot = "-"
            if all(b.rows == b.cols and not b.repeated for b in structure.blocks):
                start = time.perf_counter()
                for m in M[:compared]:
                    mu_upper_slicot(m, blocks)
                slicot = f"{(time.perf_counter() - start) / compared * 1e3:.1f} ms"
            difference = np.max(np.abs(lmi / upper[:compared] - 1))
            print(
                f"{name:38s} {own * 1e3:6.1f} ms {slow * 1e3:6.0f} ms {slow / own:7.0f} {slicot:>9s} {difference:19.1e}"
            )
        both_bounds()


if __name__ == "__main__":
    main()
