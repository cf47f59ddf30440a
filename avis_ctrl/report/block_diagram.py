"""Block diagram of a generalized plant, drawn from its parts and signals.

The loop runs down the middle: the controller, then the longest path from its command to its measurement. Parts driven
by the loop are placed to the right of it, parts that drive the loop to the left, and the uncertainty Delta next to the
part that it perturbs. Parts that differ only by axis or channel are drawn as one box with their number.
"""

from __future__ import annotations

from avis_ctrl.report.canvas import Canvas, Point
from avis_ctrl.report.families import EXTERNAL, Families, SignalFamily
from avis_ctrl.study.plant import DesignPlant

WIDTH, ROW, TOP = 880.0, 84.0, 34.0
LEFT, MIDDLE, NEAR, FAR = 150.0, 405.0, 570.0, 710.0
BOX_WIDTH, BOX_HEIGHT, SMALL = 160.0, 42.0, 120.0
RIG_HEIGHT = 96.0
DISTURBANCE, JUDGED = "#8a1c12", "#00548a"
FILLS = {
    "rig": "#dbe8f6",
    "actuator": "#fdebc8",
    "sensor": "#d5f0e5",
    "weight": "#f6dfec",
    "allocation": "#eeeeee",
    "sum": "#ffffff",
    "controller": "#ffffff",
    "delta": "#fbd9d3",
}
Node = tuple[float, float, float]  # centre (x, y) and width


class BlockDiagram:
    """Boxes and the signals between them; `chain` is the loop down the middle, from the controller K."""

    def __init__(self, plant: DesignPlant) -> None:
        self.families = Families(plant)
        self.signals = self.families.signals
        self.kind = {p.name: (p.kind, p.count) for p in self.families.parts}
        self.chain = ["K", *self._longest_way()]
        self.driven = {reader for s in self.signals if s.role == "w_delta" for reader in s.readers}
        self.nodes: dict[str, Node] = {}
        self.rows = {name: row for row, name in enumerate(self.chain)}
        self._place()
        rows = max(y for _, y, _ in self.nodes.values())
        self.canvas = Canvas(WIDTH, rows + 70)

    def svg(self) -> str:
        """The diagram as SVG."""
        self._loop()
        drawn: set[tuple[str, str]] = set()
        for s in self.signals:
            for reader in s.readers:
                source = self._source(s)
                if (source, reader) not in drawn and not self._in_chain(source, reader):
                    drawn.add((source, reader))
                    self._link(s, source, reader)
        self._external()
        self._delta()
        self._boxes()
        return self.canvas.svg()

    def _longest_way(self) -> list[str]:
        """Longest path of parts from one that reads u to one that drives y."""
        after: dict[str, list[str]] = {}
        for s in self.signals:
            after.setdefault(s.source, []).extend(s.readers)
        last = {s.source for s in self.signals if s.role == "y"}

        def longest(part: str, seen: tuple[str, ...]) -> list[str]:
            ways = [longest(n, (*seen, n)) for n in dict.fromkeys(after.get(part, [])) if n not in seen]
            ways = [[part, *way] for way in ways if way]
            return max(ways, key=len) if ways else [part] if part in last else []

        starts = dict.fromkeys(r for s in self.signals if s.role == "u" for r in s.readers)
        return max((longest(start, (start,)) for start in starts), key=len)

    def _place(self) -> None:
        for row, name in enumerate(self.chain):
            self.nodes[name] = (MIDDLE, self._level(row), BOX_WIDTH)
        taken: set[tuple[float, int]] = set()
        waiting = [p.name for p in self.families.parts if p.name not in self.chain]
        for _ in range(len(waiting)):
            for name in [n for n in waiting if n not in self.nodes]:
                self._beside(name, taken)

    def _beside(self, name: str, taken: set[tuple[float, int]]) -> None:
        """Place a part: to the right, one row below its source in the chain; or else to the left of its reader (below
        it, if Delta drives the part); or else below its source outside the chain."""
        feeding = [self._source(s) for s in self.signals if name in s.readers]
        reading = [r for s in self.signals if s.source == name for r in s.readers]
        before = [self.rows[n] for n in feeding if n in self.nodes and n in self.chain]
        after = [self.rows[n] for n in reading if n in self.nodes]
        beside = [n for n in feeding if n in self.nodes and n not in self.chain]
        if before:
            x, row, step = FAR, max(before) + 1, 1
        elif after and name in self.driven:  # below the reader, where Delta has a way past the chain
            x, row, step = LEFT, max(after) + 1, 1
        elif after:
            x, row, step = LEFT, min(after) - (reading[0] not in self.chain), -1
        elif beside:
            x, row, step = self.nodes[beside[0]][0], self.rows[beside[0]] + 1, 1
        else:
            return
        while (x, row) in taken:
            row += step
        taken.add((x, row))
        self.rows[name] = row
        self.nodes[name] = (x, self._level(row), SMALL)

    def _level(self, row: int) -> float:
        """Vertical centre of a row; the rig's box is taller than the others."""
        tall = [k for k, name in enumerate(self.chain) if self._height(name) > BOX_HEIGHT]
        rig = tall[0] if tall else len(self.chain)
        taller = (RIG_HEIGHT - BOX_HEIGHT) / 2
        return TOP + ROW * row + taller * ((row >= rig) + (row > rig))

    def _height(self, name: str) -> float:
        return RIG_HEIGHT if self.kind.get(name, ("", 1))[0] == "rig" else BOX_HEIGHT

    @staticmethod
    def _source(s: SignalFamily) -> str:
        return "K" if s.role == "u" else s.source

    def _in_chain(self, source: str, reader: str) -> bool:
        return (source, reader) in zip(self.chain, self.chain[1:], strict=False)

    def _loop(self) -> None:
        """The chain down the middle, and the measurement fed back to the controller at the top."""
        for upper, lower in zip(self.chain, self.chain[1:], strict=False):
            (x, y, _), (_, y2, _) = self.nodes[upper], self.nodes[lower]
            between = next(s for s in self.signals if lower in s.readers and self._source(s) == upper)
            tip = y2 - self._height(lower) / 2
            self.canvas.line([(x, y + self._height(upper) / 2), (x, tip)], width=1.6, arrow=True)
            self.canvas.text((x - 8, tip - 9), self._label(between), 11, anchor="end")
        x, y, width = self.nodes[self.chain[-1]]
        top, bottom, corner = self.nodes["K"][1], y + BOX_HEIGHT / 2, 26.0
        low = bottom + 24
        seen = next(s for s in self.signals if s.role == "y")
        back = [(x, bottom), (x, low), (corner, low), (corner, top), (x - width / 2, top)]
        self.canvas.line(back, width=1.6, arrow=True)
        self.canvas.text((x - 8, low - 6), self._label(seen), 11, anchor="end")

    def _link(self, s: SignalFamily, source: str, reader: str) -> None:
        if source == EXTERNAL or source not in self.nodes or reader not in self.nodes:
            return
        (x, y, width), (x2, y2, width2) = self.nodes[source], self.nodes[reader]
        if source in self.chain and any(self._in_chain(source, r) for r in s.readers):
            self._branch((x, y + self._height(source) / 2), (x2, y2))
        elif x == x2:
            self.canvas.line([(x, y + BOX_HEIGHT / 2), (x2, y2 - BOX_HEIGHT / 2)], arrow=True)
            self.canvas.text((x - 6, (y + y2) / 2 + 4), self._label(s), 11, anchor="end")
        elif x2 > MIDDLE:
            lane, level = NEAR + 50, y + self._height(source) / 2 - 12
            self.canvas.line([(x + width / 2, level), (lane, level), (lane, y2), (x2 - width2 / 2, y2)], arrow=True)
        elif y == y2:
            self.canvas.line([(x + width / 2, y), (x2 - width2 / 2, y2)], arrow=True)
            self.canvas.text(((x + width / 2 + x2 - width2 / 2) / 2, y - 7), s.name, 11)
        else:
            lane, begin, end = x + width / 2 + 40, y - BOX_HEIGHT / 4, y2 + BOX_HEIGHT / 4
            self.canvas.line([(x + width / 2, begin), (lane, begin), (lane, end), (x2 - width2 / 2, end)], arrow=True)
            self.canvas.text((lane + 6, begin - 4), s.name, 11, anchor="start")

    def _branch(self, begin: Point, end: Point) -> None:
        """Branch from the chain to the top of a box on the right."""
        level = begin[1] + 12
        self.canvas.circle((begin[0], level), 2.6, "#333333")
        self.canvas.line([(begin[0], level), (end[0], level), (end[0], end[1] - BOX_HEIGHT / 2)], arrow=True)

    def _external(self) -> None:
        """Disturbances entering from the left, performance outputs leaving to the right."""
        used: dict[tuple[str, str], int] = {}
        for s in self.signals:
            if s.role not in ("w", "z"):
                continue
            name = s.readers[0] if s.role == "w" else s.source
            x, y, width = self.nodes[name]
            k = used[name, s.role] = used.get((name, s.role), 0) + 1
            tall = self._height(name) > BOX_HEIGHT
            level = y + (20 * k - (0 if s.role == "w" else 44)) * tall
            if s.role == "w":
                self.canvas.line([(x - width / 2 - 40, level), (x - width / 2, level)], arrow=True)
                place = (x - width / 2 - 45, level + 4) if x == MIDDLE else (x - width / 2 - 6, level - 7)
                self.canvas.text(place, self._label(s), 11, DISTURBANCE, "end")
            else:
                self.canvas.line([(x + width / 2, level), (x + width / 2 + 24, level)], arrow=True)
                self.canvas.text((x + width / 2 + 29, level + 4), self._label(s), 11, JUDGED, "start")

    def _delta(self) -> None:
        """Delta from z to w: to the left of the rig, or on the right between a weight and its channel."""
        w = [s for s in self.signals if s.role == "w_delta"]
        z = {s.name[2:]: s for s in self.signals if s.role == "z_delta"}
        for s in w:
            made, reader = z[s.name[2:]], s.readers[0]
            (x, y, width), (x2, y2, width2) = self.nodes[reader], self.nodes[made.source]
            count = len(s.members)
            if made.source == reader:
                level = y - RIG_HEIGHT / 2 + BOX_HEIGHT / 2
                self._box("delta", f"Δ {s.name[2:]}", count, (LEFT, level), SMALL)
                right, left = LEFT + SMALL / 2, x - width / 2
                self.canvas.line([(left, level - 10), (right, level - 10)], arrow=True)
                self.canvas.line([(right + 4, level + 10), (left, level + 10)], arrow=True)
                self.canvas.text(((left + right) / 2, level - 15), "z", 11)
                self.canvas.text(((left + right) / 2, level + 23), "w", 11)
            else:
                self._box("delta", "Δ", count, (NEAR, y2), 52.0)
                self.canvas.line([(x2 - width2 / 2, y2), (NEAR + 26, y2)], arrow=True)
                self.canvas.text(((x2 - width2 / 2 + NEAR + 26) / 2, y2 - 6), "z", 11)
                lane = NEAR - 52
                self.canvas.line([(NEAR - 26, y2), (lane, y2), (lane, y), (x + width / 2 + 4, y)], arrow=True)
                self.canvas.text(((x + width / 2 + NEAR - 26) / 2, y - 6), "w", 11)

    def _boxes(self) -> None:
        for name, (x, y, width) in self.nodes.items():
            kind, count = self.kind.get(name, ("controller", 1))
            shown = "controller K" if name == "K" else name.removesuffix(" *")
            self._box(kind, shown, count, (x, y), width, self._height(name))

    def _box(self, kind: str, name: str, count: int, place: Point, width: float, height: float = BOX_HEIGHT) -> None:
        (x, y), fill = place, FILLS.get(kind, "#ffffff")
        times = f" ×{count}" if count > 1 else ""
        if count > 1:
            self.canvas.rectangle((x + 4, y + 4), width, height, fill, "#777777", 0.8, 4)
        self.canvas.rectangle(place, width, height, fill, corner=4)
        if 6.9 * len(name + times) > width - 8 and " " in name:
            cut = name.index(" ", len(name) // 2 - 1) if " " in name[len(name) // 2 - 1 :] else name.rindex(" ")
            self.canvas.text((x, y - 3), name[:cut])
            self.canvas.text((x, y + 13), f"{name[cut + 1 :]}{times}")
        else:
            self.canvas.text((x, y + 4), name + times)

    @staticmethod
    def _label(s: SignalFamily) -> str:
        unit = f" [{s.unit}]" if s.unit not in ("", "1") else ""
        return f"{s.name}{unit}"


def block_diagram(plant: DesignPlant) -> str:
    """Block diagram of a design's plant as SVG."""
    return BlockDiagram(plant).svg()
