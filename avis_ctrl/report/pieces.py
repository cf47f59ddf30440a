"""The report as a list of typed pieces, written once and drawn by each renderer.

Every text is plain: a renderer escapes it. Only `Formula.typst` is markup, and it comes from this package alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from avis_ctrl.report.figures import Figure


@dataclass(frozen=True)
class Mark:
    """A table cell with a verdict: coloured, and in words for whoever sees no colour."""

    text: str
    good: bool


Cell = str | Mark


@dataclass(frozen=True)
class Heading:
    """A heading inside a section."""

    text: str


@dataclass(frozen=True)
class Paragraph:
    """Text. "verdict" stands out, coloured by `good`, or as a warning by `half`; "note" stands back."""

    text: str
    kind: Literal["text", "verdict", "note"] = "text"
    good: bool | None = None
    half: bool = False


@dataclass(frozen=True)
class Bullets:
    """Short lines under each other."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Formula:
    """A displayed formula.

    typst : in Typst's mathematical notation.
    words : how it is read aloud.
    """

    typst: str
    words: str


@dataclass(frozen=True)
class Table:
    """A table.

    align : one letter a column, l, c or r.
    """

    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    align: str = ""

    def alignment(self, column: int) -> str:
        """l, c or r."""
        return self.align[column] if column < len(self.align) else ("l" if column == 0 else "r")


@dataclass(frozen=True)
class Drawing:
    """A drawing that is not a graph, as SVG with escaped text."""

    name: str
    caption: str
    svg: str
    alternative: str


@dataclass(frozen=True)
class Fold:
    """Pieces that are there to be looked up: closed at first on a screen, in small print on paper."""

    title: str
    pieces: tuple[Piece, ...]


Piece = Heading | Paragraph | Bullets | Formula | Table | Figure | Drawing | Fold


@dataclass(frozen=True)
class Section:
    """A numbered section. alone : on a page of its own, to be read without the rest."""

    title: str
    anchor: str
    pieces: tuple[Piece, ...]
    alone: bool = False

    def flat(self) -> list[Piece]:
        """All pieces in order, those inside folds in their place."""
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


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[Cell]], align: str = "") -> Table:
    """A table from any sequences."""
    return Table(caption, tuple(header), tuple(tuple(row) for row in rows), align)
