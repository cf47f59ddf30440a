"""Uncertainty model that a controller design derives from an identification."""

from __future__ import annotations

import numpy as np

from avis_ctrl.report import words
from avis_ctrl.report.pieces import Paragraph, Section
from avis_ctrl.report.sections.identified import directions, spread
from avis_ctrl.study.identification import Identification
from avis_ctrl.study.identified_uncertainty import InDesign

TITLE = "Uncertainty for design"


def uncertainty(found: Identification, made: InDesign | None) -> Section:
    """Directions of the parameters, and the filter that covers the measured spread."""
    if made is None:
        missing = (
            "The uncertainty model for a controller design was not computed with this report; the covariance is in "
            "result.json."
        )
        return Section(TITLE, "uncertainty", (Paragraph(missing),))
    kept = words.joined([words.axis(name) for name in made.spread.keep])
    count = len(made.directions)
    bounded = (
        f"the joint covariance of the parameters is represented by {count} bounded direction{'s' * (count != 1)}"
        if count
        else "the parameters are known so precisely that no direction of their covariance needs a bound of its own"
    )
    text = (
        f"For a design of {kept}, {bounded}. The spread of the measured response about the model is represented by "
        "one filter. The directions and the remaining parameter uncertainty contain the true parameters with a "
        f"probability of {words.number(100 * made.found.coverage)} %; the bound of the spread is valid with a "
        f"probability of {words.number(100 * made.confidence)} % at each spectral line. Outside the measured band, "
        "or if the design file states a larger uncertainty of the drives, the filter is increased accordingly."
    )
    left = words.number(100 * float(np.max(made.found.rest, initial=0.0)), 2)
    rest = f"The remaining parameter uncertainty changes the response by at most {left} %; the filter covers it."
    rig = found.rig.parameters()
    nominal, units = {name: p.value for name, p in rig.items()}, {name: p.unit for name, p in rig.items()}
    pieces = (Paragraph(text), *directions(made, nominal, units), Paragraph(rest), spread(made))
    return Section(TITLE, "uncertainty", pieces)
