"""A record in time for effects that depend on amplitude or time: its voltages, and the motion at the mounts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.fft


@dataclass(frozen=True)
class MotionSettings:
    """Of spectra of a record's motion.

    kept_bytes : of the spectra kept for each record; those that have not been used for longest go first. Enough for a
        step of a fit with several effects; ten records of it are a fifth of the memory that a search may take.
    node_ratio : ratio of the values between which spectra are interpolated [1]. Of a contact's friction over its
        slip, cubic interpolation is then exact to a part in ten thousand, and its derivative to a part in five
        hundred.
    """

    kept_bytes: int = 32_000_000
    node_ratio: float = 1.2


SETTINGS = MotionSettings()


class Kept:
    """Arrays by key, up to so many bytes; those that have not been used for longest go first."""

    def __init__(self, most_bytes: int):
        self.most_bytes, self.bytes = most_bytes, 0
        self.arrays: dict[tuple, np.ndarray] = {}

    def of(self, key: tuple, make: Callable[[], np.ndarray]) -> np.ndarray:
        """The array of a key, made where it is not kept."""
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
    """A record, or the part of one that a block holds.

    Attributes
    ----------
    name : of the block. sample_rate_Hz, start_s : of the first sample, on the campaign's clock.
    campaign_s : (first, last) time of the campaign.
    volts : (samples, n_u) commanded, in the model's order.
    deflection : (samples, n_g) of each mount along each axis, payload less chassis [m], in the order of
        `MountGeometry.names`. rows : (n_g, 6) from q to it. stiffness : (n_g,) N/m of each.
    vertical : (n_g,) which are along z. driven_rows : (n_u,) which row each motor acts along.
    before : samples of the record before the block's first one, held in all arrays; cut off by `spectrum`.
    large_force, turned_force, turned_reading : (samples, 6), (samples, 6) N and N m, (samples, n_y) m/s^2: second-order
        terms of large rotations (`effects.large_motion`), empty where they were not asked for.
    actuators, sensors : names of the columns of volts and y. y : (samples, n_y) measured, empty where not every sensor
        of the model was.
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
        """(samples,) on the campaign's clock."""
        return self.start_s + (np.arange(len(self.volts)) - self.before) / self.sample_rate_Hz

    @cached_property
    def largest_volts(self) -> float:
        """Largest r.m.s. of a drive's voltage, V."""
        return float(np.sqrt(np.mean(self.volts ** 2, axis=0)).max())

    @cached_property
    def rms_deflections(self) -> np.ndarray:
        """(n_g,) m, r.m.s. over the record."""
        return np.sqrt(np.mean(self.deflection ** 2, axis=0))

    def spectrum(self, samples: np.ndarray, omega: np.ndarray) -> np.ndarray:
        """(n, channels) of (samples, channels) on the block's lines, scaled as a `SpectralBlock` is."""
        own = samples[self.before:]
        if not len(own):
            return np.zeros((len(omega), samples.shape[1]), complex)
        lines = np.rint(omega * len(own) / (2 * np.pi * self.sample_rate_Hz)).astype(int)
        return scipy.fft.rfft(own, axis=0)[lines] / np.sqrt(len(own))

    def kept(self, key: str, omega: np.ndarray, samples: Callable[[], np.ndarray]) -> np.ndarray:
        """`spectrum` of samples that never change, under a key: computed once for each set of lines."""
        where = (key, len(omega), float(omega[0]), float(omega[-1]), float(np.sum(omega)))
        return self._spectra.of(where, lambda: self.spectrum(samples(), omega))

    def interpolated(self, key: str, value: float, omega: np.ndarray, samples: Callable[[float], np.ndarray]
                     ) -> np.ndarray:
        """`spectrum` of samples(value), value > 0: cubic interpolation over log(value) between spectra that are kept.

        A fit asks for many values near each other, and for differences between them.
        """
        at = np.log(value) / np.log(SETTINGS.node_ratio)
        nodes = np.floor(at) + np.arange(-1, 3)

        def at_node(node: float) -> np.ndarray:
            return self.kept(f"{key} {node:g}", omega, lambda: samples(SETTINGS.node_ratio ** node))
        weights = [np.prod([(at - other) / (node - other) for other in nodes if other != node]) for node in nodes]
        return np.asarray(sum(weight * at_node(node) for weight, node in zip(weights, nodes, strict=True)))
