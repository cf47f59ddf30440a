"""A report with the provenance of its results: versions, hash of the inputs, seed, computing time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from avis_ctrl.report import words
from avis_ctrl.report.elements import Document, Section, section, table
from avis_ctrl.report.settings import SETTINGS

NAMES = {
    "avis_ctrl": "avis_ctrl version",
    "design_file": "design file",
    "inputs_sha256": "SHA-256 of the inputs",
    "measurement_sha256": "SHA-256 of the measurement",
    "seconds": "seconds of computing",
    "python": "Python",
}
REPRODUCED = "The same measurement, rig, options, seed, library versions and processor give the same figures."


def document_of(
    title: str, subtitle: str, provenance: Mapping[str, Any], sections: Iterable[Section], caption: str = REPRODUCED
) -> Document:
    """A report with the date under its title, version and hash of the inputs in its page header, and the provenance.

    caption : of the table of provenance.
    """
    date = str(provenance.get("date", ""))[:10]
    rows = [(NAMES.get(key, key), _as_text(value)) for key, value in provenance.items() if value is not None]
    made = table(caption, ("what", "value"), rows, "ll")
    return Document(
        title,
        subtitle + (f", {date}" if date else ""),
        f"avis_ctrl {provenance.get('avis_ctrl', '')}, inputs {str(provenance.get('inputs_sha256', ''))[:12]}",
        (*sections, section("Provenance", "provenance", made)),
    )


def _as_text(value: Any) -> str:
    if isinstance(value, Mapping) and len(value) > SETTINGS.provenance_values:
        return "listed in the JSON file of results"
    if isinstance(value, Mapping):
        return "; ".join(
            f"{key} ({_as_text(one)})" if isinstance(one, Mapping) else f"{key} {_as_text(one)}"
            for key, one in value.items()
            if one is not None
        )
    return words.number(value) if isinstance(value, float) else str(value)
