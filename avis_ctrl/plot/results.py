"""Plots of results: bounds of mu, transmissibility, progress of a synthesis, vibration criteria."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.norms import in_dB
from avis_ctrl.plot.axes import HERTZ, axes_of, finish, limit_line, log_if_wide, whole_numbers
from avis_ctrl.rigs.vibration_criteria import CRITERIA
from avis_ctrl.summary import distinct_from_one, rounded_down

# Palette of Okabe and Ito; controllers have the same colours as in the report.
COLOURS = {
    "passive": "#7a7a7a",
    "skyhook_classical": "#56b4e9",
    "skyhook": "#e69f00",
    "loops": "#d55e00",
    "hinf": "#009e73",
    "mu": "#0072b2",
}
LOWER = "#e69f00"


def mu(peak: Any, ax: Any = None, *, label: str = "mu", color: str = COLOURS["mu"]) -> Any:
    """Upper and lower bound of mu over frequency [Hz], with the bound of the peak and whether it is proved.

    peak : `MuPeak` (of `mu_peak` or `worst_case_gain`), a result of `robust_stability` or `robust_performance`, or a
        design's `Bound`. Returns the axes. Raises InputError for a result without these curves, such as a
        `MuSynthesis`.

    Examples
    --------
    >>> loop = (ac.real("k", 1.0, percent=20) * ac.tf([25.0], [1.0, 10.0, 10.0, 10.0])).feedback()
    >>> [text.get_text() for text in ac.plot.mu(ac.robust_stability(loop)).get_legend().get_texts()][-1]
    'reached: 0.1428 at 0 Hz'
    """
    peak = getattr(peak, "mu", peak)
    if not hasattr(peak, "upper_curve"):
        raise InputError(
            "expected bounds of mu over frequency; for the result of a synthesis use "
            "mu_peak(result.closed_loop, result.blocks)",
            field="peak",
            value=type(peak).__name__,
        )
    ax = axes_of(ax)
    f = np.asarray(peak.frequencies) / HERTZ
    shown = f > 0
    ax.plot(f[shown], peak.upper_curve[shown], ".-", markersize=4, color=color, label=f"{label}, upper bound")
    lower = np.where(peak.lower_curve > 0, peak.lower_curve, np.nan)
    ax.plot(f[shown], lower[shown], color=LOWER, linestyle="--", label=f"{label}, lower bound")
    if np.isfinite(peak.upper):
        worth = "proved between all points" if peak.guaranteed else "at the computed points only"
        label_of_peak = f"peak at most {distinct_from_one(peak.upper)}, {worth}"
        limit_line(ax, peak.upper, label_of_peak, color=color, linestyle="--")
    if np.isfinite(peak.lower) and peak.lower > 0 and np.isfinite(peak.omega):
        at = peak.omega / HERTZ
        # Zero has no place on the axis. With real parameters alone, mu can be zero at all other frequencies.
        x, y = ([at], [peak.lower]) if at > 0 else ([], [])
        ax.vlines(x, 0, y, color=color, linewidth=0.8, linestyle=":")
        words = f"reached: {rounded_down(peak.lower, 4):.4g} at {at:.4g} Hz"
        ax.plot(x, y, "o", color=color, markersize=5, fillstyle="none", label=words)
    ax.set_ylim(bottom=0)
    return finish(ax, "frequency [Hz]", label, above=True)


def transmissibility(result: Any, ax: Any = None, *, controllers: Iterable[str] | None = None) -> Any:
    """Largest singular value from floor to payload [dB] over frequency [Hz]: nominal, and the range of sampled plants.

    Parameters
    ----------
    result : a design's result (of `avis_ctrl.design` or `run_design`).
    controllers : names of the controllers to draw; all by default. The range of sampled plants and the upper bound
        of the worst-case peak (dashed line) are drawn for the last controller.

    Raises
    ------
    InputError : a controller that is not in the result.

    Examples
    --------
    After `study = ac.design(...)`:

    >>> ac.plot.transmissibility(study, controllers=["skyhook", "mu"])        # doctest: +SKIP
    """
    ax = axes_of(ax)
    result = getattr(result, "result", result)
    known = {one.name: one for one in result.controllers}
    names = list(known if controllers is None else controllers)
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"expected some of {', '.join(known)}", field="controllers", value=unknown[0])
    for name in names:
        one, t = known[name], known[name].transmissibility
        f, colour = t.omega / HERTZ, COLOURS.get(name, "#222222")
        ax.plot(f, in_dB(t.sigma), color=colour, label=one.title, linewidth=2 if name == "mu" else 1.3)
        if name == names[-1]:
            look = {"color": colour, "alpha": 0.25, "linewidth": 0}
            ax.fill_between(f, in_dB(t.low), in_dB(t.high), label=f"{one.title}, sampled plants", **look)
            if np.isfinite(one.worst_peak.upper):
                level = float(in_dB(np.array(one.worst_peak.upper)))
                limit_line(ax, level, f"{one.title}, worst case {level:.1f} dB", linestyle="--")
    return finish(ax, "frequency [Hz]", "transmissibility [dB]")


def dk_history(history: Any, ax: Any = None) -> Any:
    """gamma and peak mu by iteration; `history` of a `MuSynthesis`, a design's result, or the rows themselves.

    Examples
    --------
    >>> k = ac.real("k", 1.0, percent=50)
    >>> plant = ac.ss([[-1]], [[1, 0, k]], [[1], [0], [1]], [[0, 0, 0], [0, 0, 1], [0, 1, 0]])
    >>> ax = ac.plot.dk_history(ac.musyn(plant, 1, 1, max_iterations=2, polish=False))
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('iteration', 'gamma, mu')
    """
    ax = axes_of(ax)
    rows = _rows(history)
    steps = [row.iteration for row in rows]
    ax.plot(steps, [row.gamma for row in rows], "s--", color="#e69f00", markersize=4, label="gamma of the scaled loop")
    ax.plot(steps, [row.mu_upper for row in rows], "o-", color=COLOURS["mu"], markersize=4, label="peak mu on the grid")
    return _progress(ax, np.array([[row.gamma, row.mu_upper] for row in rows]), "iteration", "gamma, mu")


def order(history: Any, ax: Any = None) -> Any:
    """Peak mu of each controller against its number of states; `history` as for `dk_history`, or pairs (order, mu).

    Examples
    --------
    >>> ac.plot.order([(3, 1.2), (5, 0.9), (8, 0.85)]).get_xlabel()
    'states of the controller'
    """
    ax = axes_of(ax)
    rows = (
        history
        if isinstance(history, (list, tuple)) and history and isinstance(history[0], tuple)
        else [(row.order, row.mu_upper) for row in _rows(history)]
    )
    if hasattr(history, "K") and hasattr(history, "mu_upper"):  # of a given order, it is not in the history
        rows = [*rows, (history.K.nstates, history.mu_upper)]
    states, values = (np.array(part, float) for part in zip(*sorted(rows), strict=True))
    ax.plot(states, values, "o", color=COLOURS["mu"], markersize=4, label="controllers")
    look = {"where": "post", "color": COLOURS["mu"], "linewidth": 1}
    ax.step(states, np.minimum.accumulate(values), label="least mu up to this order", **look)
    return _progress(ax, values, "states of the controller", "peak mu")


def vc_curves(spectra: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None, ax: Any = None) -> Any:
    """The criteria VC-A to VC-G, and third-octave spectra by name: (midbands [Hz], r.m.s. velocity [m/s]), each (n,).

    Returns the axes. Source of the criteria: `avis_ctrl.rigs.vibration_criteria`.

    Examples
    --------
    >>> midbands = np.array([4.0, 8.0, 16.0, 31.5])
    >>> ax = ac.plot.vc_curves({"floor": (midbands, np.array([4e-6, 3e-6, 2e-6, 1e-6]))})
    >>> [text.get_text() for text in ax.texts][:2]
    ['VC-A', 'VC-B']
    """
    ax = axes_of(ax)
    for one in CRITERIA:
        f = one.midbands()
        ax.plot(f, 1e6 * one.limit(f), color="#8a8a8a", linewidth=1)
        place = {"xytext": (4, 0), "textcoords": "offset points", "va": "center"}
        ax.annotate(one.name, (f[-1], 1e6 * one.limit(f)[-1]), fontsize="x-small", color="#555555", **place)
    for name, (f, rms) in (spectra or {}).items():
        f, rms = np.asarray(f, float), np.asarray(rms, float)
        if f.shape != rms.shape or f.ndim != 1:
            raise InputError(f"expected two vectors of one length, got {f.shape} and {rms.shape}", field=name)
        known = np.isfinite(rms) & (rms > 0)
        ax.plot(f[known], 1e6 * rms[known], "o-", markersize=3, label=name)
    ax.set_yscale("log")
    ax.margins(x=0.08)
    return finish(ax, "midband of the third octave [Hz]", "velocity, r.m.s. [µm/s]")


def _progress(ax: Any, values: np.ndarray, x: str, y: str) -> Any:
    """Finish a plot over whole numbers, with the limit 1 and a logarithmic y axis if the values span a decade."""
    log_if_wide(ax, values)
    limit_line(ax, 1.0, "mu = 1", linestyle=":")
    whole_numbers(ax)
    return finish(ax, x, y, log=False)


def _rows(history: Any) -> list[Any]:
    """Rows of the D-K history with finite gamma and mu."""
    for name in ("result", "dk_history", "history"):
        history = getattr(history, name, history)
    rows = [row for row in history if np.isfinite(row.gamma) and np.isfinite(row.mu_upper)]
    if not rows:
        raise InputError("expected at least one iteration with finite gamma and mu", field="history")
    return rows
