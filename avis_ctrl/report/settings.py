"""How much a report shows: lengths of tables and lists, points and ranges of curves."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ReportSettings:
    """Tables and lists; what is left out is in the JSON file of results.

    tolerances : maximum number of rows, which fill a third of a page. far : change in tolerances beyond which a value
        counts as far off [1]: one in 400 if the tolerances are right.
    provenance_values : maximum number of values in a row of the provenance.
    parameters : maximum number of parameters of a direction or a named effect: they fill a row of the table.
        candidate_parameters : the same of a rejected candidate, which has a column more.
    candidates : rejected candidates shown at once, about a page; the others are folded.
    poles : maximum number of poles of a controller, about one page.
    cell_letters : letters of a cell beyond which its text wraps on a phone.

    Figures.

    gain_dB : range of a gain axis [dB]: down to isolation by a factor of 1000, up to the peak of a table with little
        damping.
    weight_Hz, weight_points : range of the curves of the weights [Hz], from below the modes of a table to beyond the
        band of any loop, and number of their points: a hundred per decade show every resonance.
    loop_Hz, loop_points : the same of controllers, loops and mu; the slowest filters of a controller lie lower.
    controller_entries : maximum number of entries of a controller that are distinguishable in one diagram.
    gate_panels : panels per figure of gates; three rows of two fill a page.
    gate_letters : letters that fit side by side under a panel of half the width, at the font size of the legend.
    measured_points : maximum number of points of a measured response in a panel: more would hide the lines of the
        models. overview_points : the same in the overview of all responses, whose panels are small.
    response_outputs : outputs in one figure of responses, which then fills a page. worst_outputs : number of outputs,
        the worst, whose response is drawn in the report of a gap: their figures fill a page.
    held_out : maximum number of held-out records with figures of their own: a long record is split into many pieces.
    stage_letters : letters per row of a stage's name under its bar, so that four names fit side by side on a phone.
    page_letters : letters of such names, in one row and side by side, that fit across a page.
    least_power : smallest fraction of the power that is drawn [1], -90 dB.
    map_lowest, map_top : lower end, and smallest upper end, of the colour scale of a map relative to the noise power
        [1]: noise alone is nearly white, and a residual little above it does not look large.
    map_letters : letters of a name that fit beside a map.
    """

    tolerances: int = 10
    far: float = 3.0
    provenance_values: int = 12
    parameters: int = 5
    candidate_parameters: int = 4
    candidates: int = 12
    poles: int = 60
    cell_letters: int = 40
    gain_dB: tuple[float, float] = (-60.0, 40.0)
    weight_Hz: tuple[float, float] = (0.1, 500.0)
    weight_points: int = 400
    loop_Hz: tuple[float, float] = (0.01, 500.0)
    loop_points: int = 500
    controller_entries: int = 9
    gate_panels: int = 6
    gate_letters: int = 36
    measured_points: int = 60
    overview_points: int = 90
    response_outputs: int = 3
    worst_outputs: int = 3
    held_out: int = 3
    stage_letters: int = 13
    page_letters: int = 80
    least_power: float = 1e-9
    map_lowest: float = 0.5
    map_top: float = 10.0
    map_letters: int = 20


SETTINGS = ReportSettings()
