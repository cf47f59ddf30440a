"""Settings of the filter: those of the source (Rademakers, TU/e 2005, section 3.3), and settings from the
actual noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.checks import require, require_positive, require_whole
from avis_ctrl.errors import InputError
from avis_ctrl.rigs.converter import Converter
from avis_ctrl.rigs.rig import Rig

FLOOR_BAND_Hz = (0.5, 60.0)


@dataclass(frozen=True)
class EkfSettings:
    """Tuning.

    q_sigma, v_sigma : standard deviation of q [m, rad] and q' [m/s, rad/s] at the start of a record (eqs. 3.12, 3.13).
    prior_share : standard deviation of a parameter, as a fraction of its starting value (eq. 3.14).
    Q : spectral density of the acceleration noise of each coordinate, E[W(t) W(t')] = Q delta(t - t') [(m/s^2)^2/Hz,
        two-sided] (eq. 3.16); None: the rig's ambient floor motion, as three more states.
    R : variance of a measurement [(m/s)^2] (eq. 3.18); None: the rig's sensor noise and converter.
    highpass_Hz, highpass_order : prefilter of u and y (section 3.2).
    reset : start each record from the prior covariance about the last estimate (section 3.2); False keeps it.
    warm_up : number of records filtered once beforehand. Their covariance is then discarded: the actual filter starts
        from their estimate, where its linearisation is valid. The data still count only once.
    lowest : lower limit of a parameter, as a fraction of its starting value.
    history_s : time step of the history.
    """

    q_sigma: float = 2.5e-6
    v_sigma: float = 1e-8
    prior_share: float = 0.25
    Q: float | None = 1e-8
    R: float | None = 1e-8
    highpass_Hz: float = 1.0
    highpass_order: int = 6
    reset: bool = True
    warm_up: int = 0
    lowest: float = 0.05
    history_s: float = 1.0

    def __post_init__(self) -> None:
        for field in ("q_sigma", "v_sigma", "highpass_Hz", "prior_share", "history_s"):
            require_positive(getattr(self, field), field)
        if self.R is not None:
            require_positive(self.R, "R")
        if self.Q is not None:
            require_positive(self.Q, "Q", zero_allowed=True)
        require_whole(self.warm_up, "warm_up", 0)
        require(self.lowest, "lowest", 0, 1)


SOURCE_SETTINGS = EkfSettings()
"""Settings of section 3.3 as printed. Unlike in the source, the response of the sensors' chain is compensated.

R = 1e-8 corresponds to an r.m.s. velocity of 1e-4 m/s, which is the size of the payload's own motion and five orders of
variance above sensor noise and converter (1e-13). Q = 1e-8 is close to the spectral density of the acceleration by the
drives of section 3.4 along x and y (1.6e-8); along z it is a sixth of that density, about x a hundredth. The source
raised R because the filter was unstable otherwise. The filter therefore gives little weight to its data: its bands are
wide, and cover errors that the data would have revealed. Only 20 combinations of the 26 parameters affect the payload:
the bands of the others show the prior, not the data."""

HONEST_SETTINGS = EkfSettings(q_sigma=2.5e-6, v_sigma=1e-4, Q=None, R=None, reset=False, warm_up=1)
"""Settings from the actual noise, so that the bands show what the data determine.

R follows from the rig's sensor noise and quantiser. The process noise follows from its ambient floor motion: white
velocity through the isolators, which colour it (three more states). The covariance is kept from record to record. The
first record is filtered once beforehand, to start from its estimate: with parameters that are 25 % off, the modelled
transmission of the floor motion and the first corrections are wrong, and the bands would remain too narrow. The small
R, with which the source's filter was unstable, causes no problem once the sensors' chain is compensated."""


def measurement_variance(settings: EkfSettings, rig: Rig, y_names: Sequence[str], unit: str) -> np.ndarray:
    """R's diagonal, (n_y,) [(m/s)^2, or m^2 for displacements].

    From the rig: ambient noise and rounding in volts over the passband gain. Inverting the chain raises it near the
    corner of the high-pass; that affects 1 % of the band of 0-500 Hz and is neglected.

    Raises
    ------
    InputError : R = None for a rig without geophones or for data that are not in volts.
    """
    if settings.R is not None:
        return np.full(len(y_names), settings.R)
    g, a = rig.geophones, rig.acquisition
    if unit != "V" or g is None or a is None or rig.ambient is None:
        raise InputError(
            "the sensor noise is known only for geophones in V of a rig file with acquisition and ambient "
            "noise; state R",
            field="R",
            value=None,
        )
    rounding = Converter(a.adc_bits, a.adc_range_V, a.sample_rate_Hz).noise_rms_V
    gain = np.array([g.sensitivity_Vs_per_m[g.names.index(name)] for name in y_names]) * g.preamplifier_gain
    return (rig.ambient.sensor_noise_rms_V**2 + rounding**2) / gain**2


@dataclass(frozen=True)
class FloorNoise:
    """Floor motion as a disturbance: f' = -rate f + w, with f the floor's displacement (3,) after the high-pass.

    density : of the white velocity w [(m/s)^2/Hz, two-sided], in each direction. rate : [1/s], half the corner of the
        high-pass, so that f drifts no further than the filtered floor. The payload is accelerated by M^-1 (K_f f + C_f
        f').
    """

    density: float
    rate: float

    def acceleration(self, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
        """Acceleration of the payload by f (6, 3) and by w (6, 3)."""
        eom = rig.equations_of_motion()
        by_f = np.linalg.solve(eom.M, eom.K_floor[:, :3] - self.rate * eom.C_floor[:, :3])
        return by_f, np.linalg.solve(eom.M, eom.C_floor[:, :3])


def floor_noise(settings: EkfSettings, rig: Rig) -> FloorNoise | None:
    """Floor velocity of `rig.ambient` in each direction, flat over 0.5-60 Hz, if settings.Q is None; otherwise None.

    Raises
    ------
    InputError : Q = None for a rig without ambient data, or without floor motion in them.
    """
    if settings.Q is not None:
        return None
    if rig.ambient is None or not rig.ambient.floor_velocity_rms_m_per_s > 0:
        raise InputError("the rig file has no ambient floor motion; state Q", field="Q", value=None)
    density = rig.ambient.floor_velocity_rms_m_per_s**2 / (2 * (FLOOR_BAND_Hz[1] - FLOOR_BAND_Hz[0]))
    return FloorNoise(density, np.pi * settings.highpass_Hz)
