"""Time of a complete design against the order of the generalized plant.

    python -m benchmarks.design_orders [--axes 1 2 3 4 5 6]

The loaded Halcyonics table with one to six controlled axes. Each row is one `ac.design`: model, synthesis, order
reduction, bounds of mu for all controllers compared, simulation of the nonlinear table. Weights and uncertainty are
those of designs/halcyonics_six_axes.toml, without the parameters that do not affect the chosen axes. The last line is
the exponent p of time = c order^p, fitted by least squares to the logarithms.
"""

from __future__ import annotations

import argparse
import os
import runpy
import time
from pathlib import Path

import numpy as np

import avis_ctrl as ac

DESIGN = Path(__file__).parents[1] / "designs" / "halcyonics_six_axes.py"
# Axes are added in this sequence.
AXES = ("z", "phi_x", "phi_y", "x", "y", "phi_z")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--axes", type=int, nargs="+", default=[1, 2, 3, 4, 5, 6], choices=range(1, 7))
    arguments = parser.parse_args()
    script = runpy.run_path(str(DESIGN))
    print(f"{os.cpu_count()} processors, load average {os.getloadavg()[0]:.1f}")
    print(
        f"{'axes':>4s} {'plant order':>11s} {'blocks':>6s} {'controller order':>16s} {'mu upper':>8s} {'time [s]':>8s}"
    )
    orders, seconds = [], []
    for count in arguments.axes:
        began = time.perf_counter()
        study = ac.design(script["rig"], **{**script["sections"], "keep": list(AXES[:count])})
        elapsed = time.perf_counter() - began
        plant, mu = study.result.plant.synthesis, study.result.controller("mu")
        orders.append(plant.P.nstates)
        seconds.append(elapsed)
        print(
            f"{count:4d} {orders[-1]:11d} {len(plant.blocks.blocks):6d} {mu.order:16d} {mu.mu.upper:8.3f} "
            f"{elapsed:8.1f}",
            flush=True,
        )
    if len(orders) > 1:
        print(f"exponent {np.polyfit(np.log(orders), np.log(seconds), 1)[0]:.2f}")


if __name__ == "__main__":
    main()
