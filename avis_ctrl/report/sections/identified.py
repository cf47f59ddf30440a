"""What a design takes from an identification: directions of parameters, and the spread of the measured response."""

from __future__ import annotations

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.figures import STYLES, Axis, Curve, Figure, Panel, Style, hertz, numbered
from avis_ctrl.report.pieces import Heading, Paragraph, Piece, Table, table
from avis_ctrl.study.design_result import DesignResult
from avis_ctrl.study.identified_uncertainty import InDesign

# Parameters shown for each direction.
SHOWN = 5


def identified(result: DesignResult) -> list[Piece]:
    """Directions, what they leave, and the spread with its weight; nothing where the design names no identification."""
    found, content = result.plant.identified, result.design.uncertainty.identification
    if found is None or content is None:
        return []
    pieces: list[Piece] = [Heading("Uncertainty from the identification"), _origin(result, found)]
    if found.directions:
        pieces.append(_directions(result, found))
    return [*pieces, _spread(found)]


def _origin(result: DesignResult, found: InDesign) -> Paragraph:
    content = result.design.uncertainty.identification
    assert content is not None
    d = found.found
    source = content.provenance.get("measurement")
    determined, kept = len(content.direction), len(found.directions)
    text = (f"The identification{f' ({source})' if source else ''} determined {determined} combinations of "
            f"{len(content.parameter)} parameters; {content.undetermined} have no influence on the measurements and "
            f"keep their starting values. ")
    if kept:
        text += (f"{kept} of them are bounded directions here, within {words.number(d.box)} standard deviations; the "
                 f"others together change the response by at most {_percent(d.rest)} and the transmissibility by at "
                 f"most {_percent(d.rest_floor)}. ")
    else:
        text += (f"All of them together, within {words.number(d.ball)} standard deviations, change the response by at "
                 f"most {_percent(d.rest)} and the transmissibility by at most {_percent(d.rest_floor)}: no block of "
                 "their own is needed. ")
    text += (f"The combinations without a direction of their own are added to the spread of the response. The spread "
             f"acts at the actuators; their influence on the response to floor motion is not covered. Directions and "
             f"the other combinations together hold with a probability of {words.number(100 * d.coverage)} % if the "
             f"errors are normally distributed; the spread holds with {words.number(100 * found.confidence)} % at each "
             "frequency.")
    return Paragraph(text)


def _percent(share: np.ndarray) -> str:
    return f"{words.number(100 * float(np.max(share, initial=0.0)), 2)} %"


def _directions(result: DesignResult, found: InDesign) -> Table:
    nominal, units = result.plant.rig.nominal, result.plant.rig.units
    rows = []
    for direction, effect in zip(found.directions, found.found.effect, strict=True):
        sizes = sorted(direction.changes, key=lambda one: -abs(one[1] / (nominal[one[0]] or 1.0)))
        shown = [f"{name} {100 * change / abs(nominal[name]):+.2g} %" if nominal[name] else
                 f"{name} {change:+.2g} {words.unit(units[name])}" for name, change in sizes[:SHOWN]]
        more = f" and {len(sizes) - SHOWN} parameters by less" if len(sizes) > SHOWN else ""
        rows.append((direction.name, f"{words.number(100 * float(effect), 2)} %",
                     ", ".join(shown) + more))
    return table("Directions of the identified parameters: each is one real number between −1 and 1 that changes all "
                 "of them together. The effect is the largest relative change of the response at 1.",
                 ("direction", "effect", "change at +1"), rows, "lrl")


def _spread(found: InDesign) -> Figure:
    weight, spread = found.weight, found.spread
    f = np.geomspace(weight.grid[0], weight.grid[-1], 400) / (2 * np.pi)
    omega = 2 * np.pi * f
    confidence = words.number(100 * found.confidence)
    curves = [Curve(spread.frequency_Hz, 100 * spread.measured, "as measured", Style("#999999", "dot", 1.0)),
              Curve(spread.frequency_Hz, 100 * spread.bound(found.confidence), f"bound at {confidence} %",
                    numbered(0)),
              Curve(f, 100 * weight.envelope(omega), "envelope", STYLES["limit"]),
              Curve(f, 100 * weight.magnitude(omega), f"|W|, order {weight.shape.order}", STYLES["filter"])]
    low = 10 ** np.floor(np.log10(100 * np.min(weight.data) / 3))
    high = 10 ** np.ceil(np.log10(100 * np.max(weight.magnitude(omega))))
    declared = (" Where the design file states a larger uncertainty of the drives, the envelope follows it."
                if weight.declared else " Outside the measured band it keeps the value at the end of the band.")
    assumed = f" {found.assumption}" if found.assumption else ""
    return Figure("identified_spread", "Relative difference between the measured response and the identified model in "
                  "the kept coordinates (largest singular value), its bound with the measurement's noise, the envelope "
                  f"and the filter of lowest order within 1 dB above it: order {weight.shape.order}, at most "
                  f"{weight.slack_dB:.2f} dB above.{declared}{assumed}",
                  (Panel(hertz(float(f[0]), float(f[-1])), Axis("relative difference [%]", "log",
                                                                (float(low), float(high))), tuple(curves)),))
