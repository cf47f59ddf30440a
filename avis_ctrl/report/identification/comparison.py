"""Comparison of the estimates of different methods, and the influence of the Kalman filter's tuning."""

from __future__ import annotations

import numpy as np

from avis_ctrl.identification.ekf_result import EkfResult, Innovations, kinds
from avis_ctrl.identification.identifiability_text import main_members
from avis_ctrl.report import words
from avis_ctrl.report.elements import Bullets, Paragraph, Section, Table, headed, listed, section, table, yes_or_no
from avis_ctrl.report.figures import Axis, Band, Curve, Figure, Panel, Style, level
from avis_ctrl.rigs.halcyonics import Halcyonics
from avis_ctrl.study.identification import Identification
from avis_ctrl.summary import joined

ESTIMATE, RECORDS, LIKELY = Style("#0072b2"), Style("#9a9a9a", "dot", 1.2), Style("#d55e00", "dash", 1.4)
TITLE = "Comparison of identification methods"


def ways(found: Identification) -> Section:
    """Maximum likelihood, the extended Kalman filter if it was run, and the sequential fit."""
    result = found.kalman
    if result is None:
        note = found.kalman_note or "the extended Kalman filter was not run"
        return section(TITLE, "ways", Paragraph(words.sentence(note), "note"), _sequential(found))
    return section(
        TITLE,
        "ways",
        (_agreement(found, result), _table(found, result)),
        [_figure(found, result, title, index, k) for k, (title, index) in enumerate(kinds(result).items())],
        _consistency(found, result),
        headed("Influence of the filter's tuning", Bullets(_hidden(result)), _sequential(found)),
    )


def _sequential(found: Identification) -> Paragraph:
    why = (
        "was not run here: it needs the displacement per volt from single tests"
        if isinstance(found.start, Halcyonics)
        else "is for the spring-suspended table; it does not apply to this rig"
    )
    return Paragraph(f"The sequential fit of Beadle et al. {why}.", "note")


def _differences(found: Identification, result: EkfResult) -> np.ndarray:
    """(combinations, 5): value, std (likelihood), value, std (Kalman), and the difference in standard deviations."""
    information, order = found.information, list(result.names)
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
        return Paragraph("No combination of parameters is determined by both methods.", "verdict")
    far = int(np.count_nonzero(np.abs(d[known, 4]) > 3))
    k = int(np.argmax(np.abs(np.where(known, d[:, 4], 0))))
    share = 100 * np.abs(d[:, 2] / np.where(d[:, 0] == 0, np.nan, d[:, 0]) - 1)[known]
    text = (
        f"Maximum likelihood and the extended Kalman filter differ by "
        f"{words.number(float(np.nanmedian(share)), 2)} % in the median over {np.count_nonzero(known)} determined "
        f"combinations, and by at most {words.number(float(np.nanmax(share)), 2)} %. {far} of them differ by more "
        f"than 3 standard deviations; the largest difference is {words.number(float(abs(d[k, 4])), 2)} standard "
        f"deviations, in {found.identifiability.combinations[k].words}."
    )
    broken = [name for name, one in zip(_names(found, result), result.innovations, strict=True) if not one.consistent]
    if broken:
        text += (
            f" The filter's innovations do not agree with its covariance in record{'s' * (len(broken) > 1)} "
            f"{joined(broken)}: its standard deviations are too small."
        )
    return Paragraph(text, "verdict", far == 0 and not broken)


def _table(found: Identification, result: EkfResult) -> Table:
    rows = []
    for one, (value, sigma, other, spread, apart) in zip(
        found.identifiability.combinations, _differences(found, result), strict=True
    ):
        first, second = words.with_std(value, sigma), words.with_std(other, spread)
        rows.append(
            (
                one.words,
                *(first if one.determined else (first[0], "not determined")),
                *second,
                f"{apart:+.1f}" if np.isfinite(apart) else "",
                words.unit(one.unit),
            )
        )
    return table(
        "Estimates of each combination by both methods. The difference is divided by the root of the sum of "
        "both variances. Because both use the same data, it should be smaller than for independent data.",
        ("combination", "likelihood", "± 1 σ", "Kalman", "± 1 σ", "difference [σ]", "unit"),
        rows,
        "lrrrrrl",
    )


def _figure(found: Identification, result: EkfResult, title: str, index: list[int], number: int) -> Figure:
    information, curves = found.information, result.history
    t, panels = curves.time_s, []
    frame = (float(t[0]), float(max(t[-1], curves.boundaries_s[-1])))
    edges = [b for b in curves.boundaries_s if frame[0] < b < frame[1]]
    for k in index:
        name = result.names[k]
        place = information.names.index(name)
        likely = float(information.values[place])
        # The wide band of the prior at the first point would hide the estimates.
        low = float(np.min(curves.lower[1:, k], initial=likely))
        high = float(np.max(curves.upper[1:, k], initial=likely))
        pad = 0.05 * (high - low) or 1.0
        ends = (low - pad, high + pad)
        begun = np.array([(b, b, np.nan) for b in edges]).ravel(), np.array([(*ends, np.nan) for _ in edges]).ravel()
        drawn = (
            Curve(t, curves.theta[:, k], "estimate", ESTIMATE),
            level(*frame, likely, "maximum likelihood", LIKELY),
            Curve(*begun, "a record begins", RECORDS),
        )
        band = Band(t, curves.lower[:, k], curves.upper[:, k], "± 2 σ", ESTIMATE)
        x = Axis("time in the records [s]", "linear", frame)
        y = Axis(f"[{words.unit(result.units[k]) or 1}]", "linear", ends)
        panels.append(Panel(x, y, drawn, (band,), name + ("" if information.known[place] else " *")))
    return Figure(
        f"kalman_{number}",
        f"{title}: the extended Kalman filter's estimate against time, as in "
        "figs. 3.1 to 3.3 of Rademakers; the first second, with the far wider band of the prior, is not "
        "shown. A parameter marked * is known only in combination; its own value depends on the prior.",
        panels,
        3,
        0.62,
    )


def _names(found: Identification, result: EkfResult) -> list[str]:
    """Names of the records in the order of the innovations."""
    records = [r.header.name for r in found.split.fitted.records] if found.split else []
    count = len(result.innovations)
    return records if len(records) == count else [str(k + 1) for k in range(count)]


def _consistency(found: Identification, result: EkfResult) -> Table:
    def expected(one: Innovations) -> str:
        low, high = (v / one.autocorrelation.shape[1] for v in one.nis_interval)
        return f"{low:.4f} to {high:.4f}"

    return listed(
        "Innovations of the filter: mean normalised square per output, the interval that contains 99.9 % of "
        "such means for a consistent filter, and the fraction of autocorrelations outside the 95 % limits of "
        "white noise. If the innovations are larger than the filter's covariance predicts, its standard "
        "deviations are too small.",
        list(zip(_names(found, result), result.innovations, strict=True)),
        {
            "record": lambda row: row[0],
            "mean square": lambda row: words.number(row[1].nis_per_output, 4),
            "expected": lambda row: expected(row[1]),
            "beyond the bound": lambda row: f"{words.number(100 * row[1].outside, 2)} %",
            "consistent": lambda row: yes_or_no(row[1].consistent),
        },
        "lrrrc",
    )


def _hidden(result: EkfResult) -> tuple[str, ...]:
    s = result.settings
    said = [
        "Measurement noise: the sensor noise and converter of the rig file.",
        "Process noise: the rig file's ambient floor motion, transmitted by the isolators. It is too small for a "
        "record with stronger floor motion.",
        f"Prior: standard deviation {100 * s.prior_share:g} % of each starting value. A parameter that the data do "
        "not determine keeps this band; the band then depends on the prior only, not on the rig.",
        f"The covariance is kept from record to record, after {s.warm_up} record of warm-up for the linearisation.",
    ]
    held = [name for name, count in zip(result.names, result.guarded, strict=True) if count]
    if held:
        said.append(f"The lower limit of the parameters was reached by {joined(held)}.")
    ratios, directions = result.undetermined
    for ratio, direction in zip(ratios, directions.T, strict=True):
        moved = [f"{name} {'up' if weight > 0 else 'down'}" for name, weight in main_members(result.names, direction)]
        said.append(f"Not determined: {' with '.join(moved)} (variance {ratio:.2g} of the prior's).")
    return tuple(said)
