"""Section on the methods by which the results of a report were computed, and their sources."""

from __future__ import annotations

import tomllib
from collections.abc import Collection
from importlib import resources

from avis_ctrl.report.elements import Bullets, Formula, Heading, Paragraph, Section


def method(report: str, omitted: Collection[str] = (), **values: str) -> Section:
    """The method of a report: "design", "identification" or "gap" of methods.toml.

    omitted : parts of its text that do not apply. values : filled into the paragraphs, never into formulas.
    """
    content = tomllib.loads((resources.files("avis_ctrl.report") / "methods.toml").read_text(encoding="utf-8"))
    told = [piece for part, text in content[report]["text"].items() if part not in omitted for piece in prose(text)]
    filled = [Paragraph(p.text.format(**values)) if isinstance(p, Paragraph) else p for p in told]
    sources = [
        f"{content['publications'][name]}{f' ({use})' if use else ''}."
        for name, use in content[report]["sources"].items()
    ]
    return Section("Method", "method", (*filled, Heading("Sources"), Bullets(tuple(sources))))


def prose(text: str) -> list[Paragraph | Formula]:
    """Paragraphs and formulas, separated by blank lines; a formula stands in dollar signs, its spoken form follows."""
    found: list[Paragraph | Formula] = []
    for block in text.strip().split("\n\n"):
        formula, dollar, words = " ".join(block.split()).removeprefix("$ ").partition(" $ ")
        found.append(Formula(formula, words) if dollar else Paragraph(formula))
    return found
