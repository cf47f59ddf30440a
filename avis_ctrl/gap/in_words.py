"""Effects and their sizes in words."""

from __future__ import annotations

import numpy as np

from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.result import NamedEffect


def in_words(one: NamedEffect) -> str:
    """An effect with its place, first parameters and probability."""
    sizes = ", ".join(f"{spoken(name, p.unit)} {sized(p)}" for name, p in list(one.parameters.items())[:3])
    ties = f", or {' or '.join(one.indistinguishable_from)}, which this data cannot tell from it" \
        if one.indistinguishable_from else ""
    return f"{one.title} ({one.name}, {one.location}: {sizes}; probability {one.probability:.2f}{ties})"


def spoken(name: str, unit: str) -> str:
    """A parameter's name without its unit, which stands behind the number."""
    tail = "".join(sign for sign in unit if sign not in " ^()").replace("/", "_per_").removeprefix("1").lstrip("_")
    return (name.removesuffix(f"_{tail}") if tail else name).replace("_", " ")


def sized(p: Reported) -> str:
    """value +- standard deviation unit, both to the second digit of the latter."""
    unit = "" if p.unit == "1" else f" {p.unit}"
    if not (np.isfinite(p.std) and p.std > 0 and np.isfinite(p.value)):
        return f"{p.value:.5g}{unit}"
    places = 1 - int(np.floor(np.log10(float(f"{p.std:.1e}"))))
    power = int(np.floor(np.log10(max(abs(p.value), p.std)))) if not -4 <= places <= 6 else 0
    value, std = (f"{v / 10.0 ** power:.{max(places + power, 0)}f}" for v in (p.value, p.std))
    return f"({value} +- {std})e{power}{unit}" if power else f"{value} +- {std}{unit}"
