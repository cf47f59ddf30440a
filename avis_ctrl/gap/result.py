"""The result of `gap`: verdict, named effects, stages, residual, and the next measurement."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.priors import Tolerance

Verdict = Literal["none", "explained", "partly explained", "unexplained"]
VERDICTS: tuple[str, ...] = get_args(Verdict)


def spoken(name: str, unit: str) -> str:
    """A parameter's name without its unit, which follows the number; of a rotation, "about" its axis. The values of
    mounts or drives that differ are fractions of their mean."""
    if name.startswith("uneven_"):
        return f"deviation of {name.removeprefix('uneven_')} from the mean"
    tail = "".join(sign for sign in unit if sign not in " ^()").replace("/", "_per_").removeprefix("1").lstrip("_")
    words = (name.removesuffix(f"_{tail}") if tail else name).replace("_", " ")
    return re.sub(r"\br([xyz])$", r"about \1", words)


@dataclass(frozen=True, eq=False)
class NamedEffect:
    """An effect that is supported by the data.

    name, location : of the contract. title : in words. parameters : with standard deviations.
    probability : of this effect among the candidates fitted in its place, given the data, with equal prior
        probabilities within the library; for an effect on the signals alone, the confidence of its detector.
        indistinguishable_from : names of effects that these data cannot distinguish from it.
    share : increase of the held-out residual power if the effect is replaced by what the rig file states, over the
        baseline's power in excess of the noise.
    label : of the active effect in the updated model; empty for an effect on the signals alone (hum, converter, ground
        motion). confirmation : a sentence on how it was found.
    """

    name: str
    location: str
    title: str
    parameters: Mapping[str, Reported]
    probability: float
    indistinguishable_from: tuple[str, ...] = ()
    label: str = ""
    confirmation: str = ""
    share: float | None = None

    def to_json(self) -> dict[str, Any]:
        """As defined in the contract."""
        return {
            "name": self.name,
            "location": self.location,
            "parameters": {key: asdict(p) for key, p in self.parameters.items()},
            "probability": self.probability,
            "indistinguishable_from": list(self.indistinguishable_from),
            **({} if self.share is None else {"share": self.share}),
        }

    def in_words(self) -> str:
        """Title with place, probability, and the first three quantities that differ from zero by two standard
        deviations, then direction and position; differences between single mounts appear only in the table. The
        components of a vector are one quantity.
        """
        groups: dict[str, list[tuple[str, Reported]]] = {}
        for name, p in self.parameters.items():
            if not name.startswith("uneven_"):
                words = spoken(name, p.unit)
                of = re.fullmatch("(?:(.*?) )?((?:about )?[xyz])", words)
                stem, axis = (of[1] or "", of[2]) if of else (words, "")
                groups.setdefault(stem, []).append((axis, p))
        # Of these all components are given, also those that are zero.
        direction, position = groups.pop("direction", []), groups.pop("", [])
        certain = {
            stem: kept
            for stem, group in groups.items()
            if (kept := [(axis, p) for axis, p in group if not (p.std or 0.0) > abs(p.value) / 2])
        }
        shown = dict(list((certain or groups).items())[:3])
        if direction:
            shown["direction"] = direction
        if known := [(axis, p) for axis, p in position if p.std and np.isfinite(p.std)]:
            shown["line of action through" if direction else "position"] = known
        sizes = ", ".join(
            f"{stem} {', '.join(f'{axis} {p}'.lstrip() for axis, p in group)}" for stem, group in shown.items()
        )
        ties = (
            f"; these data cannot distinguish it from {' or '.join(self.indistinguishable_from)}"
            if self.indistinguishable_from
            else ""
        )
        where = f"{self.name}, {self.location}{': ' * bool(sizes)}{sizes}"
        return f"{self.title} ({where}; probability {self.probability:.2f}{ties})"


def missed(reported: Sequence[NamedEffect]) -> str:
    """The sentence that names the missing effects."""
    count = "one effect" if len(reported) == 1 else f"{len(reported)} effects"
    return f"The model misses {count}: {'; '.join(one.in_words() for one in reported)}."


@dataclass(frozen=True)
class Remainder:
    """Residual of the updated model on held-out records.

    nrmse : over y, r.m.s. over_noise : over the residual expected from noise alone. share : power beyond noise over
        that of the baseline. grows_with_level : whether it grows faster than the drive level; None if the records do
        not show it.
    """

    nrmse: float
    over_noise: float
    share: float
    grows_with_level: bool | None = None


@dataclass(frozen=True)
class Stage:
    """A stage of the search, on held-out data: r.m.s. residual over r.m.s. y, and chi-square over degrees of
    freedom."""

    name: str
    nrmse: float
    chi2_per_dof: float


@dataclass(frozen=True)
class Where:
    """A band and path with a fraction of the residual power in excess of the noise. input "" for no particular input.

    excess : power of the residual over that of the noise. p_value : of this excess by noise alone, family-wise over all
        places.
    """

    from_Hz: float
    to_Hz: float
    input: str
    output: str
    share: float
    excess: float = float("nan")
    p_value: float = float("nan")

    def to_json(self) -> dict[str, Any]:
        """As defined in the contract."""
        return {key: getattr(self, key) for key in ("from_Hz", "to_Hz", "input", "output", "share")}


@dataclass(frozen=True, eq=False)
class Considered:
    """A candidate that was fitted: held-out chi-square per degree of freedom, and why it was not named.

    probability : of this candidate among all fitted in the same step, at most `GapSettings.most_sure`. law : of the
        effect, if it has several.
    """

    name: str
    location: str
    chi2_per_dof: float
    probability: float
    reason: str
    parameters: Mapping[str, Reported] = field(default_factory=dict)
    law: str = ""


@dataclass(frozen=True)
class Detectable:
    """Detection limit of a parameter of an absent effect: the difference from its value without the effect, five
    standard deviations in a fit to the fitted records. A name requires about as much, five to seven
    (`detection_limits`). Infinite if re-identification would absorb the parameter."""

    name: str
    location: str
    parameter: str
    value: float
    unit: str


@dataclass(frozen=True, eq=False)
class HeatMap:
    """Residual power over noise power, (n_bands, n_columns), before and after naming, on held-out records.

    bands_Hz : (n_bands + 1,) edges. columns : "output" or "record: output".
    """

    bands_Hz: np.ndarray
    columns: tuple[str, ...]
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True, eq=False)
class PowerShares:
    """Decomposition of the power of each output on the lines that the drives excite, in the records of one level.

    Attributes
    ----------
    level_V : mean over the records. excitation, records : of the group. bands_Hz : (n_bands + 1,) edges.
    outputs : names. shares : (n_bands, n_y) by part, which add up to one: "model" is the linear response to the
        measured inputs as the updated model predicts it; "missing" is linear in these inputs, but not predicted by the
        model; "nonlinear" depends on amplitude or time; "unmeasured" is motion from inputs that are not measured, and
        all noise if the sensor noise is not known; "sensors" is sensor noise, absent if it is not known.
    whole : (n_y,) by part, for the power of all bands together.
    how : noise was separated from nonlinearity on lines where the drives are "silent", by several "levels", or not at
        all: with "one level", "nonlinear" contains only the model's own terms, and "unmeasured" everything else that is
        not linear.
    """

    level_V: float
    excitation: str
    records: tuple[str, ...]
    bands_Hz: np.ndarray
    outputs: tuple[str, ...]
    shares: Mapping[str, np.ndarray]
    whole: Mapping[str, np.ndarray]
    how: Literal["silent", "levels", "one level"]


@dataclass(frozen=True, eq=False)
class RecordGap:
    """Residual of the models in one record, r.m.s. over that of the noise, on lines drawn alike for all records.

    start_s : on the campaign's clock. held_out : not used in any fit. kind : excitation, and whether the floor was
        measured; residual over noise can be compared among records of one kind.
    """

    name: str
    level_V: float
    start_s: float
    held_out: bool
    before: float
    after: float
    kind: str = ""


class Findings:
    """What the results of a table and of one axis have in common."""

    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    traces: tuple[NamedEffect, ...]
    stages: tuple[Stage, ...]
    remaining: tuple[Where, ...]
    left: Remainder | None
    next_experiment: str | None

    def findings(self) -> dict[str, Any]:
        """The keys of gap.json that do not depend on the kind of result."""
        where = [one.to_json() for one in self.remaining]
        return {
            "verdict": self.verdict,
            "effects": [one.to_json() for one in self.effects],
            "traces": [one.to_json() for one in self.traces],
            "gap": [{"stage": one.name, "nrmse": one.nrmse, "chi2_per_dof": one.chi2_per_dof} for one in self.stages],
            "where": where,
            "remaining": self.left and {**asdict(self.left), "where": where},
            "next_experiment": self.next_experiment,
        }


@dataclass(frozen=True, eq=False)
class Gap(Findings):
    """The complete result.

    Attributes
    ----------
    verdict : one of VERDICTS. effects : named. stages : on held-out data, "nominal", "re-identified", "tolerances",
        then "mains_hum", if there is any, without the polluted lines, and one for each effect that a model explains.
    where : location of the gap after re-identification. remaining : the same after the named effects.
    noise_nrmse : residual of the held-out records expected from noise alone. next_experiment : None or a sentence.
    baseline, updated : models (without named effects, updated is the baseline with all values of the rig file
        fitted with their tolerances as prior standard deviations).
    considered : runners-up. heat : residual over noise by band and channel. sentences : verdict first.
    held_out : the held-out data and the reason for their choice. seed, seconds.
    covariance : (n_p, n_p) of the updated model's parameters.
    detectable : if the verdict is none, detection limits of absent effects (five standard deviations); otherwise empty.
    shares : decomposition of the outputs' power by level, the lowest first. records : residual of each record.
    raised : sensors with raised noise, if nothing else is left unexplained; `remaining` then contains these.
    traces : effects that are present, each below 1 % of the gap. left : size of the residual. tolerances : of the
        updated model, the largest shift first.
    """

    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    stages: tuple[Stage, ...]
    where: tuple[Where, ...]
    remaining: tuple[Where, ...]
    noise_nrmse: float
    next_experiment: str | None
    baseline: TableModel
    updated: TableModel
    considered: tuple[Considered, ...]
    heat: HeatMap | None
    sentences: tuple[str, ...]
    held_out: str
    seed: int
    seconds: float
    covariance: np.ndarray | None = None
    detectable: tuple[Detectable, ...] = ()
    shares: tuple[PowerShares, ...] = ()
    records: tuple[RecordGap, ...] = ()
    raised: tuple[str, ...] = ()
    traces: tuple[NamedEffect, ...] = ()
    left: Remainder | None = None
    tolerances: tuple[Tolerance, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """gap.json of the contract, format "avis-gap" version 1."""
        return {
            "format": "avis-gap",
            "version": 1,
            **self.findings(),
            **({"where": []} if self.verdict == "none" else {}),
            "tolerances": [one.to_json() for one in self.tolerances],
            "seconds": self.seconds,
        }
