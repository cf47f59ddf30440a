"""musyn beside dkpy on the same generalized plant: CPU seconds and peak mu.

    python -m benchmarks.musyn_vs_dkpy

Plant: Skogestad and Postlethwaite's distillation example, as dkpy ships it (its `example_skogestad2006_p325`). dkpy
runs as its own example shows: SLICOT's H-infinity synthesis, mu by linear matrix inequalities at 61 frequencies,
three iterations of a fourth-order fit (and one, since its later controllers are not always stabilising). Peak mu of
every controller is evaluated by the same route, SLICOT's AB13MD on 1e-4 to 1e4 rad/s; where the loop is unstable
that number means nothing. All run on one thread, and `import` is not counted. musyn runs to its own end, with D-K
iteration alone, and until it is proved as good as the mu that dkpy reports.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import dkpy
import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.lti import StateSpace, lft_lower
from avis_ctrl.robust.musyn import musyn
from avis_ctrl.robust.slycot_adapter import mu_upper_slicot
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull

BLOCKS = [ComplexFull(1, 1), ComplexFull(1, 1)]
OMEGA = np.logspace(-4, 4, 800)


def peak_mu(N: StateSpace) -> float:
    """Largest upper bound of AB13MD over the frequencies."""
    structure = BlockStructure.of(BLOCKS).with_performance(2, 2)
    return max(mu_upper_slicot(M, structure) for M in N.frequency_response(OMEGA))


def by_dkpy(example: dict[str, Any], iterations: int) -> tuple[StateSpace, float]:
    """K and the mu that dkpy reports, with the settings of its own example, in one process."""
    iteration = dkpy.DkIterListOrder(
        controller_synthesis=dkpy.HinfSynSlicot(),
        structured_singular_value=dkpy.SsvLmiBisection(n_jobs=1),
        d_scale_fit=dkpy.DScaleFitSlicot(),
        fit_orders=[4] * iterations,
    )
    blocks = [dkpy.ComplexFullBlock(1, 1), dkpy.ComplexFullBlock(1, 1), dkpy.ComplexFullBlock(2, 2)]
    K, _, mu, *_ = iteration.synthesize(example["P"], example["n_y"], example["n_u"], np.logspace(-3, 3, 61), blocks)
    return StateSpace.from_control(K), mu


def by_musyn(P: StateSpace, **options: Any) -> tuple[StateSpace, float]:
    """K and the mu that musyn reports."""
    result = musyn(P, BLOCKS, 2, 2, **options)
    return result.K, result.mu_upper


def main() -> None:
    """Print the table."""
    example = dkpy.example_skogestad2006_p325()
    P = StateSpace.from_control(example["P"])
    runs: dict[str, Callable[[], tuple[StateSpace, float]]] = {
        "dkpy, 3 iterations": lambda: by_dkpy(example, 3),
        "dkpy, 1 iteration": lambda: by_dkpy(example, 1),
        "musyn": lambda: by_musyn(P),
        "musyn, D-K alone": lambda: by_musyn(P, polish=False),
        "musyn, target 1.036": lambda: by_musyn(P, target=1.036),
    }
    print(f"{'':<22}{'CPU s':>8}{'ratio':>8}{'reported mu':>13}{'measured mu':>13}{'stable':>8}{'order':>7}")
    first = 0.0
    for name, run in runs.items():
        with threadpool_limits(1):
            began = time.process_time()
            K, reported = run()
            seconds = time.process_time() - began
        first = first or seconds
        N = lft_lower(P, K)
        print(
            f"{name:<22}{seconds:>8.2f}{first / seconds:>8.1f}{reported:>13.4f}{peak_mu(N):>13.4f}"
            f"{'yes' if N.is_stable() else 'no':>8}{K.nstates:>7d}",
            flush=True,
        )


if __name__ == "__main__":
    main()
