"""Table, JSON and Pareto front of a sweep."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from helpers import write_points
from matplotlib.image import imread

from avis_ctrl.errors import InputError
from avis_ctrl.plot.pareto import pareto, pareto_front
from avis_ctrl.sweep.local import on_this_machine
from avis_ctrl.sweep.output import write_sweep
from avis_ctrl.sweep.run import plan_sweep, run_sweep


def by_definition(values: np.ndarray) -> set[int]:
    """Points that no other is at most equal to in both figures and below in one."""
    known = [k for k in range(len(values)) if np.all(np.isfinite(values[k]))]
    return {
        k for k in known if not any(np.all(values[j] <= values[k]) and np.any(values[j] < values[k]) for j in known)
    }


def test_the_front_is_that_of_its_definition(rng):
    for n in (1, 2, 7, 40):
        for values in (rng.standard_normal((n, 2)), rng.integers(0, 4, (n, 2)).astype(float)):
            values[rng.random(n) < 0.1] = np.nan
            found = pareto_front(values)
            assert set(found.tolist()) == by_definition(values) and len(set(found.tolist())) == found.size
            assert np.all(np.diff(values[found, 0]) >= 0)
    assert pareto_front(np.full((3, 2), np.nan)).size == 0


def test_the_plot_draws_the_front_and_its_labels():
    values = np.array([[1.0, 3.0], [2.0, 2.0], [3.0, 2.5], [np.nan, 0.0]])
    ax = pareto(values, ("mu [1]", "band [dB]"), ["a", "b", "c", "d"])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("mu [1]", "band [dB]")
    assert [text.get_text() for text in ax.texts] == ["a", "b"]
    np.testing.assert_array_equal(ax.lines[1].get_xydata(), values[:2])
    assert ax.lines[0].get_label() == "3 points"


def swept(folder, count, **constants):
    write_points(folder, count, **constants)
    (folder / "out" / "points").mkdir(parents=True)
    return run_sweep(plan_sweep(folder / "points.toml", folder / "out"), lambda tasks: on_this_machine(tasks, 1))


def test_files_say_the_same(tmp_path):
    found = swept(tmp_path, 4, refused=2, note='a, "quoted" = text')
    written = write_sweep(found, tmp_path / "out")
    assert [path.name for path in written] == ["sweep.csv", "pareto.png", "sweep.html", "sweep.json"]
    with (tmp_path / "out" / "sweep.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    stored = json.loads((tmp_path / "out" / "sweep.json").read_text())
    assert [row["k"] for row in table] == ["0", "1", "2", "3"] and table[1]["note"] == 'a, "quoted" = text'
    for row, point in zip(table, stored["points"], strict=True):
        assert (row["status"], row["message"], row["identity"]) == (
            point["status"],
            point["message"],
            point["identity"],
        )
        assert {name: json.loads(row[name]) for name in point["figures"]} == point["figures"]
    assert table[2]["cost"] == "" and table[2]["message"] == "ValueError: no value at this point"
    assert stored["pareto"] == {"quantities": ["cost", "error"], "front": [1, 2, 4]}  # rows, counted from 1
    assert stored["provenance"]["points_file"] == "points.toml"
    assert imread(tmp_path / "out" / "pareto.png").std() > 0.05
    page = (tmp_path / "out" / "sweep.html").read_text()
    assert "data:image/png" in page and "no value at this point" in page and "a, &quot;quoted&quot;" in page


def test_a_quantity_that_no_point_has(tmp_path):
    found = swept(tmp_path, 2)
    (tmp_path / "points.toml").write_text(
        (tmp_path / "points.toml").read_text().replace('"cost", "error"', '"cost", "eror"')
    )
    found = run_sweep(plan_sweep(tmp_path / "points.toml", tmp_path / "out"))
    with pytest.raises(InputError, match="pareto = 'eror': expected some of cost, error"):
        write_sweep(found, tmp_path / "out")
    assert not (tmp_path / "out" / "sweep.json").exists()
