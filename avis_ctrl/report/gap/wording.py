"""Wording of verdicts, effects and parameters, the same in every section."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avis_ctrl.gap.effects.base import Effect, Reported
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.result import Considered, Gap, NamedEffect, Where, spoken
from avis_ctrl.gap.settings import SETTINGS as GAP
from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph
from avis_ctrl.summary import joined
from avis_ctrl.uncertain_value import with_prefix

# What each verdict claims, and what it does not.
CLAIMS = {
    "none": "Verdict: none. The parameters of the rig were re-identified, and the other values of the rig file were "
    "fitted with their tolerances as standard deviations. The residual is noise, or exceeds it by less "
    "than 1 % of the response. Apart from traces, no effect is named. An effect "
    "can still be present if it is too weak for this campaign, if these records do not excite it, or if "
    "the parameters of the rig can imitate it.",
    "explained": "Verdict: explained. Refitted values and the effects named above remove {removed} of the power that "
    "the residual of the re-identified model has beyond noise, on held-out records.",
    "partly explained": "Verdict: partly explained. The effects named above meet all conditions for being named. "
    "With the refitted values they remove {removed} of the power that the residual of the "
    "re-identified model has beyond noise. The rest is described below. The updated model is "
    "better, not complete.",
    "unexplained": "Verdict: unexplained. Model and held-out records disagree. Neither refitted values nor any effect "
    "of the library that meets all conditions for being named explains the difference. The updated model "
    "contains no effects except traces.",
}
# The claim if only the increased noise of some sensors is unexplained.
RAISED = (
    "Verdict: {verdict}. The noise of {sensors} is above the rig file's ambient level, and no effect of the "
    "library describes this. As a whole, the residual of the model{with_effects} on the held-out data is the measured "
    "noise."
)


def claim(gap: Gap) -> str:
    """What the verdict claims, and what it does not."""
    if gap.raised:
        return RAISED.format(
            verdict=gap.verdict,
            sensors=joined(list(gap.raised)),
            with_effects=" with the effects named above" if gap.effects else "",
        )
    left = gap.left.share if gap.left else np.nan
    removed = words.percent(max(1 - left, 0.0)) if np.isfinite(left) else "a part"
    within_noise = gap.verdict == "explained" and left > 1 - GAP.explained
    rest = " The rest is within the uncertainty of the noise." * within_noise
    return CLAIMS[gap.verdict].format(removed=removed) + rest


def verdict(text: str, word: str) -> Paragraph:
    """A verdict, coloured by its word."""
    good = {"none": True, "explained": True, "unexplained": False}.get(word)
    return Paragraph(text, "verdict", good, word == "partly explained")


def titled(name: str) -> str:
    """Name of an effect in text."""
    return name.replace("_", " ")


def known(name: str) -> Effect | None:
    """The effect of this name in the library; None for an effect that acts only on the signals."""
    return library().get(name)


def what_it_is(effect: NamedEffect) -> str:
    """Title of an effect."""
    listed = known(effect.name)
    return effect.title or (listed.title if listed else titled(effect.name))


def rivals(one: NamedEffect, gap: Gap) -> str:
    """Which effects these records cannot distinguish from a named one, whether or not the updated model has them."""
    others = list(map(titled, one.indistinguishable_from))
    names = [titled(one.name), *others]
    if {each.name for each in (*gap.effects, *gap.traces)} >= set(one.indistinguishable_from):
        return (
            f"When {names[0]} was found, {joined(others)} explained these records almost as well. The updated model "
            f"has {'both' if len(names) == 2 else 'all of them'}; part of what is attributed to one may belong to "
            "another. See the section on what to measure next."
        )
    return (
        f"These records cannot distinguish {joined(names)}. {'Either' if len(names) == 2 else 'Any'} of them may be "
        "the cause, and so may a cause that was not among the candidates. See the section on what to measure next."
    )


def probability(value: float) -> str:
    """A probability in per cent, never 0 and at most `GapSettings.most_sure`."""
    if not np.isfinite(value):
        return "not computed"
    if value >= GAP.most_sure:
        return f"{100 * GAP.most_sure:g} %"
    return "< 0.1 %" if value < 0.001 else f"{words.number(100 * value)} %"


def quantity(one: Reported) -> str:
    """A value with its standard deviation and unit."""
    size, std, unit = with_prefix(one.value, one.std, one.unit)
    value, sigma = words.with_std(size, std)
    unit = words.unit(unit)
    if not (np.isfinite(one.std) and one.std > 0):
        return f"{value} {unit}".rstrip() + " (no standard deviation)"
    return f"({value} ± {sigma}) {unit}" if unit else f"{value} ± {sigma}"


def quantities(parameters: Mapping[str, Reported], most: int | None = None) -> str:
    """Parameters with name, value, standard deviation and unit; at most `most` of them."""
    told = [f"{spoken(name, one.unit)} {quantity(one)}" for name, one in parameters.items()]
    return "; ".join([*told[:most], *([f"and {len(told) - most} more"] if most and len(told) > most else [])])


def place(one: Where) -> str:
    """A band and path in words."""
    path = f"{one.output} from {one.input}" if one.input else one.output
    return f"{path}, {words.number(one.from_Hz)} to {words.number(one.to_Hz)} Hz"


def candidate(one: Considered) -> str:
    """Name, place and law of a candidate."""
    details = ", ".join(filter(None, [one.location, one.law and f"form {one.law!r}"]))
    return f"{titled(one.name)} ({details})" if details else titled(one.name)
