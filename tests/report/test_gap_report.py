"""The report of a gap: what it says agrees with what was found, in HTML and in PDF."""

from __future__ import annotations

import re
from dataclasses import replace

import gap_stand_in as stand_in
import numpy as np
import pytest
from gap_stand_in import Finds
from reading import Reader, cells, figures, part, pdf_text, prose, tables, written

from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.result import VERDICTS, Detectable, HeatMap, Stage, Where, spoken
from avis_ctrl.gap.table_model import active
from avis_ctrl.report import html, words
from avis_ctrl.report.elements import Mark, Paragraph, Section
from avis_ctrl.report.figures import Figure, Heat, Panel
from avis_ctrl.report.gap import wording
from avis_ctrl.report.gap.before_after import spectrum, worst_pairs
from avis_ctrl.report.gap.content import document
from avis_ctrl.report.gap.places import heat_map
from avis_ctrl.report.matplotlib_backend import svg
from avis_ctrl.report.plotly_backend import graph
from avis_ctrl.study.gap_overlay import GapOverlay, gap_overlay, selections

NAMED = {
    "gap_spectrum",
    "ladder",
    "gap_responses",
    "heat_map",
    "gap_records",
    "gap_coherence",
    "gap_coherence_lowest",
    "gap_mu",
}


@pytest.fixture
def found(gap_found: Finds) -> Finds:
    return gap_found


def section(found: Finds, anchor: str) -> Section:
    return part(document(found), anchor)


def page_of(found: Finds) -> Reader:
    return Reader(html.render(document(found)))


def test_figures_are_those_of_the_gap(found):
    assert {p.name for p in document(found).figures()} == NAMED


def test_opens_with_the_sentence_of_the_finder_and_the_numbers(found):
    first = section(found, "result").pieces[0]
    assert isinstance(first, Paragraph) and first.text == found.gap.sentences[0] and first.good is True
    text = prose(section(found, "result"))
    assert "31.0 %" in text and "12.0 %" in text and "1.04 %" in text
    assert "that of the noise alone is estimated at 1.01 %" in text
    assert "11.5 times smaller" in text and "1.03 times the noise" in text  # 0.12/0.0104 and 0.0104/0.0101


@pytest.mark.parametrize("verdict", VERDICTS)
def test_each_verdict_has_its_words_and_colour(found, verdict):
    one = replace(found, gap=stand_in.with_verdict(found.gap, verdict))
    own = section(one, "result")
    first = own.pieces[0]
    look = (first.good, first.half)
    assert (
        look
        == {
            "none": (True, False),
            "explained": (True, False),
            "partly explained": (None, True),
            "unexplained": (False, False),
        }[verdict]
    )
    left = one.gap.left
    removed = words.percent(1 - left.share) if left else "a part"
    claims = {name: claim.format(removed=removed) in prose(own) for name, claim in wording.CLAIMS.items()}
    assert claims == {name: name == verdict for name in VERDICTS}
    assert f"Verdict: {verdict}." in prose(own)
    css = {(True, False): "verdict good", (None, True): "verdict half", (False, False): "verdict bad"}[look]
    classes = [a.get("class") for tag, a in page_of(one).elements if tag == "p"]
    assert css in classes
    # Without a named effect nothing of an updated model is drawn or tabled.
    labels = {
        label
        for name in ("before_after", "where")
        for f in figures(section(one, name)).values()
        for label in f.legend()
    }
    assert ("updated" in labels) == bool(one.gap.effects)
    assert len(figures(section(one, "where"))["heat_map"].panels) == 1 + bool(one.gap.effects)


def test_none_says_what_would_not_have_been_seen(found):
    one = replace(found, gap=stand_in.with_verdict(found.gap, "none"))
    assert "An actuator lag below 3.1e−5 s would not have been seen." in page_of(one).text


def test_a_band_that_stands_out_of_a_closed_gap_is_not_denied(found):
    left = stand_in.with_verdict(found.gap, "unexplained").remaining
    for verdict in ("none", "explained"):
        gap = stand_in.with_verdict(found.gap, verdict)
        one = replace(found, gap=replace(gap, remaining=left))
        assert "No band of any channel" not in prose(section(one, "where")) + prose(section(one, "remaining"))
        assert tables(section(one, "remaining"))
        quiet = replace(found, gap=replace(gap, remaining=()))
        assert "No band of any channel" in prose(section(quiet, "remaining"))


def test_a_group_is_said_to_be_one(found):
    effect = replace(found.gap.effects[0], indistinguishable_from=("product_of_inertia",))
    one = replace(found, gap=replace(found.gap, effects=(effect,), next_experiment="Shake the floor."))
    assert "cannot distinguish com offset and product of inertia" in prose(section(one, "result"))
    assert tables(section(one, "result"))[0].rows[0][-1] == "product of inertia"
    assert "Shake the floor." in prose(section(one, "remaining"))


def test_ladder_and_noise_line(found):
    drawn = figures(section(found, "result"))["ladder"].panels[0]
    bars = next(c for c in drawn.curves if c.bars)
    np.testing.assert_allclose(bars.y, [31.0, 12.0, 1.04])
    line = next(c for c in drawn.curves if c.label == "noise alone")
    np.testing.assert_allclose(line.y, 1.01)
    assert drawn.y.scale == "log" and [word for _, word in drawn.x.ticks] == [
        "nominal",
        "re-identified",
        "+ com offset",
    ]
    rows = tables(section(found, "before_after"))[0].rows
    assert [row[0] for row in rows] == ["nominal", "re-identified", "+ com offset", "noise alone"]
    assert [row[3] for row in rows] == ["900.0", "140.0", "1.030", "1"]


def test_sizes_are_rounded_to_their_deviation(found):
    rows = {row[2]: row for row in tables(section(found, "parameters"))[0].rows}
    for name, p in found.gap.effects[0].parameters.items():
        assert abs(float(rows[name][3].replace("−", "-")) - p.value) <= 0.06 * p.std
        assert float(rows[name][4].removeprefix("± ")) == pytest.approx(p.std, rel=0.06)


@pytest.mark.parametrize(
    ("one", "text"),
    [
        (Reported(92.0, 1.0, "Hz"), "(92.0 ± 1.0) Hz"),
        (Reported(0.93, 0.004, "1"), "0.9300 ± 0.0040"),
        (Reported(5.0, float("nan"), "Hz"), "5.0000 Hz (no standard deviation)"),
        (Reported(0.00132638, 4.6e-7, "s"), "(1.32638 ± 0.00046) ms"),
        (Reported(0.0121, 0.0002, "m"), "(0.01210 ± 0.00020) m"),
    ],
)
def test_a_quantity_in_words(one, text):
    assert wording.quantity(one) == text


def test_probabilities_are_never_certain():
    assert wording.probability(1.0) == "99 %" and wording.probability(0.0) == "< 0.1 %"
    assert wording.probability(0.874) == "87.4 %"


def test_runners_up_with_their_reasons(found):
    rows = tables(section(found, "considered"))[0].rows
    assert {row[-1] for row in rows} == {one.reason for one in found.gap.considered}
    assert rows[0][0] == "cable stiffness (payload)"  # the most probable first


def test_heat_map_cells_reach_both_backends(found):
    drawn = figures(section(found, "where"))["heat_map"]
    made = graph(drawn)
    for trace, values in zip(made["data"], (found.gap.heat.before, found.gap.heat.after), strict=True):
        assert trace["type"] == "heatmap" and len(trace["x"]) == len(values) + 1
        with np.errstate(invalid="ignore"):
            expected = np.log10(values).T
        shown = np.array([[np.nan if v is None else v for v in row] for row in trace["z"]])
        np.testing.assert_allclose(shown, expected, atol=1e-5)
    bar = made["layout"]["coloraxis"]
    assert bar["colorbar"]["title"]["text"] == "residual / noise power [-]" and bar["cmin"] < 0 < bar["cmax"]
    assert bar["cmax"] == 3.0  # the decade above the largest ratio
    assert "residual / noise power [-]" in svg(drawn)


def test_colours_are_ordered_and_white_is_noise():
    heat = Heat(np.array([1.0, 2.0]), np.ones((1, 1)), "", (0.5, 1000.0))
    places = [place for place, _ in heat.colours]
    assert places == sorted(places) and places[0] == 0 and places[-1] == pytest.approx(1)
    white = next(place for place, colour in heat.colours if colour == "#ffffff")
    low, high = np.log10(heat.range)
    assert low + white * (high - low) == pytest.approx(0, abs=1e-12)


def test_spectrum_is_the_mean_and_the_worst_of_the_map():
    heat = HeatMap(np.array([1.0, 2.0, 4.0]), ("a", "b"), np.array([[1.0, 3.0], [np.nan, 8.0]]), np.ones((2, 2)))
    mean, worst = spectrum(heat, True).panels
    np.testing.assert_allclose(mean.curves[0].y, [2, 2, 8, 8])
    np.testing.assert_allclose(worst.curves[0].y, [3, 3, 8, 8])
    np.testing.assert_allclose(mean.curves[0].x, [1, 2, 2, 4])


def test_a_map_of_nothing_is_drawn():
    empty = HeatMap(np.array([1.0, 2.0, 4.0]), ("a",), np.full((2, 1), np.nan), np.full((2, 1), np.inf))
    for drawn in (heat_map(empty, True), spectrum(empty, True)):
        assert svg(drawn).startswith("<?xml") and graph(drawn)["data"]


def test_responses_show_the_gap_and_that_it_closes(found):
    """The records are of a table whose centre of mass is off: the updated model has it, the other has not."""
    seen = gap_overlay(found.measured, found.gap.baseline, found.gap.updated)
    assert isinstance(seen, GapOverlay)
    pairs = worst_pairs(seen)
    assert len({i for i, _ in pairs}) == len(pairs) == 3
    far = [
        np.mean(np.abs(seen.measured - G) ** 2 / (2 * seen.measured_std**2), axis=0)
        for G in (seen.baseline, seen.updated)
    ]
    for i, j in pairs:
        assert far[0][i, j] > 50 * far[1][i, j]
        assert far[1][i, j] < 3  # of complex noise alone 1
    assert far[0][pairs[0]] == pytest.approx(far[0].max())


def test_an_effect_without_a_response_is_measured_from_its_simulation(found):
    base = found.gap.baseline
    updated = base.with_effect(active(library()["cubic_stiffness"], base, library()["cubic_stiffness"].places(base)[0]))
    seen = gap_overlay(found.measured, base, updated)
    assert isinstance(seen, GapOverlay) and seen.simulated == ("cubic_stiffness",) and not seen.left_out
    # Of no strength: what is measured of its simulation is the linear model's response.
    np.testing.assert_allclose(seen.updated, seen.baseline, rtol=1e-3, atol=1e-4 * np.abs(seen.baseline).max())
    text = prose(section(replace(found, gap=replace(found.gap, updated=updated, covariance=None)), "before_after"))
    assert "Cubic stiffness has no frequency response." in text


def test_records_of_one_level_come_first(found):
    def at(record, level):
        return replace(record, header=replace(record.header, level_V=level))

    a, b, c, rest = found.measured.records
    campaign = replace(found.measured, records=(at(a, 0.1), at(b, 0.3), at(c, 0.31), rest))
    assert [[r.header.name for r in one.records] for one in selections(campaign)] == [["01", "02"], ["00", "01", "02"]]
    quiet = replace(found.measured, records=(rest,))
    assert selections(quiet) == []
    assert "no record drives" in gap_overlay(quiet, found.gap.baseline, found.gap.updated)


def test_records_stand_by_level_and_time_fitted_ones_open(found):
    by_level, by_time = figures(section(found, "dependence"))["gap_records"].panels
    for panel, field in ((by_level, "level_V"), (by_time, "start_s")):
        for held, word in ((True, "held out"), (False, "fitted")):
            own = [one for one in found.gap.records if one.held_out == held]
            for label, value in (("re-identified", "before"), ("updated", "after")):
                curve = next(c for c in panel.curves if c.label == f"{label}, {word}")
                assert curve.hollow is not held and curve.points
                np.testing.assert_allclose(curve.x, [getattr(one, field) for one in own])
                np.testing.assert_allclose(curve.y, [getattr(one, value) for one in own])
    markers = [t["marker"].get("symbol") for t in graph(figures(section(found, "dependence"))["gap_records"])["data"]]
    assert markers.count("circle-open") == 4
    one = replace(found, gap=stand_in.with_verdict(found.gap, "none"))
    assert set(figures(section(one, "dependence"))["gap_records"].legend()) == {
        "re-identified, fitted",
        "re-identified, held out",
        "noise alone",
    }


def test_shares_of_power_are_drawn_and_tabled(found):
    own = section(found, "dependence")
    drawn, low = figures(own)["gap_coherence"], figures(own)["gap_coherence_lowest"]
    assert "0.2 V" in drawn.caption.replace("0.200", "0.2") and "0.05" in low.caption
    assert [panel.title for panel in drawn.panels] == list(stand_in.OUTPUTS)
    top = found.gap.shares[1]
    for curve, key in zip(drawn.panels[2].curves, top.shares, strict=True):
        shown = np.nan_to_num(np.asarray(curve.y)[::2])
        np.testing.assert_allclose(shown, np.where(top.shares[key][:, 2] > 1e-9, top.shares[key][:, 2], 0))
    rows = tables(own)[0].rows
    assert len(rows) == len(stand_in.OUTPUTS) and len(rows[0]) == 6
    assert "lowest level" in prose(own)
    alone = replace(
        top,
        how="one level",
        shares={k: v for k, v in top.shares.items() if k != "sensors"},
        whole={k: v for k, v in top.whole.items() if k != "sensors"},
    )
    text = prose(section(replace(found, gap=replace(found.gap, shares=(alone,))), "dependence"))
    assert "cannot be distinguished from nonlinearity" in text and "counts as unmeasured inputs" in text


def test_none_says_from_which_size_on_an_effect_would_show(found):
    gap = stand_in.with_verdict(found.gap, "none")
    assert not tables(section(replace(found, gap=gap), "remaining"))
    seen = (
        Detectable("actuator_lag", "actuators", "time_constant_s", 3.1e-5, "s"),
        Detectable("sensor_gain", "Sz1", "gain", float("inf"), "1"),
        Detectable("actuator_gain", "Ax2", "gain", 3e-4, "1"),
        Detectable("actuator_gain", "Az1", "gain", 1e-4, "1"),
    )
    one = replace(found, gap=replace(gap, detectable=seen))
    assert tables(section(one, "remaining"))[0].rows == (
        ("actuator lag", "actuators", "time constant", "3.1e−5 s"),
        ("sensor gain", "Sz1", "gain", "not detectable"),
        ("actuator gain", "Az1 (best) to Ax2", "gain", "1.0e−4 to 3.0e−4"),
    )
    assert "detection limits" in prose(section(one, "result"))


def test_terms_that_every_model_holds_are_no_effect(found):
    base = found.gap.baseline
    large = active(LargeMotion(), base, "payload", (1.0, 0.0, 1.0))
    gap = replace(
        found.gap, baseline=base.with_effect(large), updated=found.gap.updated.with_effect(large), covariance=None
    )
    own = section(replace(found, gap=gap), "parameters")
    assert not [row for t in tables(own) for row in t.rows if "large" in row[0]]
    assert "which exist in every table" in prose(own) and "motors turn" in prose(own)


@pytest.mark.parametrize(
    ("name", "unit", "read"),
    [
        ("stiffness_N_per_m", "N/m", "stiffness"),
        ("integral_gain_N_per_ms", "N/(m s)", "integral gain"),
        ("time_constant_s", "s", "time constant"),
        ("k3_N_per_m3", "N/m^3", "k3"),
        ("mass_kg", "kg", "mass"),
        ("damping", "1", "damping"),
        ("uneven_1", "1", "deviation of 1 from the mean"),
        ("slope_per_h", "1/h", "slope"),
    ],
)
def test_parameters_are_read_without_their_units(name, unit, read):
    assert spoken(name, unit) == read


def test_sentences_of_the_finder_are_set_in_type():
    assert words.sentence("noise of 3 +- 1 V") == "Noise of 3 ± 1 V."
    assert words.sentence("actuator_lag comes nearest, but no") == "actuator_lag comes nearest, but no."
    assert words.sentence("Is it?") == "Is it?"


def test_controller_only_where_there_is_one(found):
    assert "controller" not in {s.anchor for s in document(replace(found, design=None)).sections}
    own = section(found, "controller")
    assert own.pieces[0] == Paragraph(found.design.sentences[0])
    rows = tables(own)[0].rows
    assert [row[4] for row in rows] == [Mark("0.950", True), Mark("1.32", False), Mark("0.970", True)]
    assert [row[7] for row in rows] == ["+5.2 dB", "no bound", "+5.4 dB"]
    lost = replace(
        found.design.before,
        stable=False,
        **dict.fromkeys(("mu_upper", "mu_lower", "peak_dB", "band_dB", "worst_peak_dB", "worst_band_dB"), float("inf")),
    )
    own = section(replace(found, design=replace(found.design, before=lost, after=None, new=None)), "controller")
    assert tables(own)[0].rows == (
        (
            "re-identified",
            "re-identified",
            Mark("no", False),
            Mark("yes", True),
            Mark("no bound", False),
            *["no bound"] * 4,
        ),
    )
    drawn = figures(own)["gap_mu"]
    assert "not proved" in drawn.caption and svg(drawn).startswith("<?xml")


@pytest.mark.parametrize("verdict", VERDICTS)
def test_next_to_nothing_found(found, verdict, tmp_path):
    """None, nan and empty everywhere: sentences in their place, in both formats."""
    poor = Finds(stand_in.minimal(found.gap, verdict), found.measured)
    page = page_of(poor).text
    assert "No fractions of power were computed" in page
    assert "No other candidate was fitted." in page or "No candidate raises the evidence" in page
    if verdict == "none":
        assert "No fractions of power were computed" in pdf_text(written(document(poor)).pdf, tmp_path)


@pytest.mark.slow
def test_numbers_that_are_not_finite(found):
    """A stage without noise, a place without statistics, an effect without deviation: said in words."""
    nan, inf = float("nan"), float("inf")
    effect = replace(found.gap.effects[0], parameters={"offset_x_m": Reported(0.02, nan, "m")}, probability=nan)
    gap = replace(
        found.gap,
        effects=(effect,),
        stages=(Stage("nominal", inf, nan), Stage("re-identified", 0.0, nan)),
        where=(Where(1.0, 2.0, "", "Sz1", nan, 3.0, 1e-3),),
        noise_nrmse=nan,
    )
    one = replace(found, gap=gap)
    shown = cells(written(document(one)).document)
    assert len(shown) > 100
    assert not [c for c in shown if re.search(r"\b(inf|nan|None|np\.|array)\b", c)]


def test_every_axis_has_a_unit_or_names(found):
    for figure in document(found).figures():
        assert isinstance(figure, Figure) and figure.caption
        for panel in figure.panels:
            assert isinstance(panel, Panel)
            for axis in (panel.x, panel.y):
                assert re.search(r"\[[^\]]+\]$", axis.label) or axis.ticks, (figure.name, axis.label)


def test_long_names_of_stages_stand_in_rows(found):
    stages = (*found.gap.stages, Stage("mount_relaxation", 0.0102, 1.01))
    drawn = figures(section(replace(found, gap=replace(found.gap, stages=stages)), "result"))["ladder"]
    assert drawn.panels[0].x.ticks[-1][1] == "+ mount\nrelaxation"
    assert graph(drawn)["layout"]["xaxis"]["ticktext"][-1] == "+ mount<br>relaxation"
