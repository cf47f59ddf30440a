"""Cause of an unstable closed loop: the axes that move in its unstable mode, and the loops responsible."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy.linalg as la

from avis_ctrl.lti.statespace import StateSpace, gain
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation.discrete import period_map, spectral_radius
from avis_ctrl.simulation.sampled_loop import SampledLoop, lever_arms
from avis_ctrl.summary import joined


@dataclass(frozen=True)
class InstabilityCause:
    """The cause of an instability of the linear sampled loop.

    Attributes
    ----------
    plant : name of the plant. radius : spectral radius of its loop over one sample period.
    frequency_Hz, growth_per_s : of the fastest-growing mode; if only the nonlinear simulation diverges, the growth rate
        is negative and no loop is named.
    axes : coordinates with the largest motion in that mode, in descending order, rotations as displacement of the edge.
    kind : "table" (unstable without control), "controller" (unstable with the design's controller alone), "companions"
        (unstable with the other axes' loops alone), "together" (only with both), "nonlinear" (only the simulation
        diverges).
    loops : axes of the smallest set of other axes' loops whose removal makes this plant stable; empty if there is none.
    """

    plant: str
    radius: float
    frequency_Hz: float
    growth_per_s: float
    axes: tuple[str, ...]
    kind: str
    loops: tuple[str, ...] = ()

    def words(self) -> str:
        """The cause, with frequency and growth rate of the motion."""
        at = f'(plant "{self.plant}", spectral radius {self.radius:.6f})'
        if self.kind == "nonlinear":
            return f"the nonlinear simulation diverges although the linear loop is stable {at}"
        along = joined(self.axes) or "no axis"
        how = (
            f"a motion at {self.frequency_Hz:.3g} Hz, mainly along {along}, grows with a time constant "
            f"of {1 / max(self.growth_per_s, 1e-12):.3g} s {at}"
        )
        loops = f"the skyhook loop{'s' if len(self.loops) > 1 else ''} of {joined(self.loops)}"
        without = f"without {'these loops' if len(self.loops) > 1 else 'that loop'} this plant is stable"
        who = {
            "table": "the table is unstable even without control",
            "controller": "the cause is the controller; this plant is unstable even without the other axes' loops",
            "companions": f"the cause is {loops}; {without}",
            "together": (f"the cause is the controller together with {loops}; {without}")
            if self.loops
            else "the cause is the controller together with the other axes' loops",
        }[self.kind]
        return f"{how}: {who}"


def find_cause(loop: SampledLoop) -> InstabilityCause:
    """Cause of the instability of one plant's loop; no loop is named if the linear loop is stable."""
    values, vectors = la.eig(period_map(loop))
    most = int(np.argmax(np.abs(values)))
    rate = np.log(values[most]) * loop.sample_rate_Hz
    motion = np.abs(vectors[: len(COORDINATES), most]) * lever_arms(loop.plant)
    order = np.argsort(motion)[::-1]
    axes = tuple(COORDINATES[k] for k in order if motion[k] >= 0.3 * motion[order[0]])
    radius = float(np.abs(values[most]))
    kind, loops = _who(loop) if radius >= 1 else ("nonlinear", ())
    return InstabilityCause(loop.name, radius, float(abs(rate.imag)) / (2 * np.pi), float(rate.real), axes, kind, loops)


def _who(loop: SampledLoop) -> tuple[str, tuple[str, ...]]:
    idle = gain(np.zeros(loop.K.D.shape))

    def stable(K: StateSpace, keep: Collection[str]) -> bool:
        return spectral_radius(replace(loop, K=K, loops={a: s for a, s in loop.loops.items() if a in keep})) < 1

    if not stable(idle, ()):
        return "table", ()
    if not stable(loop.K, ()):
        return "controller", ()
    names = tuple(loop.loops)
    fewest = next(
        (
            out
            for size in range(1, len(names) + 1)
            for out in combinations(names, size)
            if stable(loop.K, set(names) - set(out))
        ),
        (),
    )
    return ("companions" if not stable(idle, names) else "together"), fewest
