"""Typed pieces of a report, independent of the renderer.

All texts are plain; the renderer escapes them. Only `Formula.typst` is markup, and it comes from this package alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

from avis_ctrl.report.figures import Figure
from avis_ctrl.report.settings import SETTINGS


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

    items: Sequence[str]


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

    @property
    def folds(self) -> bool:
        """Whether the table is too wide for a phone, and each row becomes a block there."""
        return len(self.header) > (2 if any(self.wraps(cell) for row in self.rows for cell in row) else 3)

    @staticmethod
    def wraps(cell: Cell) -> bool:
        """Whether a cell has text of more than a line."""
        return isinstance(cell, str) and len(cell) > SETTINGS.cell_letters

    @property
    def keys(self) -> tuple[int, ...]:
        """Columns that head such a block: the first and, if it repeats, the one of short text that differs most."""
        columns = list(zip(*self.rows, strict=True))
        short = [
            k
            for k, cells in enumerate(columns)
            if self.alignment(k) == "l" and all(isinstance(c, str) and not self.wraps(c) for c in cells)
        ]
        different = [len({str(cell) for cell in cells}) for cells in columns]
        other = max(short, key=lambda k: different[k], default=0)
        return (0,) if not columns or different[other] <= different[0] else (0, other)


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
Content = Piece | Iterable["Content"] | None


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


def section(title: str, anchor: str, *content: Content, alone: bool = False) -> Section:
    """A `Section` of the pieces in `shown(*content)`."""
    return Section(title, anchor, shown(*content), alone)


def shown(*content: Content) -> tuple[Piece, ...]:
    """The pieces in order, those of sequences in their place; without None, texts, lists and tables that are empty."""
    found: list[Piece] = []
    for one in content:
        match one:
            case None | Paragraph("") | Bullets(()) | Fold(_, ()) | Table(_, _, ()):
                continue
            case Heading() | Paragraph() | Bullets() | Formula() | Table() | Figure() | Drawing() | Fold():
                found.append(one)
            case _:
                found += shown(*one)
    return tuple(found)


def headed(text: str, *content: Content) -> tuple[Piece, ...]:
    """Pieces under a heading; empty if there is nothing to show."""
    pieces = shown(*content)
    return (Heading(text), *pieces) if pieces else ()


def yes_or_no(good: bool) -> Mark:
    """A verdict as "yes" or "no"."""
    return Mark("yes" if good else "no", good)


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[Cell]], align: str = "") -> Table:
    """A `Table` from any sequences."""
    return Table(caption, tuple(header), tuple(tuple(row) for row in rows), align)


def listed(caption: str, items: Iterable[T], columns: Mapping[str, Callable[[T], Cell]], align: str = "") -> Table:
    """A `Table` with a row for each item. columns : the cell of an item by the header of its column."""
    return table(caption, tuple(columns), [[cell(one) for cell in columns.values()] for one in items], align)
