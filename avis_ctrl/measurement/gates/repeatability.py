"""Gates that compare records with each other: repeatability at one level, and level dependence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy import stats

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import SETTINGS as FINDING
from avis_ctrl.measurement.gates.finding import (
    Finding,
    Limit,
    Picture,
    Severity,
    curves,
    over_frequency,
    percent,
    quoted,
    those,
)
from avis_ctrl.measurement.gates.h1 import Samples, Spectra, driven_lines, h1, octaves, spectra_of, usable
from avis_ctrl.measurement.gates.periodicity import smoothed, windowed


@dataclass(frozen=True)
class ComparisonSettings:
    """common : cosine of the angle between directions of the voltages above which they count as common to two records:
        1.4 mrad, more than the rotation caused by rounding the voltages to four digits.
    excited : power of u at a line relative to the median of the driven lines, below which the line counts as the edge
        of the band: u and y are small there, and leakage into them differs from record to record.
    largest_stated : ratio of T to its limit above which the message states "far more than noise explains" instead of
        the number.
    notable, large : difference relative to the response above which it is a note, because gains are known to 1 % at
        best, and above which it is a warning.
    blind : noise of the comparison relative to the response, above which it hides changes that matter.
    apart : minimum ratio of two levels that are compared: closer levels show leakage and drift, not nonlinearity.
    """

    common: float = 1 - 1e-6
    excited: float = 0.03
    largest_stated: float = 20.0
    notable: float = 0.01
    large: float = 0.05
    blind: float = 0.2
    apart: float = 1.4


SETTINGS = ComparisonSettings()
LEVEL_DEPENDENCE = "level dependence"  # gate name of the findings on different levels


@dataclass(frozen=True, eq=False)
class _Kept:
    """Data of one record; of periodic records also the mean period, with the variance (lines, n_y) of its windowed
    lines and the degrees of freedom of this variance.
    """

    record: str
    kind: str
    level: float
    of: Spectra
    mean: Samples | None = None
    variance: np.ndarray | None = None
    dof: int = 0


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference of two records (or levels): T (n_y,) mean |difference|^2 / variance in the most significant octave,
    divided by its 1 % limit for noise alone; relative (n_y,) difference there, noise subtracted; band_Hz (n_y, 2) of
    this octave; noise : relative to the response, in the octave where it is largest.
    """

    a: str
    b: str
    T: np.ndarray
    relative: np.ndarray
    band_Hz: np.ndarray
    f: np.ndarray
    by_line: np.ndarray
    noise: float


class Comparison(Gate):
    """Comparison of records with one kind of excitation: at one level, each with the first (repeatability); and of
    levels at least a factor 1.4 apart (level dependence; closer levels show leakage and drift rather than
    nonlinearity).

    If two records repeat one periodic u up to a factor, their mean periods are compared line by line against the
    variance between periods (Hann-windowed, smoothed over 9 lines): T, the mean over the L lines of an octave, is
    F(L, L (P - 1)) distributed. Otherwise their H1 estimates are compared, with the covariance V of the difference d:
    T = mean of d* inv(V) d over every second line of an octave is F(n_u L, (K - n_u) L) distributed. Levels are
    compared over all their records. Each gate divides 1 % among octaves, pairs and channels. With H1 from different u,
    V is mainly leakage at resonances: small shifts of lightly damped resonances remain hidden. A significant difference
    below 1 % of the response (noise subtracted) is accepted; above 5 % it is a warning.
    """

    name = "repeatability"

    def look(self, seen: Excerpt) -> _Kept | None:
        h = seen.header
        if not seen.driven or h.excitation == "sine":
            return None
        mean = usable(seen)
        kept = _Kept(h.name, h.excitation, h.level_V, spectra_of(seen))
        if not mean.wrap or (P := len(periods := seen.periods("y")[1:])) < 3:
            return kept
        variance = smoothed(np.sum(np.abs(windowed(periods - mean.y)) ** 2, axis=0) / (P - 1)) / P
        return replace(kept, mean=mean, variance=variance, dof=P - 1)

    def conclude(self, kept: list[_Kept | None]) -> list[Finding]:
        groups, n_y = _by_kind_and_level(kept), len(self.campaign.y_names)
        pairs = [(first, b) for first, *others in groups.values() for b in others if len(b.of.f) == len(first.of.f)]
        level = FINDING.false_alarm / max(1, len(pairs) * n_y)
        compared = [difference([a], [b], level, (f"record {a.record}", f"record {b.record}")) for a, b in pairs]
        repeats = [*filter(None, compared)]
        apart = [(a, b) for a, b in combinations(sorted(groups), 2) if a[0] == b[0] and b[1] >= SETTINGS.apart * a[1]]
        level = FINDING.false_alarm / max(1, len(apart) * n_y)
        compared = [difference(groups[a], groups[b], level, (f"{a[1]:g} V", f"{b[1]:g} V")) for a, b in apart]
        agreed = "One pair of records agrees" if len(repeats) == 1 else f"{len(repeats)} pairs of records agree"
        untested = "Repeatability was not tested: no two driven records of one level and enough length."
        found = _judged(self.name, repeats, self.campaign, _drifted, agreed, untested)
        untested = (
            "Dependence on the level was not tested: no driven records of one kind and enough length at two levels, at "
            f"least a factor {SETTINGS.apart:g} apart."
        )
        agreed = "The responses at all levels agree"
        return found + _judged(LEVEL_DEPENDENCE, [*filter(None, compared)], self.campaign, _nonlinear, agreed, untested)


def _drifted(d: Difference, bad: np.ndarray, names: tuple[str, ...]) -> tuple[str, tuple[str, ...]]:
    """Sentence and records of the finding."""
    return (
        f"{d.b.capitalize()} does not repeat {d.a}: {quoted(names)} differ by up to "
        f"{percent(d.relative[bad].max())} of the response, {significance(d.T[bad].max())}. The rig drifted or "
        "was changed in between; treat its parameters as uncertain by this amount, or use only one of the two."
    ), (d.a, d.b)


def _nonlinear(d: Difference, bad: np.ndarray, names: tuple[str, ...]) -> tuple[str, tuple[str, ...]]:
    low, high = d.band_Hz[int(np.argmax(np.where(bad, d.relative, 0)))]
    return (
        f"The response depends on the level: from {d.a} to {d.b} {quoted(names)} change by up to "
        f"{percent(d.relative[bad].max())} (most from {low:.3g} to {high:.3g} Hz), "
        f"{significance(d.T[bad].max())}: nonlinearity. Identify at the level of use, and include the difference "
        "in the uncertainty."
    ), ()


def _judged(
    gate: str,
    differences: list[Difference],
    campaign: Campaign,
    described: Callable[[Difference, np.ndarray, tuple[str, ...]], tuple[str, tuple[str, ...]]],
    agreed: str,
    untested: str,
) -> list[Finding]:
    """Findings on significant differences, or that there are none; then a note if the comparison is not sensitive."""
    if not differences:
        return [Finding(gate, "ok", untested)]
    found = []
    for d in differences:
        bad = (d.T > 1) & (d.relative > SETTINGS.notable)
        if bad.any():
            names = those(campaign.y_names, bad)
            severity: Severity = "warning" if d.relative[bad].max() > SETTINGS.large else "note"
            sentence, records = described(d, bad, names)
            picture = _picture(d, campaign.y_names)
            found.append(Finding(gate, severity, sentence, names, records, d.T[bad].max(), 1.0, picture))
    if found:
        return found
    d = max(differences, key=lambda d: d.noise)
    blind = d.noise > SETTINGS.blind
    hint = (
        " Smaller changes would not be detected; records with the same periodic voltage allow a more sensitive "
        "comparison."
        if blind
        else ""
    )
    sentence = (
        f"{agreed} within their noise, which is up to {100 * d.noise:.2g} % of the response in an octave ({d.a} "
        f"against {d.b}), or within 1 %.{hint}"
    )
    picture = _picture(d, campaign.y_names)
    return [Finding(gate, "note" if blind else "ok", sentence, value=d.T.max(), limit=1.0, picture=picture)]


def _picture(d: Difference, names: tuple[str, ...]) -> Picture:
    series, limits = curves(names, d.f, d.by_line), (Limit("large", SETTINGS.large),)
    return over_frequency(f"{d.a} against {d.b}", "relative difference [-]", series, limits)


def _by_kind_and_level(kept: list[_Kept | None]) -> dict[tuple[str, float], list[_Kept]]:
    """Records by excitation and level; leakage, and so the bias of H1, differs between kinds of excitation."""
    groups: dict[tuple[str, float], list[_Kept]] = {}
    for k in kept:
        if k is not None:
            groups.setdefault((k.kind, _rounded(k.level)), []).append(k)
    return groups


def _rounded(level: float) -> float:
    """Level rounded to two digits: records whose r.m.s. scatters by a few per cent have the same level."""
    return float(f"{level:.2g}")


def difference(a: list[_Kept], b: list[_Kept], level: float, names: tuple[str, str]) -> Difference | None:
    """Difference of two groups of records; None if they cannot be compared."""
    for one in a:
        for other in b:
            if (d := _same_input(one, other, level, names)) is not None:
                return d
    first, second = ([k.of for k in group if len(k.of.f) == len(group[0].of.f)] for group in (a, b))
    return _compared(first, second, level, names)


def _same_input(a: _Kept, b: _Kept, level: float, names: tuple[str, str]) -> Difference | None:
    """If u of b is a multiple of u of a: y of b compared with the same multiple of y of a; otherwise None."""
    first, second = a.mean, b.mean
    if first is None or second is None or a.variance is None or b.variance is None or first.u.shape != second.u.shape:
        return None
    power = float(np.sum(first.u * first.u))
    scale = float(np.sum(first.u * second.u)) / power if power else 0.0
    if scale <= 0 or np.max(np.abs(second.u - scale * first.u)) > 1e-3 * np.max(np.abs(second.u)):
        return None
    D = windowed(second.y - scale * first.y)
    variance = np.maximum(b.variance + scale**2 * a.variance, 1e-300)
    size = np.abs(windowed(second.y - second.y.mean(axis=0))) ** 2
    f = np.fft.rfftfreq(len(first.y), 1 / first.rate_Hz)[2:-1:2]
    driven = np.sum(np.abs(windowed(second.u)) ** 2, axis=1)
    keep = driven_lines(driven)
    keep &= driven > SETTINGS.excited * np.median(driven[keep])
    f, power, variance, size = f[keep], np.abs(D[keep]) ** 2, variance[keep], size[keep]
    return _in_octaves(names, f, power / variance, power, variance, size, 1, min(a.dof, b.dof), level)


def _in_octaves(
    names: tuple[str, str],
    f: np.ndarray,
    ratio: np.ndarray,
    power: np.ndarray,
    noise: np.ndarray,
    size: np.ndarray,
    n_u: int,
    dof: int,
    level: float,
) -> Difference:
    """The difference with this power (n, n_y) on the lines f (n,) Hz, where noise gives `noise` and the response is
    `size`; ratio : power over the variance of the noise, whose mean over L lines is F(n_u L, dof L) distributed.
    """
    bands = octaves(f)
    T, relative, blur = np.zeros((3, ratio.shape[1]))
    ends = np.zeros((ratio.shape[1], 2))
    for band in bands:
        lines, response = int(band.sum()), np.maximum(size[band].sum(axis=0), 1e-300)
        limit = float(stats.f.isf(level / len(bands), n_u * lines, dof * lines))
        here = ratio[band].mean(axis=0) / limit
        part = np.sqrt(np.maximum((power - noise)[band].sum(axis=0), 0) / response)
        relative = np.where(here > T, part, relative)
        ends[here > T] = f[band][[0, -1]]
        T = np.maximum(T, here)
        blur = np.maximum(blur, np.sqrt(noise[band].sum(axis=0) / response))
    by_line = np.sqrt(power / np.maximum(size, 1e-300))
    return Difference(*names, T, relative, ends, f, by_line, float(blur.max()))


def _compared(first: list[Spectra], second: list[Spectra], level: float, names: tuple[str, str]) -> Difference | None:
    """Difference of the H1 estimates over two sets of spectra; None if there are too few segments."""
    a, b = h1(first), h1(second)
    if a is None or b is None:
        return None
    f, ia, ib = np.intersect1d(a.f, b.f, return_indices=True)
    inside = (a.power[ia] > SETTINGS.excited * np.median(a.power)) & (
        b.power[ib] > SETTINGS.excited * np.median(b.power)
    )
    ia, ib, f = ia[inside][::2], ib[inside][::2], f[inside][::2]
    common = _common(a.basis, b.basis)
    rank = common.shape[1]
    if not len(f) or not rank:
        return None
    Ga, Gb = (of.G[index] @ common for of, index in ((a, ia), (b, ib)))
    Va, Vb = (common.T @ of.covariance[index] @ common for of, index in ((a, ia), (b, ib)))
    D = Gb - Ga
    V = a.noise[ia][:, :, None, None] * Va[:, None] + b.noise[ib][:, :, None, None] * Vb[:, None]
    V += 1e-12 * np.trace(V, axis1=2, axis2=3).real[..., None, None] * np.eye(rank) + 1e-300 * np.eye(rank)
    ratio = np.real(np.einsum("fyi,fyi->fy", D.conj(), np.linalg.solve(V, D[..., None])[..., 0])) / rank
    spread = np.trace(V, axis1=2, axis2=3).real
    size, power = np.sum(np.abs(Ga) ** 2, axis=2), np.sum(np.abs(D) ** 2, axis=2)
    return _in_octaves(names, f, ratio, power, spread, size, rank, min(a.dof, b.dof), level)


def _common(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(n_u, m) orthonormal basis of the directions that two records have in common; only these can be compared."""
    left, cosine, _ = np.linalg.svd(a.T @ b, full_matrices=False)
    return np.asarray(a @ left[:, cosine > SETTINGS.common])


def significance(T: float) -> str:
    """How far a statistic exceeds its 1 % limit, in words."""
    if SETTINGS.largest_stated < T:
        return "far more than noise explains"
    return f"{T:.1f} times the 1 % limit of noise alone"
