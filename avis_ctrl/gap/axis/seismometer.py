"""A seismometer channel: coil and displacement of a second-order mass, and effects that one of them may lack.

The data are the first channel over the drive, and the second channel over the first. In the second ratio the mass
cancels: a fault of one channel shows there far below the residual that the nonlinearity of the mass causes in each
response. Logarithms of magnitudes and phases are separate outputs, each with its own discrepancy: a laser that misses
counts does not affect the phase. They are real; two neighbouring frequencies form one complex number for the
likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.axis.model import AxisModel, Effect, Parameter, Problem
from avis_ctrl.gap.axis.records import block_of
from avis_ctrl.gap.axis.settings import SETTINGS, AxisSettings
from avis_ctrl.identification.likelihood import Data
from avis_ctrl.identification.single_axis.identify import distinct, responses_of
from avis_ctrl.identification.single_axis.seismometer import Responses, fit_seismometer, response
from avis_ctrl.identification.single_axis.sine import SineRecord
from avis_ctrl.identification.spectral_block import SpectralBlock


@dataclass(frozen=True, eq=False)
class Channels:
    """Responses as blocks for the likelihood. Outputs are magnitude and phase of each response: Y is 1 + j, and the
    model predicts Y plus the logarithm of its own response over the measured one.

    f : (n,) Hz; an odd last one is not used. measured : (n, responses). spread : (pairs,) scale to which the
    discrepancy is expected to be proportional; all outputs are divided by it. names : of the channels, one or two.
    rows : pairs by block.
    """

    f: np.ndarray
    measured: np.ndarray
    spread: np.ndarray
    names: tuple[str, ...]
    fitted: Data
    held: Data
    rows: dict[str, np.ndarray]
    settings: AxisSettings

    def of_lines(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(n,) pair number, and its position in the order of frequencies."""
        return self.rows[name], self.rows[name].astype(float)


@dataclass(frozen=True, eq=False)
class SensorModel(AxisModel):
    """A mass on a spring, measured by its coil and by a displacement sensor."""

    lines: Channels

    def predicted(self, block: SpectralBlock) -> np.ndarray:
        c, pairs = self.lines, self.lines.rows[block.name]
        rows = (2 * pairs[:, None] + np.arange(2)).ravel()
        s = 2j * np.pi * c.f[rows]
        model = response(c.f[rows], tuple(p.name for p in self.base), self.values[: len(self.base)])
        H = [np.asarray(model[kind], complex) for kind in c.names]
        for one, p in zip(self.effects, self.parts, strict=True):
            assert one.channel is not None
            H = [
                h * one.channel(s, p) if one.location in (kind, "drive") else h
                for kind, h in zip(c.names, H, strict=True)
            ]
        found = np.log(_first_and_ratio(H) / c.measured[rows])
        parts = 1 + np.stack([found.real, found.imag], axis=2).reshape(len(rows), -1)
        return (parts[::2] + 1j * parts[1::2]) / c.spread[pairs][:, None]

    def steps(self) -> np.ndarray:
        least = np.where(np.arange(len(self.values)) < len(self.base), 0.0, 1e-7 / float(self.lines.f[-1]))
        return np.maximum(1e-5 * np.abs(self.values), least)

    def contributions(self, block: SpectralBlock) -> np.ndarray:
        return np.zeros((*block.Y.shape[:2], 1))  # an error that is constant over the band is a gain, which is free


def _first_and_ratio(H: Sequence[np.ndarray]) -> np.ndarray:
    """(n, 1 or 2) the first channel, and the second over the first."""
    return np.stack([H[0], *(one / H[0] for one in H[1:])], axis=1)


def seismometer(
    responses: Responses,
    distortion: np.ndarray | None = None,
    ratio_variance: np.ndarray | None = None,
    settings: AxisSettings = SETTINGS,
) -> Problem:
    """Problem of a seismometer driven by its calibration coil.

    Parameters
    ----------
    responses : coil, displacement or both over the drive. distortion : (n,) r.m.s. of the harmonics of the motion
    itself over its fundamental, which lacks what they contain; zero where unknown. ratio_variance : (n,) relative
    E|error|^2 of the second channel over the first; by default the sum of both variances.

    Raises
    ------
    InputError : wrong shapes, too few frequencies, a ground response. ComputationError : no seismometer fits.
    """
    f = np.asarray(responses.frequency_Hz, float)
    n, least = len(f), settings.frequencies
    if n < least or "ground" in responses.value:
        raise InputError(
            f"expected coil, displacement or both at {least} frequencies or more",
            field="responses",
            value=(n, sorted(responses.value)),
        )
    names = tuple(kind for kind in ("coil", "displacement") if kind in responses.value)
    h = np.zeros(n) if distortion is None else np.asarray(distortion, float).ravel()
    if h.shape != (n,) or not np.all(np.isfinite(h)) or np.any(h < 0):
        raise InputError(f"expected {n} finite numbers, none negative", field="distortion", value=h.shape)
    start = fit_seismometer(responses, delay=False)
    H = [np.asarray(responses.value[kind], complex) for kind in names]
    relative = {kind: np.asarray(responses.variance[kind]) / np.abs(responses.value[kind]) ** 2 for kind in names}
    both = sum(relative.values()) if ratio_variance is None else np.asarray(ratio_variance)
    n -= n % 2
    measured = _first_and_ratio(H)[:n]
    measured_noise, noise = (
        np.repeat(np.maximum(one[::2] + one[1::2], settings.floor**2), 2, axis=1)
        for one in (
            np.stack([relative[names[0]] + harmonic, *([both] if len(H) > 1 else [])], axis=1)[:n] / 2
            for harmonic in (0.0, h**2)
        )
    )
    # A nonlinear mass scatters by as much as its harmonics contain, in addition to the scatter at all frequencies.
    spread = np.sqrt(1 + (h[:n] / max(float(np.median(h)), 1e-12)) ** 2)
    spread = np.sqrt(spread[::2] * spread[1::2])
    measured_noise, noise = measured_noise / spread[:, None] ** 2, noise / spread[:, None] ** 2
    # The minimum over all pairs; the rest is part of the estimated discrepancy, which is equal in all of them.
    noise = np.broadcast_to(noise.min(axis=0), noise.shape)
    pairs, rows, data = np.arange(n // 2), {}, {}
    inner = (pairs % 3 == 1) & (pairs < n // 2 - 1)  # the ends, where effects show most, are fitted
    for name, inside in (("fitted", ~inner), ("held out", inner)):
        at = rows[name] = pairs[inside]
        Y, omega = np.full(2 * len(names), 1 + 1j) / spread[at][:, None], 2 * np.pi * np.sqrt(f[2 * at] * f[2 * at + 1])
        data[name] = Data((block_of(name, omega, Y, noise[at]),), (1.0,))
    lines = Channels(f, measured, spread, names, data["fitted"], data["held out"], rows, settings)
    base = tuple(
        Parameter(name, unit, linear=name not in ("corner_Hz", "damping"))
        for name, unit in zip(start.names, start.information.units, strict=True)
    )
    notes = (
        [f"The highest of the {len(f)} frequencies, {f[-1]:.4g} Hz, is not used: they are evaluated in pairs."]
        if n < len(f)
        else []
    )
    if np.any(h):
        notes.append(
            f"Harmonics of the motion reach {100 * h.max():.2g} % of it at {f[int(np.argmax(h))]:.3g} Hz: this may "
            "be a nonlinear mass or drive, for which the library has no effect."
        )
    outputs = " and ".join(names)
    power = float(np.sum(np.abs(data["held out"].blocks[0].Y) ** 2))
    return Problem(
        "seismometer",
        SensorModel(lines, base, (), np.asarray(start.values, float)),
        sensor_effects(f, names),
        float(np.sum(measured_noise[rows["held out"]])) / power,
        tuple(notes),
        {"F": "", "x": "", "input": "drive", "output": outputs},
    )


HIGHER = "higher frequencies: the phase of a delay stays proportional to them, that of a pole bends"


def sensor_effects(f: np.ndarray, channels: Sequence[str]) -> list[Effect]:
    """The library: delay, lag, mode and high-pass of one channel or of all, and crosstalk."""
    top, low, found = float(f[-1]), float(f[0]), []
    longest = 0.45 / top

    def mode(p: np.ndarray) -> dict[str, tuple[float, str]]:
        w = 1 / np.sqrt(max(p[1], 1e-300))
        return {"frequency_Hz": (w / (2 * np.pi), "Hz"), "damping": (p[0] * w / 2, "1")}

    def heavy(p: np.ndarray) -> str:
        damping = mode(p)["damping"][0]
        return (
            f"a resonance with a damping ratio of {damping:.2g} is no mode" if damping > SETTINGS.mode_damping else ""
        )

    for place in ("drive", *reversed(channels)) if len(channels) > 1 else channels:
        what = f"of the {place}"
        found += [
            # No channel can lead; the drive's column may have been logged late.
            Effect(
                "delay",
                place,
                f"a pure delay {what}",
                (Parameter("delay_s", "s", -longest if place == "drive" else 0.0, longest),),
                HIGHER,
                channel=lambda s, p: np.exp(-s * p[0]),
            ),
            Effect(
                "first_order_lag",
                place,
                f"a first-order lag {what}",
                (Parameter("time_constant_s", "s", 0.0, longest),),
                HIGHER,
                channel=lambda s, p: 1 / (1 + s * p[0]),
            ),
            Effect(
                "mechanical_mode",
                place,
                f"a mechanical mode {what}",
                (
                    Parameter("lag_s", "s", 0.0),
                    Parameter("inverse_square_s2", "s^2", 0.0, (2 * np.pi * 1.05 * top) ** -2),
                ),
                "frequencies up to the mode, where the magnitude rises",
                channel=lambda s, p: 1 / (1 + p[0] * s + p[1] * s**2),
                derived=mode,
                implausible=heavy,
            ),
            Effect(
                "highpass",
                place,
                f"a first-order high-pass (AC coupling) {what}",
                (Parameter("corner_Hz", "Hz", 0.0, 10 * low),),
                "lower frequencies",
                channel=lambda s, p: s / (s + 2 * np.pi * p[0]),
            ),
        ]
    if "displacement" in channels:
        found.append(
            Effect(
                "crosstalk",
                "displacement",
                "a fraction of the velocity in the displacement channel",
                (Parameter("share_s", "s", -longest, longest),),
                "the magnitude at higher frequencies",
                channel=lambda s, p: 1 + s * p[0],
            )
        )
    z = 1 / (2 * np.pi * np.sqrt(low * top))
    found.append(
        Effect(
            "other_dynamics",
            "drive",
            "other dynamics of the mass itself",
            tuple(Parameter(f"c{k}", "1") for k in range(4)),
            channel=lambda s, p: 1 + sum(c * (s * z) ** (k + 1) for k, c in enumerate(p)) / (1 + np.abs(s * z) ** 4),
            outside=True,
        )
    )
    return found


def of_sines(records: Sequence[SineRecord], measured: Sequence[str], driven: str) -> dict[str, Any]:
    """Arguments of `seismometer` from sine records in order of frequency.

    Raises
    ------
    ComputationError : too few frequencies.
    """
    used = distinct(records)
    if len(used) < SETTINGS.frequencies:
        raise ComputationError(
            "too few sine records",
            measured=f"{len(used)} usable frequencies",
            cause="records refused or columns mapped wrongly",
            next_step=f"map the columns; give at least {SETTINGS.frequencies} frequencies",
        )
    at = [used[0].channels.index(role) for role in measured]
    # Distortion in every channel is that of the motion; in one channel alone it is its own noise or hum.
    distortion = np.array([min(float(np.sqrt(np.sum(record.harmonics[j] ** 2))) for j in at) for record in used])
    found: dict[str, Any] = {"responses": responses_of(used, driven, measured), "distortion": distortion}
    if {"coil", "displacement"} <= set(measured):
        ratio = [record.ratio("displacement", "coil") for record in used]
        found["ratio_variance"] = np.array([v / abs(H) ** 2 for H, v in ratio])
    return found
