"""Frequency responses of linear systems."""

from __future__ import annotations

from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.interchange import is_response, plot_frequencies, response_of
from avis_ctrl.lti.norms import in_dB
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.plot.axes import HERTZ, axes_of, finish
from avis_ctrl.uncertainty.uncertain_system import UncertainSystem

# Number of random samples drawn for an uncertain system, and their line style.
SAMPLES, FAINT = 20, {"color": "#0072b2", "alpha": 0.3, "linewidth": 0.8}


def bode(
    system: Any,
    omega: np.ndarray | None = None,
    ax: Any = None,
    *,
    frequency_Hz: np.ndarray | None = None,
    label: str | None = None,
    **line: Any,
) -> Any:
    """Magnitude [dB] and phase [degrees] over frequency [Hz], one curve for each input-output pair.

    Returns the two axes.

    Parameters
    ----------
    system : StateSpace, or python-control's StateSpace, TransferFunction or FRD; for an UncertainSystem the nominal
        system and 20 random samples are drawn.
    omega, frequency_Hz : (n,) frequencies [rad/s] or [Hz]; by default a range around the poles, or the frequencies of
        the FRD.
    ax : two axes, magnitude and phase; by default those of a new figure.
    label : label of the curves in the legend; by default "output / input" if there are several.
    line : options of matplotlib's `plot`.

    Raises
    ------
    InputError : an object that is not a system; both omega and frequency_Hz given.
    """
    top, bottom = axes = axes_of(ax, 2)
    if isinstance(system, UncertainSystem):
        return _family(bode, system, _rad_s(omega, frequency_Hz), axes, label, line)
    omega = _rad_s(omega, frequency_Hz, system)
    H = response_of(system, omega)
    for i in range(H.shape[1]):
        for k in range(H.shape[2]):
            names = f"{_name(system, 'outputs', i)} / {_name(system, 'inputs', k)}" if H[0].size > 1 else None
            words = " ".join(part for part in (label, names) if part) or None
            top.plot(omega / HERTZ, in_dB(H[:, i, k]), label=words, **line)
            bottom.plot(omega / HERTZ, np.degrees(np.unwrap(np.angle(H[:, i, k]))), **line)
    finish(top, "", "magnitude [dB]")
    finish(bottom, "frequency [Hz]", "phase [degrees]")
    low, high = bottom.get_ylim()
    step = 45 if high - low <= 270 else 90 * np.ceil((high - low) / 720)
    bottom.set_yticks(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step)
    return axes


def sigma(
    system: Any,
    omega: np.ndarray | None = None,
    ax: Any = None,
    *,
    frequency_Hz: np.ndarray | None = None,
    label: str | None = None,
    **line: Any,
) -> Any:
    """Singular values [dB] over frequency [Hz], in one colour; arguments as for `bode`, but a single axes object."""
    ax = axes_of(ax)
    if isinstance(system, UncertainSystem):
        return _family(sigma, system, _rad_s(omega, frequency_Hz), ax, label, line)
    omega = _rad_s(omega, frequency_Hz, system)
    values = in_dB(np.linalg.svd(response_of(system, omega), compute_uv=False))
    for k in range(values.shape[1]):
        if k:
            line["color"] = ax.lines[-1].get_color()
        ax.plot(omega / HERTZ, values[:, k], label=None if k else label, **line)
    return finish(ax, "frequency [Hz]", "singular values [dB]" if values.shape[1] > 1 else "magnitude [dB]")


def _rad_s(omega: Any, frequency_Hz: Any, system: Any = None) -> Any:
    """(n,) frequencies [rad/s]; if none are given, a range that suits the system (None without a system)."""
    if omega is not None and frequency_Hz is not None:
        raise InputError("expected omega or frequency_Hz", field="omega, frequency_Hz")
    if frequency_Hz is not None:
        return HERTZ * np.asarray(frequency_Hz, float)
    if omega is not None:
        return np.asarray(omega, float)
    return None if system is None else plot_frequencies(system)


def _family(
    draw: Any, system: UncertainSystem, omega: np.ndarray | None, ax: Any, label: str | None, line: dict[str, Any]
) -> Any:
    nominal = system.nominal
    omega = plot_frequencies(nominal) if omega is None else omega
    for one in system.sample(SAMPLES):
        draw(one, omega, ax, **FAINT)
    return draw(nominal, omega, ax, label=label or "nominal", **{"color": "black", **line})


def _name(system: Any, which: str, k: int) -> str:
    if isinstance(system, StateSpace):
        return getattr(system, which)[k]
    labels = getattr(system, f"{which[:-1]}_labels", None)
    return str(labels[k]) if labels is not None and not is_response(system) else f"{which[0]}{k}"
