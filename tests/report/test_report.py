"""The report: same content in HTML and PDF, nothing fetched, nothing in a file read as markup."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from avis_ctrl.report import html as page_of
from avis_ctrl.report import pdf as paper_of
from avis_ctrl.report.content import document
from avis_ctrl.report.figures import Figure
from avis_ctrl.report.pieces import Mark, Paragraph, Table
from avis_ctrl.study.design_result import Bound, DesignResult

HOSTILE = '</script><script>alert(1)</script> <b>x</b> #panic("y") $ *z* {{ 7*7 }} \\ & "'


def render_html(result: DesignResult) -> bytes:
    return page_of.render(document(result))


def render_pdf(result: DesignResult) -> bytes:
    return paper_of.render(document(result))


class Reader(HTMLParser):
    """Elements with their attributes, and the text outside scripts and styles."""

    def __init__(self, page: bytes) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text, self.scripts, self._inside = "", [], ""
        self.feed(page.decode())

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._inside = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        self._inside = ""

    def handle_data(self, data):
        if self._inside == "script":
            self.scripts[-1] += data
        elif self._inside != "style":
            self.text += data

    def graphs(self) -> dict:
        return next(
            json.loads(script)
            for (tag, attrs), script in zip([e for e in self.elements if e[0] == "script"], self.scripts, strict=True)
            if attrs.get("id") == "graphs"
        )


def pdf_text(pdf: bytes, tmp_path) -> str:
    if shutil.which("pdftotext") is None:
        pytest.skip("pdftotext is not installed")
    path = tmp_path / "report.pdf"
    path.write_bytes(pdf)
    return subprocess.run(["pdftotext", "-layout", path, "-"], capture_output=True, text=True, check=True).stdout


@pytest.fixture(scope="module")
def html(fabricated: DesignResult) -> bytes:
    return render_html(fabricated)


@pytest.fixture(scope="module")
def pdf(fabricated: DesignResult) -> bytes:
    return render_pdf(fabricated)


@pytest.fixture(scope="module")
def hostile(fabricated: DesignResult) -> DesignResult:
    return replace(
        fabricated,
        design=fabricated.design.model_copy(update={"title": HOSTILE}),
        rig=replace(fabricated.rig, name=HOSTILE),
        notes=(HOSTILE,),
        requirements=(replace(fabricated.requirements[0], note=HOSTILE),),
        controllers=tuple(replace(c, title=f"{c.name} {HOSTILE}") for c in fabricated.controllers),
    )


def test_html_fetches_nothing(html: bytes) -> None:
    page = Reader(html)
    for tag, attributes in page.elements:
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            assert re.match(r"#|data:|$", attributes.get(name) or ""), (tag, attributes)
    policy = next(a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy and "http" not in policy
    style = re.findall(r"<style>(.*?)</style>", html.decode(), re.S)
    assert len(style) == 1 and "url(" not in style[0] and "@import" not in style[0]
    assert len(html) < 6e6


def test_requirements_in_both(html: bytes, pdf: bytes, tmp_path) -> None:
    for text in (Reader(html).text, pdf_text(pdf, tmp_path)):
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


def test_the_first_page_is_read_alone(fabricated: DesignResult, html: bytes, pdf: bytes, tmp_path) -> None:
    """Task, verdicts, certificate and one figure, and nothing else; the second section begins on the second page."""
    pages = pdf_text(pdf, tmp_path).split("\f")
    first = " ".join(pages[0].split())
    for shown in (
        "1 Summary",
        "Task: one controller for z and phi_x (edge)",
        "mass ± 10 %",
        "Table 1",
        "NOT MET",
        "the peak of mu is between",
        "Figure 1",
    ):
        assert shown in first, shown
    assert "2 Controllers compared" not in first and "2 Controllers compared" in " ".join(pages[1].split())
    assert [s.alone for s in document(fabricated).sections[:3]] == [True, False, False]


def test_a_wide_table_folds_on_a_phone(fabricated: DesignResult, html: bytes) -> None:
    """Each cell carries the title of its column; the style sheet shows it where the header is hidden."""
    page = Reader(html)
    labels = [a["data-label"] for tag, a in page.elements if tag == "td"]
    tables = [p for s in document(fabricated).sections for p in s.flat() if isinstance(p, Table)]
    compared = [table for table in tables if "mu synthesis" in table.header]
    assert compared[0].header[1] == "mu synthesis"  # the delivered controller is not the one that is cut off
    assert labels.count("mu synthesis") == sum(len(table.rows) for table in compared)
    assert sum("folds" in (a.get("class") or "") for tag, a in page.elements if tag == "table") > 3


def test_same_sections_figures_and_tables_in_both(fabricated: DesignResult, html: bytes, pdf: bytes, tmp_path) -> None:
    content, page, text = document(fabricated), Reader(html), pdf_text(pdf, tmp_path)
    drawn = [a["data-name"] for tag, a in page.elements if "data-name" in a]
    drawings = [p for p in content.figures() if not hasattr(p, "panels")]
    assert drawn == [p.name for p in content.figures() if hasattr(p, "panels")] == list(page.graphs())
    assert len(drawn) + len(drawings) == len(content.figures())
    tables = [p for s in content.sections for p in s.pieces if isinstance(p, Table)]
    for word, things in (("Figure", content.figures()), ("Table", tables)):
        for source in (page.text, text):
            captions = {int(n) for n in re.findall(rf"\b{word} (\d+)[.:]", source)}
            assert captions == set(range(1, len(things) + 1))
    for number, section in enumerate(content.sections, 1):
        assert f"{number}. {section.title}" in page.text
        assert re.search(rf"^ *{number} +{re.escape(section.title)}", text, re.M), section.title


def test_text_from_files_is_never_markup(html: bytes, hostile: DesignResult, tmp_path) -> None:
    plain, page = Reader(html), Reader(render_html(hostile))
    assert [tag for tag, _ in page.elements].count("script") == [tag for tag, _ in plain.elements].count("script")
    assert page.text.count(HOSTILE) >= 4
    names = [t["name"] for g in page.graphs().values() for t in g["data"]]
    assert any("&lt;b&gt;x" in name for name in names) and not any("<b>" in name for name in names)
    text = " ".join(pdf_text(render_pdf(hostile), tmp_path).split())
    assert '#panic("y") $ *z* {{ 7*7 }}' in text and "<b>x</b>" in text


@pytest.mark.slow
def test_same_input_same_bytes(fabricated: DesignResult, html: bytes, pdf: bytes) -> None:
    assert render_html(fabricated) == html
    assert render_pdf(fabricated) == pdf


def test_pdf_is_a_pdf_of_several_pages(pdf: bytes) -> None:
    assert pdf.startswith(b"%PDF-") and pdf.rstrip().endswith(b"%%EOF")
    assert int(re.search(rb"/Count (\d+)", pdf)[1]) >= 8


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


def test_no_cell_shows_a_programmer_s_nothing(fabricated: DesignResult) -> None:
    tables = [p for s in document(fabricated).sections for p in s.pieces if isinstance(p, Table)]
    cells = [c.text if isinstance(c, Mark) else c for t in tables for row in t.rows for c in row]
    assert len(cells) > 300
    assert not [c for c in cells if re.search(r"\b(inf|nan|None|np\.|array)\b", c)]


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
    text = " ".join(Reader(render_html(poor)).text.split())
    assert "not proved to be stable for every plant" in text
    assert not re.search(r"\b(inf|nan) (dB|Hz|V)\b", text)
    assert render_pdf(poor).startswith(b"%PDF-")
