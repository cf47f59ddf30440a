"""Gate for spikes: single samples far from the interpolation of their neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.measurement.campaign import RecordHeader
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import Finding, Limit, bars, samples_over_time, times

# Departure from the cubic through the two neighbours on either side: x0 - (4 (x-1 + x1) - (x-2 + x2)) / 6. These are
# also the five departures around a spike of height 1.
SHAPE = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6
# Departures around a corner of a flat top or of the signal's slope.
CORNER = np.array([0.0, -1.0, 2.0, -1.0, 0.0])


@dataclass(frozen=True)
class SpikeSettings:
    """factor : minimum ratio of a spike to the median departure around it [1]: 13.5 standard deviations of Gaussian
        noise. Noise that grows with the signal, such as that of a real laser sensor, reaches 15 times.
    steps : minimum ratio of a spike to the converter's step [1].
    around : number of samples over which the median departure is taken.
    left : maximum residual departure around a spike after its removal, relative to the spike [1].
    """

    factor: float = 20.0
    steps: float = 5.0
    around: int = 512
    left: float = 0.3


SETTINGS = SpikeSettings()


class Spikes(Gate):
    """Single samples away from the cubic through their four neighbours.

    The departure is compared with the median departure around it, so that quiet and loud parts are treated alike; noise
    alone never reaches the limit (1e-40 for each sample). Departures are small for a smooth signal and large for a
    signal with power up to the Nyquist frequency: the message states the smallest spike that would be found. A single
    spike must explain the departures around it, and better than a corner, such as that of a flat top; steps, lost
    samples and runs of two or more are left to other gates. The outer four samples of a piece are not tested.
    """

    name = "spikes"

    def look(self, seen: Excerpt) -> tuple[list[Finding], float]:
        """Findings on the record, and the largest median departure."""
        found, least = [], 0.0
        for piece in seen.pieces:
            t = piece.time - seen.header.start_s
            for name, x in zip(seen.header.y_names, piece.y.T, strict=True):
                where, ratio, spread = spikes(x, self.expectation.y_lsb_V)
                least = max(least, float(np.max(spread, initial=0.0)))
                if len(where):
                    found.append(self._finding(seen.header, name, t, x, where, ratio))
        return found, least

    def conclude(self, kept: list[tuple[list[Finding], float]]) -> list[Finding]:
        if found := [finding for of, _ in kept for finding in of]:
            return found
        least = np.array([SETTINGS.factor * one for _, one in kept])
        sentence = (
            f"No single sample differs from its neighbours; a spike of more than {least.max():.2g} "
            f"{self.campaign.y_unit} would be found in every record."
        )
        heights = dict(zip((r.header.name for r in self.campaign.records), least, strict=True))
        picture = bars("Smallest spike that would be found", "record", f"spike [{self.campaign.y_unit}]", heights)
        return [Finding(self.name, "ok", sentence, value=least.max(), picture=picture)]

    def _finding(
        self, header: RecordHeader, channel: str, t: np.ndarray, x: np.ndarray, where: np.ndarray, ratio: np.ndarray
    ) -> Finding:
        """Finding on the spikes x[where] of a channel, with their ratios to the usual departure."""
        k, largest = int(where[np.argmax(ratio)]), float(ratio.max())
        many = f"{len(where)} single samples, the worst" if len(where) > 1 else "a single sample"
        sentence = (
            f"Channel {channel!r} of record {header.name} has {many} far from the neighbours, at {t[k]:.6g} s (sample "
            f"{k + round(float(t[0]) * header.sample_rate_Hz)}): {x[k]:.4g} {header.y_unit}, while interpolation gives "
            f"{x[k] - departure(x[k - 2 : k + 3])[0]:.4g}. The deviation is {times(largest)} the usual one (limit "
            f"{SETTINGS.factor:g}): an electrical disturbance or a faulty conversion. Check cables and grounding; "
            "repeat the record, or replace the sample by the interpolated value."
        )
        part = slice(max(0, k - 100), k + 100)
        limits = (Limit("spike", float(t[k]), "x"),)
        picture = samples_over_time(header.name, channel, t[part], x[part], header.y_unit, limits)
        return Finding(self.name, "warning", sentence, (channel,), (header.name,), largest, SETTINGS.factor, picture)


def spikes(x: np.ndarray, lsb: float | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices (m,) of spikes, ratios (m,) of their departure to the median around, and this median (blocks,)."""
    if len(x) < 16 or np.ptp(x) == 0:
        return np.zeros(0, int), np.zeros(0), np.zeros(0)
    r = np.concatenate([np.zeros(2), departure(x), np.zeros(2)])
    if lsb is None:
        lsb = float(np.min(np.diff(np.unique(x[: 1 << 14])), initial=np.inf))
        lsb = lsb if np.isfinite(lsb) else 0.0
    floor = SETTINGS.steps * lsb / SETTINGS.factor + 1e-12 * float(np.max(np.abs(x)))
    blocks = np.array_split(np.abs(r), max(1, len(r) // SETTINGS.around))
    spread = np.maximum([np.median(block) for block in blocks], floor)
    # A part that has just become loud is compared with the largest median of itself and its neighbours.
    wide = np.max([spread, np.append(spread[1:], 0), np.append(0, spread[:-1])], axis=0)
    ratio = np.abs(r) / np.repeat(wide, [len(block) for block in blocks])
    near = np.flatnonzero(ratio > SETTINGS.factor)
    single = []
    for k in near[(near >= 4) & (near < len(x) - 4)]:
        here = r[k - 2 : k + 3]
        left = here - r[k] * SHAPE
        largest = abs(r[k]) >= np.max(np.abs(here))
        if largest and np.max(np.abs(left)) < SETTINGS.left * abs(r[k]) and np.sum(left**2) < jump_corner(here):
            single.append(int(k))
    return np.array(single, int), ratio[single], spread


def jump_corner(here: np.ndarray) -> float:
    """Residual sum of squares of five departures, less the best corner at the middle sample or next to it."""
    trials = [np.column_stack([CORNER, np.roll(CORNER, shift)]) for shift in (-1, 1)]
    sums = []
    for A in trials:
        c = np.linalg.lstsq(A, here, rcond=None)[0]
        if c[0] * c[1] < 0:  # corners of opposite sign are not one corner
            c = np.array([CORNER @ here / (CORNER @ CORNER), 0.0])
        sums.append(float(np.sum((here - A @ c) ** 2)))
    return min(sums)


def departure(x: np.ndarray) -> np.ndarray:
    """(n - 4,) difference of each sample from the cubic through its two neighbours on either side."""
    return np.convolve(x, SHAPE, "valid")
