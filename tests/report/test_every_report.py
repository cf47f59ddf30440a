"""Every report: same content in HTML and PDF, nothing fetched, nothing in a file read as markup."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from reading import HOSTILE, Reader, Written, cells, pdf_text, tables, written

from avis_ctrl.measurement.gates.finding import Finding
from avis_ctrl.report.content import document as design_document
from avis_ctrl.report.elements import Document
from avis_ctrl.report.figures import Figure
from avis_ctrl.report.gap.content import document as gap_document
from avis_ctrl.report.identification.content import document as identification_document

RESULTS = {
    "design": (design_document, "fabricated"),
    "identification": (identification_document, "identified"),
    "gap": (gap_document, "gap_found"),
}
SECTIONS = {"design": 12, "identification": 11, "gap": 12}
LARGEST = {"design": 6e6, "identification": 8e6, "gap": 8e6}
FIRST_PAGE = {
    "design": ("Task: one controller for z and phi_x (edge)", "mass ± 10 %", "NOT MET", "the peak of mu is between"),
    "identification": ("Measured: 4 records, 32.0 s in total",),
    "gap": ("The centre of mass is not where", "What to measure next"),
}


@pytest.fixture(scope="module", params=["design", "identification", "gap"])
def name(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def report(name, request) -> Written:
    return request.getfixturevalue(f"{name}_report")


@pytest.fixture(scope="module")
def hostile(name, request, fabricated) -> Document:
    """The report of results whose names and texts try to be markup."""
    warned = (Finding(HOSTILE, "warning", HOSTILE),)
    if name == "design":
        title = fabricated.design.model_copy(update={"title": HOSTILE})
        noted = (replace(fabricated.requirements[0], note=HOSTILE),)
        titled = tuple(replace(c, title=f"{c.name} {HOSTILE}") for c in fabricated.controllers)
        rig = replace(fabricated.rig, name=HOSTILE)
        return design_document(
            replace(fabricated, design=title, rig=rig, notes=(HOSTILE,), requirements=noted, controllers=titled)
        )
    found = request.getfixturevalue(RESULTS[name][1])
    measured = replace(found.measured, notes=(HOSTILE,), source=HOSTILE)
    bad = replace(found, measured=measured, findings=warned)
    if name == "identification":
        # Without the figures of responses, which take most of the time of a PDF.
        quick = replace(bad.validation, overlay=None)
        return identification_document(replace(bad, advice=(HOSTILE,), kalman_note=HOSTILE, validation=quick))
    gap = replace(
        found.gap,
        sentences=(HOSTILE, HOSTILE),
        effects=(replace(found.gap.effects[0], confirmation=HOSTILE),),
        next_experiment=HOSTILE,
        heat=replace(found.gap.heat, columns=(HOSTILE, *found.gap.heat.columns[1:])),
    )
    return gap_document(replace(bad, gap=gap))


def test_same_sections_figures_and_tables_in_both(name, report, tmp_path) -> None:
    content, page = report.document, Reader(report.html)
    assert len(content.sections) == SECTIONS[name]
    drawn = [a["data-name"] for tag, a in page.elements if "data-name" in a]
    assert drawn == [p.name for p in content.figures() if isinstance(p, Figure)] == list(page.graphs())
    text = pdf_text(report.pdf, tmp_path)
    count = sum(len(tables(s)) for s in content.sections)
    for word, things in (("Figure", len(content.figures())), ("Table", count)):
        for source in (page.text, text):
            assert {int(n) for n in re.findall(rf"\b{word} (\d+)[.:]", source)} == set(range(1, things + 1))
    for number, one in enumerate(content.sections, 1):
        assert f"{number}. {one.title}" in page.text
        assert re.search(rf"^ *{number} +{re.escape(one.title)}", text, re.M), one.title


def test_the_first_page_is_read_alone(name, report, tmp_path) -> None:
    """The summary, and nothing else; the second section begins on the second page."""
    pages = [" ".join(page.split()) for page in pdf_text(report.pdf, tmp_path).split("\f")]
    for shown in ("1 Summary", "Table 1", "Figure 1", *FIRST_PAGE[name]):
        assert shown in pages[0], shown
    second = f"2 {report.document.sections[1].title}"
    assert second not in pages[0] and second in pages[1]
    assert [s.alone for s in report.document.sections[:3]] == [True, False, False]


def test_the_pages_are_numbered(name, report, tmp_path) -> None:
    pages = pdf_text(report.pdf, tmp_path).split("\f")[:-1]
    numbers = [re.findall(r"^ *(\d+) ?/ ?(\d+)$", page.rstrip(), re.M)[-1] for page in pages]
    assert numbers == [(str(k), str(len(pages))) for k in range(1, len(pages) + 1)]


def test_html_fetches_nothing_and_stays_small(name, report) -> None:
    page = Reader(report.html)
    for tag, attributes in page.elements:
        for source in ("src", "href", "srcset", "data", "action", "poster"):
            assert re.match(r"#|data:|$", attributes.get(source) or ""), (tag, attributes)
    policy = next(a["content"] for tag, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy and "http" not in policy
    style = re.findall(r"<style>(.*?)</style>", report.html.decode(), re.S)
    assert len(style) == 1 and "url(" not in style[0] and "@import" not in style[0]
    assert len(report.html) < LARGEST[name]


def test_pdf_is_a_pdf_of_several_pages(report) -> None:
    assert report.pdf.startswith(b"%PDF-") and report.pdf.rstrip().endswith(b"%%EOF")
    assert int(re.search(rb"/Count (\d+)", report.pdf)[1]) >= 8


def test_text_from_files_is_never_markup(name, report, hostile, tmp_path) -> None:
    bad = written(hostile)
    page = Reader(bad.html)
    assert page.count("script") == Reader(report.html).count("script")
    assert page.text.count(HOSTILE) >= 5
    names = [t["name"] for g in page.graphs().values() for t in g["data"] if "name" in t]
    assert not any("<b>" in one for one in names)
    assert name != "design" or any("&lt;b&gt;x" in one for one in names)
    text = " ".join(pdf_text(bad.pdf, tmp_path).split())
    assert '#panic("y") $ *z* {{ 7*7 }}' in text and "<b>x</b>" in text


@pytest.mark.slow
def test_same_input_same_bytes(name, report, request) -> None:
    make, result = RESULTS[name]
    again = written(make(request.getfixturevalue(result)))
    assert (again.html, again.pdf) == (report.html, report.pdf)


def test_no_cell_shows_a_programmer_s_nothing(name, report) -> None:
    shown = cells(report.document)
    assert len(shown) > {"design": 300, "identification": 150, "gap": 100}[name]
    assert not [c for c in shown if re.search(r"\b(inf|nan|None|np\.|array)\b", c)]
