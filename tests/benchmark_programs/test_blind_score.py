"""The score of blind campaigns: hand-made lines whose figures are known by hand."""

import gzip
import json
import sys
from math import log
from pathlib import Path

import pytest

from avis_ctrl.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks.blind.asked import asked_table  # noqa: E402
from benchmarks.blind.figures import closed, noise_ratio  # noqa: E402
from benchmarks.blind.judge import contradiction, judge, split_name  # noqa: E402
from benchmarks.blind.lines import Answer, Line, Stage, finished, read_lines  # noqa: E402
from benchmarks.blind.matrix import Confusion  # noqa: E402
from benchmarks.blind.parameters import Equivalent, parameter_errors, true_value  # noqa: E402
from benchmarks.blind.rates import Share, brier, log_score, reliability, wilson  # noqa: E402
from benchmarks.blind.score import main, score  # noqa: E402
from benchmarks.blind.tables import Table, effect_table  # noqa: E402


def hidden(name, location="payload", strength="clear", **parameters):
    return {"name": name, "location": location, "strength": strength, "parameters": parameters}


def named(name, location="payload", probability=0.99, group=(), **parameters):
    return {
        "name": name,
        "location": location,
        "probability": probability,
        "indistinguishable_from": list(group),
        "parameters": {key: {"value": value, "std": std, "unit": ""} for key, (value, std) in parameters.items()},
    }


def answer(verdict, *effects, nrmse=(0.2, 0.01), chi2=1.0, traces=()):
    return {
        "traces": list(traces),
        "format": "avis-gap",
        "version": 1,
        "verdict": verdict,
        "effects": list(effects),
        "where": [],
        "gap": [
            {"stage": "nominal", "nrmse": 0.5, "chi2_per_dof": 900.0},
            {"stage": "re-identified", "nrmse": nrmse[0], "chi2_per_dof": 140.0},
            {"stage": "last", "nrmse": nrmse[1], "chi2_per_dof": chi2},
        ],
        "next_experiment": None,
        "seconds": 20.0,
    }


def table(seed, kind, truths, given, **changed):
    return {
        "seed": seed,
        "kind": kind,
        "hidden": truths,
        "excitation": "multisine",
        "floor_recorded": False,
        "relative_change": 0.1,
        "answer": given if isinstance(given, dict) else None,
        "crash": given if isinstance(given, str) else None,
        "seconds": 10.0,
        "cpu_seconds": 12.0,
        "memory_MB": 500.0,
        "simulation_seconds": 3.0,
        "unseen": None,
        "unseen_error": None,
        "settings": {
            "duration_s": 60.0,
            "jobs": 2,
            "kind": None,
            "effect": None,
            "strength": None,
            "unseen": False,
            "commit": "abc",
        },
    } | changed


def line(*content, **changed):
    return Line.model_validate(table(*content, **changed))


LAG, GAIN = hidden("actuator_lag", "actuators"), hidden("sensor_gain", "Sz2")


@pytest.mark.parametrize(
    ("kind", "truths", "given", "outcome"),
    [
        ("none", [], answer("none"), "quiet"),
        ("none", [], answer("unexplained"), "alarm without a name"),
        ("none", [], answer("explained", named("com_offset")), "false name"),
        ("none", [], "Error: x", "crash"),
        ("one", [LAG], answer("explained", named("actuator_lag", "actuators")), "right"),
        ("one", [LAG], answer("explained", named("loop_delay", "loop", group=["actuator_lag"])), "right"),
        ("one", [LAG], answer("explained", named("loop_delay", "loop")), "wrong"),
        (
            "one",
            [LAG],
            answer("explained", named("actuator_lag", "actuators"), named("com_offset")),
            "right and an extra",
        ),
        ("one", [LAG], answer("unexplained"), "refused"),
        ("one", [LAG], answer("none"), "missed"),
        ("two", [LAG, GAIN], answer("explained", named("sensor_gain", "Sz2"), named("actuator_lag")), "both right"),
        ("two", [LAG, GAIN], answer("partly explained", named("sensor_gain", "Sz2")), "one right"),
        # 1 % is the tolerance: no missing effect below three of it, nor a false name.
        ("one", [hidden("sensor_gain", "Sz2", gain=1.02)], answer("none"), "quiet"),
        ("one", [hidden("sensor_gain", "Sz2", gain=1.02)], answer("explained", named("sensor_gain", "Sz2")), "quiet"),
        ("one", [hidden("sensor_gain", "Sz2", gain=0.96)], answer("none"), "missed"),
        (
            "two",
            [LAG, hidden("com_offset", x_m=1e-3, y_m=-2e-3, z_m=0.0)],
            answer("explained", named("actuator_lag", "actuators")),
            "right",
        ),
        ("two", [LAG, GAIN], answer("explained", named("sensor_gain"), named("com_offset")), "one right, one wrong"),
        ("two", [LAG, GAIN], answer("explained", named("com_offset")), "wrong"),
        # One named effect cannot stand for two hidden ones, nor two named ones for one.
        ("two", [GAIN, GAIN], answer("explained", named("sensor_gain", "Sz2")), "one right"),
        (
            "one",
            [GAIN],
            answer("explained", named("sensor_gain", "Sz2"), named("sensor_gain", "Sz1")),
            "right and an extra",
        ),
        ("outside", [hidden("backlash")], answer("unexplained"), "refused"),
        ("outside", [hidden("backlash")], answer("none"), "missed"),
        ("outside", [hidden("backlash")], answer("partly explained"), "refused"),
        ("outside", [hidden("backlash")], answer("explained", named("contact_friction")), "named as something else"),
    ],
)
def test_outcomes(kind, truths, given, outcome):
    assert judge(line(1, kind, truths, given)).outcome == outcome


def test_pairs_are_chosen_together():
    """A group that fits the first hidden effect must not take it from the one that fits nothing else."""
    given = answer(
        "explained",
        named("loop_delay", "loop", group=["actuator_lag", "sensor_gain"]),
        named("actuator_lag", "actuators"),
    )
    case = judge(line(1, "two", [LAG, GAIN], given))
    assert case.outcome == "both right"
    assert [(one.hidden.name, one.named.name, one.exact) for one in case.pairs] == [
        ("actuator_lag", "actuator_lag", True),
        ("sensor_gain", "loop_delay", False),
    ]


def test_two_of_one_name_are_paired_by_place():
    truths = [hidden("sensor_gain", "Sz1"), hidden("sensor_gain", "Sz2")]
    case = judge(line(1, "two", truths, answer("explained", named("sensor_gain", "Sz2"), named("sensor_gain", "Sz1"))))
    assert all(one.place for one in case.pairs)


@pytest.mark.parametrize(
    ("entry", "parts"),
    [
        ("sensor_gain", ("sensor_gain", None)),
        ("sensor_gain at Sz2", ("sensor_gain", "Sz2")),
        ("sensor_gain@Sz2", ("sensor_gain", "Sz2")),
        ("mount_surge (isolators z)", ("mount_surge", "isolators z")),
    ],
)
def test_entries_of_groups(entry, parts):
    assert split_name(entry) == parts


def test_a_place_of_a_group_counts():
    given = answer("explained", named("geophone_corner", "Sz1", group=["sensor_gain at Sz2"]))
    assert judge(line(1, "one", [GAIN], given)).pairs[0].place
    given = answer("explained", named("geophone_corner", "Sz1", group=["sensor_gain"]))
    assert not judge(line(1, "one", [GAIN], given)).pairs[0].place


def test_wilsons_interval_as_published():
    """Newcombe, Statistics in Medicine 17 (1998), p. 857, table I: 81/263, 15/148, 0/20, 1/29."""
    for hits, trials, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ):
        assert wilson(hits, trials) == pytest.approx((low, high), abs=5e-5)
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(20, 20)[1] == 1.0


def test_scores_of_probabilities_by_hand():
    p, right = [0.9, 0.6, 1.0], [True, False, True]
    assert brier(p, right) == pytest.approx((0.01 + 0.36 + 0.0) / 3)
    assert log_score(p, right) == pytest.approx(-(log(0.9) + log(0.4)) / 3, abs=1e-6)
    # Sure and wrong is bad, but not infinitely: -log(1e-6).
    assert log_score([1.0], [False]) == pytest.approx(13.8155, abs=1e-3)


def test_reliability_bins():
    bins = reliability([0.49, 0.5, 0.7, 0.99, 1.0], [True, False, True, True, False])
    assert [(one.low, one.high, one.right) for one in bins] == [
        (0.0, 0.5, Share(1, 1)),
        (0.5, 0.8, Share(1, 2)),
        (0.99, 1.0, Share(1, 2)),
    ]
    assert bins[1].mean == pytest.approx(0.6)


def campaign():
    """Eleven cases; every figure of the tests below follows by counting."""
    lag, corner = hidden("actuator_lag", "actuators"), hidden("geophone_corner", "Sz2", "gross", corner_Hz=5.0)
    faint = hidden("com_offset", strength="faint")
    return [
        line(1, "none", [], answer("none")),
        line(2, "none", [], answer("unexplained")),
        line(3, "one", [corner], answer("explained", named("geophone_corner", "Sz2", 1.0, corner_Hz=(5.1, 0.1)))),
        line(
            4,
            "one",
            [corner],
            answer(
                "explained", named("geophone_corner", "Sz1", 0.8, corner_Hz=(5.1, 0.1)), nrmse=(0.2, 0.15), chi2=9.0
            ),
        ),
        line(5, "one", [lag], answer("explained", named("loop_delay", "loop", 0.5, ["actuator_lag"]))),
        line(6, "one", [lag], answer("explained", named("com_offset", probability=0.6))),
        line(7, "one", [faint], answer("none")),
        line(
            8,
            "two",
            [lag, corner],
            answer(
                "explained", named("actuator_lag", "actuators"), named("geophone_corner", "Sz2", corner_Hz=(5.0, 0.01))
            ),
        ),
        line(9, "two", [lag, corner], "Traceback\nValueError: no", seconds=70.0),
        line(10, "outside", [hidden("backlash")], answer("unexplained"), memory_MB=900.0),
        line(11, "outside", [hidden("backlash")], answer("explained", named("contact_friction")), excitation="noise"),
    ]


def test_asked_figures_by_hand():
    found = {
        row[0]: dict(zip(("clean", "asked"), row[1:], strict=True))
        for row in asked_table(list(map(judge, campaign()))).rows
    }
    for what, fraction in {
        "cases": "11",
        "no effect: false names": "0.0 % (0/2;",
        "one effect, clear or gross: named first": "75.0 % (3/4;",
        "right place, where the effect has one and its name is right": "50.0 % (1/2;",
        "two effects: both named": "50.0 % (1/2;",
        "outside the library: named as something else": "50.0 % (1/2;",
        "parameter inside its own 95 % interval": "100.0 % (2/2;",
    }.items():
        assert found[what]["clean"].startswith(fraction), what
    assert found["two effects: both named"]["asked"] == "85 %"


def test_a_second_effect_that_explains_little_may_be_listed_as_a_trace():
    lag, corner = hidden("actuator_lag", "actuators"), hidden("geophone_corner", "Sz2", corner_Hz=5.0)
    first, second = named("actuator_lag", "actuators"), named("geophone_corner", "Sz2", corner_Hz=(5.0, 0.01))
    lines = [
        line(0, "two", [lag, corner], answer("explained", first, traces=[second])),
        line(1, "two", [lag, corner], answer("explained", first)),
        line(2, "one", [corner], answer("explained", first, traces=[second])),
        line(3, "one", [corner], answer("explained", first)),
    ]
    found = {row[0]: row[1] for row in asked_table(list(map(judge, lines))).rows}
    assert found["two effects: both named"].startswith("0.0 % (0/2;")
    assert found["two effects: both named, as effects or as traces"].startswith("50.0 % (1/2;")
    assert found["one effect, clear or gross: named first"].startswith("0.0 % (0/2;")
    assert found["one effect, clear or gross: named first, or listed as a trace"].startswith("50.0 % (1/2;")


@pytest.mark.parametrize(
    ("nrmse", "chi2", "good"),
    [((0.2, 0.19), 1.43, True), ((0.2, 0.19), 1.45, False), ((0.2, 0.0199), 99.0, True), ((0.2, 0.021), 99.0, False)],
)
def test_closed_gaps(nrmse, chi2, good):
    assert closed(Answer.model_validate(answer("explained", nrmse=nrmse, chi2=chi2))) is good


def test_noise_ratio():
    assert noise_ratio(Stage(stage="x", nrmse=0.1, chi2_per_dof=1.44)) == pytest.approx(1.2)


def test_parameters_in_other_words_and_units():
    table = (Equivalent("actuator_gain", "change_percent", "gain", 0.01, 1.0),)
    assert true_value("actuator_gain", "gain", {"change_percent": 5.0}, table)[1] == pytest.approx(1.05)
    assert true_value("actuator_lag", "time_constant_ms", {"time_constant_s": 2e-3})[1] == pytest.approx(2.0)
    assert true_value("actuator_lag", "corner_Hz", {"corner_rad_per_s": 2 * 3.141592653589793})[1] == pytest.approx(1.0)
    # A table's entry goes before the same name: the truth's delay comes on top of the nominal 1 ms.
    assert true_value("loop_delay", "delay_s", {"delay_s": 2e-3})[1] == pytest.approx(3e-3)
    assert true_value("loop_delay", "extra_delay_s", {"delay_s": 2e-3})[1] == pytest.approx(2e-3)
    assert true_value("actuator_gain", "gain", {"shape": [1.0]}) is None
    assert true_value("cubic_stiffness", "gain", {"gain": True}) is None


def test_parameters_of_a_wrong_place_are_not_compared():
    errors, unknown = parameter_errors([judge(one) for one in campaign()])
    assert sorted(round(one.error, 6) for one in errors) == [0.0, 0.1]  # seeds 8 and 3, not 4
    assert [one.deviations for one in errors] == pytest.approx([1.0, 0.0])
    assert unknown == []


def test_a_parameter_counts_once():
    """The report gives the extra delay and the sum with the nominal one: one truth, one error."""
    truth = hidden("loop_delay", "loop", delay_s=2e-3)
    given = answer("explained", named("loop_delay", "loop", extra_delay_s=(2.1e-3, 1e-4), delay_s=(3.1e-3, 1e-4)))
    errors, unknown = parameter_errors([judge(line(1, "one", [truth], given))])
    assert [(one.parameter, pytest.approx(1.0)) for one in errors] == [("extra_delay_s", errors[0].deviations)]
    assert unknown == []


def test_errors_without_a_truth_are_counted():
    given = answer("explained", named("actuator_lag", "actuators", corner_Hz=(92.0, 1.0)))
    assert parameter_errors([judge(line(1, "one", [LAG], given))]) == ([], ["actuator_lag.corner_Hz"])


def test_confusion_matrix():
    """Seed 5 is right through its group: it stands under the hidden name."""
    found = Confusion.of([judge(one) for one in campaign()])
    assert found.rows == ("geophone_corner", "actuator_lag", "com_offset", "outside: backlash", "none")
    counts = {
        (row, column): int(n)
        for row, numbers in zip(found.rows, found.counts, strict=True)
        for column, n in zip(found.columns, numbers, strict=True)
        if n
    }
    assert counts == {
        ("geophone_corner", "geophone_corner"): 2,
        ("actuator_lag", "actuator_lag"): 1,
        ("actuator_lag", "com_offset"): 1,
        ("com_offset", "none"): 1,
        ("none", "none"): 1,
        ("none", "unexplained"): 1,
        ("outside: backlash", "unexplained"): 1,
        ("outside: backlash", "contact_friction"): 1,
    }
    assert len({len(text) for text in found.text().splitlines()[:6]}) == 1  # columns stand below each other


def test_counts_by_effect():
    rows = {row[0]: row[1:] for row in effect_table([judge(one) for one in campaign()]).rows}
    #                               faint  clear  gross  place  group  in two
    assert rows["geophone_corner"] == ("0/0", "0/0", "2/2", "1/2", "0/2", "1/2", "")
    assert rows["actuator_lag"] == ("0/0", "1/2", "0/0", "", "1/1", "1/2", "com_offset 1")


def test_answers_that_contradict_the_contract():
    assert contradiction(line(1, "none", [], answer("unexplained", named("com_offset"))))
    assert contradiction(line(1, "none", [], answer("explained")))
    assert contradiction(line(1, "none", [], answer("explained", named("gremlins"))))
    assert contradiction(line(1, "none", [], answer("explained", named("com_offset")))) is None


def write(path, *tables):
    path.write_text("".join(json.dumps(one) + "\n" for one in tables))
    return path


def test_files_to_text_markdown_and_picture(tmp_path, capsys):
    path = write(tmp_path / "b.jsonl", *(one.model_dump() for one in reversed(campaign())))
    main([str(path), "--markdown", str(tmp_path / "b.md")])
    text, markdown = capsys.readouterr().out, (tmp_path / "b.md").read_text()
    for said in ("fewer than the 300", "seed 9: ValueError: no", "missed", "outside: backlash"):
        assert said in text and said in markdown
    assert (tmp_path / "b.png").read_bytes().startswith(b"\x89PNG")
    for block in markdown.split("\n\n"):
        if block.startswith("|"):
            assert len({row.replace("\\|", "").count("|") for row in block.splitlines()}) == 1


def test_the_brier_score_of_the_text():
    """Named: 1.0, 0.8, 0.5, 0.6, 0.99 twice, 0.99; by own name right are the first two and the two of seed 8."""
    squares = [0.0, 0.04, 0.25, 0.36, 1e-4, 1e-4, 0.99**2]
    note = next(one.note for one in score(campaign()).tables if one.title.endswith("own name"))
    assert f"Brier score {sum(squares) / 7:.4f}" in note


def test_unseen_campaigns():
    asked = table(1, "none", [], answer("none"))["settings"] | {"unseen": True}
    lines = [
        line(
            1,
            "one",
            [GAIN],
            answer("explained", named("sensor_gain", "Sz2")),
            settings=asked,
            unseen={"baseline": 0.2, "updated": 0.02},
        ),
        line(2, "none", [], answer("none"), settings=asked, unseen_error="Traceback\nValueError: shapes"),
    ]
    text = score(lines).text()
    assert "seed 2: ValueError: shapes" in text
    assert "unseen campaign, named: updated over baseline, median and most" in text and "0.1, 0.1" in text


def test_markdown_of_a_bar():
    assert "a\\|b" in Table("t", ("x",), (("a|b",),)).markdown()


GOOD = table(1, "none", [], answer("none"))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "at least one line"),
        ("{", "line 1: expected one JSON object"),
        ("[]\n", "line 1"),
        ("[" * 100000 + "\n", "nested too deeply"),
        (json.dumps(GOOD) + "\n" + json.dumps(GOOD)[:80], "line 2: expected one JSON object"),
        (json.dumps(GOOD) + "\n" + json.dumps(GOOD) + "\n", "line 2: seed = 1: expected each seed once"),
        (json.dumps(GOOD | {"kind": "three"}), "kind"),
        (json.dumps(GOOD | {"kind": "two"}), "2 hidden effects"),
        (json.dumps(GOOD | {"kind": "outside"}), "at least one hidden effect"),
        (json.dumps(GOOD | {"crash": "x"}), "an answer or a crash"),
        (json.dumps(GOOD | {"answer": None}), "an answer or a crash"),
        (json.dumps(GOOD | {"seconds": float("nan")}), "seconds"),
        (json.dumps(GOOD | {"seconds": -1.0}), "seconds"),
        (json.dumps(GOOD | {"colour": 1}), "colour"),
        (json.dumps({key: value for key, value in GOOD.items() if key != "answer"}), "answer"),
        (json.dumps(GOOD | {"answer": answer("explained", named("com_offset", probability=1.5))}), "probability"),
        (json.dumps(GOOD | {"answer": answer("sure")}), "verdict"),
        (
            json.dumps(GOOD)
            + "\n"
            + json.dumps(GOOD | {"seed": 2, "settings": GOOD["settings"] | {"duration_s": 30.0}}),
            "expected the campaign of line 1",
        ),
    ],
)
def test_hostile_lines(tmp_path, content, said):
    path = tmp_path / "b.jsonl"
    path.write_text(content)
    with pytest.raises(InputError) as caught:
        read_lines(path)
    assert said in str(caught.value) and "b.jsonl" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path, capsys):
    for path in (tmp_path / "absent", tmp_path):
        with pytest.raises(InputError, match="readable file"):
            read_lines(path)
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "bytes.gz").write_bytes(b"\xff\xfe\x00")
    for name in ("bytes", "bytes.gz"):
        with pytest.raises(InputError, match="UTF-8"):
            read_lines(tmp_path / name)
    with pytest.raises(SystemExit) as caught:
        main([str(tmp_path / "absent")])
    assert caught.value.code == 2 and "Traceback" not in capsys.readouterr().err


def test_lines_may_be_gzipped(tmp_path):
    path = write(tmp_path / "b.jsonl", GOOD)
    (tmp_path / "b.jsonl.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert read_lines(tmp_path / "b.jsonl.gz") == read_lines(path)


def test_an_unfinished_last_line_is_cut(tmp_path):
    path = write(tmp_path / "b.jsonl", GOOD)
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"seed": 2, "kin')
    assert [one.seed for one in finished(path)] == [1]
    assert path.read_bytes() == whole
    assert finished(tmp_path / "absent") == []


def test_a_value_that_lies_beyond_its_tolerance_is_no_false_name():
    drawn = line(1, "none", [], answer("explained", named("sensor_gain", "Sz2")), cluttered=True)
    assert judge(drawn).outcome == "false name"
    for place, outcome in (("Sz2", "quiet"), ("Sx2", "false name")):
        assert judge(drawn.model_copy(update={"far": [("sensor_gain", place)]})).outcome == outcome
