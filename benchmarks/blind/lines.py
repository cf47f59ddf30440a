"""The lines of a blind campaign: what was hidden, what was answered, and what it cost.

One JSON object per line and case. The runner writes them, the scorer reads them; nothing else passes between the two.
"""

from __future__ import annotations

import gzip
import json
import zlib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.file_errors import first_complaint

Kind = Literal["none", "one", "two", "outside"]
Strength = Literal["faint", "clear", "gross"]
KINDS: tuple[Kind, ...] = ("none", "one", "two", "outside")
STRENGTHS: tuple[Strength, ...] = ("faint", "clear", "gross")
NotNegative = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(ge=0, le=1)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class Hidden(_Part):
    """An effect that the truth contains; its parameters are what the truth was built with.

    variant : which of the effect's laws a cluttered truth obeys; None where there is only the simplest.
    """

    name: str
    location: str
    parameters: dict[str, Any]
    strength: Strength
    variant: str | None = None


class Trace(_Part):
    """An effect that a cluttered truth contains besides, at a level that nobody need name.

    unexplained : what it leaves of the response, r.m.s., when the table is re-identified.
    """

    name: str
    location: str
    parameters: dict[str, Any]
    unexplained: NotNegative


class Estimate(_Part):
    """A parameter with its standard deviation (None where the finder gives none)."""

    value: float
    std: NotNegative | None
    unit: str


class Named(_Part):
    """An effect that the finder names (gap.json)."""

    name: str
    location: str
    parameters: dict[str, Estimate]
    probability: Probability
    indistinguishable_from: list[str]
    share: Probability | None = None


class Stage(_Part):
    """A stage of the ladder; measured on data that no fit has seen."""

    stage: str
    nrmse: NotNegative
    chi2_per_dof: NotNegative


class Place(_Part):
    """Where the gap is."""

    from_Hz: float
    to_Hz: float
    input: str | None
    output: str | None
    share: float


class Answer(BaseModel):
    """gap.json of the contract; keys beyond it are kept."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False, frozen=True)

    format: Literal["avis-gap"]
    version: Literal[1]
    verdict: Literal["none", "explained", "partly explained", "unexplained"]
    effects: list[Named]
    traces: list[Named] = []
    gap: list[Stage]
    where: list[Place]
    next_experiment: str | None
    seconds: NotNegative


class Unseen(_Part):
    """nrmse of the two predictions on a campaign of the same truth that the finder never saw.

    best : of the best prediction possible: the true table with its traces and all that is random switched off.
    """

    baseline: NotNegative
    updated: NotNegative
    best: NotNegative | None = None


class Settings(_Part):
    """What a line was made with: the same for every line of a file, but for the commit.

    kind, effect, strength : forced on every case; None where the truth draws them.
    cluttered : share of the cases with a cluttered table.
    commit : of the code, with "+" where files differed from it.
    """

    duration_s: Annotated[float, Field(gt=0)]
    jobs: Annotated[int, Field(ge=1)]
    kind: Kind | None = None
    effect: str | None = None
    strength: Strength | None = None
    unseen: bool = False
    cluttered: Annotated[float, Field(ge=0, le=1)] = 0.0
    commit: str = ""

    @property
    def campaign(self) -> tuple:
        """What decides on the cases; lines that differ here do not belong together."""
        return self.duration_s, self.kind, self.effect, self.strength, self.cluttered


class Line(_Part):
    """A case.

    hidden : effects of the truth; empty where kind is "none" (and where the truth itself failed).
    cluttered : the table is off its rig file in everything a little, and has traces of effects besides.
    far : (effect, place) of its values that the draw put beyond three tolerances; set by the scorer.
    relative_change : by how much the effects change the signals, as the truth counts it; None where unknown.
    answer : what the finder said; None after a crash. crash : the text of the exception, None without one.
    seconds, cpu_seconds : the finder's, by the clock and summed over its processes.
    memory_MB : the most that the worker and its children held together while the finder ran, shared pages once.
    simulation_seconds : the truth's.
    unseen : None where it was not asked for, or failed; unseen_error : the text of that exception.
    """

    seed: Annotated[int, Field(ge=0)]
    kind: Kind
    hidden: list[Hidden]
    excitation: str
    floor_recorded: bool
    relative_change: float | None
    answer: Answer | None
    crash: str | None
    seconds: NotNegative | None
    cpu_seconds: NotNegative | None
    memory_MB: NotNegative | None
    simulation_seconds: NotNegative | None
    unseen: Unseen | None
    unseen_error: str | None
    settings: Settings
    cluttered: bool = False
    traces: list[Trace] = []
    far: list[tuple[str, str]] = []

    @model_validator(mode="after")
    def _consistent(self) -> Line:
        if (self.answer is None) == (self.crash is None):
            raise ValueError("expected an answer or a crash, one of the two")
        expected = {"none": 0, "one": 1, "two": 2}.get(self.kind)
        if expected is not None and len(self.hidden) != expected:
            raise ValueError(f"kind {self.kind!r} expects {expected} hidden effects, this case has {len(self.hidden)}")
        if self.kind == "outside" and not self.hidden:
            raise ValueError("kind 'outside' expects at least one hidden effect")
        return self

    @property
    def strength(self) -> Strength | None:
        """Of the weakest hidden effect."""
        return min((one.strength for one in self.hidden), key=STRENGTHS.index, default=None)

    @property
    def clear(self) -> bool:
        return self.strength in ("clear", "gross")


Content = TypeVar("Content", bound=BaseModel)


def parse(text: str, model: type[Content]) -> Content:
    """A checked object from JSON text.

    Raises
    ------
    InputError : text that is not JSON, a wrong or missing key, a number that is none.
    """
    try:
        table = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(f"expected one JSON object on a line: {error.msg} at character {error.pos + 1}") from None
    except RecursionError:
        raise InputError("expected one JSON object on a line; this one is nested too deeply") from None
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise first_complaint(error, model) from None


def read_lines(path: str | Path) -> list[Line]:
    """All lines of a file, by seed.

    Raises
    ------
    InputError : no such file, no line, a line that is wrong or incomplete, a seed twice, lines of different campaigns.
    """
    path = Path(path)
    found: dict[int, Line] = {}
    for number, text in enumerate(_text(path).splitlines(), 1):
        where = f"{path}, line {number}"
        try:
            line = parse(text, Line)
        except InputError as error:
            raise error.in_file(where) from None
        if line.seed in found:
            raise InputError("expected each seed once", file=where, field="seed", value=line.seed)
        first = next(iter(found.values()), line)
        if line.settings.campaign != first.settings.campaign:
            raise InputError(
                f"expected the campaign of line 1: {first.settings.campaign}",
                file=where,
                field="settings",
                value=line.settings.campaign,
            )
        found[line.seed] = line
    if not found:
        raise InputError("expected at least one line", file=path)
    return [found[seed] for seed in sorted(found)]


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
        return (gzip.decompress(content) if path.suffix == ".gz" else content).decode("utf-8")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or "is not UTF-8 text, or gzipped text"
        raise InputError(f"expected a readable file of JSON lines: {reason}", file=path) from None


def finished(path: Path) -> list[Line]:
    """Lines of an interrupted campaign; an unfinished last line, left by a kill, is cut from the file."""
    if not path.exists():
        return []
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        path.write_bytes(whole)
    return read_lines(path) if whole else []
