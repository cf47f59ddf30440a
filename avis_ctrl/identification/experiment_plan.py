"""Candidate experiments, ranked by what they would determine, and a minimum set that determines everything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.linalg

from avis_ctrl.identification.experiments import Added, Drive, Noise, changed, predicted_information
from avis_ctrl.identification.identifiability import identifiability_report
from avis_ctrl.identification.identifiability_text import combination_text
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.response import FLOOR, ResponseModel
from avis_ctrl.identification.structural_identifiability import structural_null_space, structure_of
from avis_ctrl.summary import joined

CAUTION = (
    "These predictions include noise only: added masses, changed positions and added channels count as exactly "
    "known, and the model as correct."
)


@dataclass(frozen=True)
class ExperimentPlanSettings:
    """Size of the proposed experiments.

    floor_m_per_s : r.m.s. velocity of a shaken floor [m/s], fifty times that of a quiet laboratory.
    bench : relative standard deviation of a mount's stiffness or damping measured on a test bench [1]: force and
        travel are each known to a per cent.
    """

    floor_m_per_s: float = 1e-4
    bench: float = 0.02


SETTINGS = ExperimentPlanSettings()


@dataclass(frozen=True, eq=False)
class Experiment:
    """A further record or bench measurement.

    words : what to do, as an instruction. drive : the record, None for none. change : of the rig on which it is taken,
        as arguments of `experiments.changed`. bench : relative standard deviations of parameters measured individually.
    """

    words: str
    drive: Drive | None = None
    change: Mapping[str, Any] = field(default_factory=dict)
    bench: Mapping[str, float] = field(default_factory=dict)

    def information(self, model: ResponseModel, noise: Noise) -> Information:
        """Information that it would add on the model's free parameters."""
        n = len(model.names)
        found = Information(model.names, model.values, model.units, np.zeros((n, n)), model.scales())
        if self.drive is not None:
            matrix = predicted_information(changed(model, **self.change), self.drive, noise).matrix
            found = replace(found, matrix=matrix)
        sizes = dict(zip(model.names, model.scales().tolist(), strict=True))
        return found.with_priors({name: share * sizes[name] for name, share in self.bench.items()})


@dataclass(frozen=True, eq=False)
class Outcome:
    """An experiment added to the present information.

    gained : further combinations determined. alone : parameters that become determined individually, with their
        predicted relative standard deviation. tighter : ratio of old to new standard deviation, median over what was
        known before.
    """

    experiment: Experiment
    information: Information
    gained: int
    alone: Mapping[str, float]
    tighter: float

    @property
    def words(self) -> str:
        """The combinations that the experiment adds, as a sentence."""
        many = "combination" if self.gained == 1 else "combinations"
        said = f"{self.experiment.words}: determines {self.gained} more {many}"
        if not self.alone:
            return f"{said}."
        shown = [f"{name} to {100 * share:.3g} %" for name, share in list(self.alone.items())[:6]]
        if len(self.alone) > 6:
            worst = 100 * max(self.alone.values())
            shown.append(f"{len(self.alone) - 6} more parameters (the worst to {worst:.3g} %)")
        return f"{said}, so that these parameters are determined individually: {joined(shown)}."


Predictions = list[tuple[Experiment, Information]]


def candidates(model: ResponseModel, drive: Drive) -> tuple[Experiment, ...]:
    """Experiments that are usually possible with a table; `drive` is the present record.

    Masses are 10 % of the payload, attachments move by 50 mm, the floor is shaken and measured, single mounts are
    measured on a test bench (`ExperimentPlanSettings`). Sensors and actuators are added on the payload: a sensor on the
    chassis measures the floor, which is a separate candidate.
    """
    low, high = drive.band_Hz
    rate, once = 1 / model.period_s if model.period_s else 1000.0, "Record once more"
    drives = {"Record four times as long": replace(drive, duration_s=3 * drive.duration_s)}
    level = min(3 * drive.level_V, float(np.min(model.rig.drive_limits_V())) / 4)
    if level > drive.level_V:
        drives[f"{once} with {level:.3g} V r.m.s. at each actuator"] = replace(drive, level_V=level)
    drives[f"{once} over {low / 5:.3g}-{low:.3g} Hz, below the present band"] = replace(drive, band_Hz=(low / 5, low))
    if 3 * high < 0.45 * rate:
        words = f"{once} over {high:.3g}-{3 * high:.3g} Hz, above the present band"
        drives[words] = replace(drive, band_Hz=(high, 3 * high))
    speed = SETTINGS.floor_m_per_s
    for axis in FLOOR:
        words = f"Shake the floor along {axis[-1]} ({1e3 * speed:.3g} mm/s r.m.s.) and measure its velocity"
        drives[words] = replace(drive, level_V=0.0, floor_m_per_s={axis: speed})
    return (
        *(Experiment(words, one) for words, one in drives.items()),
        *(Experiment(words, drive, change) for words, change in _changes(model).items()),
        *(Experiment(words, bench=known) for words, known in _bench(model).items()),
    )


def _changes(model: ResponseModel) -> dict[str, dict[str, Any]]:
    """Changes of the rig before one more record, by what to do."""
    body, once = model.rig.mounted_body(), "Record once more with"
    kg, corner = round(0.1 * body.mass, 3), body.mounts[0].position
    x, y, z = corner
    top = (-x, -y, -z)
    at, opposite = (f"({', '.join(f'{v:g}' for v in place)}) m" for place in (corner, top))
    found: dict[str, dict[str, Any]] = {f"{once} a known mass of {kg:g} kg fixed at {at}": {"masses": [(kg, corner)]}}
    for axis in "xyz":
        for picked in ([1], [1, 3]):
            shifts = {f"isolator{i}.p_{axis}": 0.05 for i in picked}
            if shifts.keys() <= model.rig.parameters().keys():
                who = f"isolator{'s' if len(picked) > 1 else ''} {joined([str(i) for i in picked])}"
                how = "raised by 50 mm" if axis == "z" else f"moved by 50 mm along {axis}"
                found[f"{once} {who} {how}, with the motors and sensors in it"] = {"shifts": shifts}
    for axis, direction in {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}.items():
        words = f"Add a calibrated sensor along {axis} on the payload at {opposite} and record once more"
        found[words] = {"sensors": [Added(f"added sensor {axis}", top, direction)]}
    motor = Added("added actuator", top, (0.0, 0.0, 1.0), float(np.max(np.abs(model.matrices.T))))
    found["Add a calibrated vertical actuator at the same place and record once more"] = {"actuators": [motor]}
    return found


def _bench(model: ResponseModel) -> dict[str, dict[str, float]]:
    """Single parameters that a bench or a balance can measure, by what to do: from each group as many as determine the
    rest."""
    structure = structure_of(structural_null_space(model), model.values, model.units, model.names)
    picked = [model.names[j] for group in structure.groups for j in _independent(group.unseen)]
    mounts = [name for name in picked if name.rpartition(".")[2].startswith(("k_", "c_"))]
    found = {}
    if mounts:
        words = f"Measure single mounts on a bench, to {100 * SETTINGS.bench:.3g} % each: {joined(mounts)}"
        found[words] = dict.fromkeys(mounts, SETTINGS.bench)
    if "mass" in model.names:
        found["Weigh the payload to 0.5 %"] = {"mass": 0.005}
    for kind, how in (("sensor", "Calibrate {} to 1 %"), ("actuator", "Measure {} with a load cell to 1 %")):
        for name in [name for name in model.names if name.startswith(f"{kind}.")][:1]:
            found[how.format(name)] = {name: 0.01}
    return found


def _independent(rows: np.ndarray) -> list[int]:
    """Columns, as many as rows, in which no combination of the rows vanishes except the zero combination."""
    scaled = rows / np.max(np.abs(rows), axis=1, keepdims=True)
    return sorted(scipy.linalg.qr(scaled, mode="r", pivoting=True)[1][: len(rows)].tolist())


def predicted(model: ResponseModel, experiments: Sequence[Experiment], noise: Noise) -> Predictions:
    """Each experiment with the information that it would add."""
    return [(one, one.information(model, noise)) for one in experiments]


def compared(information: Information, added: Predictions) -> tuple[Outcome, ...]:
    """Effect of each experiment by itself, the best first: most combinations, then the smallest errors."""

    def rank(one: Outcome) -> tuple[float, ...]:
        error = float(np.median(list(one.alone.values()))) if one.alone else np.inf
        return -one.gained, -len(one.alone), error, -one.tighter

    return tuple(sorted((_outcome(information, one, extra) for one, extra in added), key=rank))


def _outcome(before: Information, experiment: Experiment, added: Information) -> Outcome:
    after = before.plus(added)
    new = after.known & ~before.known
    alone = {
        name: float(sigma / size)
        for name, sigma, size, is_new in zip(after.names, after.standard_deviation, after.scale, new, strict=True)
        if is_new
    }
    V = before.directions[1][:, before.determined]
    ratios = [
        before.of(row)[1] / after.of(row)[1] for row in (V / before.scale[:, None]).T if np.isfinite(after.of(row)[1])
    ]
    tighter = float(np.median(ratios)) if ratios else 1.0
    return Outcome(experiment, after, after.rank - before.rank, alone, tighter)


def planned(information: Information, added: Predictions) -> tuple[Outcome, ...]:
    """Sequence of experiments, each adding the most to those before it; ends when nothing is gained."""
    chosen: list[Outcome] = []
    now = information
    while now.rank < len(now.names):
        best = compared(now, added)[0]
        if not best.gained:
            break
        chosen.append(best)
        now = best.information
    return tuple(chosen)


def needed_experiment(
    information: Information,
    model: ResponseModel,
    drive: Drive,
    noise: Noise,
    experiments: Sequence[Experiment] | None = None,
) -> tuple[str, ...]:
    """Sentences: what determines the missing combinations, what does not, and the shortest sequence found for all of
    them."""
    if information.rank == len(information.names):
        return ("Every combination is determined; further records only make it more precise.",)
    chosen = candidates(model, drive) if experiments is None else experiments
    added = predicted(model, chosen, noise)
    outcomes = compared(information, added)
    said = [one.words for one in outcomes if one.gained]
    useless = [f"{one.experiment.words[:1].lower()}{one.experiment.words[1:]}" for one in outcomes if not one.gained]
    if useless:
        said.append(f"These determine no further combination: {'; '.join(dict.fromkeys(useless))}.")
    steps, left = planned(information, added), information
    if steps:
        left = steps[-1].information
        order = " Then: ".join(one.experiment.words + "." for one in steps)
        worst, rest = 100 * np.max(left.standard_deviation / left.scale), len(left.names) - left.rank
        after = f"Every parameter is then determined individually, the least precise to {worst:.3g} %."
        said.append(
            f"Shortest sequence found: {order} {f'{rest} combinations remain undetermined.' if rest else after}"
        )
    if left.rank < len(left.names):
        still = "; ".join(combination_text(row.items()) for row in identifiability_report(left).unseen[:8])
        said.append(f"None of these experiments determines: {still}.")
    return (*said, CAUTION)
