"""Effect of the level on one mode: a linear model of the mode at two levels, and the differences between them.

    H(s) = r/(s^2 + 2 zeta w s + w^2 + change) + b0 + b1 s,    change = 0 at the lower level

The responses are best linear approximations at each level; their variances include noise and the scatter of nonlinear
distortion (`measurement.frequency_response.best_linear`). A softening spring changes the stiffness alone. Rayleigh
hysteresis (Lord Rayleigh, Phil. Mag. 23 (1887) 225) reduces the stiffness in proportion to the amplitude and adds a
loss of 4/(3 pi) times that reduction, at any frequency. Friction provides less damping at a higher level.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.gap.axis.model import AxisModel, Effect, Parameter, Problem
from avis_ctrl.gap.axis.records import block_of
from avis_ctrl.gap.axis.settings import SETTINGS, AxisSettings
from avis_ctrl.identification.likelihood import Data
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.measurement.frequency_response.best_linear import Transient, best_linear_approximations
from avis_ctrl.measurement.frequency_response.resonance import resonance
from avis_ctrl.measurement.frequency_response.response import FrequencyResponse

RAYLEIGH = 4 / (3 * np.pi)


@dataclass(frozen=True, eq=False)
class TwoLevels:
    """Lines of both levels. high : names of the blocks of the higher level. middle : centre of the band [rad/s]; size :
    r.m.s. response at the lower level."""

    fitted: Data
    held: Data
    high: tuple[str, ...]
    middle: float
    size: float
    settings: AxisSettings

    def of_lines(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(n,) number of a group of neighbouring lines, and position within the band."""
        block = next(one for data in (self.fitted, self.held) for one in data.blocks if one.name == name)
        order = np.arange(len(block.omega))
        return order // 4 + 1000 * (name in self.high), order.astype(float)


@dataclass(frozen=True, eq=False)
class ModeModel(AxisModel):
    """Mode at two levels. Parameters: frequency_Hz, damping, then real and imaginary parts of r, b0 and b1."""

    lines: TwoLevels

    def predicted(self, block: SpectralBlock) -> np.ndarray:
        s, lines, x = 1j * block.omega, self.lines, self.values
        w = 2 * np.pi * x[0]
        r, b0, b1 = x[2:8:2] + 1j * x[3:8:2]
        change: complex | np.ndarray = 0.0
        gain: complex | np.ndarray = 1.0
        if block.name in lines.high:
            for one, p in zip(self.effects, self.parts, strict=True):
                change = change + (one.dynamics(s / w, p) * w**2 if one.dynamics else 0.0)
                gain = gain * (one.path(s / w, p) if one.path else 1.0)
        mode = r * 2j * x[1] * w**2 / (s**2 + 2 * x[1] * w * s + w**2 + change)
        return (gain * lines.size * (mode + b0 + b1 * (block.omega / lines.middle - 1)))[:, None]

    def steps(self) -> np.ndarray:
        return 1e-6 * np.maximum(np.abs(self.values), 1e-3)


def level_effects(scatters: bool) -> list[Effect]:
    """Effects of the level on a mode. The parameters are changes from the lower to the higher level: of stiffness and
    gain as fractions, of damping as a damping ratio. scatters : the response scatters between realisations as much as a
    static nonlinearity of the drive predicts; a gain that follows the level adds no scatter."""
    sweep = "a sine swept slowly up and down about the mode at several levels"
    far = "the response far from every mode at several levels"
    hysteresis = 1 - 1j * RAYLEIGH
    falling = ("saturation", "a drive or a sensor that saturates")
    rising, law = ("dead_zone", "a drive or a sensor with a dead zone"), ""
    if not scatters:
        falling = ("gain_by_level", "a gain of the drive or the sensor that falls with the level")
        rising, law = ("gain_by_level", "a gain of the drive or the sensor that rises with the level"), "rising"

    def mode(change: str, by: Callable[[np.ndarray], Any], name: str, title: str, separated_by: str = sweep) -> Effect:
        parameters = (Parameter(change, "1", 0.0),)
        return Effect(name, "mode", title, parameters, separated_by, dynamics=lambda s, p: p[0] * by(s))

    def gain(change: str, by: complex, name: str, title: str, separated_by: str = far, law: str = "") -> Effect:
        parameters = (Parameter(change, "1", 0.0),)
        return Effect(name, "drive", title, parameters, separated_by, law=law, path=lambda s, p: 1 + by * p[0])

    return [
        mode(
            "stiffness_lost",
            lambda s: -hysteresis,
            "hysteresis",
            "hysteresis, which softens the mode and adds loss as the level rises",
            "the loop of force and displacement at low frequency",
        ),
        mode("stiffness_lost", lambda s: -1, "softening", "a spring that softens as the level rises"),
        mode("stiffness_gained", lambda s: 1, "hardening", "a spring that stiffens as the level rises"),
        mode(
            "damping_ratio_lost",
            lambda s: -2 * s,
            "friction_damping",
            "friction, whose damping falls as the level rises",
        ),
        mode("damping_ratio_gained", lambda s: 2 * s, "quadratic_damping", "a damping that grows with the level"),
        gain("gain_lost", -1, *falling),
        gain("gain_gained", 1, *rising, law=law),
        gain(
            "gain_gained",
            hysteresis,
            "drive_hysteresis",
            "hysteresis of the drive (piezo), whose gain and lag grow with the level",
            "the drive's loop of input and output at low frequency",
        ),
        Effect(
            "other_change",
            "unnamed",
            "another change of the mode with the level",
            tuple(Parameter(name, "1") for name in ("a", "b", "c", "d")),
            dynamics=lambda s, p: (p[0] + 1j * p[1]) + (p[2] + 1j * p[3]) * (s / 1j - 1),
            outside=True,
        ),
    ]


def levels(
    campaign: Campaign,
    band_Hz: tuple[float, float] | None = None,
    transient: Transient = "auto",
    settings: AxisSettings = SETTINGS,
) -> Problem:
    """Problem for the mode that changes most between the lowest and highest level of a campaign of periodic records.

    band_Hz : around one mode; by default around the one that changes most. transient : as in
    `best_linear_approximations`; "none" for steady-state records.

    Raises
    ------
    InputError : fewer than two levels, records that are not periodic, no realisations (noise and distortion cannot be
    separated), no repeated periods, no mode in the band.
    """
    known = sorted({r.header.level_V for r in campaign.records if r.header.level_V})
    if len(known) < 2:
        raise InputError("expected records at two levels at least", field="level_V", value=known)
    found = []
    for level in (known[0], known[-1]):
        # Lines that are too weak for some of the inputs form smaller sets, which are not used.
        one = max(
            best_linear_approximations(campaign, level_V=level, transient=transient),
            key=lambda r: len(r.inputs) * len(r.frequency_Hz),
        )
        if one.distortion is None or one.measurement_noise is None:
            raise InputError(
                "expected repeated periods and more realisations than inputs: without them noise and "
                "distortion are not separated",
                field=f"records at {level:g} V",
            )
        found.append(one)
    low, high = _common(found[0], found[1])
    change = high.value - low.value
    size = np.sqrt(np.mean(np.abs(low.value) ** 2, axis=0))
    variance = np.maximum(low.variance() + high.variance(), 1e-12 * size**2)
    mode, mode_words = _mode(low, high, band_Hz, settings)
    half = max(8 * mode[1] * mode[0], 20 * float(np.median(np.diff(low.frequency_Hz))))
    band = (mode[0] - half, mode[0] + half) if band_Hz is None else band_Hz
    use = (low.frequency_Hz >= band[0]) & (low.frequency_Hz <= band[1])
    if np.count_nonzero(use) < 24:
        raise InputError("expected at least 24 lines in the band around a mode", field="band_Hz", value=band)
    ratio = np.mean(np.abs(change[use]) ** 2, axis=0) / np.mean(np.maximum(variance[use], 1e-300), axis=0)
    i, j = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    whole = float(np.sqrt(np.mean(np.abs(change / size) ** 2)))
    over = float(np.sqrt(np.mean(np.abs(change) ** 2 / variance)))
    notes = (
        f"From {known[0]:g} V to {known[-1]:g} V the responses change by {100 * whole:.3g} % (r.m.s. over all "
        f"entries), {over:.3g} times noise and distortion together.",
        *mode_words,
        f"Fitted: {low.inputs[j]} to {low.outputs[i]}, {band[0]:.5g} to {band[1]:.5g} Hz.",
    )
    realisations = sum(r.header.level_V == known[-1] for r in campaign.records) / len(high.inputs)
    return _problem(low.at(use), high.at(use), (int(i), int(j)), mode, realisations, notes, settings)


def _common(a: FrequencyResponse, b: FrequencyResponse) -> tuple[FrequencyResponse, FrequencyResponse]:
    if (a.inputs, a.outputs) != (b.inputs, b.outputs):
        raise InputError("expected the same channels at both levels", field="inputs", value=(a.inputs, b.inputs))
    both = np.intersect1d(np.round(a.frequency_Hz, 6), np.round(b.frequency_Hz, 6))
    if len(both) < 24:
        raise InputError("expected at least 24 lines that both levels excite", field="records", value=len(both))
    return tuple(r.at(np.isin(np.round(r.frequency_Hz, 6), both)) for r in (a, b))  # type: ignore[return-value]


def _mode(
    low: FrequencyResponse, high: FrequencyResponse, band: tuple[float, float] | None, settings: AxisSettings
) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Frequency [Hz] and damping ratio of the lower-level mode near which the responses change most, and a sentence on
    modes that move. A mode whose shape differs is another mode and has not moved."""
    f = low.frequency_Hz
    loud = 20 * np.log10(np.maximum(np.sqrt(np.sum(np.abs(high.value) ** 2, axis=(1, 2))), 1e-300))
    smooth = signal.savgol_filter(loud, 5, 2)
    peaks, about = signal.find_peaks(smooth, prominence=6.0)  # twice as high as its surroundings
    peaks = peaks[np.argsort(-about["prominences"])][:8]
    if band is not None:
        peaks = np.array(
            [k for k in peaks if band[0] <= f[k] <= band[1]]
            or [int(np.argmax(np.where((f >= band[0]) & (f <= band[1]), loud, -np.inf)))]
        )
    found = []
    for peak in peaks:
        try:
            a, b = resonance(low, float(f[peak])), resonance(high, float(f[peak]))
        except AvisError:
            continue  # no single mode there
        alike = abs(np.vdot(a.residue, b.residue)) / (np.linalg.norm(a.residue) * np.linalg.norm(b.residue))
        moved = abs(b.frequency_Hz - a.frequency_Hz) / max(np.hypot(a.frequency_std_Hz, b.frequency_std_Hz), 1e-300)
        found.append((moved if alike**2 >= settings.same_shape else 0.0, a, b))
    if not found:
        raise InputError("expected a mode that stands out; give a band around one", field="band_Hz", value=band)
    words = [
        f"{a.frequency_Hz:.5g} +- {a.frequency_std_Hz:.2g} Hz to {b.frequency_Hz:.5g} +- "
        f"{b.frequency_std_Hz:.2g} Hz ({100 * (b.frequency_Hz / a.frequency_Hz - 1):+.2g} %)"
        for moved, a, b in sorted(found, key=lambda one: one[1].frequency_Hz)
        if moved > 4
    ]
    size = np.sqrt(np.mean(np.abs(low.value) ** 2, axis=0))
    change = np.sum(np.abs((high.value - low.value) / size) ** 2, axis=(1, 2))
    best = max((a for _, a, _ in found), key=lambda a: change[np.abs(f / a.frequency_Hz - 1) < 2 * a.damping].sum())
    return (best.frequency_Hz, best.damping), (f"Modes move with the level: {'; '.join(words)}.",) if words else ()


def _problem(
    low: FrequencyResponse,
    high: FrequencyResponse,
    entry: tuple[int, int],
    mode: tuple[float, float],
    realisations: float,
    notes: tuple[str, ...],
    settings: AxisSettings,
) -> Problem:
    (i, j), omega, n = entry, 2 * np.pi * low.frequency_Hz, len(low.frequency_Hz)
    size = float(np.sqrt(np.mean(np.abs(low.value[:, i, j]) ** 2)))
    held = np.arange(n) % 3 == 1
    blocks: dict[bool, list[SpectralBlock]] = {False: [], True: []}
    noise = []
    for response, level in ((low, "low"), (high, "high")):
        variance = np.maximum(response.variance()[:, i, j], (settings.floor * size) ** 2)
        for out in (False, True):
            at = held == out
            name = f"{'held out' if out else 'fitted'} {level}"
            blocks[out].append(block_of(name, omega[at], response.value[at, i, j][:, None], variance[at][:, None]))
            if out:
                noise.append(variance[at])
    change = float(np.sqrt(np.mean(np.abs(high.value[:, i, j] - low.value[:, i, j]) ** 2)))
    # Scatter of one realisation; the response is the mean of all.
    scatter = float(np.sqrt(np.mean(np.maximum(high.variance("distortion")[:, i, j], 0.0)) * realisations))
    data = {out: Data(tuple(several), (1.0, 2.0)) for out, several in blocks.items()}
    middle = float(np.sqrt(omega[0] * omega[-1]))
    lines = TwoLevels(data[False], data[True], ("fitted high", "held out high"), middle, size, settings)
    f0, zeta = mode[0], max(mode[1], 1e-4)
    s, w = 1j * omega, 2 * np.pi * f0
    X = np.column_stack([2j * zeta * w**2 / (s**2 + 2 * zeta * w * s + w**2), np.ones(n), omega / middle - 1])
    c = np.linalg.lstsq(X, low.value[:, i, j] / size, rcond=None)[0]
    base = (
        Parameter("frequency_Hz", "Hz", linear=False),
        Parameter("damping", "1", linear=False),
        *(Parameter(f"{name}_{part}", "1") for name in ("r", "b0", "b1") for part in ("real", "imaginary")),
    )
    start = np.concatenate([[f0, zeta], np.stack([c.real, c.imag], axis=1).ravel()])
    whole = float(np.mean([np.mean(np.abs(block.Y) ** 2) for block in data[True].blocks]))

    def ratios(v: Mapping[str, float]) -> dict[str, tuple[float, str]]:
        lost = v.get("stiffness_lost", -v.get("stiffness_gained", 0.0))
        return {"change of the mode's frequency": (100 * (np.sqrt(max(1 - lost, 0.0)) - 1), "%")} if lost else {}

    return Problem(
        "levels",
        ModeModel(lines, base, (), start),
        level_effects(scatter > settings.static * change),
        float(np.mean(noise)) / whole,
        notes,
        {"input": low.inputs[j], "output": low.outputs[i]},
        ratios,
    )


def read_levels(folder: str | Path, sample_rate_Hz: float | None, y_unit: str = "m") -> Campaign:
    """Read records from u_*.npy and y_*.npy, samples of a period x channels x realisations x periods. The file name
    contains the level in mV (u_100mV_train.npy). The records are assumed to be in steady state.

    Raises
    ------
    InputError : a missing folder, partner file or level; arrays that do not fit; no sample rate.
    """
    folder = Path(folder)
    files = sorted(folder.glob("u_*.npy")) if folder.is_dir() else []
    if not files:
        raise InputError("expected a folder with u_*.npy and y_*.npy", file=folder)
    if sample_rate_Hz is None or not (np.isfinite(sample_rate_Hz) and sample_rate_Hz > 0):
        raise InputError(
            "missing; expected the sample rate in Hz (--sample-rate), because .npy files hold none",
            file=folder,
            field="sample_rate_Hz",
            value=sample_rate_Hz,
        )
    records: list[Record] = []
    for file in files:
        level = re.search(r"(\d+(?:\.\d+)?)\s*mV", file.name)
        partner = file.with_name("y" + file.name[1:])
        if level is None:
            raise InputError("expected the level in the name, such as u_100mV.npy", file=file)
        if not partner.is_file():
            raise InputError("expected it beside u_*.npy", file=partner)
        u, y = (_loaded(one) for one in (file, partner))
        if u.shape[0] != y.shape[0] or u.shape[2:] != y.shape[2:]:
            raise InputError(
                f"expected samples, realisations and periods of {file.name}, {u.shape}",
                file=partner,
                field="shape",
                value=y.shape,
            )
        records += _records(float(level.group(1)), u, y, float(sample_rate_Hz), y_unit)
    return Campaign(folder.name, tuple(records))


def _loaded(file: Path) -> np.ndarray:
    try:
        x = np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"expected an array: {error}".splitlines()[0], file=file) from None
    if x.ndim != 4 or x.dtype.kind not in "fiu" or not np.all(np.isfinite(x)):
        raise InputError(
            "expected finite numbers, samples x channels x realisations x periods",
            file=file,
            field="shape",
            value=x.shape,
        )
    return x.astype(float)


def _records(level_mV: float, u: np.ndarray, y: np.ndarray, rate: float, y_unit: str) -> list[Record]:
    n, count, periods = u.shape[0], u.shape[2], u.shape[3]
    found = []
    for k in range(count):
        header = RecordHeader(
            f"{level_mV:g}mV_{k}",
            rate,
            n * periods,
            tuple(f"u{j + 1}" for j in range(u.shape[1])),
            tuple(f"y{j + 1}" for j in range(y.shape[1])),
            "multisine",
            level_mV / 1000,
            period_s=n / rate,
            y_unit=y_unit,
        )
        found.append(Record(header, *(x[:, :, k, :].transpose(2, 0, 1).reshape(n * periods, -1) for x in (u, y))))
    return found
