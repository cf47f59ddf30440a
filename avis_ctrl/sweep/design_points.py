"""Points that are designs: the certified mu controller, or the skyhook of the classical rule (takes seconds)."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from avis_ctrl.errors import InputError
from avis_ctrl.lti.norms import decibels
from avis_ctrl.rigs.file_errors import read_toml
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.study.analysis import analyse
from avis_ctrl.study.design_file import Design, design_from_table, study_of
from avis_ctrl.study.output import controller_dict
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.random_plants import random_perturbations
from avis_ctrl.study.runner import run_design
from avis_ctrl.study.skyhooks import classical_skyhook
from avis_ctrl.sweep.keys import FACTOR, VALUE, expanded, keys_of, put, with_rig_keys
from avis_ctrl.sweep.points import PointsFile
from avis_ctrl.sweep.task import Job

KEYS = {**keys_of(Design), "base": False}
BAND = "worst_case_band_transmissibility_dB"


@dataclass(frozen=True, eq=False)
class DesignBase:
    """A design file. The key `base` of a point selects another design file, with another structure."""

    path: Path
    skyhook: bool
    table: dict[str, Any]
    rig: Rig
    others: dict[str, DesignBase] = field(default_factory=dict)
    quantities = {
        "mu_upper": "mu, upper bound [1]",
        "mu_lower": "mu, lower bound [1]",
        "guaranteed": "bounds proved",
        "worst_case_peak_transmissibility_dB": "worst-case transmissibility, peak [dB]",
        BAND: "worst-case transmissibility in the band [dB]",
        "order": "states of the controller [1]",
    }
    pareto = ("mu_upper", BAND)

    @classmethod
    def read(cls, file: PointsFile, folder: Path) -> DesignBase:
        """Raises InputError for a base that is missing or is not a design file."""
        if file.rig is not None:
            raise InputError(
                'expected no rig: the design file names it; vary the key "rig"', field="rig", value=file.rig
            )
        return cls.of(folder / file.base, file.kind == "skyhook")

    @classmethod
    def of(cls, path: Path, skyhook: bool) -> DesignBase:
        """Read the base from a path."""
        table = read_toml(path, "a design file such as designs/avis_z_phix.toml")
        return cls(path, skyhook, table, study_of(design_from_table(table, path), path)[1])

    def expand(self, key: str) -> Sequence[str]:
        """Expand a key of the design file or a parameter of its rig."""
        return expanded(key, KEYS, self.rig)

    def job(self, point: Mapping[str, Any]) -> Job:
        """One design on one rig. Its inputs are the design without its title, and the rig file."""
        design, rig = self.resolved(point)
        inputs = design.model_dump_json(exclude={"title"}) + rig_toml(rig)
        return Job(inputs, partial(compute, design, rig, self.skyhook))

    def resolved(self, point: Mapping[str, Any]) -> tuple[Design, Rig]:
        """The design and the rig of a point."""
        if (other := point.get("base")) is not None:
            if not isinstance(other, str):
                raise InputError("expected the name of a design file", field="base", value=other)
            if other not in self.others:
                self.others[other] = DesignBase.of(self.path.parent / other, self.skyhook)
            return self.others[other].resolved({key: value for key, value in point.items() if key != "base"})
        table = copy.deepcopy(self.table)
        for key, value in point.items():
            if not key.startswith((VALUE, FACTOR)):
                put(table, key, value, KEYS)
        design, rig = study_of(design_from_table(table), self.path)
        return design, with_rig_keys(rig, point)


def compute(design: Design, rig: Rig, skyhook: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures of the controller, and the controller itself."""
    further = {}
    if skyhook:
        plant = build_plant(design, rig)
        samples = random_perturbations(plant, 0, design.simulation.seed)
        found = analyse(design, plant, classical_skyhook(plant, rig, design), samples)
    else:
        result = run_design(design, rig)
        found = result.controller("mu")
        further = {"stable": result.stable, "requirements_met": all(one.met for one in result.requirements)}
    figures = {
        "mu_upper": found.mu.upper,
        "mu_lower": found.mu.lower,
        "guaranteed": found.guaranteed,
        "worst_case_peak_transmissibility_dB": decibels(found.worst_peak.upper),
        BAND: decibels(found.worst_band.upper),
        "order": found.order,
    }
    return figures | further, {"controller": controller_dict(found.name, found.K)}
