"""The report of an identification: what it says agrees with what was found, in HTML and in PDF."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reading import Reader, figures, part, tables, written

from avis_ctrl.identification.ekf_result import EkfHistory, EkfResult, innovation_statistics
from avis_ctrl.identification.ekf_settings import HONEST_SETTINGS
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.frequency_response.local_polynomial import local_polynomial
from avis_ctrl.measurement.gates.finding import Finding, Limit, Picture, Series
from avis_ctrl.report import words
from avis_ctrl.report.elements import Fold, Mark, Paragraph, Section
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style
from avis_ctrl.report.identification.content import document
from avis_ctrl.report.identification.gates import figure_of
from avis_ctrl.report.identification.responses import strongest
from avis_ctrl.report.matplotlib_backend import svg
from avis_ctrl.report.plotly_backend import graph
from avis_ctrl.study.identification import Identification


@pytest.fixture
def found(identified: Identification) -> Identification:
    return identified


def section(found: Identification, anchor: str) -> Section:
    return part(document(found), anchor)


def test_verdict_has_the_numbers_of_the_validation(found):
    first = section(found, "result").pieces[0]
    assert isinstance(first, Paragraph) and found.validation.verdict[1:] in first.text
    information = found.campaign_fit.information
    assert f"{information.rank} combinations of the {len(information.names)} parameters" in first.text
    assert first.good == (
        all(h.consistent and not h.repeats for h in found.validation.held_out)
        and not any(f.severity == "stop" for f in found.findings)
        and found.campaign_fit.fit.converged
    )


def test_an_error_that_repeats_in_all_records_is_no_noise(found):
    """Most dampings are fixed at wrong values: the residuals of all records contain the same error, thirty times the
    noise of a local model, and agree with one another."""
    (one,) = found.validation.held_out
    assert one.consistent and one.repeats and one.chi2_local > 100
    assert not found.validation.explains and not found.validation.passed
    assert "does not explain the records" in found.validation.verdict and "avis gap" in found.validation.verdict


def test_the_summary_has_the_modes(found):
    modes = tables(section(found, "result"))[0].rows
    assert [float(row[2]) for row in modes] == pytest.approx([m.frequency_Hz for m in found.validation.modes], rel=1e-3)


def test_every_parameter_is_shown_as_well_as_it_is_known(found):
    """Horizontal springs in one line are known only as sums; the table says so, and gives numbers for the others."""
    rows = {row[0]: row for row in tables(section(found, "parameters"))[0].rows}
    information = found.campaign_fit.information
    assert tuple(rows) == information.names
    for name, value, sigma in zip(information.names, information.values, information.standard_deviation, strict=True):
        if np.isfinite(sigma):
            assert abs(float(rows[name][2]) - value) < sigma
            assert float(rows[name][3]) == pytest.approx(sigma, rel=0.06)
        else:
            assert rows[name][3] == "only in combination"
    assert rows["isolator1.k_x"][3] == "only in combination" != rows["mass"][3]


def test_combinations_in_the_table_are_those_determined(found):
    shown = tables(section(found, "identifiability"))[0].rows
    assert [row[0] for row in shown] == [one.words for one in found.identifiability.combinations]
    assert "isolator1.k_x + isolator2.k_x" in {row[0] for row in shown}


def test_records_say_what_they_were_used_for(found):
    rows = {row[0]: row for row in tables(section(found, "measurements"))[0].rows}
    held = {r.header.name for r in found.split.held_out.records}
    assert {name for name, row in rows.items() if row[-1] == "held out"} == held
    assert [row[1] for row in rows.values()] == ["noise", "noise", "noise", "rest"]


def test_measured_and_model_reach_the_page(found, identification_report):
    seen = found.validation.overlay
    assert seen is not None
    i, j = strongest(seen)[0]
    gain = np.mean(np.log(np.abs(seen.model)), axis=0)[i, :8]
    assert j == int(np.argmax(gain))
    traces = Reader(identification_report.html).graphs()["response_0"]["data"]
    model = next(t for t in traces if t["name"] == "identified" and t["xaxis"] == "x")
    np.testing.assert_allclose(model["y"], np.abs(seen.model[:, i, j]), rtol=1e-5)


def test_warnings_come_first_with_their_pictures(found):
    picture = Picture(
        "Sz1",
        "time [s]",
        "Sz1 [V]",
        (Series("Sz1", np.arange(4.0), np.array([1.0, 2, 2, 2])),),
        (Limit("stuck from", 1.0, "x"),),
    )
    extra = Finding("dead channel", "warning", "Sz1 is stuck.", picture=picture)
    own = section(replace(found, findings=(*found.findings, extra)), "gates")
    assert tables(own)[0].rows[0][:2] == ("dead channel", Mark("WARNING", False))
    drawn = figures(own)["gate_0"]
    assert drawn.caption == "Sz1 is stuck."
    line = next(c for c in drawn.panels[0].curves if c.label == "stuck from")
    assert line.x.tolist() == [1.0, 1.0] and line.y.tolist() == [1.0, 2.0]
    assert any(isinstance(p, Fold) for p in own.pieces)
    first = section(replace(found, findings=(extra,)), "result").pieces[0]
    assert "Gates (data checks) with warnings: dead channel." in first.text


def test_pictures_of_every_style_are_drawn():
    x = np.array([0.0, 1.0, 2.0])
    picture = Picture(
        "A",
        "channel",
        "r.m.s. [V]",
        (Series("b", x, x + 1, "bars"), Series("p", x, x + 2, "points")),
        (Limit("most", 5.0),),
        y_scale="log",
    )
    figure = figure_of("f", "c", [picture, picture], 2)
    assert [c.bars > 0 for c in figure.panels[0].curves] == [True, False, False]
    assert figure.panels[0].x.ticks == ((0.0, "0"), (1.0, "1"), (2.0, "2"))
    drawn = graph(figure)
    assert [t["type"] for t in drawn["data"][:3]] == ["bar", "scatter", "scatter"]
    assert svg(figure).startswith("<?xml")


def test_panels_of_a_grid_do_not_overlap():
    panel = Panel(
        Axis("x"), Axis("y"), (Curve(np.arange(2.0), np.arange(2.0), "a", Style("#000000"), error=np.ones(2)),)
    )
    for columns, shared in ((1, False), (2, False), (3, True)):
        figure = Figure("f", "c", (panel,) * 5, columns, 0.7, shared)
        found = graph(figure)
        layout = found["layout"]
        boxes = [
            (layout[f"xaxis{s}"].get("domain", [0, 1]), layout[f"yaxis{s}"]["domain"]) for s in ("", "2", "3", "4", "5")
        ]
        for k, (x, y) in enumerate(boxes):
            assert 0 <= x[0] < x[1] <= 1 + 1e-9 and 0 <= y[0] < y[1] <= 1 + 1e-9
            for other_x, other_y in boxes[:k]:
                assert x[0] >= other_x[1] or other_x[0] >= x[1] or y[1] <= other_y[0] or other_y[1] <= y[0]
        assert ("narrow" in found) == (columns == 2)
        assert found["data"][0]["error_y"]["array"] == [1.0, 1.0]


def kalman(found: Identification, off: float) -> EkfResult:
    """A filter's result that lies `off` standard deviations from the likelihood's, with white innovations."""
    information = found.campaign_fit.information
    values = information.values * (1 + off * 1e-3)
    n, m = len(values), 6
    theta = np.tile(values, (m, 1))
    history = EkfHistory(np.arange(m, dtype=float), theta, 0.99 * theta, 1.01 * theta, np.array([0.0, 3.0, 6.0]))
    white = innovation_statistics(np.random.default_rng(3).standard_normal((4000, 6)))
    return EkfResult(
        information.names,
        information.units,
        information.values,
        values,
        1e-6 * np.eye(n),
        history,
        (white, white),
        np.zeros(n, int),
        HONEST_SETTINGS,
    )


def test_ways_are_compared_in_standard_deviations(found):
    near = section(replace(found, kalman=kalman(found, 0.0)), "ways")
    rows = tables(near)[0].rows
    assert len(rows) == len(found.identifiability.combinations)
    assert all(abs(float(row[5].replace("−", "-"))) < 0.05 for row in rows)
    assert near.pieces[0].good is True
    far = section(replace(found, kalman=kalman(found, 20.0)), "ways")
    assert far.pieces[0].good is False
    mass = next(row for row in tables(far)[0].rows if row[0] == "mass")
    information = found.campaign_fit.information
    k = information.names.index("mass")
    share = information.standard_deviation[k] / information.values[k]
    assert float(mass[5]) == pytest.approx(20e-3 / np.hypot(1e-3, share), rel=0.02)
    names = [p.title.removesuffix(" *") for f in figures(far).values() for p in f.panels]
    assert sorted(names) == sorted(found.campaign_fit.information.names)


def test_a_filter_that_did_not_run_is_said_to_have_not(found):
    own = section(replace(found, kalman=None, kalman_note="the extended Kalman filter was not requested"), "ways")
    assert own.pieces[0].text == "The extended Kalman filter was not requested." and not figures(own)


@pytest.mark.slow
def test_frequency_responses_alone(found):
    """No records, no gates, no filter: the report says so."""
    assert isinstance(found.measured, Campaign)
    records = found.measured.only(("00", "01", "02"))
    response = local_polynomial(records, band_Hz=(1.5, 18.0), half_width=20, floor=False)
    alone = replace(found, measured=response, findings=(), split=None, kalman_note="needs records")
    content = document(alone)
    text = " ".join(p.text for s in content.sections for p in s.flat() if isinstance(p, Paragraph))
    assert "there were none" in text and "Every fourth group of neighbouring lines" in text
    assert written(document(alone)).pdf.startswith(b"%PDF-")


def test_little_was_found(found):
    """No overlay, no modes, no whiteness: sentences in their place."""
    v = found.validation
    poor = replace(
        found,
        advice=(),
        validation=replace(
            v,
            overlay=None,
            modes=(),
            held_out=tuple(
                replace(h, whiteness=None, nrms_time=None, nrms_time_start=None, nrms_time_whole=None)
                for h in v.held_out
            ),
        ),
    )
    text = " ".join(Reader(written(document(poor)).html).text.split())
    assert "No measured frequency response can be shown" in text and "not tested" in text


@given(st.floats(1e-9, 1e9), st.floats(1e-9, 1e5), st.booleans())
def test_rounding_to_the_standard_deviation(value, sigma, negative):
    """What is shown lies within a twentieth of sigma of the value, and sigma within 5 % of itself."""
    signed = -value if negative else value
    shown = [float(text.replace("−", "-")) for text in words.with_std(signed, sigma)]
    assert abs(shown[0] - signed) <= 0.06 * sigma + 1e-15 * value
    if sigma < value:
        assert shown[1] == pytest.approx(sigma, rel=0.06)
