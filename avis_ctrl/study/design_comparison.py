"""Two designs side by side, from the folders of `avis design`: what was requested differently, and the results."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.file_errors import read_json
from avis_ctrl.study.study_file import STUDY
from avis_ctrl.summary import html_table, in_short

RESULT = "result.json"
# Sections that define the mu problem; if they differ, the values of mu cannot be compared.
WEIGHTS = ("rig", "loaded", "keep", "loop", "uncertainty", "transmissibility", "control_effort", "compliance", "floor")
FIGURES = (
    ("order", "states of the controller", ""),
    ("mu_upper", "mu, upper bound", ""),
    ("mu_lower", "mu, lower bound", ""),
    ("peak_transmissibility_dB", "peak transmissibility, nominal", "dB"),
    ("worst_case_peak_transmissibility_dB", "peak transmissibility, worst case", "dB"),
)


@dataclass(frozen=True)
class DesignComparison:
    """titles : of both designs. requested : (key of the design file, first, second) where they differ.
    found : (quantity with unit, first, second). note : what cannot be compared; empty if everything can.
    """

    titles: tuple[str, str]
    requested: tuple[tuple[str, str, str], ...]
    found: tuple[tuple[str, str, str], ...]
    note: str

    def _repr_html_(self) -> str:
        return html_table([*self.requested, *self.found], ("", *self.titles), self.note)


def compare_designs(first: str | Path, second: str | Path) -> DesignComparison:
    """Compare the results of two designs.

    Parameters
    ----------
    first, second : folders written by `avis design` or a design's `save`.

    Raises InputError: a folder without such a result, in one line.
    """
    folders = Path(first), Path(second)
    studies = [read_json(folder / STUDY, "avis-study") for folder in folders]
    results = [read_json(folder / RESULT, "avis-design") for folder in folders]
    rigs = [_rig_values(study.get("rig")) for study in studies]
    asked = [_asked(study.get("design")) for study in studies]
    requested = [(f"rig file: {key}", one, other) for key, one, other in _side_by_side(rigs, differing=True)]
    requested += _side_by_side(asked, differing=True)
    found = list(_side_by_side([_figures(result, folder) for result, folder in zip(results, folders, strict=True)]))
    other = sorted({key.partition(".")[0].partition(":")[0] for key, *_ in requested} & {*WEIGHTS, "rig file"})
    note = (
        "mu of the two cannot be compared, because it depends on what was requested differently "
        f"({', '.join(other)}); transmissibilities can be compared"
        if other
        else ""
    )
    titles = tuple(
        str(study.get("design", {}).get("title", folder)) for study, folder in zip(studies, folders, strict=True)
    )
    if titles[0] == titles[1]:
        titles = str(folders[0]), str(folders[1])
    return DesignComparison((titles[0], titles[1]), tuple(requested), tuple(found), note)


def _side_by_side(tables: Sequence[dict[str, Any]], differing: bool = False) -> Iterator[tuple[str, str, str]]:
    """(key, first, second) as text for two tables: of all keys, or of those whose values differ."""
    first, second = tables
    for key in dict.fromkeys([*first, *second]):
        one, other = first.get(key), second.get(key)
        if not differing or one != other:
            yield key, _as_text(one), _as_text(other)


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of nested tables; the tables of a list by name, or by number from 1."""
    if isinstance(value, dict) and not name.endswith("identified"):
        for key, one in value.items():
            yield from _leaves(one, f"{name}.{key}" if name else key)
    elif isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
        for k, one in enumerate(value, 1):
            yield from _leaves(one, f"{name} {one.get('name', k)}")
    else:
        yield name, value


def _asked(design: Any) -> dict[str, Any]:
    """The values of a design by dotted key; those of its requirements by quantity."""
    if not isinstance(design, dict):
        raise InputError("expected a design", field=STUDY)
    asked = dict(_leaves({key: value for key, value in design.items() if key not in ("title", "requirement")}))
    for one in design.get("requirement", ()):
        limit = "at_most" if one.get("at_most") is not None else "at_least"
        asked[f"requirement {one.get('quantity')}, {limit.replace('_', ' ')}"] = one.get(limit)
    return asked


def _rig_values(text: Any) -> dict[str, Any]:
    """The values of a rig file by dotted key."""
    try:
        return dict(_leaves(tomllib.loads(text) if isinstance(text, str) else {"text": text}))
    except tomllib.TOMLDecodeError:
        return {"text": text}


def _figures(result: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Values by quantity: those of the delivered controller and those of the verdict table."""
    try:
        mu = next(row for row in result["controllers"] if row["name"] == "mu")
        figures: dict[str, Any] = {f"{words}{f' [{unit}]' if unit else ''}": mu[key] for key, words, unit in FIGURES}
        figures["stable in every simulated plant"] = result["stable"]
        for row in result["requirements"]:
            unit = f" [{row['unit']}]" if row["unit"] else ""
            figures[f"{row['name']}{unit}"] = row["value"]
        figures["requirements met"] = (
            f"{sum(row['met'] for row in result['requirements'])} of {len(result['requirements'])}"
        )
    except (KeyError, TypeError, StopIteration) as error:
        raise InputError(f"expected a result as avis design writes it; {error!r}", file=folder / RESULT) from None
    return figures


def _as_text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return "an identification"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return value if isinstance(value, str) else in_short(value)
