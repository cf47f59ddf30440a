"""What made this report: versions, hash of the inputs, seed, time."""

from __future__ import annotations

from avis_ctrl.report import words
from avis_ctrl.report.pieces import Section, table
from avis_ctrl.study.model import DesignResult

NAMES = {"avis_ctrl": "avis_ctrl version", "design_file": "design file", "inputs_sha256": "SHA-256 of the inputs",
         "seconds": "seconds of computing", "python": "Python"}


def provenance(result: DesignResult) -> Section:
    """The provenance table."""
    rows = [(NAMES.get(key, key), words.number(value) if isinstance(value, float) else str(value))
            for key, value in result.provenance.items() if value is not None]
    return Section("Provenance", "provenance", (
        table("With the same inputs, seed, library versions and processor the same figures come out; elsewhere "
              "round-off may lead the D-K iteration another way.", ("what", "value"), rows, "ll"),))


def stamp(result: DesignResult) -> str:
    """A short provenance for page headers."""
    made = result.provenance
    return f"avis_ctrl {made.get('avis_ctrl', '')}, inputs {str(made.get('inputs_sha256', ''))[:12]}"
