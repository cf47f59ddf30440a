"""Single-mass problems: a drive F = M a + Fv v, and an oscillator m y'' + d y' + k y = u."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial

import numpy as np
from scipy import signal

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.axis.mass_effects import Scale, drive_effects, oscillator_effects, unnamed_forces
from avis_ctrl.gap.axis.model import MassModel, Parameter, Problem
from avis_ctrl.gap.axis.records import Lines, Signals
from avis_ctrl.gap.axis.settings import SETTINGS, AxisSettings


def drive(
    records: Sequence[Signals],
    rate: float,
    cutoff_Hz: float | None = None,
    band_Hz: tuple[float, float] | None = None,
    settings: AxisSettings = SETTINGS,
) -> Problem:
    """Problem of a drive. Its band extends to where force and motion are coherent: only there do delay and lag differ.

    Parameters
    ----------
    cutoff_Hz : low-pass filter of the motion from which friction is computed; by default the upper end of the band.
    band_Hz : of the lines.

    Raises
    ------
    InputError : wrong shapes, a record that is too short, an axis at rest, exchanged columns, a flipped sign.
    """
    _check(records, rate, ("force", "position"))
    high = coherent_to(records[0], rate, settings) if band_Hz is None else band_Hz[1]
    cutoff_Hz = high if cutoff_Hz is None else cutoff_Hz
    if not 0 < cutoff_Hz < rate / 2:
        raise InputError(f"expected a cutoff between 0 and {rate / 2:g} Hz", field="cutoff_Hz", value=cutoff_Hz)
    band = (0.0, high) if band_Hz is None else band_Hz

    def fitted(some: Sequence[Signals]) -> tuple[float, bool]:
        lines = Lines(some, rate, "force", band, cutoff_Hz, settings)
        # Free functions of position are included, because a spring or a stop acts like a negative mass.
        places = next(one for one in unnamed_forces(lines) if one.variable == "position").shapes
        columns = _flat(lines.A, lines.V, *map(lines.of, (lambda m: m.sign, *places)))
        x, residual = _least_squares(columns, *_flat(lines.F))
        return residual, bool(x[0] > 0)

    require_oriented(fitted, records, ("force", "position"), settings)
    lines = Lines(records, rate, "force", band, cutoff_Hz, settings)
    start, _ = _least_squares(_flat(lines.A, lines.V), *_flat(lines.F))
    start[0] = start[0] if start[0] > 0 else lines.size / float(np.sqrt(np.mean(np.abs(_flat(lines.A)[0]) ** 2)))
    scale = Scale.of(lines, pitches=True)
    return Problem(
        "drive",
        MassModel(lines, (_positive("M", "{F} s^2/{x}"), Parameter("Fv", "{F} s/{x}")), (), start),
        [*drive_effects(scale), *unnamed_forces(lines)],
        *repeated(lines),
        {"F": "N", "x": "m", "input": "position", "output": "force"},
        lambda v: {"time constant M/Fv": (v["M"] / v["Fv"], "s")} if v["Fv"] > 0 else {},
        {"scale": asdict(scale), "cutoff_Hz": cutoff_Hz, "rate_Hz": rate},
    )


def oscillator(
    records: Sequence[Signals],
    rate: float,
    band_Hz: tuple[float, float] | None = None,
    units: Mapping[str, str] | None = None,
    settings: AxisSettings = SETTINGS,
) -> Problem:
    """Problem of an oscillator, or of one mode of a structure in a band around it; u and y are force and position.

    Raises
    ------
    InputError : wrong shapes or band, a record that is too short, exchanged columns, a flipped sign. ComputationError :
    no oscillator fits.
    """
    _check(records, rate, ("u", "y"))
    band = (0.005 * rate, 0.4 * rate) if band_Hz is None else band_Hz
    if not 0 <= band[0] < band[1] < rate / 2:
        raise InputError(f"expected low < high between 0 and {rate / 2:g} Hz", field="band_Hz", value=band)

    def fitted(some: Sequence[Signals]) -> tuple[float, bool]:
        x, residual = _modal_start(Lines(some, rate, "position", band, None, settings))
        return residual, bool(x[0] > 0 and x[2] > 0)

    require_oriented(fitted, records, ("u", "y"), settings)
    lines = Lines(records, rate, "position", band, None, settings)
    start, _ = _modal_start(lines)
    if not (start[0] > 0 and start[2] > 0):
        raise ComputationError(
            "no oscillator fits",
            measured=f"mass {start[0]:.3g}, stiffness {start[2]:.3g}",
            cause="no resonance in the band, or columns of another kind",
            next_step="choose a band around one resonance",
        )

    def ratios(v: Mapping[str, float]) -> dict[str, tuple[float, str]]:
        w = np.sqrt(v["k"] / v["m"])
        found = {"resonance": (w / (2 * np.pi), "Hz"), "damping ratio": (v["d"] / (2 * v["m"] * w), "1")}
        for name in ("k2", "k3"):
            if name in v:
                found[f"{name}/k"] = v[name] / v["k"], "1/{x}^" + str(int(name[1]) - 1)
        return found

    scale = Scale.of(lines, pitches=False)
    base = _positive("m", "{F} s^2/{x}"), Parameter("d", "{F} s/{x}"), _positive("k", "{F}/{x}")
    return Problem(
        "oscillator",
        MassModel(lines, base, (), start),
        [*oscillator_effects(scale), *unnamed_forces(lines)],
        *repeated(lines),
        {"F": "u", "x": "y", "input": "u", "output": "y", **(units or {})},
        ratios,
        {"scale": asdict(scale), "rate_Hz": rate},
    )


_positive = partial(Parameter, linear=False)


def _least_squares(
    columns: Sequence[np.ndarray], y: np.ndarray, weight: np.ndarray | float = 1.0
) -> tuple[np.ndarray, float]:
    """Coefficients, and the norm of the residual over that of y."""
    X = np.column_stack(columns) * np.broadcast_to(weight, y.shape)[:, None]
    y = y * weight
    size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
    x = np.linalg.lstsq(np.r_[X.real, X.imag] / size, np.r_[y.real, y.imag], rcond=None)[0] / size
    return x, float(np.linalg.norm(y - X @ x) / max(float(np.linalg.norm(y)), 1e-300))


def _flat(*columns: Sequence[np.ndarray]) -> list[np.ndarray]:
    """(n,) lines of all records for each column."""
    return [np.concatenate([one.sum(axis=2).ravel() for one in several]) for several in columns]


def _modal_start(lines: Lines, steps: int = 8) -> tuple[np.ndarray, float]:
    """m, d and k by iterative reweighting with 1/|D| (C. Sanathanan, J. Koerner, IEEE T-AC 8 (1963) 56), and the norm
    of the residual over that of y."""
    A, V, Q, F = _flat(lines.A, lines.V, lines.Q, lines.F)
    s = np.concatenate([np.tile(lines.s, len(one)) for one in lines.Q])
    weight = 1 / np.abs(s) ** 2
    x = np.zeros(3)
    for _ in range(steps):
        x, _ = _least_squares([A, V, Q], F, weight)
        weight = 1 / np.maximum(np.abs(x[0] * s**2 + x[1] * s + x[2]), 1e-300)
    residual = (F - x[0] * A - x[1] * V - x[2] * Q) * weight
    return x, float(np.linalg.norm(residual) / np.linalg.norm(Q))


def require_oriented(
    fitted: Callable[[Sequence[Signals]], tuple[float, bool]],
    records: Sequence[Signals],
    names: tuple[str, str],
    settings: AxisSettings,
) -> None:
    """Refuse exchanged columns and a flipped sign; a mass must be positive. If the model fits with the sign of the
    input reversed, or with input and output exchanged, but not with the columns as given, the columns are wrong.

    Raises
    ------
    InputError : as above.
    """
    field = ", ".join(names)
    residual, positive = fitted(records)
    if positive and residual < settings.no_model:
        return
    others = (
        fitted([Signals(one.name, -one.force, one.position) for one in records]),
        fitted([Signals(one.name, one.position, one.force) for one in records]),
    )
    turned, swapped = (left if sensible else np.inf for left, sensible in others)
    if swapped < min(turned, settings.no_model, settings.much_better * residual):
        raise InputError(
            f"the residual is {100 * residual:.3g} % with these columns and {100 * swapped:.2g} % with input and "
            "output exchanged: the columns look exchanged",
            field=field,
        )
    if turned < settings.no_model:
        raise InputError(
            f"expected a positive mass: with the input reversed the model fits (residual {100 * turned:.2g} %), so "
            "one column has the wrong sign; give it a scale of -1",
            field=field,
        )


def coherent_to(one: Signals, rate: float, settings: AxisSettings) -> float:
    """Upper end [Hz] of the last third-octave band in which acceleration and force are coherent."""
    with np.errstate(divide="ignore", invalid="ignore"):  # no acceleration at all: coherent nowhere
        f, coherence = signal.coherence(
            np.diff(one.position, 2), one.force[1:-1], rate, nperseg=max(len(one.force) // 16, 8)
        )
    top = min(settings.least_cutoff_Hz, 0.4 * rate)
    for upper in top * 2 ** (np.arange(1, 40) / 3):
        band = (f >= upper / 2 ** (1 / 3)) & (f < upper)
        if upper <= 0.4 * rate and band.any() and np.mean(coherence[band]) >= settings.coherent:
            top = float(upper)
    return top


def repeated(lines: Lines) -> tuple[float | None, tuple[str, ...]]:
    """Noise power of held-out lines over the power of the response, and a sentence, where the signal that drives the
    model repeats; else None. A repeating reference is no evidence, because added forces need not repeat."""
    one, settings = lines.records[0], lines.settings
    guide, target = ("position", one.force) if lines.solves_for == "force" else ("force", one.position)
    x = getattr(one, guide) - np.mean(getattr(one, guide))
    n, least = len(x), len(x) // 32
    product = np.fft.irfft(np.abs(np.fft.rfft(x, 2 * n)) ** 2)[:n]
    energy, lags = np.cumsum(x**2), np.arange(max(least, 1), n // 2)
    apart = (energy[n - 1 - lags] + energy[-1] - energy[lags - 1] - 2 * product[lags]) / (n - lags)
    mean = float(np.mean(x**2))
    good = lags[apart < (settings.repeats**2 + 1e-9) * mean]
    if not len(good):
        return None, ()
    lag = int(good[0] + np.argmin(apart[good - lags[0]][: max(1, least // 4)]))
    change = np.zeros(n)
    change[: n - lag] = (target[lag:] - target[:-lag]) / np.sqrt(2)
    inside = np.array([start + lines.length <= n - lag for start in lines.starts[0]])
    if not inside.any():
        return None, ()
    # The median over the segments: a start or a single disturbance is not noise.
    noise = float(np.median(np.mean(np.abs(lines.transform(change, 0).sum(axis=2)[inside]) ** 2, axis=1)))
    whole = float(np.mean([np.mean(np.abs(block.Y) ** 2) for block in lines.held.blocks]))
    return noise / whole, (
        f"The {guide} repeats every {lag / lines.rate:.4g} s; from one repetition to the next the "
        f"response scatters by {100 * np.sqrt(noise / whole):.2g} %, which is the measured noise.",
    )


def position_of(x: np.ndarray, rate: float, output: str, low_Hz: float) -> np.ndarray:
    """Displacement from displacement, or from velocity or acceleration with a high-pass filter at low_Hz."""
    order = {"position": 0, "velocity": 1, "acceleration": 2}
    if output not in order:
        raise InputError(f"expected one of {', '.join(order)}", field="output", value=output)
    if not order[output]:
        return x
    n = len(x)
    f = np.fft.rfftfreq(2 * n, 1 / rate)
    # The record followed by its mirror image has no step at the ends.
    X = np.fft.rfft(np.r_[x, x[::-1]])
    s = 2j * np.pi * np.maximum(f, 1e-12)
    smooth = (f / low_Hz) ** 4 / (1 + (f / low_Hz) ** 4)
    return np.fft.irfft(X * smooth / s ** order[output], 2 * n)[:n]


def _check(records: Sequence[Signals], rate: float, names: tuple[str, str]) -> None:
    if not records or not (np.isfinite(rate) and rate > 0):
        raise InputError("expected at least one record and a sample rate above zero", field="records, rate", value=rate)
    for one in records:
        for name, x in zip(names, (one.force, one.position), strict=True):
            if x.shape != one.force.shape or x.ndim != 1 or not np.all(np.isfinite(x)):
                raise InputError(f"expected {len(one.force)} finite samples", field=name, value=x.shape)
        for name, x in zip(names, (one.force, one.position), strict=True):
            if len(x) < 64 or not np.ptp(x) > 1e-9 * max(float(np.max(np.abs(x))), 1e-300):
                raise InputError("expected at least 64 samples of a signal that changes", field=name, value=len(x))
