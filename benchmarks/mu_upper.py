"""Upper bound of mu: time and value against LMI bisection (cvxpy, Clarabel) and SLICOT's AB13MD.

    python -m benchmarks.mu_upper
"""

from __future__ import annotations

import time

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.robust.mu import mu_upper
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


def main(frequencies: int = 60, compared: int = 3) -> None:
    """Times per matrix; the LMI and SLICOT on the first `compared` matrices only."""
    rng = np.random.default_rng(0)
    print(f"{'blocks':38s} {'mu_upper':>9s} {'LMI':>9s} {'ratio':>7s} {'SLICOT':>9s} {'largest difference':>19s}")
    # Compiled code is loaded before the clock starts.
    mu_upper(np.eye(1), [ComplexScalar()])
    with threadpool_limits(1):
        for name, blocks in CASES.items():
            structure = BlockStructure.of(blocks)
            shape = (frequencies, structure.n_z, structure.n_w)
            M = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
            start = time.perf_counter()
            upper = np.asarray(mu_upper(M, blocks).upper)
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
            print(f"{name:38s} {own * 1e3:6.1f} ms {slow * 1e3:6.0f} ms {slow / own:7.0f} {slicot:>9s} "
                  f"{difference:19.1e}")


if __name__ == "__main__":
    main()
