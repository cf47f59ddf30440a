"""Levels of floor motion and sensor noise, compared with the ambient levels in the rig file.

Sensor noise: variance of each channel on quiet lines far above the modes, where the mounts transmit no floor motion.

Floor: on quiet lines e = G v + n with G (n_y, 3) of the model and n with the variance D of the sensor noise, so that

    v_hat = (G^H D^-1 G)^-1 G^H D^-1 e,    E|v_hat|^2 = S_v + diag (G^H D^-1 G)^-1

gives the density S_v of each direction without bias, whatever its shape (generalised least squares). Above about 15 Hz
the mounts hide the floor from the sensors; there a power law fitted at lower frequencies is extrapolated, with its
uncertainty. The part of e outside the range of G, which the floor cannot explain, shows whether the source is the floor
at all.

The floor's power must not depend on u. It is modelled as S + c L^2 in the level L of the records, c >= 0, if c is
significant: model errors and distortion vanish as L goes to 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import norm

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.signals.converter import nominal_converter
from avis_ctrl.gap.signals.hum import HumFinding, polluted
from avis_ctrl.gap.signals.noise_lines import QuietLines, quiet_lines
from avis_ctrl.gap.signals.record_residual import HANN_SHARED, RecordResidual
from avis_ctrl.rigs.rig import Rig

FloorResponse = Callable[[np.ndarray], np.ndarray]
# What `_floor_lines` returns.
FloorLines = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]


@dataclass(frozen=True)
class NoiseLevelSettings:
    """Settings of the levels of floor motion and sensor noise.

    floor_band_Hz : band of the floor's level [Hz]: that of the rig file's `[ambient]`.
    sensor_band : band of the sensor noise, in fractions of the sample rate [1]: 100 Hz to 490 Hz at 1 kHz, where no
        table moves.
    significant : standard errors above ambient that count as significant [1]: 2e-4 one-sided, for three directions and
        their mean.
    seen_factor : r.m.s. in the band where sensors detect the floor over the ambient figure for the whole band, from
        which the floor is clearly above ambient [1]: no shape of an ambient spectrum explains that; a smaller factor
        could be due to a model error of a few per cent.
    total_factor : the same for the whole band, with a power law [1]: an ambient floor that is flat where it is detected
        and ends there would be estimated at sqrt(59.5 / 14.5) = 2.0 times its value.
    sensor_factor : sensor noise over the expected value, from which it counts as raised [1]: a converter without
        dither, or noise that is not quite white, has a smaller effect.
    foreign : fraction of the excess outside the range of G above which it is not the floor [1]; a force at any place
        would have a half.
    bands_per_octave : bands per octave.
    seen : a direction is detected if the density's error is below this fraction of a white ambient floor's density [1],
        plus half of the estimate.
    narrowest_Hz : narrowest band [Hz]: a few lines of a record of 20 s.
    line : power outside the range of G over its median in the band, above which a line is not due to the floor [1]; a
        gamma distribution of shape 3 exceeds 20 times its median with probability 1e-20.
    """

    floor_band_Hz: tuple[float, float] = (0.5, 60.0)
    sensor_band: tuple[float, float] = (0.1, 0.49)
    significant: float = 3.5
    seen_factor: float = 1.25
    total_factor: float = 2.0
    sensor_factor: float = 1.15
    foreign: float = 0.25
    bands_per_octave: int = 3
    seen: float = 0.5
    narrowest_Hz: float = 0.4
    line: float = 20.0


SETTINGS = NoiseLevelSettings()


@dataclass(frozen=True, eq=False)
class FloorLevel:
    """Velocity of the floor where it was not measured.

    rms : of x, y and z, and their "mean", in 0.5-60 Hz, with a power law beyond `seen_to_Hz`. seen : from 0.5 Hz to
    seen_to_Hz only. ambient : of the rig file [m/s].
    foreign : fraction of the excess over sensor noise that no floor motion explains, 0 to 1.
    """

    rms: dict[str, Reported]
    seen: dict[str, Reported]
    seen_to_Hz: dict[str, float]
    ambient: float
    foreign: float

    @property
    def parameters(self) -> dict[str, Reported]:
        """ "velocity_rms" (mean over directions) and "velocity_rms_x" ... [m/s] in 0.5-60 Hz."""
        return {"velocity_rms" if axis == "mean" else f"velocity_rms_{axis}": one for axis, one in self.rms.items()}

    @property
    def excess(self) -> float:
        """Standard errors by which the highest of five estimates exceeds ambient."""
        highest = (self.rms["mean"], *self.seen.values())
        return max((one.value - self.ambient) / max(one.std, 1e-30) for one in highest)

    @property
    def clear(self) -> bool:
        """Whether the floor is above ambient by a clear factor."""
        return any(
            one.value > factor * self.ambient and one.value - SETTINGS.significant * one.std > self.ambient
            for found, factor in ((self.seen, SETTINGS.seen_factor), (self.rms, SETTINGS.total_factor))
            for one in found.values()
        )

    @property
    def confidence(self) -> float:
        """1 - p, p an upper bound on the probability of estimates as high as these if the floor is at ambient."""
        return 1 - min(5 * float(norm.sf(self.excess)), 1.0)

    @property
    def sentence(self) -> str:
        """The finding in one sentence."""
        m, seen = self.rms["mean"], self.seen["mean"]
        each = ", ".join(f"{axis} {1e6 * self.rms[axis].value:.3g}" for axis in "xyz")
        return (
            f"The unmeasured floor moves by {1e6 * m.value:.3g} +- {1e6 * m.std:.2g} um/s r.m.s. in 0.5-60 Hz"
            f" ({each}), {m.value / self.ambient:.3g} times the rig file's ambient {1e6 * self.ambient:.3g} um/s;"
            f" {1e6 * seen.value:.3g} +- {1e6 * seen.std:.2g} um/s of it are measured, up to "
            f"{min(self.seen_to_Hz.values()):.3g} Hz; the rest is extrapolated (power law)."
        )


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Levels of floor motion and sensor noise, and sensors above ambient.

    floor : None if every record has it measured, or no line shows it. sensors : r.m.s. of each channel including its
        converter's rounding, at the lowest level of the drives. raised : sensors above ambient, which is no effect of
        the library.
    """

    floor: FloorLevel | None
    sensors: dict[str, Reported]
    raised: tuple[str, ...]

    @property
    def ground_motion(self) -> FloorLevel | None:
        """The floor if it moves clearly more than stated in the rig file, and the source is the floor."""
        floor = self.floor
        above = floor is not None and floor.excess > SETTINGS.significant and floor.clear
        return floor if floor and above and floor.foreign <= SETTINGS.foreign else None


def noise_levels(
    residuals: Sequence[RecordResidual],
    floor_response: FloorResponse,
    rig: Rig,
    hum: HumFinding | None = None,
    steps_V: dict[str, float] | None = None,
) -> NoiseLevels:
    """Levels of floor motion and sensor noise, and which of them are above the rig's [ambient].

    Parameters
    ----------
    residuals : y minus the prediction, which should include the floor of records that have it measured.
    floor_response : omega (n,) rad/s -> (n, n_y, 3), unit of y per m/s; for a ResponseModel the last three columns of
        `response`.
    hum : lines to leave out. steps_V : resolution of channels whose converter was found coarser.

    Raises
    ------
    InputError : a rig file without [ambient], or too few quiet lines for the sensor noise.
    """
    first = residuals[0].header
    ambient = getattr(rig, "ambient", None)
    if ambient is None:
        raise InputError("the rig file does not say what is normal on site", field="ambient")
    masks = (
        None if hum is None else [polluted(hum, one.header.samples, one.header.sample_rate_Hz, 4) for one in residuals]
    )
    rate = first.sample_rate_Hz
    high = quiet_lines(residuals, (SETTINGS.sensor_band[0] * rate, SETTINGS.sensor_band[1] * rate), False, masks)
    if not any(len(one.left) for one in high):
        raise InputError(
            "expected lines that hold noise alone, above a tenth of the sample rate; records are too short"
            " to estimate the noise",
            field="residuals",
        )
    sensors = _sensor_noise(high, first.y_names, first.y_unit)
    lsb = {name: (steps_V or {}).get(name, nominal_converter(rig).lsb_V) for name in first.y_names}
    expected = {name: float(np.hypot(ambient.sensor_noise_rms_V, lsb[name] / np.sqrt(12))) for name in first.y_names}
    raised = tuple(
        name
        for name in first.y_names
        if sensors[name].value > SETTINGS.sensor_factor * expected[name]
        and sensors[name].value - SETTINGS.significant * sensors[name].std > expected[name]
    )
    unknown = [k for k, one in enumerate(residuals) if not one.header.floor_names]
    floor = None
    if unknown:
        low = quiet_lines(
            [residuals[k] for k in unknown],
            SETTINGS.floor_band_Hz,
            True,
            None if masks is None else [masks[k] for k in unknown],
        )
        D = np.array([sensors[name].value ** 2 for name in first.y_names])
        floor = _floor(low, floor_response, D, ambient.floor_velocity_rms_m_per_s, rate)
    return NoiseLevels(floor, sensors, raised)


def _sensor_noise(high: Sequence[QuietLines], names: tuple[str, ...], unit: str) -> dict[str, Reported]:
    """From the records at the lowest level: distortion and model error raise the noise of others."""
    some = [one for one in high if len(one.left)]
    least = min(one.level for one in some)
    quiet = [one for one in some if one.level <= 1.05 * least]
    power = np.concatenate([one.power for one in quiet])
    weight = np.concatenate([one.left for one in quiet])
    rms = np.sqrt(weight @ power / weight.sum())
    std = rms / 2 * np.sqrt(HANN_SHARED / weight.sum())
    return {name: Reported(float(a), float(s), unit) for name, a, s in zip(names, rms, std, strict=True)}


def _floor(
    low: Sequence[QuietLines], floor_response: FloorResponse, D: np.ndarray, ambient: float, rate: float
) -> FloorLevel | None:
    """Level of the floor from v_hat of every line, band by band."""
    edges = _edges()
    count = len(edges) - 1
    estimated = [_floor_lines(one, floor_response, D) for one in low if len(one.left)]
    if not estimated:
        return None
    white = ambient**2 / (SETTINGS.floor_band_Hz[1] - SETTINGS.floor_band_Hz[0]) * rate / 2
    S, std = np.full((count, 3), np.nan), np.full((count, 3), np.inf)
    louder, foreign = _foreign(estimated, edges, len(D) - 3)
    for b in range(count):
        rows = [r for r in (_band(one, edges[b], edges[b + 1], white, louder[b]) for one in estimated) if r is not None]
        if rows:
            S[b], std[b] = _at_zero_level(rows)
    # Variance per line to one-sided density.
    S, std = S * 2 / rate, std * 2 / rate
    visible = std < SETTINGS.seen * white * 2 / rate + 0.5 * np.maximum(np.nan_to_num(S), 0.0)
    return _level(S, std, visible, edges, ambient, foreign)


def _foreign(estimated: Sequence[FloorLines], edges: np.ndarray, n_out: int) -> tuple[np.ndarray, float]:
    """Noise outside the range of G over sensor noise (bands,), at least 1, and the fraction of the excess that it is.

    The fraction is the mean over bands that contain more than noise. The median in each band is robust against the few
    lines on a resonance; that of a gamma distribution is its shape minus 1/3.
    """
    louder, shares = np.ones(len(edges) - 1), []
    f, parallel, outside = (np.concatenate([one[k] for one in estimated]) for k in (0, 3, 4))
    for b, (low, high) in enumerate(pairwise(edges)):
        band = (f >= low) & (f < high)
        if n_out < 1 or np.count_nonzero(band) < 10:
            continue
        inside, beyond = (
            max(float(np.median(p[band])) / (n - 1 / 3) - 1, 0.0) for p, n in ((parallel, 3), (outside, n_out))
        )
        louder[b] += beyond
        if inside + beyond > 1:
            shares.append(beyond / (inside + beyond))
    return louder, float(np.mean(shares)) if shares else 0.0


def _edges() -> np.ndarray:
    """Band edges: `bands_per_octave`, with no band narrower than `narrowest_Hz`."""
    edges = [SETTINGS.floor_band_Hz[0]]
    while edges[-1] < SETTINGS.floor_band_Hz[1] * 0.9:
        edges.append(max(edges[-1] * 2 ** (1 / SETTINGS.bands_per_octave), edges[-1] + SETTINGS.narrowest_Hz))
    return np.array([*edges[:-1], SETTINGS.floor_band_Hz[1]])


def _floor_lines(one: QuietLines, floor_response: FloorResponse, D: np.ndarray) -> FloorLines:
    """frequency, |v_hat|^2 and its noise (n, 3), e^H D^-1 e inside and outside the range of G (n,); left, level."""
    G = floor_response(2 * np.pi * one.frequency_Hz)
    W = np.conj(G.swapaxes(1, 2)) / D
    covariance = np.linalg.inv(W @ G)
    v = (covariance @ (W @ one.e[:, :, None]))[:, :, 0]
    fitted = (G @ v[:, :, None])[:, :, 0]
    # Scaled by the noise variances of the channels, so that the projections have unit noise.
    inside = np.sum(np.abs(fitted) ** 2 / D, axis=1) / one.left
    outside = np.sum(np.abs(one.e - fitted) ** 2 / D, axis=1) / one.left
    noise = np.real(np.einsum("nii->ni", covariance))
    return one.frequency_Hz, np.abs(v) ** 2 / one.left[:, None], noise, inside, outside, one.left, one.level


def _band(
    one: FloorLines, low: float, high: float, white: float, louder: float
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """S (3,), its variance, and the record's level; None with fewer than four lines."""
    f, power, noise, _, outside, fraction, level = one
    inside = (f >= low) & (f < high)
    if np.count_nonzero(inside) < 4:
        return None
    # Machine or mains lines in the sensor signals stand out in the part that is not floor motion.
    inside &= outside <= SETTINGS.line * np.median(outside[inside])
    # Noise from other sources is assumed as large inside the range of G as outside it, relative to sensor noise.
    P, N, h = power[inside], louder * noise[inside], fraction[inside][:, None]
    S = np.full(3, white)
    for _ in range(3):
        w = h / (S + N) ** 2
        S = np.maximum(np.sum(w * (P - N), axis=0) / w.sum(axis=0), 0.25 * white)
    total = w.sum(axis=0)
    raw = np.sum(w * (P - N), axis=0) / total
    return raw, np.sum(w**2 * (S + N) ** 2 / h, axis=0) / total**2 * HANN_SHARED, level


def _at_zero_level(rows: list[tuple[np.ndarray, np.ndarray, float]]) -> tuple[np.ndarray, np.ndarray]:
    """S (3,) and its standard error from S + c L^2 over the records, with c only if it exceeds twice its error."""
    value, variance = np.stack([r[0] for r in rows]), np.stack([r[1] for r in rows])
    # A record's variance contains its own estimate; the median of all is more stable and does not favour low estimates.
    steady = np.maximum(np.median(variance, axis=0), 1e-300) * np.ones((len(rows), 1))
    L2 = np.array([r[2] for r in rows]) ** 2
    S, std = np.zeros(3), np.zeros(3)
    for j in range(3):
        w = 1 / steady[:, j]
        S[j], std[j] = np.sum(w * value[:, j]) / w.sum(), 1 / np.sqrt(w.sum())
        if np.ptp(L2) > 0:
            A = np.column_stack([np.ones(len(L2)), L2 / L2.max()])
            # Records with a large scatter, mostly due to model error, have less weight here.
            w = 1 / np.maximum(variance[:, j], steady[:, j])
            covariance = np.linalg.inv((A.T * w) @ A)
            c = covariance @ (A.T @ (w * value[:, j]))
            if c[1] > 2 * np.sqrt(covariance[1, 1]):
                S[j], std[j] = c[0], np.sqrt(covariance[0, 0])
    return S, std


def _level(
    S: np.ndarray, std: np.ndarray, visible: np.ndarray, edges: np.ndarray, ambient: float, foreign: float
) -> FloorLevel | None:
    width, centre = np.diff(edges), np.sqrt(edges[1:] * edges[:-1])
    # Mean square of each direction, and its variance.
    seen, whole, ends = np.zeros((3, 2)), np.zeros((3, 2)), {}
    for j, axis in enumerate("xyz"):
        m = int(np.argmin(np.append(visible[:, j], False)))
        if m < 3:
            return None
        ends[axis] = float(edges[m])
        seen[j] = np.sum(S[:m, j] * width[:m]), np.sum((std[:m, j] * width[:m]) ** 2)
        tail, tail_std = _tail(centre[:m], S[:m, j], std[:m, j], edges[m])
        whole[j] = seen[j] + (tail, tail_std**2)
    return FloorLevel(_rms(whole), _rms(seen), ends, ambient, foreign)


def _rms(squares: np.ndarray) -> dict[str, Reported]:
    """R.m.s. velocities from the mean squares of x, y and z with their variances (3, 2); their "mean" first."""
    found, mean = {}, (squares[:, 0].mean(), squares[:, 1].sum() / 9)
    for axis, (square, variance) in zip(("mean", *"xyz"), (mean, *squares), strict=True):
        rms = np.sqrt(max(square, 1e-30))
        found[axis] = Reported(float(rms), float(np.sqrt(variance) / (2 * rms)), "m/s")
    return found


def _tail(f: np.ndarray, S: np.ndarray, std: np.ndarray, end: float) -> tuple[float, float]:
    """Power above `end` of a power law a f^-s fitted below, and its standard error, averaged over slopes that fit."""
    if end >= SETTINGS.floor_band_Hz[1] * (1 - 1e-9):
        return 0.0, 0.0
    slopes = np.linspace(0.0, 6.0, 61)
    shape = f[None, :] ** -slopes[:, None]
    x = np.geomspace(end, SETTINGS.floor_band_Hz[1], 200)
    integral = np.trapezoid(x[None, :] ** -slopes[:, None], x, axis=1)
    w = 1 / std**2
    a_var = 1 / (shape**2 @ w)
    a = np.maximum((shape * S) @ w * a_var, 0.0)
    chi2 = ((S - a[:, None] * shape) ** 2) @ w
    # A spectrum that is not a power law widens all errors.
    scale = max(float(chi2.min()) / max(len(f) - 2, 1), 1.0)
    weight = np.exp(-(chi2 - chi2.min()) / (2 * scale))
    weight /= weight.sum()
    tail = a * integral
    mean = float(weight @ tail)
    return mean, float(np.sqrt(weight @ (a_var * scale * integral**2 + (tail - mean) ** 2)))
