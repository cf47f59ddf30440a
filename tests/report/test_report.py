"""The report of a design: what it says agrees with what was found, in HTML and in PDF."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from reading import Reader, Written, pdf_text, written

from avis_ctrl.report.content import document
from avis_ctrl.report.elements import Mark, Paragraph, Table, table
from avis_ctrl.report.figures import Figure
from avis_ctrl.study.design_result import Bound, DesignResult


@pytest.fixture
def html(design_report: Written) -> bytes:
    return design_report.html


def test_requirements_in_both(design_report: Written, tmp_path) -> None:
    for text in (Reader(design_report.html).text, pdf_text(design_report.pdf, tmp_path)):
        words = " ".join(text.split())
        for shown in (
            "upper bound of mu",
            "0.930",
            "at most 1.00",
            "worst-case peak",
            "at most +4.0 dB",
            "NOT MET",
            "advantage over the skyhook",
            "+7.2 dB",
            "at least +6.0 dB",
            "unstable",
        ):
            assert shown in words, shown


def test_first_words_are_what_is_not_met(fabricated: DesignResult) -> None:
    first = document(fabricated).sections[0].pieces[0]
    assert first.text.startswith("1 of 3 requirements is not met: worst-case peak.")
    assert first.good is False
    good = replace(fabricated, requirements=fabricated.requirements[:1])
    first = document(good).sections[0].pieces[0]
    assert first.text.startswith("The requirement is met.") and first.good is True


def test_what_limits_mu_stands_with_its_bounds(fabricated: DesignResult) -> None:
    """Not on the summary, which it would extend beyond a page."""
    sections = document(replace(fabricated, limits="mu peaks at 3.2 Hz.")).sections
    with_it = [
        s.anchor for s in sections for p in s.pieces if isinstance(p, Paragraph) and p.text == "mu peaks at 3.2 Hz."
    ]
    assert with_it == ["bounds"]


def test_a_wide_table_folds_on_a_phone(fabricated: DesignResult, html: bytes) -> None:
    """Each cell carries the title of its column; the style sheet shows it where the header is hidden."""
    page = Reader(html)
    labels = [a["data-label"] for tag, a in page.elements if tag == "td"]
    tables = [p for s in document(fabricated).sections for p in s.flat() if isinstance(p, Table)]
    compared = [table for table in tables if "mu synthesis" in table.header]
    assert compared[0].header[1] == "mu synthesis"  # the delivered controller is not the one that is cut off
    assert labels.count("mu synthesis") == sum(len(table.rows) for table in compared)
    assert sum("folds" in (a.get("class") or "") for tag, a in page.elements if tag == "table") > 3


def test_the_heading_of_a_folded_row_distinguishes_it() -> None:
    """By the parameter where all rows have the same effect; never by long text, and by the first column otherwise."""
    long = "a sentence that is longer than the line of a phone can be"
    rows = [("lag", "actuators", f"uneven_{k}", "0.1", long) for k in range(3)]
    assert table("", ("effect", "place", "parameter", "value", "meaning"), rows, "lllrl").keys == (0, 2)
    gates = table("", ("gate", "finding", "severity"), [("hum", long, "note"), ("spikes", long, "ok")], "llc")
    assert gates.keys == (0,) and gates.folds
    assert not table("", ("what", "value"), [("seed", long)]).folds
    assert table("", ("a", "b", "c", "d"), [], "llll").keys == (0,)


def test_curves_reach_the_page_unchanged(fabricated: DesignResult, html: bytes) -> None:
    graph = Reader(html).graphs()["transmissibility_nominal"]
    mu = next(c for c in fabricated.controllers if c.name == "mu")
    trace = next(t for t in graph["data"] if t["name"] == "mu synthesis")
    np.testing.assert_allclose(trace["x"], mu.transmissibility.omega / (2 * np.pi), rtol=1e-5)
    np.testing.assert_allclose(trace["y"], 20 * np.log10(mu.transmissibility.sigma), rtol=1e-5, atol=1e-5)


def test_an_unbounded_curve_is_a_gap(html: bytes) -> None:
    graph = Reader(html).graphs()["mu_performance"]
    trace = next(t for t in graph["data"] if t["name"] == "skyhook, critical damping")
    assert trace["y"] and all(y is None for y in trace["y"])


def test_an_unstable_loop_has_no_steady_motion(fabricated: DesignResult) -> None:
    section = next(s for s in document(fabricated).sections if s.anchor == "site")
    shown = {row[0] for p in section.pieces if isinstance(p, Table) for row in p.rows}
    shown |= {curve.label for p in section.pieces if isinstance(p, Figure) for curve in p.panels[0].curves}
    assert "skyhook, tuned" in shown and "skyhook, critical damping" not in shown
    captions = [p.caption for p in section.pieces if isinstance(p, Figure)]
    assert all("Not shown, because the nominal loop is unstable: skyhook, critical damping." in c for c in captions)


def test_comparison_says_who_is_unstable(fabricated: DesignResult) -> None:
    table = next(p for p in document(fabricated).sections[1].pieces if isinstance(p, Table))
    column = table.header.index("skyhook, critical damping")
    rows = {row[0]: row[column] for row in table.rows}
    assert rows["stable, nominal"] == Mark("no", False)
    assert rows["largest voltage r.m.s."] == rows["vibration criterion met"] == "unstable"
    assert rows["mu, upper bound"] == rows["peak transmissibility, worst case"] == "no bound"


@pytest.mark.slow
def test_a_study_that_found_little_is_still_reported(fabricated: DesignResult) -> None:
    none = np.zeros(0)
    empty = Bound(np.inf, np.nan, np.nan, None, False, "", none, none, none)
    poor = replace(
        fabricated,
        requirements=(),
        notes=(),
        controllers=tuple(
            replace(
                c,
                gamma=np.inf,
                mu=empty,
                stability=empty,
                worst_peak=empty,
                worst_band=empty,
                stable=False,
                peak_transmissibility=np.inf,
            )
            for c in fabricated.controllers
        ),
    )
    made = written(document(poor))
    text = " ".join(Reader(made.html).text.split())
    assert "not proved to be stable for every plant" in text
    assert not re.search(r"\b(inf|nan) (dB|Hz|V)\b", text)
    assert made.pdf.startswith(b"%PDF-")
