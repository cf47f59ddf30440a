"""The result of `gap`: verdict, named effects, stages, residual, and what to measure next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.priors import Tolerance

Verdict = Literal["none", "explained", "partly explained", "unexplained"]
VERDICTS: tuple[str, ...] = get_args(Verdict)


def spoken(name: str, unit: str) -> str:
    """A parameter's name without its unit, which stands behind the number."""
    tail = "".join(sign for sign in unit if sign not in " ^()").replace("/", "_per_").removeprefix("1").lstrip("_")
    return (name.removesuffix(f"_{tail}") if tail else name).replace("_", " ")


@dataclass(frozen=True, eq=False)
class NamedEffect:
    """An effect that the data call for.

    name, location : of the contract. title : in words. parameters : with standard deviations.
    probability : of this effect among the candidates that were refitted in its place, given the data, equal beforehand;
    of one that acts on the signals alone, what its finder states. indistinguishable_from : names that this data cannot
    tell from it.
    share : by how much the held-out residual power rises without it, over the baseline's in excess of the noise.
    label : of the active effect in the updated model; empty for one that acts on the signals alone (hum, converter,
    ground motion). confirmation : in words, how it was found.
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
        """As the contract has it."""
        return {"name": self.name, "location": self.location,
                "parameters": {key: {"value": p.value, "std": p.std, "unit": p.unit}
                               for key, p in self.parameters.items()},
                "probability": self.probability, "indistinguishable_from": list(self.indistinguishable_from),
                **({} if self.share is None else {"share": self.share})}

    def in_words(self) -> str:
        """With its place, probability, and its first parameters that differ from zero by two standard deviations; how
        single mounts differ stands in the table alone."""
        own = [(name, p) for name, p in self.parameters.items() if not name.startswith("uneven_")]
        certain = [(name, p) for name, p in own if not (p.std or 0.0) > abs(p.value) / 2]
        sizes = ", ".join(f"{spoken(name, p.unit)} {p}" for name, p in (certain or own)[:3])
        ties = (f"; these data cannot distinguish it from {' or '.join(self.indistinguishable_from)}"
                if self.indistinguishable_from else "")
        return f"{self.title} ({self.name}, {self.location}: {sizes}; probability {self.probability:.2f}{ties})"


def missed(told: Sequence[NamedEffect]) -> str:
    """The sentence that names the missing effects."""
    count = "one effect" if len(told) == 1 else f"{len(told)} effects"
    return f"The model misses {count}: {'; '.join(one.in_words() for one in told)}."


@dataclass(frozen=True)
class Remainder:
    """What the updated model leaves of held-out records.

    nrmse : over y, r.m.s. over_noise : over what noise alone leaves. share : of its power beyond noise over that of the
    baseline. grows_with_level : whether it grows faster than the drives; None where the records do not tell.
    """

    nrmse: float
    over_noise: float
    share: float
    grows_with_level: bool | None = None


@dataclass(frozen=True)
class Stage:
    """One stage of the search, on held-out data: r.m.s. of what the model leaves over that of y, and chi-square."""

    name: str
    nrmse: float
    chi2_per_dof: float


@dataclass(frozen=True)
class Where:
    """A band and path that holds a share of the excess of the residual over the noise. input "" for none in particular.

    excess : power of the residual over that of the noise. p_value : of as much by chance, family-wise over all places.
    """

    from_Hz: float
    to_Hz: float
    input: str
    output: str
    share: float
    excess: float = float("nan")
    p_value: float = float("nan")


@dataclass(frozen=True, eq=False)
class Considered:
    """A candidate that was refitted: held-out chi-square per degree of freedom and why it was not named."""

    name: str
    location: str
    chi2_per_dof: float
    probability: float
    reason: str
    parameters: Mapping[str, Reported] = field(default_factory=dict)


@dataclass(frozen=True)
class Detectable:
    """A parameter of an absent effect, and the departure from none that is five standard deviations of a fit to the
    fitted records. The search asks for more before it names. Infinite where re-identification would absorb it."""

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
    """What accounts for the power of each output on the lines that the drives excite, in the records of one level.

    Attributes
    ----------
    level_V : mean over the records. excitation, records : of the group. bands_Hz : (n_bands + 1,) edges.
    outputs : names. shares : (n_bands, n_y) by part, which add up to one: "model" follows the measured inputs as the
        updated model has it; "missing" follows them linearly, but not as the model has it; "nonlinear" depends on
        amplitude or time; "unmeasured" is motion from inputs that are not measured, and all noise where that of the
        sensors is not known; "sensors" their own noise, absent where it is not known.
    whole : (n_y,) by part, of the power of all bands together.
    how : noise was told from nonlinearity on lines where the drives are "silent", by several "levels", or not at all:
        "one level", where "nonlinear" holds the model's own terms only, and "unmeasured" whatever else is not linear.
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
    """What the models leave of one record, r.m.s. over that of the noise, on lines drawn for all records alike.

    start_s : on the campaign's clock. held_out : no fit has seen it. kind : how it was driven, whether its floor was
    measured; residual over noise compares among records of one kind.
    """

    name: str
    level_V: float
    start_s: float
    held_out: bool
    before: float
    after: float
    kind: str = ""


@dataclass(frozen=True, eq=False)
class Gap:
    """Everything that was found.

    Attributes
    ----------
    verdict : one of VERDICTS. effects : named. stages : on held-out data, "nominal", "re-identified", then one for each
        effect. where : of the gap after re-identification. remaining : the same after the named effects.
    noise_nrmse : what noise alone would leave of the held-out records. next_experiment : None or a sentence.
    baseline, updated : models (updated is the baseline where nothing was named).
    considered : runners-up. heat : residual over noise by band and channel. sentences : verdict first.
    held_out : what no fit has seen, and why. seed, seconds.
    covariance : (n_p, n_p) of the updated model's parameters.
    detectable : where the verdict is none, sizes of five standard deviations of absent effects; else empty.
    shares : what accounts for the outputs' power, by level, the lowest first. records : what each record leaves.
    raised : sensors whose own noise is all that has no name; `remaining` then holds these.
    traces : effects that are there, each below 1 % of the gap. left : what remains, in figures. tolerances : of the
    updated model, the most moved first.
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
            "format": "avis-gap", "version": 1, "verdict": self.verdict,
            "effects": [one.to_json() for one in self.effects],
            "traces": [one.to_json() for one in self.traces],
            "gap": [{"stage": one.name, "nrmse": one.nrmse, "chi2_per_dof": one.chi2_per_dof} for one in self.stages],
            "where": _places(self.remaining if self.verdict != "none" else ()),
            "remaining": None if self.left is None else {
                "nrmse": self.left.nrmse, "over_noise": self.left.over_noise, "share": self.left.share,
                "where": _places(self.remaining), "grows_with_level": self.left.grows_with_level},
            "tolerances": [one.to_json() for one in self.tolerances],
            "next_experiment": self.next_experiment,
            "seconds": self.seconds,
        }


def _places(places: Sequence[Where]) -> list[dict[str, Any]]:
    return [{"from_Hz": one.from_Hz, "to_Hz": one.to_Hz, "input": one.input, "output": one.output, "share": one.share}
            for one in places]
