"""Parameters of the named effects, and of the rig with and without the effects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.result import Gap, NamedEffect
from avis_ctrl.gap.table_model import inseparable_parameters
from avis_ctrl.report import words
from avis_ctrl.report.elements import Bullets, Fold, Paragraph, Section, Table, section, shown, table
from avis_ctrl.report.gap import wording
from avis_ctrl.report.sections.tolerances import tolerances
from avis_ctrl.study.gap import GapFinding
from avis_ctrl.summary import joined


def parameters(found: GapFinding) -> Section:
    """Sizes with standard deviations, confirmation of each effect, and the rig's parameters with and without them."""
    gap = found.gap
    named = (*gap.effects, *gap.traces)
    none = (
        "No effect is named: the updated model is the re-identified rig, with the tolerances of its values as priors."
    )
    both = " and updated" if gap.effects else ""
    groups = inseparable_parameters(gap.baseline) if len(gap.baseline.values) else []
    own = shown(_rig(gap, groups), _together(groups), _always(gap))
    return section(
        "Parameters",
        "parameters",
        (_sizes(gap), Bullets([_as_text(one, gap) for one in named])) if named else Paragraph(none),
        Fold(f"The rig's own parameters, re-identified{both}", own),
        tolerances(gap.tolerances),
    )


def _sizes(gap: Gap) -> Table:
    rows = []
    for one in (*gap.effects, *gap.traces):
        for name, p in one.parameters.items():
            value, sigma = words.with_std(p.value, p.std)
            spread = f"± {sigma}" if np.isfinite(p.std) and p.std > 0 else "none"
            rows.append((one.name, one.location, name, value, spread, words.unit(p.unit)))
    return table(
        "Parameters of the named effects. Those of mechanical and drive effects are fitted together with all "
        "values of the rig file; their standard deviation includes the noise and what no effect "
        "explains. Those of hum, converters and floor motion are estimated from the records directly.",
        ("effect", "place", "parameter", "value", "± 1 σ", "unit"),
        rows,
        "lllrrl",
    )


def _as_text(one: NamedEffect, gap: Gap) -> str:
    """Description of an effect: what it is, its influence on the responses, and its confirmation."""
    effect = wording.known(one.name)
    text = f"{wording.titled(one.name).capitalize()} ({one.location}): {wording.what_it_is(one)}."
    if effect is not None:
        text += f" Influence on the responses: {effect.looks_like}."
    if one.confirmation:
        text += f" {words.sentence(one.confirmation)}"
    if one.indistinguishable_from:
        text += f" {wording.rivals(one, gap)}"
    return text


def _rig(gap: Gap, groups: Sequence[Sequence[str]]) -> Table:
    before = dict(zip(gap.baseline.names, gap.baseline.values, strict=True))
    after = dict(zip(gap.updated.names, gap.updated.values, strict=True))
    units, sigma = dict(zip(gap.baseline.names, gap.baseline.units, strict=True)), _deviations(gap)
    shared = {name for group in groups for name in group}
    rows = []
    for name, value in before.items():
        if name.startswith(f"{LargeMotion.name}@"):
            continue
        new = after.get(name, np.nan)
        shown, spread = words.number(new, 5), "in combination" if name in shared else "not stated"
        if name in sigma and name not in shared:
            shown, spread = words.with_std(new, sigma[name])
        change = f"{100 * (new / value - 1):+.2f} %" if value and np.isfinite(new) else "none"
        middle = (words.number(value, 5), shown, spread, change) if gap.effects else (shown, spread)
        rows.append((name, *middle, words.unit(units[name])))
    if not gap.effects:
        return table(
            "The rig's own parameters as re-identified.", ("parameter", "value", "± 1 σ", "unit"), rows, "lrrl"
        )
    return table(
        "Change: from the re-identified to the updated model, due to the effects and to the other values of the rig "
        "file, which only the updated model fits. A change that is not much larger than one standard deviation means "
        "little.",
        ("parameter", "re-identified", "updated", "± 1 σ", "change", "unit"),
        rows,
        "lrrrrl",
    )


def _together(groups: Sequence[Sequence[str]]) -> Paragraph | None:
    """Parameters that the records determine only in combination."""
    told = "; ".join(joined(list(group)) for group in groups)
    text = (
        f"These records determine only combinations of: {told}. The individual values follow from the combination and "
        "the rig file. Records with mounts raised or moved would determine them; avis identify names such records."
    )
    return Paragraph(text, "note") if groups else None


def _always(gap: Gap) -> Paragraph | None:
    """Second-order terms of large rotations, which are part of every model and not an effect."""
    sigma, told = _deviations(gap), []
    for name, value in zip(gap.updated.names, gap.updated.values, strict=True):
        if name.startswith(f"{LargeMotion.name}@"):
            both = words.with_std(value, sigma[name]) if name in sigma else (words.number(value),)
            told.append(f"{wording.titled(name.rpartition('.')[2])} {' ± '.join(both)}")
    text = (
        "Every model also contains the second-order terms of large rotations, which exist in every table. Their "
        "factors are fitted and often poorly determined. The factor of the mounts is 1 in theory. The factors of the "
        "drives' and the sensors' axes are 1 if these are fixed to the payload, and 0 if they are fixed to the "
        f"chassis: {'; '.join(told)}."
    )
    return Paragraph(text, "note") if told else None


def _deviations(gap: Gap) -> dict[str, float]:
    """Known standard deviations of the updated model's parameters, by name."""
    names = gap.updated.names
    if gap.covariance is None or gap.covariance.shape != (len(names), len(names)):
        return {}
    variance = np.diag(gap.covariance)
    return {name: float(np.sqrt(v)) for name, v in zip(names, variance, strict=True) if np.isfinite(v) and v > 0}
