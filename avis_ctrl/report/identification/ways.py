"""The estimates of different methods beside each other, and what the Kalman filter's tuning hides."""

from __future__ import annotations

import numpy as np

from avis_ctrl.identification.ekf_result import EkfResult, ParameterCurves, parameter_curves
from avis_ctrl.report import words
from avis_ctrl.report.figures import Axis, Band, Curve, Figure, Panel, Style
from avis_ctrl.report.pieces import Bullets, Heading, Mark, Paragraph, Piece, Section, Table, table
from avis_ctrl.rigs.halcyonics import Halcyonics
from avis_ctrl.study.identification import Identification

ESTIMATE, RECORDS, LIKELY = Style("#0072b2"), Style("#9a9a9a", "dot", 1.2), Style("#d55e00", "dash", 1.4)
TITLE = "Ways of identification"


def ways(found: Identification) -> Section:
    """Maximum likelihood, the extended Kalman filter where it ran, and the sequential fit."""
    result = found.kalman
    if result is None:
        note = found.kalman_note or "the extended Kalman filter was not run"
        return Section(TITLE, "ways", (Paragraph(f"{note[:1].upper()}{note[1:]}.", "note"), _sequential(found)))
    pieces: list[Piece] = [_agreement(found, result), _table(found, result)]
    pieces += [_figure(found, curves, k) for k, curves in enumerate(parameter_curves(result))]
    pieces += [_consistency(found, result), Heading("What the filter's tuning hides"), Bullets(_hidden(result)),
               _sequential(found)]
    return Section(TITLE, "ways", tuple(pieces))


def _sequential(found: Identification) -> Paragraph:
    if isinstance(found.start, Halcyonics):
        return Paragraph("The sequential fit of the rig's source, test by test, was not run here: it takes "
                         "displacement per volt of single tests.", "note")
    return Paragraph("The sequential fit, test by test, belongs to the spring-suspended table; it does not apply to "
                     "this rig.", "note")


def _differences(found: Identification, result: EkfResult) -> np.ndarray:
    """(combinations, 5): both values, both standard deviations, and the difference over the root of their squares."""
    information, order = found.campaign_fit.fit.information, list(result.names)
    rows = []
    for one in found.identifiability.combinations:
        w = np.zeros(len(order))
        for name, weight in one.weights.items():
            w[order.index(name)] = weight
        values = np.array([information.values[information.names.index(name)] for name in order])
        other = one.value + float(w @ (result.values - values))
        sigma = float(np.sqrt(w @ result.covariance @ w))
        both = np.hypot(sigma, one.standard_deviation)
        rows.append((one.value, one.standard_deviation, other, sigma, (other - one.value) / both))
    return np.array(rows)


def _agreement(found: Identification, result: EkfResult) -> Paragraph:
    d = _differences(found, result)
    known = np.isfinite(d[:, 4])
    if not known.any():
        return Paragraph("No combination is determined by both.", "verdict")
    far = int(np.count_nonzero(np.abs(d[known, 4]) > 3))
    k = int(np.argmax(np.abs(np.where(known, d[:, 4], 0))))
    share = 100 * np.abs(d[:, 2] / np.where(d[:, 0] == 0, np.nan, d[:, 0]) - 1)[known]
    text = (f"Maximum likelihood and the extended Kalman filter differ by "
            f"{words.number(float(np.nanmedian(share)), 2)} % in the median over {np.count_nonzero(known)} determined "
            f"combinations, at most by {words.number(float(np.nanmax(share)), 2)} %. Measured in their standard "
            f"deviations {far} differ by more than 3, the farthest is {found.identifiability.combinations[k].words} "
            f"with {words.number(float(abs(d[k, 4])), 2)}.")
    broken = [name for name, one in zip(_names(found, result), result.innovations, strict=True) if not one.consistent]
    if broken:
        text += (f" The filter's innovations do not agree with its covariance in record{'s' * (len(broken) > 1)} "
                 f"{words.joined(broken)}: its standard deviations are too small to be believed.")
    return Paragraph(text, "verdict", far == 0 and not broken)


def _table(found: Identification, result: EkfResult) -> Table:
    rows = []
    for one, (value, sigma, other, spread, apart) in zip(found.identifiability.combinations,
                                                         _differences(found, result), strict=True):
        first, second = words.with_deviation(value, sigma), words.with_deviation(other, spread)
        rows.append((one.words, *(first if one.determined else (first[0], "not determined")), *second,
                     f"{apart:+.1f}".replace("-", "−") if np.isfinite(apart) else "",
                     words.unit(one.unit) if one.unit != "1" else ""))
    return table("Estimates of each combination by both methods. The difference is divided by the root of the sum of "
                 "both variances; the data are the same, so that it should be smaller than for independent data.",
                 ("combination", "likelihood", "± 1 σ", "Kalman", "± 1 σ", "difference [σ]", "unit"), rows, "lrrrrrl")


def _figure(found: Identification, curves: ParameterCurves, number: int) -> Figure:
    information = found.campaign_fit.fit.information
    t = curves.time_s
    frame = (float(t[0]), float(max(t[-1], curves.boundaries_s[-1])))
    panels = []
    for k, name in enumerate(curves.names):
        likely = float(information.values[information.names.index(name)])
        # The prior's band, at the first point, would hide what the data say.
        low = float(np.min(curves.lower[1:, k], initial=likely))
        high = float(np.max(curves.upper[1:, k], initial=likely))
        pad = 0.05 * (high - low) or 1.0
        ends = (low - pad, high + pad)
        edges = [b for b in curves.boundaries_s if frame[0] < b < frame[1]]
        x = np.array([v for b in edges for v in (b, b, np.nan)])
        y = np.array([v for _ in edges for v in (*ends, np.nan)])
        drawn = [Curve(t, curves.estimate[:, k], "estimate", ESTIMATE),
                 Curve(np.array(frame), np.array([likely, likely]), "maximum likelihood", LIKELY),
                 Curve(x, y, "a record begins", RECORDS)]
        band = Band(t, curves.lower[:, k], curves.upper[:, k], "± 2 σ", ESTIMATE)
        known = "" if information.known[information.names.index(name)] else " *"
        panels.append(Panel(Axis("time in the records [s]", "linear", frame),
                            Axis(f"[{words.unit(curves.units[k])}]", "linear", ends), tuple(drawn), (band,),
                            f"{name}{known}"))
    return Figure(f"kalman_{number}", f"{curves.title}: the extended Kalman filter's estimate against time, as in "
                  "figs. 3.1 to 3.3 of its source; the first second, when the prior's band is far wider, is cut off. A "
                  "parameter with * is known only in combination and stays where the prior and its partners leave it.",
                  tuple(panels), min(3, len(panels)), 0.62)


def _names(found: Identification, result: EkfResult) -> list[str]:
    """Records in the order of the innovations."""
    records = [r.header.name for r in found.split.fitted.records] if found.split else []
    count = len(result.innovations)
    return records if len(records) == count else [str(k + 1) for k in range(count)]


def _consistency(found: Identification, result: EkfResult) -> Table:
    rows = []
    for name, one in zip(_names(found, result), result.innovations, strict=True):
        n_y = one.autocorrelation.shape[1]
        low, high = (v / n_y for v in one.nis_interval)
        rows.append((name, words.number(one.nis_per_output, 4), f"{low:.4f} to {high:.4f}",
                     f"{words.number(100 * one.outside, 2)} %",
                     Mark("yes", True) if one.consistent else Mark("no", False)))
    return table("Innovations of the filter: mean normalised square per output, where 99.9 % of such means lie, and "
                 "the share of autocorrelations beyond what white noise keeps in 95 % of the cases. A filter whose "
                 "innovations are larger than it believes states standard deviations that are too small.",
                 ("record", "mean square", "expected", "beyond the bound", "consistent"), rows, "lrrrc")


def _hidden(result: EkfResult) -> tuple[str, ...]:
    s = result.settings
    said = ["Noise of the measurements: " + ("the rig's own sensor noise and converter." if s.R is None else
                                             f"set by hand, R = {s.R}; more than the sensors have widens every band."),
            "Noise of the process: " + ("the rig's ambient floor motion, through the isolators. A record in which the "
                                        "floor is shaken harder than that contradicts it." if s.Q is None else
                                        f"set by hand, Q = {s.Q}."),
            f"Prior: {100 * s.prior_share:g} % of each starting value. A parameter that the data do not determine "
            "keeps this band, which tells of the prior and nothing of the rig."]
    said.append("Each record begins again from the prior covariance: the last record alone sets the bands." if s.reset
                else "The covariance is kept from record to record"
                + (f", after {s.warm_up} record{'s' * (s.warm_up > 1)} of warm-up that set the linearisation."
                   if s.warm_up else "."))
    held = [name for name, count in zip(result.names, result.guarded, strict=True) if count]
    if held:
        said.append(f"The guard against values near zero held {words.joined(held)}.")
    return (*said, *(f"{line[:1].upper()}{line[1:]}." for line in result.directions.words()))
