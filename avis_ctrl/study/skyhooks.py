"""Skyhook controllers for comparison: by the classical rule, and tuned for the worst case of the uncertainty set.

A comparison with a badly tuned skyhook is worthless. The search therefore starts from the classical tunings and keeps
them as candidates. Tunings are ranked by the same bound over the whole set as in the report.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.classical.skyhook import Skyhook, critical_damping
from avis_ctrl.classical.tuning import Merit, Scenarios, Search, TuningRange
from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.norms import decibels
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.robust.mu_gain import worst_gain
from avis_ctrl.robust.mu_peak import MuPeak, worst_case_gain
from avis_ctrl.simulation.sampled_loop import lever_arms
from avis_ctrl.study.analysis import SETTINGS as ANALYSIS
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.design_result import Candidate
from avis_ctrl.study.plant import DesignPlant


@dataclass(frozen=True)
class SkyhookSettings:
    """The classical tuning, and limits of the search for the worst case. Every limit is a count, not a time.

    corners_Hz : corners of the classical loops: tilt corner well below the table's modes, roll-off well above the
        bandwidth of its loops.
    frequencies_Hz : at which tunings are compared: densest from 5.5 to 200 Hz, up to the highest roll-off of a search.
    samples : number of plants on the boundary of the set at the start of the search.
    rounds : maximum number of times that the worst case of the best tuning is added to the samples.
    agreement : relative excess of a worst case over the samples' largest value above which it is added to them.
    room : fraction of the limit that is the target of the search, so that the worst case ends below the limit.
    restrained : fraction of the target, and of the limit times room, above which a peak counts as at it. Below it the
        limit does not restrain the search; above it nothing is left to gain.
    certified : number of tunings, besides the classical one, for which the bound over the whole set is computed; if a
        bound is above the limit, its worst case and frequency are added to the samples for the next tuning.
    beside : frequencies added around the worst one, as factors, so that a narrow peak is not missed.
    ascents, ascent_steps : effort of the search for a worst case at each frequency.
    """

    corners_Hz: tuple[float, float] = (0.1, 100.0)
    frequencies_Hz: tuple[float, ...] = (
        *np.geomspace(0.1, 5.0, 20).tolist(),
        *np.geomspace(5.5, 200.0, 44).tolist(),
        300.0,
        400.0,
    )
    samples: int = 16
    rounds: int = 12
    agreement: float = 0.01
    room: float = 0.99
    restrained: float = 0.97
    certified: int = 8
    beside: tuple[float, ...] = (0.95, 0.98, 0.99, 1.0, 1.01, 1.02, 1.05)
    ascents: int = 2
    ascent_steps: int = 12


SETTINGS = SkyhookSettings()


def classical_skyhook(plant: DesignPlant, rig: Rig, design: Design) -> Candidate:
    """Critical damping of each decoupled axis, with the usual corners."""
    loops = classical_loops(plant, rig, design)
    return Candidate(
        "skyhook_classical", "skyhook, critical damping", "skyhook", loops.controller(), (in_words(loops),)
    )


def classical_loops(plant: DesignPlant, rig: Rig, design: Design) -> Skyhook:
    """The loops of `classical_skyhook`."""
    return Skyhook(plant.axes, critical_gains(rig, design.keep), *SETTINGS.corners_Hz)


def tuned_skyhook(
    plant: DesignPlant, rig: Rig, design: Design, peak_limit: float, settings: SkyhookSettings = SETTINGS
) -> Candidate:
    """The best skyhook found for a limit on the worst-case peak: gains of all axes and both corners.

    Of the tunings that meet the limit, it has the smallest worst-case transmissibility in the band. If none meets it,
    it has the smallest worst-case peak, and a note states this. By the bounds over the whole set it is never worse than
    critical damping with the usual corners.

    Raises ComputationError: no tuning tried, including the classical ones, is stable on the nominal plant.
    """
    evaluation = WorstCaseTuning(plant, design, peak_limit, settings)
    classical = classical_loops(plant, rig, design)
    ranked = [(evaluation.certified(classical)[0], classical)]
    task, highest = evaluation.search(rig), settings.room * peak_limit
    target = highest
    points = [task.search.point(1.0, (classical.tilt_corner_Hz, classical.roll_off_Hz))]
    for _ in range(settings.certified):
        found, points, task = evaluation.tuned(task, points, target)
        loops = task.search.skyhook(plant.axes, found)
        if loops in [known for _, known in ranked[1:]]:
            break
        bound, worst = evaluation.certified(loops)
        ranked.append((bound, loops))
        if worst is None:
            break
        if bound.meets:
            # What the bound leaves below the limit is given to the search, if its target restrained it.
            if bound.peak < settings.restrained * target or bound.peak > settings.restrained * highest:
                break
            target = min(highest, target * highest / bound.peak)
            continue
        task = evaluation.with_worst_case(task, worst)
        # The bound lies above the worst case found: the search has to stay below the limit by the same ratio.
        attained = max(worst.lower, evaluation.worst(task, found)[0].peak)
        target = highest * min(1.0, attained / bound.peak) if np.isfinite(bound.peak) else highest
    best, loops = min(ranked, key=lambda one: one[0].key())
    if best.unstable:
        raise ComputationError(
            "no skyhook tuning tried is stable on the nominal plant",
            measured=f"gains from {task.search.gain_factor[0]:g} to {task.search.gain_factor[1]:g} "
            "times critical damping",
            cause="the phase of the sensors and the delay turns damping into excitation",
            next_step="change the corners in [skyhook], or use sensors with a lower corner",
        )
    low, high = evaluation.band_Hz
    aim = (
        f"tuned for the smallest worst-case transmissibility from {low:g} to {high:g} Hz with a worst-case peak of at "
        f"most {decibels(peak_limit):+.2f} dB, not for mu; the drive voltage is not limited"
    )
    notes = [in_words(loops), *([aim] if best.meets else []), *at_limits(loops, task.search)]
    if loops is classical:
        notes.append("this is critical damping with the usual corners: none of the other tunings tried is better")
    if not best.meets:
        reached = (
            f"this one has the lowest, {decibels(best.peak):+.2f} dB"
            if np.isfinite(best.peak)
            else "none is proved stable for the whole uncertainty set"
        )
        notes.append(
            f"no skyhook tuning found has a worst-case peak below {decibels(peak_limit):+.2f} dB: {reached} (tuned for "
            "this peak, not for mu; the drive voltage is not limited)"
        )
    return Candidate("skyhook", "skyhook, tuned", "skyhook", loops.controller(), tuple(notes))


@dataclass(frozen=True, eq=False)
class WorstCaseTuning:
    """Search for a tuning of skyhook loops on a plant, and the bounds that rank the tunings."""

    plant: DesignPlant
    design: Design
    peak_limit: float
    settings: SkyhookSettings

    @property
    def band_Hz(self) -> tuple[float, float]:
        """Band of the design's limit on transmissibility."""
        low, high = self.design.transmissibility.band_Hz
        return low, high

    def search(self, rig: Rig) -> Search:
        """The search over the design's range on sampled plants."""
        asked, plant = self.design.skyhook, self.plant
        scenarios = Scenarios.sample(
            plant.full,
            plant.floor_velocities,
            plant.velocities,
            2 * np.pi * np.array(self.settings.frequencies_Hz),
            self.settings.samples,
            self.design.simulation.seed,
        )
        search = TuningRange(
            critical_gains(rig, self.design.keep),
            tilt_corner_Hz=_pair(asked.tilt_corner_Hz),
            roll_off_Hz=_pair(asked.roll_off_Hz),
        )
        return Search(scenarios, plant.axes, search, self.band_Hz)

    def tuned(
        self, task: Search, points: Sequence[np.ndarray], target: float
    ) -> tuple[np.ndarray, list[np.ndarray], Search]:
        """The best tuning by the worst case at each frequency, the known points, and the search with its worst cases.

        Each round improves the points on the samples. The worst case of the best point is then added to the samples,
        until it is no worse than the samples predict.
        """
        judged: list[tuple[Merit, np.ndarray]] = []
        for _ in range(self.settings.rounds):
            points = [task.improved(point, target) for point in task.best_starts(target, points)]
            best = min(points, key=lambda point: task.merit(point, target).key())
            said, (true, deltas) = task.merit(best, target), self.worst(task, best)
            judged.append((true, best))
            figure = "band" if true.meets else "peak"
            if deltas is None or getattr(true, figure) <= (1 + self.settings.agreement) * getattr(said, figure):
                break
            task = replace(task, scenarios=task.scenarios.with_worst(deltas))
        return min(judged, key=lambda one: one[0].key())[1], list(points), task

    def worst(self, task: Search, point: np.ndarray) -> tuple[Merit, np.ndarray | None]:
        """The worst case found at each frequency (a lower bound), and its perturbations (n_omega, n_w, n_z)."""
        motion = task.scenarios.plant
        closed = motion.closed(task.search.skyhook(task.axes, point).controller())
        if not closed.is_stable():
            return Merit(np.inf, np.inf, self.peak_limit, 1.0), None
        found = worst_gain(
            closed.frequency_response(task.scenarios.omega),
            motion.blocks,
            count=self.settings.ascents,
            iterations=self.settings.ascent_steps,
        )
        return Merit(float(np.max(found.gain)), float(np.max(found.gain[task.inside])), self.peak_limit), found.delta

    def with_worst_case(self, task: Search, worst: MuPeak) -> Search:
        """The search with the worst case of a bound added to its samples, and its frequency to the grid."""
        scenarios = task.scenarios
        if np.isfinite(worst.omega) and worst.omega > 0:
            scenarios = scenarios.with_frequencies(worst.omega * np.array(self.settings.beside))
        if worst.delta is not None:
            n_w, n_z = scenarios.deltas.shape[2:]
            scenarios = scenarios.with_delta(worst.delta[:n_w, :n_z])  # a plant: its stability counts
        return replace(task, scenarios=scenarios)

    def certified(self, loops: Skyhook) -> tuple[Merit, MuPeak | None]:
        """The bounds over the whole set, as in the report, and the result for the peak.

        The bound in the band is computed only if the peak meets the limit; otherwise it does not affect the ranking.
        """
        plant = self.plant
        motion = plant.full.restricted(plant.floor_velocities, plant.velocities)
        closed = motion.closed(loops.controller())
        if not closed.is_stable():
            return Merit(np.inf, np.inf, self.peak_limit, 1.0), None
        slack, few = ANALYSIS.slack, ANALYSIS.few_points
        worst = worst_case_gain(closed, motion.blocks, slack=slack, points=few)
        if worst.upper > self.peak_limit:
            return Merit(worst.upper, np.inf, self.peak_limit), worst
        low, high = self.band_Hz
        band_rad_s = 2 * np.pi * low, 2 * np.pi * high
        band = worst_case_gain(closed, motion.blocks, band=band_rad_s, slack=slack, points=few)
        return Merit(worst.upper, band.upper, self.peak_limit), worst


def critical_gains(rig: Rig, axes: Sequence[str]) -> tuple[float, ...]:
    """Classical gains [N s/m] of some axes, rotations at the edge."""
    equations = rig.equations_of_motion()
    kept = [equations.coordinates.index(name) for name in axes]
    scale = 1 / lever_arms(rig, axes) ** 2
    return tuple(critical_damping(*(np.diag(X)[kept] * scale for X in (equations.M, equations.K, equations.C))))


def in_words(loops: Skyhook) -> str:
    """Gains and corners of the loops."""
    gains = ", ".join(f"{axis} {gain:.4g} N s/m" for axis, gain in zip(loops.axes, loops.gains, strict=True))
    return f"gains {gains}; tilt corner {loops.tilt_corner_Hz:.3g} Hz, roll-off {loops.roll_off_Hz:.3g} Hz"


def at_limits(loops: Skyhook, search: TuningRange) -> list[str]:
    """A sentence on tuned values at an end of their range, where a wider range may give a better result."""
    values = [
        *(
            (f"the gain of {axis}", gain / critical, search.gain_factor)
            for axis, gain, critical in zip(loops.axes, loops.gains, search.critical, strict=True)
        ),
        ("the tilt corner", loops.tilt_corner_Hz, search.tilt_corner_Hz),
        ("the roll-off", loops.roll_off_Hz, search.roll_off_Hz),
    ]
    found = [name for name, value, ends in values if min(abs(np.log(value / end)) for end in ends) < 1e-6]
    if not found:
        return []
    return [
        f"{' and '.join(found)} {'is' if len(found) == 1 else 'are'} at the end of the range searched: a wider "
        "range may give a better skyhook"
    ]


def _pair(limits: list[float]) -> tuple[float, float]:
    return limits[0], limits[1]
