"""The confusion matrix of cases with no effect, one, or one outside the library: as text and as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.blind.judge import LIBRARY, Judged

WORDS = ("several", "unexplained", "none", "crash")


@dataclass(frozen=True, eq=False)
class Confusion:
    """counts : (rows, columns) cases; rows what was hidden, columns what was answered."""

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    counts: np.ndarray

    @classmethod
    def of(cls, cases: Sequence[Judged]) -> Confusion:
        """Only what occurs has a row or column; a name right through its group stands under the hidden name."""
        pairs = [(row_of(case), case.answered) for case in cases if case.line.kind != "two"]
        hidden, answered = {row for row, _ in pairs}, {column for _, column in pairs}
        outside = sorted(row for row in hidden if row.startswith("outside: "))
        own = sorted((hidden | answered) - set(LIBRARY) - set(outside) - set(WORDS))
        rows = [name for name in (*LIBRARY, *own, *outside, "none") if name in hidden]
        # A name that is hidden has a column too, so that a hit lies on the diagonal.
        columns = [name for name in (*LIBRARY, *own) if name in answered | hidden]
        columns += [word for word in WORDS if word in answered or word in ("unexplained", "none")]
        counts = np.zeros((len(rows), len(columns)), int)
        for row, column in pairs:
            counts[rows.index(row), columns.index(column)] += 1
        return cls(tuple(rows), tuple(columns), counts)

    def text(self) -> str:
        """Columns by number, with a legend; "." for no case."""
        wide = max((len(name) for name in self.rows), default=0)
        number = {name: str(k) for k, name in enumerate(self.columns, 1)}
        lines = [" " * wide + "".join(f"{number[name]:>4s}" for name in self.columns)]
        lines += [
            f"{name:>{wide}s}" + "".join(f"{count or '.':>4}" for count in row)
            for name, row in zip(self.rows, self.counts, strict=True)
        ]
        legend = [f"{k} {name}" for name, k in number.items()]
        return "\n".join([*lines, "", "columns: " + ", ".join(legend)])

    def draw(self, path: Path) -> None:
        """As a picture: shares of each row as shades, counts as numbers; right answers framed."""
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot

        total = self.counts.sum(axis=1, keepdims=True)
        share = self.counts / np.maximum(total, 1)
        size = (4.0 + 0.36 * len(self.columns), 2.4 + 0.30 * len(self.rows))
        figure, axes = pyplot.subplots(figsize=size, layout="constrained")
        picture = axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        for (i, j), count in np.ndenumerate(self.counts):
            if self.right(self.rows[i], self.columns[j]):
                axes.add_patch(
                    pyplot.Rectangle((j - 0.5, i - 0.5), 1, 1, fill=False, edgecolor="tab:green", linewidth=1.4)
                )
            if count:
                axes.text(
                    j,
                    i,
                    str(count),
                    ha="center",
                    va="center",
                    fontsize=8,
                    color="white" if share[i, j] > 0.55 else "black",
                )
        axes.set_xticks(
            range(len(self.columns)), self.columns, rotation=60, ha="right", rotation_mode="anchor", fontsize=8
        )
        labels = [f"{name} ({n})" for name, n in zip(self.rows, total[:, 0], strict=True)]
        axes.set_yticks(range(len(self.rows)), labels, fontsize=8)
        axes.set(xlabel="answered", ylabel="hidden (cases)", title="Hidden against answered; right answers are framed")
        figure.colorbar(picture, ax=axes, label="share of the row", shrink=0.8)
        figure.savefig(path, dpi=130)
        pyplot.close(figure)

    @staticmethod
    def right(row: str, column: str) -> bool:
        return column == ("unexplained" if row.startswith("outside: ") else row)


def row_of(case: Judged) -> str:
    line = case.line
    if line.kind == "none":
        return "none"
    return ("outside: " if line.kind == "outside" else "") + " + ".join(one.name for one in line.hidden)
