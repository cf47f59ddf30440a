"""Keys that may vary: keys of the sections of an input file, and parameters of its rig."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, get_args, get_origin

from pydantic import BaseModel

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True)
class KeySettings:
    """similar : smallest fraction of matching characters with which a known key is suggested for an unknown one [1]:
    it is above 0.8 after a typing error, and below 0.5 for unrelated keys of the same length.
    """

    similar: float = 0.7


SETTINGS = KeySettings()
# Prefixes of a parameter's name: its value, or a factor on the value in the rig file.
VALUE, FACTOR = "rig.", "rig_factor."


def keys_of(model: type[BaseModel], before: str = "") -> dict[str, bool]:
    """Dotted keys of a file's model; True for a table with arbitrary keys, such as parameters_percent."""
    found: dict[str, bool] = {}
    for name, field in model.model_fields.items():
        kinds = [one for one in (field.annotation, *get_args(field.annotation)) if one is not type(None)]
        found[f"{before}{name}"] = any(get_origin(one) is dict for one in kinds)
        inner = [one for one in kinds if isinstance(one, type) and issubclass(one, BaseModel)]
        if inner and str not in kinds and get_origin(field.annotation) is not list:
            found |= keys_of(inner[0], f"{before}{name}.")
    return found


def put(table: dict[str, Any], key: str, value: Any, known: Mapping[str, bool]) -> None:
    """Set a dotted key in nested tables; an arbitrary key inside a table ("isolator*.k_z") keeps its dots."""
    free = next((name for name, free in known.items() if free and key.startswith(f"{name}.")), None)
    before, _, last = key.rpartition(".") if free is None else (free, "", key[len(free) + 1 :])
    for name in before.split(".") if before else ():
        table = table.setdefault(name, {})
    table[last] = value


def expanded(key: str, known: Mapping[str, bool], rig: Rig) -> list[str]:
    """The keys that match a key with wildcards.

    Raises InputError with the closest known keys.
    """
    if key in known or any(free and key.startswith(f"{name}.") for name, free in known.items()):
        return [key]
    names = [f"{before}{name}" for before in (VALUE, FACTOR) for name in rig.parameters()]
    if found := [name for name in names if fnmatchcase(name, key)]:
        return found
    if "*" in key:
        names = [re.sub(r"\d+", "*", name) for name in names]
    near = _nearest(key, [*known, *names])
    hint = f"did you mean {' or '.join(near)}?" if near else f"expected one of {', '.join(known)}"
    raise InputError(f"unknown key; {hint}", field="key", value=key)


def _nearest(key: str, every: Sequence[str]) -> list[str]:
    """At most three names that resemble a key, as a whole or in their last part, the nearest first."""

    def similarity(one: str, other: str) -> float:
        return difflib.SequenceMatcher(None, one, other).ratio()

    last = key.rpartition(".")[2]
    similar = {name: max(similarity(key, name), similarity(last, name.rpartition(".")[2])) for name in every}
    # Of names with the same last part, those that resemble the whole key come first.
    order = sorted(similar, key=lambda name: (-similar[name] - similarity(key, name), name))
    return [name for name in order if similar[name] >= SETTINGS.similar][:3]


def with_rig_keys(rig: Rig, point: Mapping[str, Any]) -> Rig:
    """The rig with the values and factors of a point. Raises InputError for a name or value that does not fit."""
    changes: dict[str, float] = {}
    for key, value in point.items():
        before = next((one for one in (VALUE, FACTOR) if key.startswith(one)), None)
        if before is None:
            continue
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError("expected a number", field=key, value=value)
        for name in _names(rig, key, before):
            if name in changes:
                raise InputError(f"{name} is set twice", field=key, value=value)
            changes[name] = value * (rig.parameters()[name].value if before == FACTOR else 1.0)
    return rig.with_parameters(changes) if changes else rig


def _names(rig: Rig, key: str, before: str) -> Sequence[str]:
    pattern = key.removeprefix(before)
    return [name for name in rig.parameters() if fnmatchcase(name, pattern)] or [pattern]
