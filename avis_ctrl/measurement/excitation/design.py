"""Excitation signals for a rig: random-phase multisines for several inputs, and band-limited noise.

A multisine is a sum of cosines at integer multiples of 1/period. Over whole periods there is no leakage, and the
response on lines that are not excited is noise or nonlinear distortion (Pintelon and Schoukens, System Identification,
2nd ed., 2012, chapters 4 and 5). The responses to several inputs are separated in one of two ways:

orthogonal : n_u experiments with U(k) = diag(A(k) exp(j phi(k))) T, where T is an orthogonal matrix with entries of
    modulus one (Dobrowiecki and Schoukens, Automatica 43 (2007), pp. 38-46): every input drives every line with its own
    amplitude in every experiment. T is a Hadamard matrix if n_u is a power of two, otherwise the DFT matrix.
zippered : one experiment, in which the lines are assigned to the inputs in turn. Each realisation shifts the assignment
    by one place, so that in n_u realisations every input drives every line once.

Crest factor. T only fixes how the spectra of an input are related between experiments. The phases phi of each input are
free and do not affect orthogonality. With a Hadamard matrix the signal of an input only changes sign between
experiments, so that one optimisation serves all experiments at no loss. With the DFT matrix its phases are rotated by a
constant from one experiment to the next, and the highest peak over all rotations is minimised: about 1.55 to 1.6 for
flat spectra, compared with 1.4 for a single signal.

The optimised signals are no longer Gaussian in distribution. The best linear approximation of a nonlinear rig depends
on the distribution, and is then valid for signals of this kind.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from scipy.linalg import dft, hadamard

from avis_ctrl.checks import require_positive, require_whole
from avis_ctrl.errors import InputError
from avis_ctrl.measurement.excitation.crest_factor import crest_factor, low_crest_phases, synthesise

Lines = Literal["full", "odd", "odd_detection"]
Scheme = Literal["orthogonal", "zippered"]


@dataclass(frozen=True)
class SizeSettings:
    """most_voltages : maximum of samples times drives times records: 1 GiB."""

    most_voltages: int = 2**27


SETTINGS = SizeSettings()


@dataclass(frozen=True, eq=False)
class ExcitationSignals:
    """Voltage signals to be played.

    Attributes
    ----------
    settings : of the design, with the r.m.s. voltage of the signals; they reproduce the signals.
    u : (records, samples, n_u) V, held between samples; one period of a multisine, to be repeated.
    crest_before : (records, n_u) crest factor with the initial random phases.
    """

    settings: MultisineSettings | NoiseSettings
    u: np.ndarray
    crest_before: np.ndarray

    @property
    def period_s(self) -> float | None:
        """Period of a multisine; None for noise."""
        return self.settings.period_s if isinstance(self.settings, MultisineSettings) else None

    @property
    def kind(self) -> str:
        """ "multisine" or "noise"."""
        return "noise" if self.period_s is None else "multisine"

    def stated(self) -> dict[str, Any]:
        """The settings as numbers, strings and lists, for files."""
        values = {
            name: value.item() if isinstance(value, np.generic) else value
            for name, value in vars(self.settings).items()
        }
        return values | {"inputs": list(self.settings.inputs), "band_Hz": [float(f) for f in self.settings.band_Hz]}

    @property
    def rms_V(self) -> np.ndarray:
        """(records, n_u) r.m.s. voltage."""
        return np.sqrt(np.mean(self.u**2, axis=1))

    @property
    def peak_V(self) -> np.ndarray:
        """(records, n_u) maximum absolute voltage."""
        return np.max(np.abs(self.u), axis=1)

    @property
    def crest(self) -> np.ndarray:
        """(records, n_u) crest factor as designed."""
        return crest_factor(np.moveaxis(self.u, 1, -1))

    def scaled_to(self, rms_V: float | None = None) -> ExcitationSignals:
        """The same signals at another level: the same r.m.s. for every input, by default the largest possible.

        Raises
        ------
        InputError : a level that needs more than limit_V; the message gives the largest possible level.
        """
        limit_V = self.settings.limit_V
        largest = float(limit_V / np.max(self.crest))
        rms_V = largest if rms_V is None else rms_V
        require_positive(rms_V, "rms_V")
        if rms_V > largest * (1 + 1e-12):
            message = (
                f"expected at most {largest:.6g} V r.m.s.: with a crest factor of {limit_V / largest:.3f} more "
                f"would exceed the limit of {limit_V:g} V"
            )
            raise InputError(message, field="rms_V", value=rms_V)
        # Round-off must not push the peak beyond the limit.
        u = np.clip(self.u * (rms_V / self.rms_V[:, None, :]), -limit_V, limit_V)
        return replace(self, u=u, settings=replace(self.settings, rms_V=float(rms_V)))


@dataclass(frozen=True)
class MultisineSettings:
    """Specification of a multisine.

    Attributes
    ----------
    inputs : names of the drives, in order.
    sample_rate_Hz, period_s : their product must be a whole number of samples.
    band_Hz : lowest and highest frequency, ends included; the highest must be below half the sample rate.
    limit_V : maximum voltage.
    rms_V : r.m.s. of every input; None for the largest value that the limit allows.
    lines : "full" every line, "odd" odd lines only, "odd_detection" odd lines, of which one per group of consecutive
        odd lines is left out at random.
    spacing : the lines are multiples (odd multiples) of spacing/period; the lines between them show noise.
    group : number of odd lines in a group, of which one is left out.
    scheme : how the responses to the inputs are separated, see above.
    realisations : number of independent draws of the phases; the lines are the same in all realisations.
    dealt : number of places by which the assignment of zippered lines is shifted in the first realisation.
    compensate_hold : divide the amplitudes by the sinc of the zero-order hold, so that the spectrum of the held voltage
        is flat, not that of its samples.
    low_crest : minimise the crest factor; False keeps the initial random phases.
    seed : seed of all random numbers.

    Raises
    ------
    InputError : a value outside its range, more voltages than fit into memory.
    """

    inputs: tuple[str, ...]
    sample_rate_Hz: float
    period_s: float
    band_Hz: tuple[float, float]
    limit_V: float
    rms_V: float | None = None
    lines: Lines = "full"
    spacing: int = 1
    group: int = 4
    scheme: Scheme = "orthogonal"
    realisations: int = 1
    dealt: int = 0
    compensate_hold: bool = False
    low_crest: bool = True
    seed: int = 1

    def __post_init__(self) -> None:
        _check_common(self)
        require_positive(self.period_s, "period_s")
        samples = self.period_s * self.sample_rate_Hz
        if abs(samples - round(samples)) > 1e-6 * samples or round(samples) < 4:
            message = f"expected a whole number of samples, at least 4; at {self.sample_rate_Hz:g} Hz it is"
            raise InputError(f"{message} {samples:.6g}", field="period_s", value=self.period_s)
        for name, known in (("lines", get_args(Lines)), ("scheme", get_args(Scheme))):
            if getattr(self, name) not in known:
                raise InputError(f"expected one of {', '.join(known)}", field=name, value=getattr(self, name))
        for name, least in (("spacing", 1), ("group", 2), ("realisations", 1), ("dealt", 0)):
            require_whole(getattr(self, name), name, least)
        experiments = len(self.inputs) if self.scheme == "orthogonal" else 1
        _check_size(self.realisations * experiments * len(self.inputs) * self.samples, "period_s, realisations")

    @property
    def samples(self) -> int:
        """Samples per period."""
        return round(self.period_s * self.sample_rate_Hz)

    def grid(self) -> np.ndarray:
        """(n,) numbers of the lines inside the band, including detection lines."""
        low, high = (frequency * self.period_s for frequency in self.band_Hz)
        k = np.arange(int(np.ceil(low * (1 - 1e-9))), int(np.floor(high * (1 + 1e-9))) + 1)
        k = k[(k > 0) & (k % self.spacing == 0) & (2 * k < self.samples)]
        return k if self.lines == "full" else k[(k // self.spacing) % 2 == 1]


def multisine(settings: MultisineSettings) -> ExcitationSignals:
    """Design a multisine: n_u records per realisation for the orthogonal scheme, one for the zippered scheme.

    Raises
    ------
    InputError : a band that leaves an input without lines, a level beyond the limit.
    """
    rng, n_u, N = np.random.default_rng(settings.seed), len(settings.inputs), settings.samples
    lines, _ = choose_lines(settings, rng)
    amplitude = np.ones(lines.size) / (np.sinc(lines / N) if settings.compensate_hold else 1.0)
    T = orthogonal_matrix(n_u) if settings.scheme == "orthogonal" else np.ones((1, 1))
    u, before = [], []
    for r in range(settings.realisations):
        record, drawn = np.zeros((len(T), N, n_u)), np.zeros((len(T), N, n_u))
        for i in range(n_u):
            own = slice(None) if settings.scheme == "orthogonal" else slice((i + r + settings.dealt) % n_u, None, n_u)
            turns = np.angle(T[:, i]) if settings.scheme == "orthogonal" else np.zeros(1)
            record[:, :, i], drawn[:, :, i] = _one_input(lines[own], amplitude[own], turns, N, settings.low_crest, rng)
        u.append(record)
        before.append(drawn)
    crest_before = crest_factor(np.moveaxis(np.concatenate(before), 1, -1))
    return ExcitationSignals(settings, np.concatenate(u), crest_before).scaled_to(settings.rms_V)


def _one_input(
    lines: np.ndarray, amplitude: np.ndarray, turns: np.ndarray, samples: int, low_crest: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(experiments, samples) of one input of unit r.m.s., with low crest factor and with the initial random phases."""
    amplitude = amplitude / np.sqrt(np.sum(amplitude**2) / 2)
    drawn = rng.uniform(0, 2 * np.pi, lines.size)
    # A rotation by pi only changes the sign, not the peak.
    different = np.unique(np.round(turns % np.pi, 9) % np.round(np.pi, 9))
    phase = low_crest_phases(lines, amplitude, drawn, samples, different) if low_crest else drawn
    return (
        synthesise(lines, amplitude, phase + turns[:, None], samples),
        synthesise(lines, amplitude, drawn + turns[:, None], samples),
    )


def choose_lines(settings: MultisineSettings, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the excited lines and of the detection lines, ascending."""
    grid = settings.grid()
    left_out = np.zeros(grid.size, bool)
    if settings.lines == "odd_detection":
        # An incomplete last group keeps all its lines.
        starts = np.arange(0, grid.size - settings.group + 1, settings.group)
        left_out[starts + rng.integers(settings.group, size=starts.size)] = True
    lines = grid[~left_out]
    least = len(settings.inputs) if settings.scheme == "zippered" else 1
    if lines.size < least:
        apart = f"{settings.spacing / settings.period_s:g} Hz apart ({settings.lines})"
        message = f"expected a band with at least {least} lines {apart}; it has {lines.size}"
        raise InputError(message, field="band_Hz", value=settings.band_Hz)
    return lines, grid[left_out]


def orthogonal_matrix(n: int) -> np.ndarray:
    """(n, n) T with T T^H = n I and entries of modulus one: Hadamard if n is a power of two, otherwise DFT."""
    return hadamard(n).astype(float) if n & (n - 1) == 0 else dft(n)


@dataclass(frozen=True)
class NoiseSettings:
    """Settings of Gaussian noise, flat inside band_Hz and zero outside; other fields as in `MultisineSettings`.

    records : number of independent records; duration_s : duration of each record.
    """

    inputs: tuple[str, ...]
    sample_rate_Hz: float
    duration_s: float
    band_Hz: tuple[float, float]
    limit_V: float
    rms_V: float | None = None
    records: int = 1
    seed: int = 1

    def __post_init__(self) -> None:
        _check_common(self)
        require_positive(self.duration_s, "duration_s")
        require_whole(self.records, "records", 1)
        _check_size(self.records * len(self.inputs) * self.duration_s * self.sample_rate_Hz, "duration_s, records")


def noise(settings: NoiseSettings) -> ExcitationSignals:
    """Independent noise for every input and record, synthesised from Fourier lines so that the band has sharp edges.

    Raises
    ------
    InputError : a record too short for a line inside the band, a level beyond the limit (noise peaks at 4 to 5 times
        its r.m.s.).
    """
    rng, N = np.random.default_rng(settings.seed), round(settings.duration_s * settings.sample_rate_Hz)
    if N < 4:
        raise InputError("expected at least 4 samples", field="duration_s", value=settings.duration_s)
    shape = N, settings.sample_rate_Hz, settings.band_Hz, len(settings.inputs)
    u = np.array([band_limited(*shape, rng) for _ in range(settings.records)])
    u = u / np.sqrt(np.mean(u**2, axis=1, keepdims=True))
    return ExcitationSignals(settings, u, crest_factor(np.moveaxis(u, 1, -1))).scaled_to(settings.rms_V)


def band_limited(
    samples: int, sample_rate_Hz: float, band_Hz: tuple[float, float], channels: int, rng: np.random.Generator
) -> np.ndarray:
    """(samples, channels) independent Gaussian noise of unit variance, flat inside the band, zero outside it."""
    frequency = np.fft.rfftfreq(samples, 1 / sample_rate_Hz)
    inside = (frequency >= band_Hz[0] * (1 - 1e-9)) & (frequency <= band_Hz[1] * (1 + 1e-9)) & (frequency > 0)
    inside &= 2 * np.arange(frequency.size) < samples
    if not np.any(inside):
        message = f"expected a band with a multiple of 1/duration = {sample_rate_Hz / samples:.4g} Hz inside"
        raise InputError(message, field="band_Hz", value=band_Hz)
    spectrum = np.zeros((frequency.size, channels), complex)
    draw = rng.standard_normal((2, np.count_nonzero(inside), channels))
    spectrum[inside] = (draw[0] + 1j * draw[1]) * samples / (2 * np.sqrt(np.count_nonzero(inside)))
    return np.fft.irfft(spectrum, samples, axis=0)


def _check_common(settings: MultisineSettings | NoiseSettings) -> None:
    """Checks that apply to multisines and noise."""
    inputs, rate, band_Hz = settings.inputs, settings.sample_rate_Hz, settings.band_Hz
    if not inputs or len(set(inputs)) != len(inputs):
        raise InputError("expected at least one drive, with different names", field="inputs", value=inputs)
    require_positive(rate, "sample_rate_Hz")
    require_positive(settings.limit_V, "limit_V")
    if settings.rms_V is not None:
        require_positive(settings.rms_V, "rms_V")
    require_whole(settings.seed, "seed", 0)
    if len(band_Hz) != 2 or not (np.all(np.isfinite(band_Hz)) and 0 < band_Hz[0] <= band_Hz[1] < rate / 2):
        message = (
            f"expected two frequencies above 0 and below half the sample rate ({rate / 2:g} Hz), the lower one first"
        )
        raise InputError(message, field="band_Hz", value=tuple(band_Hz))


def _check_size(voltages: float, field: str) -> None:
    if voltages > SETTINGS.most_voltages:
        message = f"expected at most {SETTINGS.most_voltages} voltages in all records and drives, which fit into memory"
        raise InputError(f"{message}; there would be {voltages:.3g}", field=field)
