"""Transmissibility from floor to payload: nominal, sampled plants and worst case, and each axis alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.lti.norms import in_dB
from avis_ctrl.report import words
from avis_ctrl.report.elements import Section, Table, listed, section
from avis_ctrl.report.figures import STYLES, Axis, Band, Curve, Figure, Panel, Style, controller_style, hertz
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.analysis import SETTINGS as CURVES
from avis_ctrl.study.design_result import ControllerResult, DesignResult
from avis_ctrl.summary import joined


def transmissibility(result: DesignResult) -> Section:
    """The figures of transmissibility."""
    figures = (_nominal(result), _uncertain(result), _by_axis(result))
    return section("Transmissibility", "transmissibility", figures, _against_skyhook(result), _six_dof(result))


def _against_skyhook(result: DesignResult) -> Table:
    low, high = result.design.transmissibility.band_Hz
    return listed(
        f"Worst case of each axis over {low:g} to {high:g} Hz, for floor motion in any combination of the "
        "controlled axes: upper bound of the mu controller over the whole set, and lower bound of the tuned skyhook, "
        "which a plant of the set reaches.",
        result.by_axis,
        {
            "axis": lambda one: words.axis(one.axis),
            "mu synthesis, at most": lambda one: words.decibel(one.mu, "upper"),
            "skyhook, at least": lambda one: words.decibel(one.skyhook, "lower"),
            "improvement, at least": lambda one: words.decibel(one.advantage, "lower"),
        },
        "lrrr",
    )


def left_out(result: DesignResult) -> str:
    """Sentence on the controllers that a figure of the nominal loop omits, because their loop is unstable."""
    unstable = [c.title for c in result.controllers if not c.stable]
    return f" Not shown, because the nominal loop is unstable: {joined(unstable)}." if unstable else ""


def target(result: DesignResult) -> Curve:
    """Target of the synthesis [dB], with its steps."""
    asked = result.design.transmissibility
    (low, high), (first, last) = asked.band_Hz, CURVES.plot_Hz
    f = np.array([first, low, low, high, high, last])
    levels = np.repeat([asked.peak_dB, asked.band_dB, asked.peak_dB], 2)
    return Curve(f, levels, "target of the synthesis", STYLES["limit"])


def nominal(c: ControllerResult, values: np.ndarray, label: str = "", style: Style | None = None) -> Curve:
    """A curve over the frequencies of the nominal loop, by default with title and style of the controller."""
    return Curve(_hz(c), values, label or c.title, style or controller_style(c.name))


def _sigma(c: ControllerResult) -> Curve:
    return nominal(c, in_dB(c.transmissibility.sigma))


def upper_bound(c: ControllerResult, label: str) -> Curve:
    """Upper bound of the worst case, marked at the computed frequencies, with those of the band and its edges; between
    them it may be higher."""
    frequencies, upper = (
        np.concatenate([getattr(c.worst_peak, name), getattr(c.worst_band, name)])
        for name in ("frequencies", "upper_curve")
    )
    f, first = np.unique(frequencies, return_index=True)
    return Curve(f / (2 * np.pi), in_dB(upper[first]), label, STYLES["plain"], points=True)


def _hz(c: ControllerResult) -> np.ndarray:
    return c.transmissibility.omega / (2 * np.pi)


def _panel(curves: list[Curve], bands: Sequence[Band] = (), title: str = "", label: str = "largest gain [dB]") -> Panel:
    return Panel(hertz(CURVES.plot_Hz), Axis(label, "linear", SETTINGS.gain_dB), curves, bands, title)


def summary_figure(result: DesignResult) -> Figure:
    """The delivered controller compared with the table without control, and its bound over the whole set."""
    mu, passive = result.controller("mu"), result.controller("passive")
    curves = [
        *(_sigma(c) for c in (passive, mu) if c.stable),
        upper_bound(mu, "mu synthesis, worst case of the set"),
        target(result),
    ]
    return Figure(
        "summary",
        "Transmissibility from floor to payload, largest gain: without control, with the mu "
        "controller on the nominal plant, and its upper bound over every plant of the uncertainty set.",
        [_panel(curves)],
    )


def _nominal(result: DesignResult) -> Figure:
    mu, passive = result.controller("mu"), result.controller("passive")
    caption = (
        f"Largest singular value from floor velocity to payload velocity, nominal plant. Without control the "
        f"table peaks at {words.decibel(passive.peak_transmissibility)}, under the mu controller at "
        f"{words.decibel(mu.peak_transmissibility)}."
    )
    curves = [_sigma(c) for c in result.controllers if c.stable]
    return Figure("transmissibility_nominal", caption + left_out(result), [_panel([*curves, target(result)])])


def _uncertain(result: DesignResult) -> Figure:
    """The mu controller, and the tuned controllers "skyhook" and "loops" if they were computed."""
    panels, peaks, guaranteed = [], [], True
    for c in (c for name in ("mu", "skyhook", "loops") for c in result.controllers if c.name == name):
        T, worst = c.transmissibility, upper_bound(c, "upper bound over the whole set")
        label = f"{c.title}: range over sampled plants"
        band = Band(_hz(c), in_dB(T.low), in_dB(T.high), label, controller_style(c.name))
        panels.append(_panel([_sigma(c), worst, target(result)], [band], c.title))
        guaranteed = guaranteed and c.worst_peak.guaranteed
        peaks.append(
            f"{c.title}: sampled plants peak at {words.decibel(float(np.max(T.high)))}, the "
            f"bound at {words.decibel(c.worst_peak.upper, 'upper')}"
        )
    proved = "; the bound of the peak is also proved between them" if guaranteed else ""
    caption = (
        "Largest singular value over the uncertainty set: nominal (line), range over the sampled plants (area), "
        f"and the upper bound that no plant of the set exceeds at the marked frequencies. The lines between the "
        f"marks only guide the eye{proved}. {'; '.join(peaks)}."
    )
    return Figure("transmissibility_uncertain", caption, panels, len(panels))


def _by_axis(result: DesignResult) -> Figure:
    settled = [c for c in result.controllers if c.stable]
    panels = [
        _panel(
            [nominal(c, in_dB(c.transmissibility.nominal[:, k, k])) for c in settled], (), words.axis(axis), "gain [dB]"
        )
        for k, axis in enumerate(result.plant.axes)
    ]
    return Figure(
        "transmissibility_axes",
        "Each axis alone, nominal plant: payload velocity over floor velocity along "
        "the same axis, without the coupling between axes." + left_out(result),
        panels,
        2,
    )


def _six_dof(result: DesignResult) -> Figure:
    check, mu = result.six_dof, result.controller("mu")
    f = check.omega / (2 * np.pi)
    curves = [
        _sigma(mu),
        Curve(f, in_dB(check.kept), "six degrees of freedom, sampled", STYLES["plain"]),
        Curve(f, in_dB(check.others), "from the floor's other coordinates", STYLES["limit"]),
    ]
    caption = (
        f"Check of the design model: the sampled mu controller on all six degrees of freedom, with the skyhook "
        f"loops of the other axes. In the band the largest gain differs by at most {check.deviation_dB:.2g} dB "
        "from that of the design model. The third line shows how floor motion along the other coordinates "
        "reaches the controlled axes."
    )
    return Figure("transmissibility_six_dof", caption, [_panel(curves)])
