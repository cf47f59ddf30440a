"""Points that are searches for missing effects, with different campaigns, rigs and options of `avis gap`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, digest
from avis_ctrl.measurement.formats import read_measurements
from avis_ctrl.rigs.file_errors import Section, validated
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import SHIPPED, load_rig
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.study.gap import GapOptions, find_gap
from avis_ctrl.sweep.keys import FACTOR, VALUE, expanded, keys_of, with_rig_keys
from avis_ctrl.sweep.points import PointsFile
from avis_ctrl.sweep.task import Job

Hertz = Annotated[float, Field(gt=0)]


class Options(Section):
    """The options of `avis gap` that may vary, validated."""

    seed: Annotated[int, Field(ge=0)] = 1
    band_Hz: Annotated[list[Hertz], Field(min_length=2, max_length=2)] | None = None
    gates: bool = True
    despite_gates: bool = False
    amplifier_corner_Hz: Hertz | None = None


KEYS = {**keys_of(Options), "base": False, "rig": False}


@dataclass(frozen=True, eq=False)
class GapBase:
    """A campaign and a rig; the keys `base` and `rig` of a point select other ones."""

    folder: Path
    campaign: str
    rig_name: str
    rig: Rig
    digests: dict[Path, str] = field(default_factory=dict)
    quantities = {
        "verdict": "verdict",
        "effects": "named effects",
        "nrmse_nominal": "gap before [1]",
        "nrmse_identified": "gap after identification [1]",
        "nrmse": "gap with the named effects [1]",
        "noise_nrmse": "noise [1]",
        "search_seconds": "time of the search [s]",
    }
    pareto = ("search_seconds", "nrmse")

    @classmethod
    def read(cls, file: PointsFile, folder: Path) -> GapBase:
        """Raises InputError for a missing campaign or rig."""
        if file.rig is None:
            raise InputError("this key is missing: the rig of the campaign", field="rig")
        made = cls(folder, file.base, file.rig, _rig(folder, file.rig))
        made.job({})
        return made

    def expand(self, key: str) -> Sequence[str]:
        """Expand an option of `avis gap` or a parameter of the rig."""
        return expanded(key, KEYS, self.rig)

    def job(self, point: Mapping[str, Any]) -> Job:
        """One search. Its inputs are the hash of the samples, the options and the rig file."""
        names = {"base": self.campaign, "rig": self.rig_name} | {
            key: point[key] for key in ("base", "rig") if key in point
        }
        if wrong := [key for key, name in names.items() if not isinstance(name, str)]:
            raise InputError("expected the name of a file", field=wrong[0], value=names[wrong[0]])
        given = {key: value for key, value in point.items() if key not in names and not key.startswith((VALUE, FACTOR))}
        options = validated(Options, given)
        path = (self.folder / names["base"]).resolve()
        if path not in self.digests:
            self.digests[path] = digest(_campaign(path))
        rig = with_rig_keys(_rig(self.folder, names["rig"]), point)
        inputs = self.digests[path] + options.model_dump_json() + rig_toml(rig)
        return Job(inputs, partial(search, path, rig, options))


def search(campaign: Path, rig: Rig, options: Options) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures of the finding, and gap.json. The campaign may be large, so it is read where the point is computed."""
    band = None if options.band_Hz is None else (options.band_Hz[0], options.band_Hz[1])
    settings = GapOptions(options.seed, band, options.gates, options.despite_gates, options.amplifier_corner_Hz)
    found = find_gap(_campaign(campaign), rig, settings)
    gap, errors = found.gap, [stage.nrmse for stage in found.gap.stages]
    figures = {
        "verdict": gap.verdict,
        "effects": "; ".join(f"{one.name} at {one.location}" for one in gap.effects),
        "nrmse_nominal": errors[0],
        "nrmse_identified": errors[1],
        "nrmse": errors[-1],
        "noise_nrmse": gap.noise_nrmse,
        "search_seconds": gap.seconds,
    }
    return figures, {"gap": found.to_json()}


def _campaign(path: Path) -> Campaign:
    measured = read_measurements(path)
    if not isinstance(measured, Campaign):
        raise InputError("expected records, found frequency responses", file=path)
    return measured


def _rig(folder: Path, name: str) -> Rig:
    return load_rig(name if name in SHIPPED else folder / name)
