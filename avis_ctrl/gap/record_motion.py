"""A record in time for effects that depend on amplitude or time: voltages and deflections of the mounts."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.fft


@dataclass(frozen=True)
class MotionSettings:
    """Settings of the motion of the mounts in a measured record: its spectra, and its estimate (`motion_estimate`).

    kept_bytes : maximum size of the spectra cached for each record; the least recently used go first. Enough for a step
        of a fit with several effects; ten such records take a fifth of the memory allowed for a search.
    node_ratio : ratio of the values between which spectra are interpolated [1]. For the friction of a contact as a
        function of its slip, cubic interpolation is then accurate to 1e-4, and its derivative to 2e-3.
    low_Hz : lower edge of the band in which the sensors correct the model; the correction rises from zero to full [Hz].
        Below, inverting the sensor response would amplify sensor noise.
    high_Hz : upper edge of that band; the correction falls from full to zero [Hz]. Above, the mounts deflect little.
    least_excess : lower limit of the power attributed to a force, in standard deviations of the power of noise alone
        [1]: next to none, but not zero. A limit of one or more would attribute noise to a force.
    noise_from : fraction of the band above which only noise remains; its power is that of the sensors [1].
    margin_s : length by which a record is extrapolated beyond its ends [s]: several periods of a table's lowest mode.
    passes : iterations of this extrapolation.
    relaxation : over-relaxation of these iterations [1]: a plain iteration reduces the error by only a fifth.
    """

    kept_bytes: int = 32_000_000
    node_ratio: float = 1.2
    low_Hz: tuple[float, float] = (0.4, 0.8)
    high_Hz: tuple[float, float] = (120.0, 150.0)
    least_excess: float = 0.02
    noise_from: float = 0.6
    margin_s: float = 5.0
    passes: int = 6
    relaxation: float = 1.8


SETTINGS = MotionSettings()


class Kept:
    """Cache of arrays by key with a maximum size in bytes; the least recently used go first."""

    def __init__(self, most_bytes: int):
        self.most_bytes, self.bytes = most_bytes, 0
        self.arrays: dict[Hashable, np.ndarray] = {}

    def of(self, key: Hashable, make: Callable[[], np.ndarray]) -> np.ndarray:
        """The array of a key, computed if it is not cached."""
        found = self.arrays.pop(key, None)
        if found is None:
            found = make()
            self.bytes += found.nbytes
            while self.arrays and self.bytes > self.most_bytes:
                self.bytes -= self.arrays.pop(next(iter(self.arrays))).nbytes
        self.arrays[key] = found
        return found


@dataclass(frozen=True, eq=False)
class RecordMotion:
    """A record, or the part of it that a block contains.

    Attributes
    ----------
    name : of the block. sample_rate_Hz, start_s : sample rate, and time of the block's first sample on the campaign's
        clock.
    campaign_s : (first, last) time of the campaign.
    volts : (samples, n_u) commanded, in the model's order.
    deflection : (samples, n_g) of each mount along each axis, payload minus chassis [m], in the order of
        `MountGeometry.names`. rows : (n_g, 6) from q to deflection. stiffness : (n_g,) N/m of each.
    vertical : (n_g,) mask of the rows along z. driven_rows : (n_u,) row along which each motor acts.
    before : number of samples before the block's first one, included in all arrays; removed by `spectrum`.
    large_force, turned_force, turned_reading : (samples, 6), (samples, 6) N and N m, (samples, n_y) m/s^2: second-order
        terms of large rotations (`effects.large_motion`), empty if not computed.
    actuators, sensors : names of the columns of volts and y. y : (samples, n_y) measured, empty unless every sensor of
        the model was measured.
    """

    name: str
    sample_rate_Hz: float
    start_s: float
    campaign_s: tuple[float, float]
    volts: np.ndarray
    deflection: np.ndarray
    rows: np.ndarray
    stiffness: np.ndarray
    vertical: np.ndarray
    driven_rows: np.ndarray
    before: int = 0
    large_force: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    turned_force: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    turned_reading: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    actuators: tuple[str, ...] = ()
    sensors: tuple[str, ...] = ()
    y: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    _spectra: Kept = field(init=False, default_factory=lambda: Kept(SETTINGS.kept_bytes), repr=False)

    @cached_property
    def time_s(self) -> np.ndarray:
        """(samples,) time on the campaign's clock."""
        return self.start_s + (np.arange(len(self.volts)) - self.before) / self.sample_rate_Hz

    @cached_property
    def largest_volts(self) -> float:
        """Largest r.m.s. voltage of a drive [V]."""
        return float(np.sqrt(np.mean(self.volts**2, axis=0)).max())

    @cached_property
    def rms_deflections(self) -> np.ndarray:
        """(n_g,) r.m.s. over the record [m]."""
        return np.sqrt(np.mean(self.deflection**2, axis=0))

    def spectrum(self, samples: np.ndarray, omega: np.ndarray) -> np.ndarray:
        """(n, channels) spectrum of (samples, channels) on the block's lines, scaled like a `SpectralBlock`."""
        own = samples[self.before :]
        if not len(own):
            return np.zeros((len(omega), samples.shape[1]), complex)
        lines = np.rint(omega * len(own) / (2 * np.pi * self.sample_rate_Hz)).astype(int)
        return scipy.fft.rfft(own, axis=0)[lines] / np.sqrt(len(own))

    def kept(self, key: str, omega: np.ndarray, samples: Callable[[], np.ndarray]) -> np.ndarray:
        """`spectrum` of samples that never change, cached under a key for each set of lines."""
        where = (key, len(omega), float(omega[0]), float(omega[-1]), float(np.sum(omega)))
        return self._spectra.of(where, lambda: self.spectrum(samples(), omega))

    def interpolated(
        self, key: str, value: float, omega: np.ndarray, samples: Callable[[float], np.ndarray]
    ) -> np.ndarray:
        """`spectrum` of samples(value), value > 0, by cubic interpolation over log(value) between cached spectra.

        A fit needs many closely spaced values, and differences between them.
        """
        at = np.log(value) / np.log(SETTINGS.node_ratio)
        nodes = np.floor(at) + np.arange(-1, 3)

        def at_node(node: float) -> np.ndarray:
            return self.kept(f"{key} {node:g}", omega, lambda: samples(SETTINGS.node_ratio**node))

        weights = [np.prod([(at - other) / (node - other) for other in nodes if other != node]) for node in nodes]
        return np.asarray(sum(weight * at_node(node) for weight, node in zip(weights, nodes, strict=True)))
