"""Time of a whole design against the order of its plant: the Halcyonics table with one to six axes under control.

    python -m benchmarks.design_orders [--axes 1 2 3 4 5 6]

Each line is one `ac.design`: model, synthesis, order reduction, proved bounds of every controller compared, simulation
on the nonlinear table. Weights and uncertainty are those of designs/halcyonics_six_axes.toml; uncertain parameters on
which the axes do not depend are left out. The exponent is that of the time in the order of the plant, by least squares
on logarithms.
"""

from __future__ import annotations

import argparse
import copy
import os
import runpy
import time
from pathlib import Path

import numpy as np

import avis_ctrl as ac

DESIGN = Path(__file__).parents[1] / "designs" / "halcyonics_six_axes.py"
# Each set contains the one before it.
ORDER = ("z", "phi_x", "phi_y", "x", "y", "phi_z")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--axes", type=int, nargs="+", default=[1, 2, 3, 4, 5, 6], choices=range(1, 7))
    asked = parser.parse_args()
    script = runpy.run_path(str(DESIGN))
    print(f"{'axes':>4s} {'order':>5s} {'blocks':>6s} {'states':>6s} {'mu':>6s} {'s':>6s}   "
          f"({os.cpu_count()} processors, load {os.getloadavg()[0]:.1f})", flush=True)
    orders, seconds = [], []
    for count in asked.axes:
        sections = copy.deepcopy(script["sections"])
        sections["keep"] = list(ORDER[:count])
        began = time.perf_counter()
        study = ac.design(script["rig"], **sections)
        took = time.perf_counter() - began
        plant, mu = study.result.plant.synthesis, study.result.controller("mu")
        orders.append(plant.P.nstates)
        seconds.append(took)
        print(f"{count:4d} {orders[-1]:5d} {len(plant.blocks.blocks):6d} {mu.order:6d} {mu.mu.upper:6.3f} {took:6.1f}",
              flush=True)
    if len(orders) > 1:
        print(f"exponent {np.polyfit(np.log(orders), np.log(seconds), 1)[0]:.2f}")


if __name__ == "__main__":
    main()
