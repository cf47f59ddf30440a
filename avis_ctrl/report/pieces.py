"""Typed pieces of a report, independent of the renderer.

All texts are plain; the renderer escapes them. Only `Formula.typst` is markup, and it comes from this package alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from avis_ctrl.report.figures import Figure


@dataclass(frozen=True)
class Mark:
    """A table cell with a verdict, shown by colour and in words for readers who cannot see the colour."""

    text: str
    good: bool


Cell = str | Mark
T = TypeVar("T")


@dataclass(frozen=True)
class Heading:
    """A heading inside a section."""

    text: str


@dataclass(frozen=True)
class Paragraph:
    """A paragraph. "verdict" is highlighted, coloured by `good` or as a warning by `half`; "note" is small print."""

    text: str
    kind: Literal["text", "verdict", "note"] = "text"
    good: bool | None = None
    half: bool = False


@dataclass(frozen=True)
class Bullets:
    """A bulleted list."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Formula:
    """A displayed formula.

    typst : in Typst's mathematical notation.
    words : spoken form, for screen readers.
    """

    typst: str
    words: str


@dataclass(frozen=True)
class Table:
    """A table.

    align : one letter per column: l, c or r. Missing letters are l for the first column and r for the others.
    """

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    align: str = ""

    def alignment(self, column: int) -> str:
        """Alignment of a column: l, c or r."""
        return self.align[column] if column < len(self.align) else ("l" if column == 0 else "r")


@dataclass(frozen=True)
class Drawing:
    """A drawing other than a plot, as SVG with escaped text. alternative : description for screen readers."""

    name: str
    caption: str
    svg: str
    alternative: str


@dataclass(frozen=True)
class Fold:
    """Reference material: collapsed at first on a screen, in small print on paper."""

    title: str
    pieces: tuple[Piece, ...]


Piece = Heading | Paragraph | Bullets | Formula | Table | Figure | Drawing | Fold


@dataclass(frozen=True)
class Section:
    """A numbered section. alone : on a page of its own, so that it can be read by itself."""

    title: str
    anchor: str
    pieces: tuple[Piece, ...]
    alone: bool = False

    def flat(self) -> list[Piece]:
        """All pieces in order; those of a fold follow it."""
        return [q for p in self.pieces for q in ((p, *p.pieces) if isinstance(p, Fold) else (p,))]


@dataclass(frozen=True)
class Document:
    """A whole report.

    subtitle : one line under the title.
    stamp : short provenance for the page header.
    """

    title: str
    subtitle: str
    stamp: str
    sections: tuple[Section, ...]

    def figures(self) -> list[Figure | Drawing]:
        """All figures and drawings in order."""
        return [p for s in self.sections for p in s.flat() if isinstance(p, (Figure, Drawing))]


def document_of(title: str, subtitle: str, provenance: Mapping[str, Any], sections: Iterable[Section]) -> Document:
    """A report with the date under its title, and version and hash of the inputs in its page header."""
    date = str(provenance.get("date", ""))[:10]
    return Document(
        title,
        subtitle + (f", {date}" if date else ""),
        f"avis_ctrl {provenance.get('avis_ctrl', '')}, inputs {str(provenance.get('inputs_sha256', ''))[:12]}",
        tuple(sections),
    )


def yes_or_no(good: bool) -> Mark:
    """A verdict as "yes" or "no"."""
    return Mark("yes" if good else "no", good)


def prose(text: str) -> tuple[Paragraph | Formula, ...]:
    """Paragraphs and formulas, separated by blank lines; a formula stands in dollar signs, its spoken form follows."""
    blocks = [" ".join(block.split()) for block in text.strip().split("\n\n")]
    found: list[Paragraph | Formula] = []
    for block in blocks:
        formula, dollar, words = block.removeprefix("$ ").partition(" $ ")
        found.append(Formula(formula, words) if dollar else Paragraph(block))
    return tuple(found)


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[Cell]], align: str = "") -> Table:
    """A `Table` from any sequences."""
    return Table(caption, tuple(header), tuple(tuple(row) for row in rows), align)


def listed(caption: str, items: Iterable[T], columns: Mapping[str, Callable[[T], Cell]], align: str = "") -> Table:
    """A `Table` with a row for each item. columns : the cell of an item by the header of its column."""
    return table(caption, tuple(columns), [[cell(one) for cell in columns.values()] for one in items], align)
