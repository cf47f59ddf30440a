"""Frequency responses of linear systems."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.interchange import is_response, plot_frequencies, response_of
from avis_ctrl.lti.norms import in_dB
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.plot.axes import HERTZ, axes_of, finish
from avis_ctrl.uncertainty.uncertain_system import UncertainSystem


@dataclass(frozen=True)
class PlotSettings:
    """samples : number of random systems drawn for an uncertain system: enough to see its range.
    round_off : a singular value below this fraction of the largest one at every frequency is zero up to round-off, and
        is not drawn [1].
    range_dB : largest range of the magnitude axis below its top [dB]: smaller values have no
        practical meaning, and with them the other curves would look flat.
    """

    samples: int = 20
    round_off: float = 1e-11
    range_dB: float = 200.0


SETTINGS = PlotSettings()
FAINT = {"alpha": 0.3, "linewidth": 0.8, "zorder": 1.5}
# Colours of a single uncertain response: the nominal system, and its random samples.
NOMINAL, SAMPLE = "black", "#0072b2"


def bode(
    system: Any,
    omega: np.ndarray | None = None,
    ax: Any = None,
    *,
    frequency_Hz: np.ndarray | None = None,
    label: str | Sequence[str] | None = None,
    **line: Any,
) -> Any:
    """Magnitude [dB] and phase [degrees] over frequency [Hz], one curve for each input-output pair.

    Returns the two axes.

    Parameters
    ----------
    system : StateSpace, or python-control's StateSpace, TransferFunction or FRD; for an UncertainSystem the nominal
        system and 20 random samples are drawn. A list of systems is drawn into the same axes.
    omega, frequency_Hz : (n,) frequencies [rad/s] or [Hz]; by default a range around the poles, or the frequencies of
        the FRD.
    ax : two axes, magnitude and phase; by default those of a new figure.
    label : label of the curves in the legend, one for each system of a list ("system 1" and so on by default); with
        several inputs or outputs followed by "output / input".
    line : options of matplotlib's `plot`.

    Raises
    ------
    InputError : an object that is not a system; both omega and frequency_Hz given; another number of labels.

    Examples
    --------
    >>> G = ac.tf([25.0], [1.0, 10.0, 10.0, 10.0])
    >>> magnitude, phase = ac.plot.bode([G, G.feedback()], label=["open loop", "closed loop"])
    >>> [text.get_text() for text in magnitude.get_legend().get_texts()]
    ['open loop', 'closed loop']
    """
    top, bottom = axes = axes_of(ax, 2)
    line = _full_names(line)
    for one in _curves(system, omega, frequency_Hz, label):
        single = one.nominal[0].size == 1
        for i in range(one.nominal.shape[1]):
            for k in range(one.nominal.shape[2]):
                pair = f"{_name(one.system, 'outputs', i)} / {_name(one.system, 'inputs', k)}"
                words = " ".join(part for part in (one.label, None if single else pair) if part) or None
                colour = _draw(top, one, in_dB(one.nominal[:, i, k]), words, line, single)
                bottom.plot(one.f, _phase(one.nominal[:, i, k]), **(line | {"color": colour}))
                for H in one.samples:
                    faint = FAINT | {"color": _of_samples(colour)}
                    top.plot(one.f, in_dB(H[:, i, k]), **faint)
                    bottom.plot(one.f, _phase(H[:, i, k]), **faint)
        _label_samples(top, one)
    finish(_in_range(top), "", "magnitude [dB]")
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
    label: str | Sequence[str] | None = None,
    **line: Any,
) -> Any:
    """Singular values [dB] over frequency [Hz], in one colour for each system.

    Arguments as for `bode`, but a single axes object. Singular values that are zero up to round-off at all frequencies
    are not drawn.

    Examples
    --------
    >>> G = ac.ss([[-1, 0], [0, -2]], [[1, 0], [0, 1]], [[1, 1], [0, 1]])
    >>> len(ac.plot.sigma(G).lines)
    2
    """
    ax, line = axes_of(ax), _full_names(line)
    several = False
    for one in _curves(system, omega, frequency_Hz, label):
        values = _singular_values(one.nominal)
        several = several or one.nominal[0].size > 1
        colour = None
        for k in range(values.shape[1]):
            own = line if colour is None else line | {"color": colour}
            colour = _draw(ax, one, in_dB(values[:, k]), None if k else one.label, own, True)
        for H in one.samples:
            for values in in_dB(_singular_values(H)).T:
                ax.plot(one.f, values, **(FAINT | {"color": _of_samples(colour)}))
        _label_samples(ax, one)
    return finish(_in_range(ax), "frequency [Hz]", "singular values [dB]" if several else "magnitude [dB]")


@dataclass(frozen=True, eq=False)
class _Curves:
    """A system with its response (n, n_y, n_u) and those of random samples at the frequencies f (n,) [Hz]."""

    system: Any
    f: np.ndarray
    nominal: np.ndarray
    samples: list[np.ndarray]
    label: str | None
    alone: bool


def _curves(system: Any, omega: Any, frequency_Hz: Any, label: Any) -> list[_Curves]:
    """The responses of a system, or of those of a list, with labels."""
    every = list(system) if isinstance(system, (list, tuple)) else [system]
    alone = len(every) == 1
    if not isinstance(label, str) and label is not None:
        labels = list(label)
    elif not alone:
        labels = [f"{'system' if label is None else label} {k + 1}" for k in range(len(every))]
    else:
        single = isinstance(every[0], UncertainSystem) and every[0].shape == (1, 1)
        labels = ["nominal" if single and label is None else label]
    if not every or len(labels) != len(every):
        raise InputError(f"expected at least one system and one label for each; systems: {len(every)}", field="label")
    members = [one.nominal if isinstance(one, UncertainSystem) else one for one in every]
    found = []
    for one, member, grid, text in zip(every, members, _rad_s(omega, frequency_Hz, members), labels, strict=True):
        drawn = one.sample(SETTINGS.samples) if isinstance(one, UncertainSystem) else []
        samples = [response_of(each, grid) for each in drawn]
        found.append(_Curves(one, grid / HERTZ, response_of(member, grid), samples, text, alone))
    return found


def _rad_s(omega: Any, frequency_Hz: Any, members: list[Any]) -> list[np.ndarray]:
    """(n,) frequencies [rad/s] for each system; if none are given, a common range that suits all of them."""
    if omega is not None and frequency_Hz is not None:
        raise InputError("expected omega or frequency_Hz", field="omega, frequency_Hz")
    if omega is not None or frequency_Hz is not None:
        try:
            given = np.asarray(omega, float) if omega is not None else HERTZ * np.asarray(frequency_Hz, float)
        except (TypeError, ValueError):
            raise InputError(
                "expected frequencies; several systems are given as a list, bode([G, H])", field="omega"
            ) from None
        return [given] * len(members)
    own = [plot_frequencies(one) for one in members]
    common = np.unique(
        np.concatenate([grid for grid, one in zip(own, members, strict=True) if not is_response(one)] or own)
    )
    return [
        grid if is_response(one) else common[common <= (np.pi / dt if (dt := getattr(one, "dt", 0)) else np.inf)]
        for grid, one in zip(own, members, strict=True)
    ]


def _full_names(line: dict[str, Any]) -> dict[str, Any]:
    """Options of a line without matplotlib's abbreviations, such as "c" for "color"."""
    from matplotlib.cbook import normalize_kwargs
    from matplotlib.lines import Line2D

    return dict(normalize_kwargs(line, Line2D))


def _draw(ax: Any, one: _Curves, values: np.ndarray, label: str | None, line: dict[str, Any], single: bool) -> Any:
    """A curve of the nominal system; returns its colour."""
    if one.samples and one.alone and single:
        line = {"color": NOMINAL} | line
    (drawn,) = ax.plot(one.f, values, label=label, **line)
    return drawn.get_color()


def _of_samples(colour: Any) -> Any:
    return SAMPLE if colour == NOMINAL else colour


def _label_samples(ax: Any, one: _Curves) -> None:
    """Label one of the random samples, which were drawn last; with several curves they have the curves' colours."""
    words = f"{len(one.samples)} random samples" + ("" if one.alone and one.nominal[0].size == 1 else " (thin)")
    if one.samples and words not in ax.get_legend_handles_labels()[1]:
        ax.lines[-1].set_label(words)


def _singular_values(H: np.ndarray) -> np.ndarray:
    """(n, m) singular values without those that are zero up to round-off at all frequencies."""
    values = np.full((len(H), min(H.shape[1:])), np.nan)
    finite = np.all(np.isfinite(H), axis=(1, 2))
    values[finite] = np.linalg.svd(H[finite], compute_uv=False)
    largest = np.max(values[finite] / np.maximum(values[finite, :1], np.finfo(float).tiny), axis=0, initial=0.0)
    return values[:, (largest > SETTINGS.round_off) | (np.arange(values.shape[1]) == 0)]


def _phase(H: np.ndarray) -> np.ndarray:
    """Phase [degrees] without jumps; NaN where the response is zero."""
    return np.where(H == 0, np.nan, np.degrees(np.unwrap(np.angle(H))))


def _in_range(ax: Any) -> Any:
    """The axes with a magnitude axis of at most `range_dB`."""
    low, high = ax.get_ylim()
    ax.set_ylim(max(low, high - SETTINGS.range_dB), high)
    return ax


def _name(system: Any, which: str, k: int) -> str:
    if isinstance(system, (StateSpace, UncertainSystem)):
        return getattr(system, which)[k]
    labels = getattr(system, f"{which[:-1]}_labels", None)
    return str(labels[k]) if labels is not None and not is_response(system) else f"{which[0]}{k}"
