"""Generic vibration criteria VC-A to VC-G: r.m.s. velocity in third-octave bands.

C. G. Gordon, Generic criteria for vibration-sensitive equipment, Proc. SPIE 1619 (1991); H. Amick, M. Gendreau,
T. Busch and C. Gordon, Evolving criteria for research facilities: I - Vibration, Proc. SPIE 5933 (2005). VC-A and
VC-B start at 4 Hz, with constant acceleration below 8 Hz; VC-C to VC-G have constant velocity from 1 Hz. All end at
80 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.rigs.floor_motion import third_octave_midbands


@dataclass(frozen=True)
class Criterion:
    """One curve: r.m.s. velocity [m/s] per third octave, from low_Hz to 80 Hz."""

    name: str
    velocity_m_per_s: float
    low_Hz: float
    constant_acceleration_below_Hz: float | None = None

    def midbands(self) -> np.ndarray:
        """Exact midbands [Hz] of the bands of the criterion."""
        return third_octave_midbands(self.low_Hz, 80.0)

    def limit(self, frequency_Hz: np.ndarray) -> np.ndarray:
        """Limit [m/s r.m.s.] at midbands [Hz]; inf outside the bands of the criterion."""
        f = np.asarray(frequency_Hz, float)
        bands = self.midbands()
        inside = (f > bands[0] * 10**-0.05) & (f < bands[-1] * 10**0.05)
        knee = self.constant_acceleration_below_Hz
        rise = np.maximum(knee / f, 1.0) if knee else np.ones(f.shape)
        return np.where(inside, self.velocity_m_per_s * rise, np.inf)


CRITERIA: tuple[Criterion, ...] = (
    Criterion("VC-A", 50e-6, 4.0, 8.0),
    Criterion("VC-B", 25e-6, 4.0, 8.0),
    Criterion("VC-C", 12.5e-6, 1.0),
    Criterion("VC-D", 6.25e-6, 1.0),
    Criterion("VC-E", 3.12e-6, 1.0),
    Criterion("VC-F", 1.56e-6, 1.0),
    Criterion("VC-G", 0.78e-6, 1.0),
)


def rating(midband_Hz: np.ndarray, rms: np.ndarray) -> str | None:
    """The strictest criterion that r.m.s. velocities [m/s] in third octaves meet; None if not even VC-A is met."""
    # VC-C starts at 1 Hz, VC-B only at 4 Hz: the curves are not nested, so take the last before the first not met.
    best = None
    for one in CRITERIA:
        if not np.all(rms <= one.limit(midband_Hz)):
            break
        best = one.name
    return best
