"""Provenance of a report: versions, hash of the inputs, seed, computing time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from avis_ctrl.report import words
from avis_ctrl.report.pieces import Section, table
from avis_ctrl.study.design_result import DesignResult

NAMES = {
    "avis_ctrl": "avis_ctrl version",
    "design_file": "design file",
    "inputs_sha256": "SHA-256 of the inputs",
    "measurement_sha256": "SHA-256 of the measurement",
    "seconds": "seconds of computing",
    "python": "Python",
}


@dataclass(frozen=True)
class ProvenanceSettings:
    """most_values : maximum number of values in a table row; longer lists are only in the JSON file."""

    most_values: int = 12


SETTINGS = ProvenanceSettings()


def provenance(result: DesignResult) -> Section:
    """The provenance of a design."""
    return provenance_table(
        result.provenance,
        "The same inputs, seed, library versions and processor give the same "
        "figures; otherwise round-off may change the course of the D-K iteration.",
    )


def provenance_table(made: Mapping[str, Any], caption: str) -> Section:
    """Table of the provenance of a result."""
    rows = [(NAMES.get(key, key), _as_text(value)) for key, value in made.items() if value is not None]
    return Section("Provenance", "provenance", (table(caption, ("what", "value"), rows, "ll"),))


def _as_text(value: Any) -> str:
    if isinstance(value, Mapping) and len(value) > SETTINGS.most_values:
        return "listed in the JSON file of results"
    if isinstance(value, Mapping):
        return "; ".join(
            f"{key} ({_as_text(one)})" if isinstance(one, Mapping) else f"{key} {_as_text(one)}"
            for key, one in value.items()
            if one is not None
        )
    return words.number(value) if isinstance(value, float) else str(value)
