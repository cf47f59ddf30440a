"""Files of points: grids, draws, lists, and what is wrong with them, in one line."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.rigs import load_rig
from avis_ctrl.sweep.design_points import KEYS, DesignBase
from avis_ctrl.sweep.points import PointsFile, SweepSettings, points_of
from avis_ctrl.sweep.run import plan_sweep, run_sweep
from avis_ctrl.sweep.task import lost

SMALL = """
title = "small"
rig = "avis"
keep = ["z"]
[uncertainty]
parameters_percent = { mass = 10.0, "isolator1.k_z" = 15.0 }
[transmissibility]
peak_dB = 6.0
band_dB = -3.0
band_Hz = [2.0, 6.0]
[control_effort]
floor_velocity_m_per_s = 1.0e-5
bandwidth_Hz = 100.0
"""


def same(key: str) -> list[str]:
    return [key]


def points(**content: object) -> list[dict[str, object]]:
    return points_of(PointsFile.model_validate({"base": "x"} | content), same)


def drawn(key: str, **changes: object) -> dict[str, object]:
    return {"key": key, "random": {"count": 200, "seed": 3, "low": 1.0, "high": 100.0} | changes}


def test_listed_points_times_grids():
    found = points(
        point=[{"a": {"b": 1}}, {"a.b": 2}], vary=[{"key": "c", "values": [[1], [2]]}, {"key": "d", "values": ["x"]}]
    )
    assert found == [{"a.b": b, "c": [c], "d": "x"} for b in (1, 2) for c in (1, 2)]


def test_no_axes_are_the_base_alone():
    assert points() == [{}]


def test_draws_are_together_independent_and_given_by_the_seed():
    both = [drawn("a", scale="log"), drawn("b")]
    found = points(vary=both)
    assert len(found) == 200 and found == points(vary=both)
    a, b = (np.array([point[key] for point in found]) for key in "ab")
    assert a.min() >= 1 and a.max() <= 100 and b.min() >= 1 and b.max() <= 100
    # Half of each lies below its middle, to four standard deviations of a binomial count; they do not hang together.
    assert abs(np.sum(a < 10) - 100) < 28 and abs(np.sum(b < 50.5) - 100) < 28
    assert abs(np.corrcoef(np.log(a), b)[0, 1]) < 4 / np.sqrt(200)
    # Another axis does not change the draws of this one; another seed does.
    assert [point["a"] for point in points(vary=both[:1])] == a.tolist()
    assert points(vary=[drawn("a", seed=4)])[0]["a"] != points(vary=[drawn("a")])[0]["a"]


def test_every_parameter_of_a_wildcard_is_drawn_by_itself(tmp_path):
    base = small(tmp_path)
    file = PointsFile.model_validate({"base": "x", "vary": [drawn("rig_factor.isolator*.k_z", low=0.9, high=1.1)]})
    point = points_of(file, base.expand)[0]
    assert sorted(point) == [f"rig_factor.isolator{n}.k_z" for n in (1, 2, 3, 4)] and len(set(point.values())) == 4
    before, after = load_rig("avis").parameters(), base.resolved(point)[1].parameters()
    for key, factor in point.items():
        name = key.removeprefix("rig_factor.")
        assert after[name].value == pytest.approx(factor * before[name].value, rel=1e-12)
    assert {name for name in before if after[name].value != before[name].value} == {
        f"isolator{n}.k_z" for n in (1, 2, 3, 4)
    }


def small(folder) -> DesignBase:
    (folder / "small.toml").write_text(SMALL)
    return DesignBase.of(folder / "small.toml", True)


def test_values_reach_the_design_and_the_rig(tmp_path):
    base = small(tmp_path)
    (tmp_path / "other.toml").write_text(SMALL.replace('["z"]', '["z", "phi_x"]'))
    design, rig = base.resolved(
        {
            "transmissibility.band_dB": -5.0,
            "uncertainty.parameters_percent.isolator1.k_z": 20.0,
            "uncertainty.actuator_chains": {"low_percent": 5.0, "crossover_Hz": 90.0, "high_percent": 300.0},
            "rig.mass": 550.0,
            "base": "other.toml",
        }
    )
    assert (design.keep, design.transmissibility.band_dB) == (["z", "phi_x"], -5.0)
    assert design.uncertainty.parameters_percent == {"mass": 10.0, "isolator1.k_z": 20.0}
    assert design.uncertainty.actuator_chains.crossover_Hz == 90.0
    assert rig.parameters()["mass"].value == 550.0
    # The base itself is as it was.
    assert base.resolved({})[0].transmissibility.band_dB == -3.0


def test_the_identity_is_that_of_the_resolved_input(tmp_path):
    base = small(tmp_path)
    inputs = base.job({}).inputs
    assert base.job({"title": "another name", "rig_factor.mass": 1.0}).inputs == inputs
    assert base.job({"transmissibility.band_dB": -3.0}).inputs == inputs
    different = [
        {"transmissibility.band_dB": -3.1},
        {"rig_factor.mass": 1.01},
        {"rig": "halcyonics_loaded", "uncertainty.parameters_percent": {"load.mass": 10.0}},
    ]
    assert len({inputs, *(base.job(point).inputs for point in different)}) == 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('kind = "design"', "base: this key is missing"),
        ('base = "nowhere.toml"', "no such file; expected a design file"),
        ('base = "small.toml"\nkind = "dream"', "kind = 'dream': expected 'design', 'skyhook', 'gap' or 'function'"),
        ('base = "small.toml"\nvarry = 1', "unknown key; did you mean vary?"),
        ('base = "small.toml"\n[[vary]]\nkey = "keep"\nvalues = []', "at least 1 item"),
        ('base = "small.toml"\n[[vary]]\nkey = "keep"', "exactly one of values and random for keep"),
        (
            'base = "small.toml"\n[[vary]]\nkey = "transmissibility.band_db"\nvalues = [1]',
            "unknown key; did you mean transmissibility.band_dB",
        ),
        (
            'base = "small.toml"\n[[vary]]\nkey = "crossover_Hz"\nvalues = [1]',
            "uncertainty.actuator_chains.crossover_Hz",
        ),
        ('base = "small.toml"\n[[vary]]\nkey = "rig.masss"\nvalues = [1]', "did you mean rig.mass"),
        (
            'base = "small.toml"\n[[vary]]\nkey = "rig_factr.isolator*.k_z"\nvalues = [1]',
            "did you mean rig_factor.isolator*.k_z or ",
        ),
        ('base = "small.toml"\n[[point]]\n"rig.masss" = 1', "did you mean rig.mass"),
        (
            'base = "small.toml"\n[[vary]]\nkey = "rig.mass"\nvalues = [1]\n[[vary]]\nkey = "rig.mass"\nvalues = [2]',
            "key = 'rig.mass': expected each key once",
        ),
        ('base = "small.toml"\n[[vary]]\nkey = "rig.mass"\nvalues = ["much", true, inf]', "expected a number"),
        ('base = "small.toml"\n[[vary]]\nkey = "transmissibility.band_dB"\nvalues = ["deep"]', "expected a number"),
        ('base = "small.toml"\n[[vary]]\nkey = "base"\nvalues = [3]', "expected the name of a design file"),
        (
            'base = "small.toml"\n[[vary]]\nkey = "rig.mass"\nrandom = {count = 2, seed = 1, low = 3.0, high = 2.0}',
            "expected low below high",
        ),
        (
            'base = "small.toml"\n[[vary]]\nkey = "rig.mass"\nrandom = {count = 2, seed = 1, low = 0.0, high = 2.0, '
            'scale = "log"}',
            "positive low on a log scale",
        ),
        (
            'base = "small.toml"\n[[vary]]\nkey = "rig.mass"\nrandom = {count = 2, seed = 1, low = 1.0, high = 2.0}\n'
            '[[vary]]\nkey = "rig.com_x"\nrandom = {count = 3, seed = 1, low = 1.0, high = 2.0}',
            "one count",
        ),
        (
            'base = "small.toml"\n[[vary]]\nkey = "rig.mass"\nrandom = {count = 200000000, seed = 1, low = 1.0, '
            "high = 2.0}",
            "points = 200000000: expected at most 20000; here are 1 x 200000000",
        ),
        ('base = "small.toml"\npareto = ["mu_upper", "band"]', "pareto = 'band': expected some of mu_upper, mu_lower"),
        ('base = "small.toml"\npareto = ["mu_upper"]', "at least 2 items"),
        ('base = "small.toml"\nkind = "gap"', "rig: this key is missing"),
        ('base = "nowhere.h5"\nkind = "gap"\nrig = "avis"', "nowhere.h5"),
        ('base = "small.toml"\nrig = "avis"', "the design file names it"),
        ('base = "own.py"\nkind = "function"', "expected FILE.py:NAME"),
        ('base = "nowhere.py:f"\nkind = "function"', "expected a Python file (No such file"),
        ('base = "broken.py:f"\nkind = "function"', "expected a Python file that runs: ZeroDivisionError"),
        ('base = "own.py:g"\nkind = "function"', "expected the name of a function"),
        ("base = ", "expected a TOML file"),
    ],
)
def test_hostile_files_are_one_line(text, words, tmp_path):
    (tmp_path / "small.toml").write_text(SMALL)
    (tmp_path / "own.py").write_text("def f(point):\n    return {}\n")
    (tmp_path / "broken.py").write_text("1 / 0\n")
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(InputError) as said:
        plan_sweep(tmp_path / "p.toml", tmp_path / "out")
    assert words in str(said.value) and "\n" not in str(said.value)
    assert not (tmp_path / "out").exists()


def test_a_grid_beyond_the_limit_is_refused_before_it_is_made():
    axes = [{"key": key, "values": list(range(1000))} for key in "abcd"]
    with pytest.raises(InputError, match="= 1000000000000: expected at most 20000; here are 1 x 1000 x 1000"):
        points(vary=axes)
    file = PointsFile.model_validate({"base": "x", "vary": [{"key": "a", "values": [1, 2, 3]}]})
    with pytest.raises(InputError, match="points = 3: expected at most 2;"):
        points_of(file, same, SweepSettings(max_points=2))


def test_a_point_that_cannot_be_made_is_a_task_less(tmp_path):
    """The others are computed; `band_dB` above `peak_dB` is refused by the design file's own check."""
    (tmp_path / "small.toml").write_text(SMALL)
    (tmp_path / "p.toml").write_text(
        'base = "small.toml"\n[[vary]]\nkey = "transmissibility.band_dB"\nvalues = [-3.0, 9.0]'
    )
    plan = plan_sweep(tmp_path / "p.toml", tmp_path / "out")
    made, refused = plan.tasks
    assert isinstance(refused, InputError) and "below peak_dB = 6" in str(refused)
    assert not isinstance(made, InputError) and plan.wrong == [refused]


def test_wrong_values_are_said_before_the_other_points_are_computed(tmp_path):
    (tmp_path / "small.toml").write_text(SMALL)
    (tmp_path / "p.toml").write_text(
        'base = "small.toml"\n[[vary]]\nkey = "transmissibility.band_dB"\nvalues = ["a", -3.0, 9.0]'
    )
    said = []

    def backend(tasks):
        assert len(tasks) == 1 and len(said) == 2
        yield lost(tasks[0], "")

    found = run_sweep(plan_sweep(tmp_path / "p.toml", tmp_path), backend, lambda done, total, text: said.append(text))
    assert (
        said[0].startswith(
            "2 of 3 points have values that do not fit and are not computed; the first: "
            "transmissibility.band_dB = 'a': expected a number"
        )
        and "\n" not in said[0]
    )
    assert [row.status for row in found.rows] == ["failed", "lost", "failed"]


def test_the_hash_of_the_points_file_is_that_of_the_text_that_was_read(tmp_path):
    path = tmp_path / "p.toml"
    (tmp_path / "small.toml").write_text(SMALL)
    path.write_text('base = "small.toml"')
    read = path.read_bytes()

    def backend(tasks):
        path.write_text("edited during the sweep")
        yield lost(tasks[0], "")

    found = run_sweep(plan_sweep(path, tmp_path), backend)
    assert found.provenance["points_sha256"] == hashlib.sha256(read).hexdigest()


def test_the_guide_s_examples_are_points(tmp_path):
    root = Path(__file__).resolve().parents[2]
    grid, listed = re.findall(r"```toml\n(.*?)```", (root / "docs" / "sweep.md").read_text(), re.DOTALL)
    for text, count in ((grid, 30), (f'base = "avis_z_phix.toml"\n{listed}', 2)):
        (tmp_path / "p.toml").write_text(text.replace('base = "', f'base = "{root / "designs"}/'))
        plan = plan_sweep(tmp_path / "p.toml", tmp_path / "out")
        assert len(plan.tasks) == count and not any(isinstance(one, InputError) for one in plan.tasks)
        assert len({one.identity for one in plan.tasks}) == count
    assert len(plan_sweep(root / "designs" / "points" / "avis_bandwidth.toml", tmp_path).tasks) == 12


def test_keys_are_those_of_the_design_file():
    """Each key of the shipped files is one that may vary."""
    assert {
        "keep",
        "rig",
        "base",
        "transmissibility.band_Hz",
        "uncertainty.sensor_chains.crossover_Hz",
        "requirement",
        "synthesis.max_iterations",
    } <= set(KEYS)
    assert [key for key, free in KEYS.items() if free] == [
        "uncertainty.parameters_percent",
        "uncertainty.parameters_absolute",
    ]
