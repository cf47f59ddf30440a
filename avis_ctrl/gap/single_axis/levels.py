"""Does one linear model hold at all levels: best linear approximations compared, channel by channel and band by band.

The difference of the responses at two levels is judged against the noise, which repeats in no period, and against noise
and stochastic distortion together, which tell how far one realisation's response is from another's at the same level
(`measurement.frequency_response.best_linear`). A difference above both is no noise and no scatter of phases: the best
linear model itself moves with the level, and no linear model of any order is nearer to both levels than half of it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal, stats

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.gap.single_axis.result import AxisGap, AxisStage
from avis_ctrl.gap.single_axis.stepwise import FALSE_ALARM, Progress
from avis_ctrl.gap.single_axis.vector_fitting import vector_fit
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader
from avis_ctrl.measurement.frequency_response.best_linear import Transient, best_linear_approximations
from avis_ctrl.measurement.frequency_response.resonance import resonance
from avis_ctrl.measurement.frequency_response.response import FrequencyResponse
from avis_ctrl.measurement.gates.finding import Picture, Series, thinned

BANDS_PER_OCTAVE = 3
LEAST_LINES = 5
ORDERS = (10, 20, 40)
FITTED_LINES = 600
MODE_PROMINENCE_DB = 6.0  # a peak that stands out by the width of its own half-power band
MOST_MODES = 8
SAME_SHAPE = 0.9  # modal assurance criterion above which two modes are one (Allemang and Brown 1982, usual practice)


@dataclass(frozen=True)
class ModeShift:
    """A mode at two levels, Hz with standard deviations."""

    low_Hz: float
    low_std_Hz: float
    high_Hz: float
    high_std_Hz: float

    @property
    def significance(self) -> float:
        return abs(self.high_Hz - self.low_Hz) / max(np.hypot(self.low_std_Hz, self.high_std_Hz), 1e-300)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """edges (b, 2) Hz; over_noise, over_all (b, n_y, n_u): mean square of the difference over its variance;
    significant (b, n_y, n_u); share (b, n_y, n_u) of the whole squared difference, relative to the entry's size."""

    edges: np.ndarray
    over_noise: np.ndarray
    over_all: np.ndarray
    significant: np.ndarray
    share: np.ndarray


def level_dependence(campaign: Campaign, band_Hz: tuple[float, float] | None = None, transient: Transient = "auto",
                     progress: Progress = lambda s: None) -> AxisGap:
    """Compare the lowest and the highest level of a campaign of periodic records.

    transient : as in `best_linear_approximations`; "none" for records of the steady state.

    Raises
    ------
    InputError : fewer than two levels, records that are not periodic, no realisations (noise and distortion cannot be
        separated), no repeated periods.
    """
    levels = sorted({r.header.level_V for r in campaign.records if r.header.level_V})
    if len(levels) < 2:
        raise InputError("expected records at two levels at least", field="level_V", value=levels)
    found = []
    for level in (levels[0], levels[-1]):
        progress(f"best linear approximation at {level:g} V")
        # Where a line is too weak for some of the inputs, it is left out.
        one = max(best_linear_approximations(campaign, band_Hz=band_Hz, level_V=level, transient=transient),
                  key=lambda r: len(r.inputs) * len(r.frequency_Hz))
        if one.distortion is None or one.measurement_noise is None:
            raise InputError("expected repeated periods and more realisations than inputs: without them noise and "
                             "distortion are not separated", field=f"records at {level:g} V")
        found.append(one)
    low, high = _common(*found)
    progress("comparison")
    compared = compare(low, high)
    modes = mode_shifts(low, high)
    progress("linear models of rising order")
    return _result(low, high, (levels[0], levels[-1]), compared, modes, linear_models(low, high, levels[0]))


def _common(a: FrequencyResponse, b: FrequencyResponse) -> tuple[FrequencyResponse, FrequencyResponse]:
    if (a.inputs, a.outputs) != (b.inputs, b.outputs):
        raise InputError("expected the same channels at both levels", field="inputs", value=(a.inputs, b.inputs))
    both = np.intersect1d(np.round(a.frequency_Hz, 6), np.round(b.frequency_Hz, 6))
    if len(both) < 4 * LEAST_LINES:
        raise InputError(f"expected at least {4 * LEAST_LINES} lines that both levels excite", field="records",
                         value=len(both))
    return tuple(r.at(np.isin(np.round(r.frequency_Hz, 6), both)) for r in (a, b))  # type: ignore[return-value]


def compare(low: FrequencyResponse, high: FrequencyResponse) -> _Comparison:
    """F tests in each third octave and entry, family-wise at FALSE_ALARM over all of them (Bonferroni).

    The lines of a band have unequal variances v: n_eff = (sum v)^2 / sum v^2 of them count (Satterthwaite), and the
    variance estimate has n_eff (experiments - inputs) complex degrees of freedom at the least.
    """
    f = low.frequency_Hz
    D2 = np.abs(high.value - low.value) ** 2
    noise = sum(np.maximum(r.variance("measurement_noise"), 0) for r in (low, high))
    total = sum(np.maximum(r.variance(), 0) for r in (low, high))
    size2 = np.mean(np.abs(low.value) ** 2, axis=0)
    edges = _bands(f)
    # dof counts all the lines that were averaged; a line's own share of them is what it adds.
    width = max(round(low.dof / _per_line(low)), 1)
    per_line = min(low.dof, high.dof) / width
    rows = []
    for a, b in edges:
        use = (f >= a) & (f < b)
        v = total[use]
        n_eff = v.sum(axis=0) ** 2 / np.maximum((v ** 2).sum(axis=0), np.finfo(float).tiny)
        ratio = D2[use].mean(axis=0) / np.maximum(v.mean(axis=0), np.finfo(float).tiny)
        limit = stats.f(2 * n_eff, 2 * n_eff * per_line).isf(FALSE_ALARM / (len(edges) * size2.size))
        rows.append((D2[use].mean(axis=0) / np.maximum(noise[use].mean(axis=0), np.finfo(float).tiny), ratio,
                     ratio > limit, D2[use].sum(axis=0) / size2))
    over_noise, over_all, significant, power = (np.stack(column) for column in zip(*rows, strict=True))
    return _Comparison(edges, over_noise, over_all, significant, power / max(float(power.sum()), 1e-300))


def _per_line(response: FrequencyResponse) -> float:
    """Complex degrees of freedom that each line has by itself, from the method's own words: experiments - inputs."""
    count = re.search(r"(\d+) experiments", response.method)
    return max(float(count.group(1)) - len(response.inputs), 1.0) if count else 1.0


def _bands(f: np.ndarray) -> np.ndarray:
    """(b, 2) bands of a third octave, widened to hold LEAST_LINES lines."""
    edges, at = [], 0
    while at < len(f):
        stop = max(int(np.searchsorted(f, f[at] * 2 ** (1 / BANDS_PER_OCTAVE))), at + LEAST_LINES)
        stop = len(f) if len(f) - stop < LEAST_LINES else stop
        edges.append((f[at], f[stop] if stop < len(f) else np.nextafter(f[-1], np.inf)))
        at = stop
    return np.array(edges)


def mode_shifts(low: FrequencyResponse, high: FrequencyResponse) -> list[ModeShift]:
    """Peaks of the responses at the higher level, and where each is at both, by frequency.

    Modes whose shapes differ are left out.
    """
    size = np.sqrt(np.sum(np.abs(high.value) ** 2, axis=(1, 2)))
    smooth = signal.savgol_filter(20 * np.log10(np.maximum(size, 1e-300)), 5, 2) if len(size) > 5 else size
    peaks, told = signal.find_peaks(smooth, prominence=MODE_PROMINENCE_DB)
    found = []
    for peak in peaks[np.argsort(-told["prominences"])][:MOST_MODES]:
        near = float(high.frequency_Hz[peak])
        try:
            a, b = resonance(low, near), resonance(high, near)
        except AvisError:
            continue  # no single mode there
        alike = abs(np.vdot(a.residue, b.residue)) ** 2 / (np.vdot(a.residue, a.residue) * np.vdot(b.residue, b.residue)
                                                           ).real
        if alike >= SAME_SHAPE:
            found.append(ModeShift(a.frequency_Hz, a.frequency_std_Hz, b.frequency_Hz, b.frequency_std_Hz))
    return sorted(found, key=lambda mode: mode.high_Hz)


def linear_models(low: FrequencyResponse, high: FrequencyResponse, level_V: float
                  ) -> list[tuple[int, float, float, float]]:
    """(order, error on the lines fitted, on unseen lines of the same level, on the same unseen lines of the other).

    Each is relative to the response, every entry in its own size. Fitted to every other line of the lower level.
    """
    step = max(1, len(low.frequency_Hz) // FITTED_LINES)
    fitted = np.arange(len(low.frequency_Hz)) // step % 2 == 0
    use = np.flatnonzero(fitted)[::max(1, step // 2)]
    size = np.sqrt(np.mean(np.abs(low.value) ** 2, axis=0)).ravel()
    G, H = (r.value.reshape(len(r.value), -1) / size for r in (low, high))
    rows = []
    for order in ORDERS:
        if len(use) <= 4 * (order + 1):
            continue
        model = vector_fit(low.frequency_Hz[use], G[use], np.ones(G[use].shape), order).response(low.frequency_Hz)

        def left(target: np.ndarray, where: np.ndarray, said: np.ndarray = model) -> float:
            return float(np.linalg.norm((target - said)[where]) / np.linalg.norm(target[where]))
        rows.append((order, left(G, np.isin(np.arange(len(G)), use)), left(G, ~fitted), left(H, ~fitted)))
    return rows


def _result(low: FrequencyResponse, high: FrequencyResponse, levels: tuple[float, float], compared: _Comparison,
            modes: list[ModeShift], models: list[tuple[int, float, float, float]]) -> AxisGap:
    D = (high.value - low.value) / np.sqrt(np.mean(np.abs(low.value) ** 2, axis=0))
    whole = float(np.sqrt(np.mean(np.abs(D) ** 2)))
    variance = low.variance() + high.variance()
    chi2 = float(np.mean(np.abs(high.value - low.value) ** 2) / np.mean(variance))
    names = [f"{levels[0]:g} V", f"{levels[1]:g} V"]
    dependent = bool(np.any(compared.significant))
    stages = (AxisStage(f"the linear response of {names[0]}, at {names[1]}", whole, chi2),)
    references = tuple(AxisStage(f"linear of order {order}, fitted at {names[0]}, unseen lines at {name}", error, None)
                       for order, _, own, other in models for name, error in ((names[0], own), (names[1], other)))
    sentences = _sentences(names, compared, modes, models, whole, chi2, low)
    return AxisGap("levels", "unexplained" if dependent else "none", (), stages, references,
                   _where(compared, low) if dependent else (), tuple(sentences),
                   "a sine at each mode, swept slowly up and down at several levels, with the drive's own hysteresis "
                   "loop recorded at low frequency: it tells a stiffness that changes from a gain that does"
                   if dependent else None, pictures=_pictures(low, high, names, compared))


def _sentences(names: list[str], compared: _Comparison, modes: list[ModeShift],
               models: list[tuple[int, float, float, float]], whole: float, chi2: float, low: FrequencyResponse
               ) -> list[str]:
    count, tests = int(compared.significant.sum()), compared.significant.size
    if not count:
        return [f"No level dependence: the responses at {names[0]} and {names[1]} differ by {100 * whole:.2g} %, which "
                f"is within noise and distortion in all {tests} bands and channels."]
    said = []
    bands = compared.edges[np.any(compared.significant, axis=(1, 2))]
    said.append(f"Unexplained: the response depends on the level, and no linear model holds it: from {names[0]} to "
                f"{names[1]} it changes by {100 * whole:.3g} % (r.m.s. over entries), significantly in {count} of "
                f"{tests} bands and channels between {bands[0, 0]:.4g} and {bands[-1, 1]:.4g} Hz.")
    moved = [m for m in modes if m.significance > stats.norm.isf(FALSE_ALARM / 2 / max(len(modes), 1))]
    if moved:
        said.append("Modes move with the level: " + "; ".join(
            f"{m.low_Hz:.5g} +- {m.low_std_Hz:.2g} Hz to {m.high_Hz:.5g} +- {m.high_std_Hz:.2g} Hz"
            f" ({100 * (m.high_Hz / m.low_Hz - 1):+.2g} %)" for m in moved) + ".")
    top = np.unravel_index(int(np.argmax(np.where(compared.significant, compared.share, 0))), compared.share.shape)
    said.append(f"The change is {np.sqrt(compared.over_noise[top]):.3g} times the noise and "
                f"{np.sqrt(compared.over_all[top]):.3g} times noise and distortion together where it is largest, "
                f"{compared.edges[top[0], 0]:.4g} to {compared.edges[top[0], 1]:.4g} Hz from {low.inputs[top[2]]} to "
                f"{low.outputs[top[1]]}.")
    if models:
        said.append(f"A higher order is no answer: linear models fitted at {names[0]} miss there "
                    + ", ".join(f"{100 * own:.3g} % (order {order})" for order, _, own, _ in models)
                    + f" on unseen lines, and at {names[1]} "
                    + ", ".join(f"{100 * other:.3g} %" for *_, other in models)
                    + "; of any order, one is at least half of the change away from one of the levels.")
    return said


def _where(compared: _Comparison, response: FrequencyResponse) -> tuple[dict[str, Any], ...]:
    """The significant places with the largest shares, at least half of the squared difference together."""
    found: list[dict[str, Any]] = []
    order = np.argsort(-np.where(compared.significant, compared.share, 0), axis=None)
    for k in order:
        b, i, j = np.unravel_index(int(k), compared.share.shape)
        if not compared.significant[b, i, j] or sum(place["share"] for place in found) >= 0.5:
            break
        found.append({"from_Hz": float(compared.edges[b, 0]), "to_Hz": float(compared.edges[b, 1]),
                      "input": response.inputs[j], "output": response.outputs[i],
                      "share": float(compared.share[b, i, j])})
    return tuple(found)


def _pictures(low: FrequencyResponse, high: FrequencyResponse, names: list[str], compared: _Comparison
              ) -> tuple[Picture, ...]:
    _, i, j = np.unravel_index(int(np.argmax(compared.share)), compared.share.shape)
    f = low.frequency_Hz
    spread = np.sqrt(np.maximum((low.variance() + high.variance())[:, i, j], 0))
    lines = [(names[0], np.abs(low.value[:, i, j])), (names[1], np.abs(high.value[:, i, j])),
             ("difference", np.abs(high.value - low.value)[:, i, j]),
             ("noise and distortion of the difference", spread)]
    unit = f"{low.output_unit}/{low.input_unit}"
    one = Picture(f"{low.inputs[j]} to {low.outputs[i]} at two levels", "frequency [Hz]", f"magnitude [{unit}]",
                  tuple(Series(name, *thinned(f, x)) for name, x in lines), (), "log", "log")
    middle = np.sqrt(compared.edges[:, 0] * compared.edges[:, 1])
    two = Picture("Change between the levels", "frequency [Hz]", "over noise and distortion (r.m.s.)",
                  tuple(Series(f"{u} to {y}", middle, np.sqrt(compared.over_all[:, i, j]))
                        for i, y in enumerate(low.outputs) for j, u in enumerate(low.inputs)), (), "log", "log")
    return one, two


def read_levels(folder: str | Path, sample_rate_Hz: float | None, y_unit: str = "m") -> Campaign:
    """Records from u_*.npy and y_*.npy, samples of a period x channels x realisations x periods; the level in mV is in
    the name (u_100mV_train.npy). The records are taken to be in the steady state.

    Raises
    ------
    InputError : a missing folder, partner or level, arrays that do not fit, no sample rate.
    """
    folder = Path(folder)
    files = sorted(folder.glob("u_*.npy")) if folder.is_dir() else []
    if not files:
        raise InputError("expected a folder with u_*.npy and y_*.npy", file=folder)
    if sample_rate_Hz is None or not (np.isfinite(sample_rate_Hz) and sample_rate_Hz > 0):
        raise InputError("expected the sample rate: .npy files hold none", file=folder, field="sample_rate_Hz",
                         value=sample_rate_Hz)
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
            raise InputError(f"expected samples, realisations and periods of {file.name}, {u.shape}", file=partner,
                             field="shape", value=y.shape)
        records += _records(float(level.group(1)), u, y, float(sample_rate_Hz), y_unit)
    return Campaign(folder.name, tuple(records))


def _loaded(file: Path) -> np.ndarray:
    try:
        x = np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"expected an array: {error}".splitlines()[0], file=file) from None
    if x.ndim != 4 or x.dtype.kind not in "fiu" or not np.all(np.isfinite(x)):
        raise InputError("expected finite numbers, samples x channels x realisations x periods", file=file,
                         field="shape", value=x.shape)
    return x.astype(float)


def _records(level_mV: float, u: np.ndarray, y: np.ndarray, rate: float, y_unit: str) -> list[Record]:
    n, count, periods = u.shape[0], u.shape[2], u.shape[3]
    found = []
    for k in range(count):
        header = RecordHeader(f"{level_mV:g}mV_{k}", rate, n * periods, tuple(f"u{j + 1}" for j in range(u.shape[1])),
                              tuple(f"y{j + 1}" for j in range(y.shape[1])), "multisine", level_mV / 1000,
                              period_s=n / rate, y_unit=y_unit)
        found.append(Record(header, *(x[:, :, k, :].transpose(2, 0, 1).reshape(n * periods, -1) for x in (u, y))))
    return found
