"""A small SVG canvas for drawings other than plots; text is escaped, coordinates are rounded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal
from xml.sax.saxutils import escape

Anchor = Literal["start", "middle", "end"]
Point = tuple[float, float]
FONT = "DejaVu Sans, Verdana, sans-serif"


class Canvas:
    """SVG canvas of the given width and height; y points down."""

    def __init__(self, width: float, height: float) -> None:
        self.width, self.height = width, height
        self._shapes: list[str] = []

    def line(self, points: Sequence[Point], colour: str = "#333333", width: float = 1.2, arrow: bool = False) -> None:
        """A polyline, optionally with an arrowhead at its end."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self._shapes.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="{width}"/>')
        if arrow:
            self._head(points[-2], points[-1], colour, 4.0 + 2.0 * width)

    def _head(self, begin: Point, tip: Point, colour: str, size: float) -> None:
        dx, dy = tip[0] - begin[0], tip[1] - begin[1]
        length = (dx * dx + dy * dy) ** 0.5 or 1.0
        dx, dy = dx / length * size, dy / length * size
        back = (tip[0] - dx, tip[1] - dy)
        self.polygon([tip, (back[0] - 0.4 * dy, back[1] + 0.4 * dx), (back[0] + 0.4 * dy, back[1] - 0.4 * dx)], colour)

    def polygon(self, points: Sequence[Point], fill: str, stroke: str = "none", width: float = 1.0) -> None:
        """A filled polygon."""
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self._shapes.append(f'<polygon points="{path}" fill="{fill}" stroke="{stroke}" stroke-width="{width}"/>')

    def rectangle(
        self,
        centre: Point,
        width: float,
        height: float,
        fill: str = "#ffffff",
        stroke: str = "#333333",
        line: float = 1.2,
        corner: float = 0.0,
    ) -> None:
        """A rectangle given by its centre."""
        self._shapes.append(
            f'<rect x="{centre[0] - width / 2:.1f}" y="{centre[1] - height / 2:.1f}" '
            f'width="{width:.1f}" height="{height:.1f}" rx="{corner}" fill="{fill}" '
            f'stroke="{stroke}" stroke-width="{line}"/>'
        )

    def circle(
        self, centre: Point, radius: float, fill: str = "none", stroke: str = "#333333", width: float = 1.2
    ) -> None:
        """A circle."""
        self._shapes.append(
            f'<circle cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" r="{radius}" fill="{fill}" '
            f'stroke="{stroke}" stroke-width="{width}"/>'
        )

    def text(
        self,
        place: Point,
        text: str,
        size: float = 12.0,
        colour: str = "#1d1d1f",
        anchor: Anchor = "middle",
        bold: bool = False,
    ) -> None:
        """A line of text with its baseline at `place`."""
        weight = ' font-weight="bold"' if bold else ""
        self._shapes.append(
            f'<text x="{place[0]:.1f}" y="{place[1]:.1f}" font-size="{size}" fill="{colour}" '
            f'text-anchor="{anchor}"{weight}>{escape(text)}</text>'
        )

    def svg(self) -> str:
        """The drawing as SVG."""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g} {self.height:g}" '
            f'width="{self.width:g}" height="{self.height:g}" font-family="{FONT}">{"".join(self._shapes)}</svg>'
        )
