"""Sentences on determined and undetermined parameters, for a mechanical engineer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from avis_ctrl import uncertain_value
from avis_ctrl.identification.information import Combination, Information
from avis_ctrl.identification.structural_identifiability import Scaling
from avis_ctrl.summary import joined

_KINDS = {
    "sensor": "sensor sensitivities",
    "kg": "masses",
    "kg m^2": "inertias",
    "N/m": "stiffnesses",
    "N m/rad": "rotational stiffnesses",
    "N s/m": "dampings",
    "N m s/rad": "rotational dampings",
    "N/V": "force constants",
    "m": "lengths",
}


def combination_text(terms: Iterable[tuple[str, float]], powers: Sequence[tuple[str, float]] = ()) -> str:
    """A weighted sum, times powers of other parameters; terms of weight zero are omitted."""
    text, terms = "", [(name, weight) for name, weight in terms if weight]
    for name, weight in terms:
        size = "" if abs(weight) == 1 else f"{abs(weight):.4g} "
        text += f" {'-' if weight < 0 else '+'} {size}{name}"
    text = text.removeprefix(" + ").removeprefix(" ")
    if len(terms) > 1 and powers:
        text = f"({text})"
    for name, power in powers:
        text += (" * " if power > 0 else " / ") + name + (f"^{abs(power):g}" if abs(power) != 1 else "")
    return text


def unit_text(unit: str, powers: Sequence[tuple[str, float]]) -> str:
    """Unit of a quantity times powers of quantities in other units."""
    if unit == "mixed units":
        return unit
    for other, power in powers:
        if (unit, power) == (other, -1):
            unit = "1"
            continue
        compound = f"({other})" if any(ch in other for ch in " /") else other
        unit += (" * " if power > 0 else " / ") + compound + (f"^{abs(power):g}" if abs(power) != 1 else "")
    return unit


def known_text(one: Combination) -> str:
    """Value and standard deviation."""
    if not one.determined:
        return f"{one.words} (not determined by these data)"
    return f"{one.words} = {uncertain_value.text(one.value, one.standard_deviation, one.unit)}"


def group_sentence(members: Sequence[str], seen: Sequence[Combination]) -> str:
    """How a group of correlated parameters is determined: the combinations that these data determine."""
    if not seen:
        one = len(members) == 1
        return (
            f"{joined(members)} {'has' if one else 'have'} no influence on the responses to these inputs and "
            f"{'is' if one else 'are'} not determined."
        )
    few = joined(members) if len(members) <= 8 else f"{', '.join(members[:7])} and {len(members) - 7} more"
    if len(seen) == 1:
        plain = seen[0].words.removeprefix("(").partition(")")[0] == " + ".join(members)
        sort = "their sum" if plain else "one combination"
        return f"{few} {'is' if len(members) == 1 else 'are'} determined only as {sort}: {known_text(seen[0])}."
    shown = "; ".join(known_text(one) for one in seen[:8]) + ("; .." if len(seen) > 8 else "")
    return f"{few} ({len(members)}) are determined only through {len(seen)} combinations: {shown}."


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def kinds(exponents: np.ndarray, information: Information, of: float) -> list[str]:
    """Kinds of parameters with this exponent; a single parameter by its name."""
    members: dict[str, list[str]] = {}
    for name, unit, exponent in zip(information.names, information.units, exponents, strict=True):
        if exponent == of:
            kind = "sensor" if name.startswith("sensor.") else unit
            members.setdefault(kind, []).append(name)
    said = []
    for kind, names in members.items():
        if len(names) == 1:
            said.append(names[0])
            continue
        plural = _KINDS.get(kind, f"parameters in {kind}")
        said.append(plural + (f" ({', '.join(names)})" if len(names) <= 3 else ""))
    return said


def scaling_sentence(scaling: Scaling, information: Information) -> str:
    """A common factor that changes no response, and the parameter that fixes it."""
    sizes = sorted(set(scaling.exponents[scaling.exponents != 0].tolist()), reverse=True)
    members = [joined(kinds(scaling.exponents, information, size)) for size in sizes]
    if sizes == [1.0]:
        said = f"{_upper(members[0])} are determined only as ratios: a common factor of all of them changes no response"
    elif sizes == [1.0, -1.0]:
        up, down = members
        products = f"{_upper(up)} and {down} are determined only as products"
        said = f"{products}: larger {up} with smaller {down} change no response"
    else:
        powers = ("" if size == 1 else f" to the power {size:g}" for size in sizes)
        parts = "; ".join(f"{some} by the factor{power}" for some, power in zip(members, powers, strict=True))
        said = f"Multiplying {parts} changes no response"
    return f"{said}. If {information.names[scaling.pin]} is known, the factor is known."


def weak_sentence(one: Combination) -> str:
    """Precision of a combination that is determined poorly."""
    return (
        f"{one.words} is determined only to {100 * one.relative:.3g} %: "
        f"{uncertain_value.text(one.value, one.standard_deviation, one.unit)}."
    )


def main_members(names: Sequence[str], direction: np.ndarray) -> list[tuple[str, float]]:
    """Members with nine tenths of a unit vector's squared length, the largest first, in positive direction."""
    order = np.argsort(-np.abs(direction))
    count = int(np.searchsorted(np.cumsum(direction[order] ** 2), 0.9)) + 1
    return [(names[j], float(np.sign(direction[order[0]]) * direction[j])) for j in order[:count]]


def weak_direction_sentence(names: Sequence[str], direction: np.ndarray, sigma: float) -> str:
    """Changes of the parameters that amount to one standard deviation along the least precise direction."""
    moved = [f"{name} by {100 * sigma * weight:+.2g} %" for name, weight in main_members(names, direction)[:6]]
    return f"The least precise combination: changing {joined(moved)} together is one standard deviation."
