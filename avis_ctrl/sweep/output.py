"""Files of a sweep: table, JSON, Pareto plot, HTML page."""

from __future__ import annotations

import base64
import csv
import io
import json
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.files import write_together
from avis_ctrl.plot.axes import png
from avis_ctrl.plot.pareto import pareto, pareto_front
from avis_ctrl.study.files import as_json, values_of
from avis_ctrl.summary import html_table
from avis_ctrl.sweep.run import Row, Sweep

FILES = "sweep.csv", "pareto.png", "sweep.html", "sweep.json"


def front_of(sweep: Sweep) -> list[int]:
    """Indices of the rows on the Pareto front. Raises InputError for a quantity that no row has."""
    return [] if sweep.pareto is None else pareto_front(_values(sweep)).tolist()


def columns(sweep: Sweep) -> tuple[list[str], list[str]]:
    """Names of the varied keys and of the figures, in the order in which they first appear."""
    keys = dict.fromkeys(key for row in sweep.rows for key in row.point)
    figures = dict.fromkeys([*sweep.quantities, *(name for row in sweep.rows for name in row.figures)])
    return [*keys], [*figures]


def write_sweep(sweep: Sweep, folder: Path) -> list[Path]:
    """All files or none, sweep.json last. Raises InputError as `front_of`, ComputationError if the disk is full."""
    front, contents = front_of(sweep), {"sweep.csv": _csv(sweep).encode()}
    drawn = sweep.pareto is not None and bool(front)
    if drawn:
        assert sweep.pareto is not None
        # Up to two values are readable as labels of a few points; otherwise the label is the row number.
        in_words = len(front) <= 12 and len(columns(sweep)[0]) <= 2
        names = [
            ", ".join(f"{key.rpartition('.')[2]} {_short(row.point[key])}" for key in row.point)
            if in_words
            else str(k + 1)
            for k, row in enumerate(sweep.rows)
        ]
        labels = [sweep.quantities.get(name, name) for name in sweep.pareto]
        values, title = _values(sweep), sweep.file.title
        contents["pareto.png"] = png(lambda ax: pareto(values, labels, names, ax, title), 7.2, 4.8)
    contents["sweep.html"] = _page(sweep, front, contents.get("pareto.png")).encode()
    contents["sweep.json"] = as_json(_dict(sweep, front))
    return write_together(folder, contents, [folder / name for name in FILES])


def _values(sweep: Sweep) -> np.ndarray:
    assert sweep.pareto is not None
    known = columns(sweep)[1] + columns(sweep)[0]
    for name in sweep.pareto:
        if name not in known:
            raise InputError(f"expected some of {', '.join(known)}", field="pareto", value=name)
    return np.array([[_number(row, name) for name in sweep.pareto] for row in sweep.rows])


def _number(row: Row, name: str) -> float:
    value = {**row.point, **row.figures}.get(name)
    return float(value) if row.status == "done" and isinstance(value, (int, float)) else float("nan")


def _cells(sweep: Sweep, row: Row) -> list[Any]:
    keys, figures = columns(sweep)
    values = [*map(row.point.get, keys), *map(row.figures.get, figures)]
    return [*values, row.seconds, row.status, row.message, row.identity]


def _csv(sweep: Sweep) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    keys, figures = columns(sweep)
    table.writerow([*keys, *figures, "seconds", "status", "message", "identity"])
    for row in sweep.rows:
        cells = ["" if cell is None else cell for cell in _cells(sweep, row)]
        table.writerow([cell if isinstance(cell, str) else json.dumps(cell, default=str) for cell in cells])
    return text.getvalue()


def _dict(sweep: Sweep, front: list[int]) -> dict[str, Any]:
    rows = [
        {
            "identity": row.identity or None,
            "parameters": row.point,
            **values_of(row, "status", "message", "seconds", "figures"),
        }
        for row in sweep.rows
    ]
    pareto = None if sweep.pareto is None else {"quantities": sweep.pareto, "front": [k + 1 for k in front]}
    return {
        "format": "avis-sweep",
        "version": 1,
        "title": sweep.file.title,
        "kind": sweep.file.kind,
        "quantities": sweep.quantities,
        "points": rows,
        "pareto": pareto,
        "computed": sweep.computed,
        "provenance": sweep.provenance,
    }


def _page(sweep: Sweep, front: list[int], png: bytes | None) -> str:
    picture = (
        f'<p><img alt="Pareto front" src="data:image/png;base64,{base64.b64encode(png).decode()}" '
        'style="max-width:100%"></p>'
        if png
        else ""
    )
    keys, figures = columns(sweep)
    # A space of no width behind dots and underscores: long keys may be broken there.
    head = [
        "point",
        *(key.replace(".", ".\u200b").replace("_", "_\u200b") for key in keys),
        *(sweep.quantities.get(name, name) for name in figures),
        "time [s]",
        "status",
        "message",
    ]
    rows = [
        [
            f"{k + 1}{' *' if k in front else ''}",
            *("" if cell is None else _short(cell) for cell in _cells(sweep, row)[:-1]),
        ]
        for k, row in enumerate(sweep.rows)
    ]
    shown = [k for k in range(len(head)) if any(row[k] for row in rows)]
    table = html_table([[row[k] for k in shown] for row in rows], [head[k] for k in shown])
    said = "<p>* on the Pareto front</p>" if front else ""
    return (
        '<!doctype html><html lang="en"><meta charset=utf-8>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        "<style>body{font:14px sans-serif;margin:1.5em}table{border-collapse:collapse}"
        "td,th{padding:2px 8px;border-bottom:1px solid #ddd;vertical-align:top}</style>"
        f"<title>{escape(sweep.file.title)}</title><h1>{escape(sweep.file.title)}</h1>{picture}"
        f'<div style="overflow-x:auto">{table}</div>{said}'
    )


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
