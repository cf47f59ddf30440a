"""What an answer is worth, case by case: hidden effects against named ones.

A named effect is right where it is a hidden one, or where a hidden one is in its `indistinguishable_from`. Entries of
that list are names, or names with a place ("sensor_gain at Sz2", "sensor_gain@Sz2", "sensor_gain (Sz2)").
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from avis_ctrl.rigs.instruments import Tolerances
from benchmarks.blind.lines import Hidden, Line, Named, Trace

# Effects of the contract with their places; those in PLACED have a place that can be wrong.
PLACED = (
    "geophone_corner",
    "sensor_gain",
    "sensor_misalignment",
    "sensor_quantisation",
    "actuator_gain",
    "product_of_inertia",
)
LIBRARY = (
    "geophone_corner",
    "sensor_gain",
    "sensor_misalignment",
    "tilt_coupling",
    "mains_hum",
    "sensor_quantisation",
    "actuator_gain",
    "actuator_lag",
    "actuator_saturation",
    "loop_delay",
    "contact_friction",
    "com_offset",
    "product_of_inertia",
    "payload_flexible_mode",
    "attached_oscillator",
    "base_compliance",
    "mount_relaxation",
    "structural_damping",
    "mount_surge",
    "cubic_stiffness",
    "leveling_loop",
    "cable_stiffness",
    "ground_motion",
    "stiffness_drift",
)

# Outcomes, the best first.
OUTCOMES = {
    "none": ("quiet", "alarm without a name", "false name", "crash"),
    "one": ("right", "right and an extra", "refused", "missed", "wrong", "crash"),
    "two": (
        "both right",
        "both right and an extra",
        "one right",
        "one right, one wrong",
        "refused",
        "missed",
        "wrong",
        "crash",
    ),
    "outside": ("refused", "missed", "named as something else", "crash"),
}


def split_name(entry: str) -> tuple[str, str | None]:
    """Name and place of an entry of `indistinguishable_from`."""
    name, *place = re.split(r"\s+at\s+|\s*@\s*|\s*\(", entry.strip(), maxsplit=1)
    return name, place[0].rstrip(") ") if place else None


@dataclass(frozen=True)
class Match:
    """A hidden effect and the named one that stands for it.

    exact : by its own name, not only through its group. place : the place is right too.
    """

    hidden: Hidden
    named: Named
    exact: bool
    place: bool


def match(hidden: Hidden, named: Named) -> Match | None:
    """None where the names do not meet."""
    group = [split_name(entry) for entry in named.indistinguishable_from]
    places = {place for name, place in group if name == hidden.name}
    if named.name == hidden.name:
        return Match(hidden, named, True, named.location == hidden.location)
    if not places:
        return None
    return Match(hidden, named, False, hidden.location in {named.location if one is None else one for one in places})


def matches(hidden: Sequence[Hidden], named: Sequence[Named]) -> list[Match]:
    """As many pairs as there are, each effect in one at most; among those, most exact names, then most places."""
    if not hidden:
        return []
    first, rest = hidden[0], hidden[1:]
    options = [matches(rest, named)]
    for k, candidate in enumerate(named):
        if (pair := match(first, candidate)) is not None:
            options.append([pair, *matches(rest, [*named[:k], *named[k + 1 :]])])
    return max(options, key=lambda pairs: (len(pairs), sum(p.exact for p in pairs), sum(p.place for p in pairs)))


@dataclass(frozen=True)
class Judged:
    """A line with its outcome (one of OUTCOMES[line.kind]) and the pairs of hidden and named effects.

    An effect that is a trace of a cluttered table is there: naming it is not wrong, though it finds no hidden one.
    """

    line: Line
    outcome: str
    pairs: tuple[Match, ...]

    @property
    def named(self) -> Sequence[Named]:
        return self.line.answer.effects if self.line.answer is not None else []

    @property
    def verdict(self) -> str:
        return self.line.answer.verdict if self.line.answer is not None else "crash"

    def right(self, named: Named, *, exact: bool) -> bool:
        """Whether a named effect is in this case; with `exact` a right group is not enough."""
        hidden = any(one.named is named and (one.exact or not exact) for one in self.pairs)
        return hidden or is_trace(named, self.line)

    @property
    def false_names(self) -> list[Named]:
        """Neither hidden nor a trace."""
        return [one for one in self.named if not self.right(one, exact=False)]

    @property
    def answered(self) -> str:
        """Column of the confusion matrix: the name, where right through its group the hidden one's; or a word."""
        if not self.named:
            return self.verdict if self.verdict in ("none", "crash") else "unexplained"
        if len(self.named) > 1:
            return "several"
        return self.pairs[0].hidden.name if self.pairs else self.named[0].name


def is_trace(named: Named, line: Line) -> bool:
    """Whether a named effect is a trace of a cluttered table, or a value of it that lies beyond its tolerance."""
    return any(one.name == named.name for one in line.traces) or (named.name, named.location) in line.far


# Parameters of a hidden value of the rig file, what the file says, and its default tolerance.
_T, _CORNER_Hz = Tolerances(), 4.5
TOLERANCES = {
    "sensor_gain": (("gain",), 1.0, _T.sensor_gain_percent / 100),
    "actuator_gain": (("gain",), 1.0, _T.actuator_gain_percent / 100),
    "sensor_misalignment": (("angle_rad",), 0.0, _T.direction_rad),
    "geophone_corner": (("corner_Hz",), _CORNER_Hz, _CORNER_Hz * _T.sensor_corner_percent / 100),
    "com_offset": (("x_m", "y_m", "z_m"), 0.0, _T.centre_of_mass_m),
    "product_of_inertia": (("product_kgm2",), 0.0, _T.product_of_inertia_kgm2),
}
# Up to so many of them a departure is within tolerance, and no missing effect.
WITHIN = 3.0


def tolerated(one: Hidden) -> bool:
    """Whether a hidden departure is within its tolerance."""
    names, stated, tolerance = TOLERANCES.get(one.name, ((), 0.0, 1.0))
    moved = [abs(one.parameters[name] - stated) / tolerance for name in names if name in one.parameters]
    return bool(moved) and max(moved) < WITHIN


def without_tolerated(line: Line) -> Line:
    """The line with hidden departures that are within tolerance among its traces: whoever names them is not wrong."""
    if line.kind not in ("one", "two"):
        return line
    within, left = ([one for one in line.hidden if tolerated(one) == so] for so in (True, False))
    traces = [Trace(name=one.name, location=one.location, parameters=one.parameters, unexplained=0.0) for one in within]
    kind = ("none", "one", "two")[len(left)]
    return line.model_copy(update={"hidden": left, "kind": kind, "traces": [*line.traces, *traces]})


def judge(line: Line) -> Judged:
    line = without_tolerated(line)
    if line.answer is None:
        return Judged(line, "crash", ())
    pairs = tuple(matches(line.hidden, line.answer.effects))
    own = [one.named for one in pairs]
    named = [one for one in line.answer.effects if any(one is pair for pair in own) or not is_trace(one, line)]
    extra, quiet = len(named) - len(pairs), line.answer.verdict == "none"
    if line.kind == "none":
        only_traces = bool(line.answer.effects) and not named
        return Judged(
            line, "false name" if named else "quiet" if quiet or only_traces else "alarm without a name", pairs
        )
    if line.kind == "outside":
        outcome = "named as something else" if extra else "missed" if quiet and not named else "refused"
        return Judged(line, outcome, pairs)
    if not named:
        return Judged(line, "missed" if quiet else "refused", pairs)
    if not pairs:
        return Judged(line, "wrong", pairs)
    if len(pairs) == len(line.hidden):
        head = "right" if line.kind == "one" else "both right"
        return Judged(line, head + " and an extra" * bool(extra), pairs)
    return Judged(line, "one right" + ", one wrong" * bool(extra), pairs)


def contradiction(line: Line) -> str | None:
    """Where an answer breaks the contract's own rules."""
    if line.answer is None:
        return None
    verdict, named = line.answer.verdict, line.answer.effects
    if verdict in ("none", "unexplained") and named:
        return f"verdict {verdict!r} with named effects"
    if verdict in ("explained", "partly explained") and not named:
        return f"verdict {verdict!r} without a named effect"
    unknown = [one.name for one in named if one.name not in LIBRARY]
    return f"effect {unknown[0]!r} is not in the contract's library" if unknown else None
