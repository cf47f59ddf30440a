"""Drawing of the rig from its named points: top view, and side view along x."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avis_ctrl.report.canvas import Anchor, Canvas, Point
from avis_ctrl.rigs.rig import Rig

ACTUATOR, SENSOR, ISOLATOR, MASS, MARK = "#0072b2", "#00785a", "#555555", "#b3261e", "#8a5a00"
WIDTH, TOP_HEIGHT, SIDE_HEIGHT = 720.0, 450.0, 280.0
ARROW_PX = 34.0
View = Callable[[np.ndarray], Point]


def rig_drawing(rig: Rig) -> str:
    """Top view above side view, to the same scale."""
    points = rig.points()
    places = np.array([p.position for p in points.values()])
    reach = np.maximum(np.abs(places).max(axis=0), [0.0, rig.edge_m, 0.0])
    scale = min(200.0 / reach[0], 125.0 / reach[1])
    canvas = Canvas(WIDTH, TOP_HEIGHT + SIDE_HEIGHT)
    middle, side = (WIDTH / 2, TOP_HEIGHT / 2 + 16), (WIDTH / 2, TOP_HEIGHT + SIDE_HEIGHT / 2 - 20)
    _top(canvas, rig, reach, lambda p: (middle[0] + scale * p[0], middle[1] - scale * p[1]))
    _side(canvas, rig, reach, lambda p: (side[0] + scale * p[1], side[1] - scale * p[2]))
    _key(canvas)
    return canvas.svg()


def _axes(canvas: Canvas, corner: Point, names: tuple[str, str]) -> None:
    x, y = corner
    canvas.line([(x, y), (x + 34, y)], arrow=True)
    canvas.line([(x, y), (x, y - 34)], arrow=True)
    canvas.text((x + 42, y + 4), names[0])
    canvas.text((x, y - 40), names[1])


def _top(canvas: Canvas, rig: Rig, reach: np.ndarray, at: View) -> None:
    canvas.text((16, 22), "from above", 13, anchor="start", bold=True)
    _axes(canvas, (30, 120), ("x", "y"))
    (left, low), (right, high) = at(-reach), at(reach)
    canvas.rectangle(
        ((left + right) / 2, (low + high) / 2), right - left + 44, low - high + 44, "#f3f3f4", "#888888", corner=6
    )
    for place in rig.points().values():
        if place.kind == "isolator":
            canvas.rectangle(at(place.position), 24, 24, "#ffffff", ISOLATOR, 1.6)
    _elements(canvas, rig, at)
    for name, place in rig.points().items():
        if place.kind in ("centre of mass", "load", "measured point"):
            _mark(canvas, at(place.position), name, place.kind)
    _labels(canvas, rig, at)


def _elements(canvas: Canvas, rig: Rig, at: View) -> None:
    for actuator in rig.mounted_body().actuators:
        _pointed(canvas, at(actuator.position), actuator.direction, ACTUATOR, 0.0)
    for position, direction in rig.sensor_axes().values():
        x, y = at(position)
        _pointed(canvas, (x + 9.0 * (-1 if x > WIDTH / 2 else 1), y), direction, SENSOR, 5.0)


def _pointed(canvas: Canvas, place: Point, direction: np.ndarray, colour: str, shift: float) -> None:
    """An arrow in the plane of the drawing, or a circled dot for a direction normal to it."""
    across = np.array([direction[0], -direction[1]])
    if np.linalg.norm(across) < 0.3:
        canvas.circle(place, 5.5, "#ffffff", colour, 1.6)
        canvas.circle(place, 1.8, colour, colour, 0.5)
        return
    begin = np.array(place) + shift
    end = begin + ARROW_PX * (0.75 if shift else 1.0) * across
    canvas.line([(begin[0], begin[1]), (end[0], end[1])], colour, 1.8, arrow=True)


def _mark(canvas: Canvas, place: Point, name: str, kind: str) -> None:
    x, y = place
    colour = MASS if kind == "centre of mass" else MARK
    canvas.line([(x - 6, y), (x + 6, y)], colour, 1.6)
    canvas.line([(x, y - 6), (x, y + 6)], colour, 1.6)
    # Marks may coincide, so each kind has its name on a different side.
    sides: dict[str, tuple[float, float, Anchor]] = {
        "centre of mass": (9, 4, "start"),
        "load": (0, -10, "middle"),
        "measured point": (0, 18, "middle"),
    }
    dx, dy, anchor = sides[kind]
    canvas.text((x + dx, y + dy), name, 11, colour, anchor)


def _labels(canvas: Canvas, rig: Rig, at: View) -> None:
    """Names of isolator, actuators and sensors at each place, stacked on its outer side."""
    groups: dict[tuple[int, int], dict[str, list[str]]] = {}
    for name, place in rig.points().items():
        if place.kind in ("isolator", "actuator", "sensor"):
            x, y = at(place.position)
            groups.setdefault((round(x), round(y)), {}).setdefault(place.kind, []).append(name)
    colours = {"isolator": ISOLATOR, "actuator": ACTUATOR, "sensor": SENSOR}
    centre = at(np.zeros(3))[1]
    rim = 0.9 * max(abs(y - centre) for _, y in groups)
    for (x, y), kinds in groups.items():
        lines = [(kind, " ".join(names)) for kind, names in kinds.items()]
        away = 42 if abs(y - centre) > rim else 20
        first = y - away - 14 * (len(lines) - 1) if y < centre else y + away
        for k, (kind, text) in enumerate(lines):
            canvas.text((x, first + 14 * k), text, 11.5, colours[kind])


def _side(canvas: Canvas, rig: Rig, reach: np.ndarray, at: View) -> None:
    canvas.text((16, TOP_HEIGHT + 22), "from the side, along −x", 13, anchor="start", bold=True)
    _axes(canvas, (30, TOP_HEIGHT + 110), ("y", "z"))
    tops = [p.position for p in rig.points().values() if p.kind == "isolator"]
    isolators = {tuple(np.round(top[1:], 6)): top for top in tops}
    foot = min(at(p)[1] for p in isolators.values())
    lower, upper = max(at(p)[1] for p in isolators.values()), at(np.array([0.0, 0.0, 0.05]))[1]
    left, right = at(-reach)[0] - 22, at(reach)[0] + 22
    upper = min(upper, at(reach)[1]) - 24
    canvas.rectangle(
        ((left + right) / 2, (upper + lower) / 2), right - left, max(lower - upper, 24), "#f3f3f4", "#888888", corner=6
    )
    floor = max(foot, lower) + 62
    canvas.line([(left - 30, floor), (right + 30, floor)], "#333333", 2.0)
    canvas.text((right + 36, floor + 4), "floor", 11.5, anchor="start")
    for top in isolators.values():
        x, y = at(top)
        zigzag = [(x + (0 if k in (0, 7) else 7 * (-1) ** k), y + (floor - y) * k / 7) for k in range(8)]
        canvas.line(zigzag, ISOLATOR, 1.6)
    _lever(canvas, rig, at)
    for name, place in rig.points().items():
        if place.kind in ("centre of mass", "load"):
            _mark(canvas, at(place.position), "" if place.kind == "centre of mass" else name, place.kind)


def _lever(canvas: Canvas, rig: Rig, at: View) -> None:
    """The lever arm that converts phi_x into a displacement of the edge."""
    (x0, y0), (x1, _) = at(np.zeros(3)), at(np.array([0.0, rig.edge_m, 0.0]))
    canvas.line([(x1, y0 - 9), (x1, y0 + 9)], MARK, 1.2)
    canvas.line([(x0, y0), (x1, y0)], MARK, 1.4, arrow=True)
    canvas.text((x1 - 10, y0 + 16), f"edge lever {rig.edge_m:.3g} m", 11.5, MARK, "end")
    arc = [(x1 + 34, y0 - 26 + 52 * k / 8) for k in range(9)]
    bent = [(x - 12 * ((k - 4) / 4) ** 2, y) for k, (x, y) in enumerate(arc)]
    canvas.line(bent[::-1], "#333333", 1.4, arrow=True)
    canvas.text((x1 + 42, y0 + 4), "phi_x", 11.5, anchor="start")


def _key(canvas: Canvas) -> None:
    y, x = TOP_HEIGHT + SIDE_HEIGHT - 12, 30.0
    for colour, word in ((ACTUATOR, "actuator"), (SENSOR, "sensor"), (ISOLATOR, "isolator"), (MASS, "centre of mass")):
        canvas.rectangle((x, y - 4), 12, 12, colour, colour)
        canvas.text((x + 12, y), word, 12, anchor="start")
        x += 52 + 7.6 * len(word)
    canvas.circle((x, y - 4), 5.5, "#ffffff", "#333333")
    canvas.circle((x, y - 4), 1.8, "#333333", "#333333")
    canvas.text((x + 12, y), "points towards the viewer", 12, anchor="start")
