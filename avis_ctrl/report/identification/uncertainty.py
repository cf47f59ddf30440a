"""What a controller design makes of the identification's uncertainty."""

from __future__ import annotations

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style, hertz
from avis_ctrl.report.pieces import Paragraph, Section, Table, table
from avis_ctrl.study.identification import Identification
from avis_ctrl.study.identified_uncertainty import JUDGED_HZ, InDesign

TITLE = "Uncertainty for design"
MOST_NAMED = 6


def uncertainty(found: Identification, made: InDesign | None) -> Section:
    """Directions of the parameters, and the filter over the measured spread."""
    if made is None:
        return Section(TITLE, "uncertainty", (Paragraph(
            "The uncertainty model for a controller design was not computed with this report; the covariance is in "
            "result.json."),))
    kept = words.joined([words.axis(name) for name in made.spread.keep])
    count = len(made.directions)
    bounded = (f"the joint covariance of the parameters is represented by {count} bounded "
               f"direction{'s' * (count != 1)}" if count else
               "the parameters are known so precisely that no direction of their covariance needs a bound of its own")
    text = (f"For a design of {kept}, {bounded}. The spread of the measured response about the model is represented by "
            f"one filter. The directions together with the remaining parameter uncertainty hold with a probability of "
            f"{words.number(100 * made.found.coverage)} %, the bound of the spread at each line with "
            f"{words.number(100 * made.confidence)} %. Outside the measured band, or if the design file states a "
            "larger uncertainty of the drives, the filter is increased accordingly.")
    return Section(TITLE, "uncertainty", (Paragraph(text), _directions(made, found), _rest(made), _spread(made)))


def _directions(made: InDesign, found: Identification) -> Table:
    values = {name: p.value for name, p in found.rig.parameters().items()}
    rows = []
    for one, effect in zip(made.directions, made.found.effect, strict=True):
        share = sorted(((100 * change / abs(values[name]), name) if values.get(name) else (np.inf, name)
                        for name, change in one.changes), key=lambda pair: -abs(pair[0]))
        shown = ", ".join(f"{name} {part:+.2g} %" if np.isfinite(part) else name
                          for part, name in share[:MOST_NAMED])
        more = f", and {len(share) - MOST_NAMED} parameters by less" if len(share) > MOST_NAMED else ""
        rows.append((one.name, f"{words.number(100 * effect, 2)} %", shown + more))
    if not rows:
        rows.append(("none", f"below {words.number(100 * float(np.max(made.found.rest, initial=0.0)), 2)} %",
                     "no direction changes the response enough to be kept"))
    return table(f"Directions of correlated parameters. Each is scaled by one real delta from −1 to 1, which "
                 f"corresponds to ± {words.number(made.found.box)} standard deviations.",
                 ("direction", "largest change of the response", "change of the parameters"), rows, "lrl")


def _rest(made: InDesign) -> Paragraph:
    return Paragraph(f"The remaining parameter uncertainty changes the response by at most "
                     f"{words.number(100 * float(np.max(made.found.rest, initial=0.0)), 2)} %; the filter covers it.")


def _spread(made: InDesign) -> Figure:
    s, weight = made.spread, made.weight
    f = np.geomspace(min(JUDGED_HZ[0], s.frequency_Hz[0]), max(JUDGED_HZ[-1], s.frequency_Hz[-1]), 400)
    omega = 2 * np.pi * f
    noise = s.bound(made.confidence) - s.measured
    curves = (Curve(s.frequency_Hz, 100 * s.measured, "measured minus model, with noise", Style("#0072b2"),
                    points=True, line=False),
              Curve(s.frequency_Hz, 100 * noise, "noise of the measurement", Style("#7a7a7a", "dot", 1.4)),
              Curve(weight.omega / (2 * np.pi), 100 * weight.data, "bound to be covered",
                    Style("#d55e00", "dash", 1.5)),
              Curve(f, 100 * weight.envelope(omega), "envelope", Style("#e69f00", "dashdot", 1.3)),
              Curve(f, 100 * weight.shape.magnitude(omega), f"filter of order {weight.shape.order}",
                    Style("#222222", "solid", 2.0)))
    assumed = f" {made.assumption}" if made.assumption else ""
    return Figure("spread", f"Relative spread of the response, largest singular value: {weight.meaning}.{assumed}",
                  (Panel(hertz(float(f[0]), float(f[-1])), Axis("relative error [%]", "log"), curves),), height=1.1)
