"""Generic vibration criteria VC-A to VC-G: r.m.s. velocity in third-octave bands.

C. G. Gordon, Generic criteria for vibration-sensitive equipment, Proc. SPIE 1619 (1991); H. Amick, M. Gendreau,
T. Busch and C. Gordon, Evolving criteria for research facilities: I - Vibration, Proc. SPIE 5933 (2005). VC-A and
VC-B start at 4 Hz, with constant acceleration below 8 Hz; VC-C to VC-G have constant velocity from 1 Hz. All end at
80 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
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


@dataclass(frozen=True)
class Rating:
    """The strictest criterion met, and the band that decides.

    Parameters
    ----------
    criterion : name, or None if not even VC-A is met.
    deciding_band_Hz : midband where the motion is largest relative to the next stricter criterion (to VC-G if all
        are met).
    deciding_rms, deciding_limit : r.m.s. velocity there and that criterion's limit [m/s].
    against : the criterion of `deciding_limit`.
    bands_missing_Hz : midbands of the criterion without data.
    """

    criterion: str | None
    deciding_band_Hz: float
    deciding_rms: float
    deciding_limit: float
    against: str
    bands_missing_Hz: tuple[float, ...]


def criterion(name: str) -> Criterion:
    """A curve by name ("VC-A" to "VC-G"); the InputError for an unknown name lists the known ones."""
    for one in CRITERIA:
        if one.name == name:
            return one
    raise InputError(f"one of {[c.name for c in CRITERIA]}", field="criterion", value=name)


def rating(midband_Hz: np.ndarray, rms: np.ndarray) -> Rating:
    """The strictest criterion that r.m.s. velocities [m/s] in third octaves meet.

    Raises
    ------
    InputError : vectors of different lengths, values that are negative or not finite, no band from 4 to 80 Hz.
    """
    f, v = np.atleast_1d(np.asarray(midband_Hz, float)), np.atleast_1d(np.asarray(rms, float))
    if f.shape != v.shape or f.ndim != 1:
        raise InputError(f"two vectors of one length, got {f.shape} and {v.shape}", field="rms")
    if not (np.all(np.isfinite(f)) and np.all(f > 0)):
        raise InputError("finite, positive midbands", field="midband_Hz")
    if not (np.all(np.isfinite(v)) and np.all(v >= 0)):
        raise InputError("finite r.m.s. velocities, zero or positive", field="rms")
    if not np.any(np.isfinite(CRITERIA[0].limit(f))):
        raise InputError("at least one third octave from 4 to 80 Hz", field="midband_Hz", value=f.tolist())
    met = [c for c in CRITERIA if np.all(v <= c.limit(f))]
    # VC-C starts at 1 Hz, VC-B only at 4 Hz: the curves are not nested, so take the last before the first not met.
    best = next((k for k, c in enumerate(CRITERIA) if c not in met), len(CRITERIA)) - 1
    against = CRITERIA[min(best + 1, len(CRITERIA) - 1)]
    worst = int(np.argmax(v / against.limit(f)))
    judged = CRITERIA[max(best, 0)].midbands()
    missing = tuple(float(m) for m in judged if not np.any(np.abs(np.log10(f / m)) < 0.05))
    return Rating(
        CRITERIA[best].name if best >= 0 else None,
        float(f[worst]),
        float(v[worst]),
        float(against.limit(f)[worst]),
        against.name,
        missing,
    )
