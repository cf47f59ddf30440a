"""Do the two routes of `closed_loop` agree? Braking loops from soft to hard on all five tables, several draws of each.

python -m benchmarks.own_tables.agreement [SECONDS] [DRAWS]
"""

import math
import sys

from . import closed_loop, tables


def loops(seconds: float, draws: int):
    """Table, draw, brake over critical damping at 2 Hz, verdict of the eigenvalues, verdict of the simulation."""
    for name, make in tables.NOMINAL.items():
        nominal = make()
        for seed in range(1, draws + 1):
            real = tables.truth(name, seed)
            for brake in (0.05, 0.3, 1.0, 2.0, 5.0, 30.0, 200.0):
                loop = closed_loop.velocity_feedback(nominal, brake * nominal.mass_kg * 4 * math.pi)
                yield name, seed, brake, closed_loop.linearise(real, loop), closed_loop.run(real, loop, seconds, seed)


if __name__ == "__main__":
    seconds, draws = (float(sys.argv[1]) if len(sys.argv) > 1 else 40.0), (int(sys.argv[2]) if len(sys.argv) > 2 else 1)
    wrong = total = unstable = 0
    for name, seed, brake, linear, shown in loops(seconds, draws):
        mode = linear.least_stable
        total, wrong, unstable = total + 1, wrong + (linear.stable != shown.stable), unstable + (not linear.stable)
        verdict = f"simulation {'stable' if shown.stable else 'UNSTABLE'} ({shown.why})"
        where = f"{mode.growth_per_s:+.3f} 1/s, {mode.frequency_Hz:.2f} Hz, {mode.axis}"
        print(f"{name:14s} draw {seed} brake {brake:6.2f}: radius {linear.spectral_radius:.6f} ({where}); {verdict}",
              "" if linear.stable == shown.stable else "DIFFER", flush=True)  # fmt: skip
    print(f"{total} loops, {unstable} of them unstable, {wrong} verdicts differ")
