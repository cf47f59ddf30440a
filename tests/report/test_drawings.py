"""Axes, words and drawings of the report."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avis_ctrl.lti.norms import in_dB
from avis_ctrl.report import words
from avis_ctrl.report.block_diagram import FILLS, BlockDiagram
from avis_ctrl.report.canvas import Canvas
from avis_ctrl.report.families import Families
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style, ticks_log
from avis_ctrl.report.matplotlib_backend import svg
from avis_ctrl.report.plotly_backend import graph
from avis_ctrl.report.rig_drawing import rig_drawing
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.study.design_file import design_from_table
from avis_ctrl.study.design_result import DesignResult
from avis_ctrl.study.plant import DesignPlant, build_plant


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (0.1, 100.0, ["0.1", "1", "10", "100"]),
        (1.0, 100.0, ["1", "2", "5", "10", "20", "50", "100"]),
        (0.05, 30.0, ["0.1", "1", "10"]),
        (1e-9, 1e-6, ["1e-9", "1e-8", "1e-7", "1e-6"]),
    ],
)
def test_ticks(low: float, high: float, labels: list[str]) -> None:
    assert ticks_log(low, high)[1] == labels


@given(st.floats(1e-6, 1e6), st.floats(1.5, 1e8))
def test_ticks_lie_inside(low: float, ratio: float) -> None:
    places, labels = ticks_log(low, low * ratio)
    assert all(low * 0.999 <= p <= low * ratio * 1.001 for p in places) and len(labels) == len(places)
    np.testing.assert_allclose([float(text) for text in labels], places, rtol=1e-9)


@given(st.floats(1e-12, 1e12))
def test_number_keeps_three_digits(value: float) -> None:
    assert float(words.number(value).replace("−", "-")) == pytest.approx(value, rel=0.0051)


def test_what_is_not_finite_is_said_in_words() -> None:
    assert words.decibel(np.inf) == words.bound(np.inf) == words.quantity(np.inf, "dB") == "no bound"
    assert words.number(np.nan) == "not computed"
    assert words.decibel(0.5) == "−6.0 dB" and words.decibel(2.0) == "+6.0 dB"
    assert np.isnan(in_dB([0.0, np.inf, np.nan])).all()


@pytest.mark.parametrize(
    ("typed", "printed"),
    [
        ("-17.2 % at -3 deg", "−17.2 % at −3 deg"),
        ("log evidence 4.14e+03 lower than the best", "log evidence 4140 lower than the best"),
        ("1.853e+04 N s/m", "18530 N s/m"),
        ("5.814e+05 rad/s", "5.814e5 rad/s"),
        ("below 3.1e-05 s", "below 3.1e−5 s"),
        ("41860 +- 160 N/m", "41860 ± 160 N/m"),
        ("2026-11-25, pages 71-109", "2026-11-25, pages 71-109"),
        ("run1e-3.h5", "run1e-3.h5"),
        ("avis gap --design", "avis gap --design"),
    ],
)
def test_signs_and_powers_are_typeset_and_names_are_not(typed, printed):
    assert words.typeset(typed) == printed


@pytest.mark.parametrize("name", ["avis", "halcyonics"])
def test_rig_drawing_names_every_point(name: str) -> None:
    rig = load_rig(name)
    drawn = " ".join(ElementTree.fromstring(rig_drawing(rig)).itertext())
    for point in rig.points():
        assert point in drawn
    assert f"{rig.edge_m:.3g} m" in drawn


def test_block_diagram_shows_every_part_and_signal(fabricated: DesignResult) -> None:
    plant = fabricated.plant
    diagram, families = BlockDiagram(plant), Families(plant)
    assert diagram.chain == [
        "K",
        "delay and amplifier *",
        "allocation",
        "actuator chain *",
        "rig",
        "sensor chain *",
        "sum *",
    ]
    assert {families.of(part.name) for part in plant.full.parts} <= set(diagram.nodes)
    assert sum(p.count for p in families.parts) == len(plant.full.parts)
    assert sorted(m for s in families.signals for m in s.members) == sorted(s.name for s in plant.full.signals)
    drawn = " ".join(ElementTree.fromstring(diagram.svg()).itertext())
    for s in families.signals:
        if s.role in ("w", "z", "u", "y"):
            assert s.name in drawn


def with_sensor_chains() -> DesignPlant:
    """Parameters, actuators and sensors uncertain: Delta stands in three places."""
    chains = {"low_percent": 10.0, "crossover_Hz": 60.0, "high_percent": 400.0}
    table = {
        "title": "all kinds of uncertainty",
        "rig": "avis",
        "keep": ["z", "phi_x"],
        "uncertainty": {"parameters_percent": {"mass": 10.0}, "actuator_chains": chains, "sensor_chains": chains},
        "transmissibility": {"peak_dB": 6.0, "band_dB": -3.0, "band_Hz": [2.0, 6.0]},
        "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0},
    }
    return build_plant(design_from_table(table), load_rig("avis"))


@pytest.mark.parametrize("sensor_chains", [False, True])
def test_boxes_of_the_block_diagram_do_not_overlap(fabricated: DesignResult, sensor_chains: bool) -> None:
    plant = with_sensor_chains() if sensor_chains else fabricated.plant
    diagram = BlockDiagram(plant)
    assert {diagram.families.of(part.name) for part in plant.full.parts} <= set(diagram.nodes)
    drawn = ElementTree.fromstring(diagram.svg())
    # The boxes of Delta are no parts; a shadow stands behind the box of several.
    delta = [one.attrib for one in drawn.iter("{http://www.w3.org/2000/svg}rect") if one.get("fill") == FILLS["delta"]]
    delta = [one for one in delta if one["stroke"] != "#777777"]
    assert len(delta) == (3 if sensor_chains else len({s.source for s in diagram.signals if s.role == "z_delta"}))
    boxes = [
        (
            float(one["x"]),
            float(one["x"]) + float(one["width"]),
            float(one["y"]),
            float(one["y"]) + float(one["height"]),
        )
        for one in delta
    ]
    boxes += [
        (x - w / 2, x + w / 2, y - diagram._height(n) / 2, y + diagram._height(n) / 2)
        for n, (x, y, w) in diagram.nodes.items()
    ]
    for k, (l1, r1, t1, b1) in enumerate(boxes):
        assert not any(l1 < r2 and l2 < r1 and t1 < b2 and t2 < b1 for l2, r2, t2, b2 in boxes[:k])


def test_canvas_escapes() -> None:
    canvas = Canvas(10, 10)
    canvas.text((1, 1), "<script>&")
    assert [*ElementTree.fromstring(canvas.svg()).itertext()] == ["<script>&"]


def test_both_backends_draw_labels_units_and_legend() -> None:
    x = np.geomspace(1, 10, 5)
    figure = Figure(
        "f",
        "caption",
        (
            Panel(
                Axis("frequency [Hz]", "log", (1.0, 10.0)),
                Axis("gain [V]"),
                (Curve(x, x, "first", Style("#0072b2")), Curve(x, 2 * x, "second", Style("#d55e00", "dash"))),
                (),
                "panel",
            ),
        ),
    )
    drawn = " ".join(ElementTree.fromstring(svg(figure)).itertext())
    for text in ("frequency [Hz]", "gain [V]", "first", "second", "panel", "10"):
        assert text in drawn
    layout = graph(figure)["layout"]
    assert layout["xaxis"]["title"]["text"] == "frequency [Hz]" and layout["xaxis"]["range"] == [0.0, 1.0]
    assert [t["name"] for t in graph(figure)["data"] if t["showlegend"]] == ["first", "second"]
