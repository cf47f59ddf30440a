"""Computation of one velocity per axis from a rig's sensor signals, as in a digital controller, for any sensors.

    volts / gain -> conditioning of each channel -> decoding -> measured ("seen") velocity of each axis

Decoding adds channels, so all channels of an axis need the same dynamics. A digital filter gives every sensor of
absolute motion the same second-order high-pass from velocity, s^2 / p(s): an accelerometer gets a leaky integrator, and
a geophone's corner is moved to the common corner. This is the highest corner of all sensors, so that no channel is
amplified below its own corner; for a lower one, specify a compensation filter for the geophone in the rig file.
Position sensors are differentiated: they give the velocity of the payload relative to the chassis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import cascade
from avis_ctrl.lti.statespace import StateSpace, gain
from avis_ctrl.rigs.instruments import Sensor
from avis_ctrl.rigs.logical_axes import SensorAxes, sensor_axes
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True)
class SensingSettings:
    """differentiator_share : corner of the position sensors' differentiator, as a fraction of the sample rate; as far
    above the loop's band as the bilinear map allows."""

    differentiator_share: float = 0.2


SETTINGS = SensingSettings()


@dataclass(frozen=True)
class Filter:
    """leading * prod(s - z) / prod(s - p), roots in rad/s."""

    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    leading: float = 1.0

    def system(self) -> StateSpace:
        """The filter as a state-space system."""
        zeros, poles = (np.real_if_close(np.array(roots, complex)) for roots in (self.zeros, self.poles))
        return cascade(zeros, poles, self.leading)

    @property
    def is_one(self) -> bool:
        """Whether it is the identity."""
        return not self.zeros and not self.poles and self.leading == 1.0

    def over(self, other: Filter) -> Filter:
        """Quotient of two filters, with equal roots cancelled."""
        zeros, poles = _cancelled([*self.zeros, *other.poles], [*self.poles, *other.zeros])
        return Filter(zeros, poles, self.leading / other.leading)


def _cancelled(zeros: list[complex], poles: list[complex]) -> tuple[tuple[complex, ...], tuple[complex, ...]]:
    left = list(poles)
    kept = []
    for zero in zeros:
        if zero in left:
            left.remove(zero)
        else:
            kept.append(zero)
    return tuple(kept), tuple(left)


@dataclass(frozen=True, eq=False)
class NoiseGroup:
    """Sensors whose noise has the same spectral shape.

    shape : unit white density -> noise of the noisiest sensor as seen velocity [m/s/sqrt(Hz)].
    share : (n_s,) noise of each sensor relative to the noisiest; zero for sensors of other groups.
    flicker, offset_rtHz : largest 1/f noise density at 1 Hz, and largest offset [sqrt(Hz)], over the white noise
        density of the noisiest sensor.
    """

    shape: StateSpace
    share: np.ndarray
    flicker: float
    offset_rtHz: float


@dataclass(frozen=True, eq=False)
class Sensing:
    """Axes as measured by the controller.

    decoder : from conditioned channels to velocities of `axes`.
    chain : absolute velocity -> seen velocity, unit passband gain.
    relative_chain : displacement relative to the chassis [m] -> seen velocity; None without position sensors.
    conditioning : filter of each channel, from volts over gain to seen velocity; None for no filter.
    noise : of the sensors that the axes use.
    """

    decoder: SensorAxes
    chain: StateSpace
    relative_chain: StateSpace | None
    conditioning: tuple[StateSpace | None, ...]
    noise: tuple[NoiseGroup, ...]

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the measured axes."""
        return self.decoder.axes

    @property
    def relative(self) -> tuple[str, ...]:
        """Axes whose velocity is measured relative to the chassis, not absolutely."""
        return self.decoder.relative


def sensing(rig: Rig, axes: Sequence[str], integrator_corner_Hz: float) -> Sensing:
    """Measurement of these axes with the rig's sensors.

    integrator_corner_Hz : corner of the accelerometers' leaky integrators.

    Raises
    ------
    InputError : axes that the sensors cannot distinguish.
    """
    decoder, filters = sensor_axes(rig, axes), conditioning(rig, integrator_corner_Hz)
    target, against = _targets(rig, integrator_corner_Hz)
    used = np.any(np.abs(decoder.decoding) > 1e-9 * np.abs(decoder.decoding).max(), axis=0)
    return Sensing(
        decoder,
        target.system() if target else gain(1.0),
        against.system() if against else None,
        tuple(None if one.is_one else one.system() for one in filters),
        _noise(rig, filters, used),
    )


def conditioning(rig: Rig, integrator_corner_Hz: float) -> tuple[Filter, ...]:
    """Filter of each channel, from volts over gain to seen velocity."""
    target, against = _targets(rig, integrator_corner_Hz)
    found = []
    for one in rig.sensors():
        asked = target if one.inertial else against
        assert asked is not None
        # Referred to velocity, the chain of an accelerometer has one more zero at s = 0.
        own = Filter((*one.zeros, 0j) if one.quantity == "acceleration" else one.zeros, one.poles, one.leading)
        found.append(asked.over(own))
    return tuple(found)


def _targets(rig: Rig, integrator_corner_Hz: float) -> tuple[Filter | None, Filter | None]:
    """Filters from absolute velocity, and from displacement relative to the chassis, to seen velocity; None without
    such sensors."""
    # The anti-alias filters are all equal and not compensated: their poles remain in the seen velocity.
    lags = next((one.low_pass for one in rig.sensors()), ())
    size = float(np.prod(np.abs(lags)))
    own = [_high_pass(one, integrator_corner_Hz) for one in rig.sensors() if one.inertial]
    target = max(own, key=lambda poles: float(np.prod(np.abs(poles)))) if own else None
    against = [one for one in rig.sensors() if not one.inertial]
    relative = None
    if against:
        corner = 2 * np.pi * SETTINGS.differentiator_share * rig.sample_rate_Hz
        own = [one.poles[: len(one.poles) - len(lags)] for one in against]
        slowest = min(own, key=lambda poles: abs(poles[0]) if poles else np.inf)
        poles = (*slowest, *lags, complex(-corner))
        relative = Filter((0j,), poles, float(np.prod(np.abs(poles))))
    return Filter((0j, 0j), (*target, *lags), size) if target else None, relative


def _high_pass(sensor: Sensor, integrator_corner_Hz: float) -> tuple[complex, ...]:
    """Poles of the second-order high-pass from velocity of a sensor, including its integrator."""
    own = sensor.poles[: len(sensor.poles) - len(sensor.low_pass)]
    return own if sensor.quantity == "velocity" else (*own, complex(-2 * np.pi * integrator_corner_Hz))


def _noise(rig: Rig, filters: Sequence[Filter], used: np.ndarray) -> tuple[NoiseGroup, ...]:
    sensors, groups = rig.sensors(), []
    density = np.array([one.motion_density(rig.converter, rig.sample_rate_Hz) for one in sensors])
    flicker = np.array([one.flicker_density(rig.sample_rate_Hz) for one in sensors])
    offset = np.array([one.offset_V / one.gain for one in sensors])
    # Integrated noise falls as 1/s up to half the sample rate and is white above, where sampling folds it back.
    nyquist = np.pi * rig.sample_rate_Hz
    for one in dict.fromkeys(f for f, in_use in zip(filters, used, strict=True) if in_use):
        own = np.array([f == one for f in filters]) & used
        largest = float(density[own].max())
        excess = len(one.poles) - len(one.zeros)
        zeros, leading = (*one.zeros, *[complex(-nyquist)] * excess), one.leading * largest / nyquist**excess
        shape = gain([[largest]]) if one.is_one else Filter(zeros, one.poles, leading).system()
        share = np.where(own, density / largest if largest else 1.0, 0.0)
        groups.append(
            NoiseGroup(
                shape,
                share,
                *(float(np.max(values[own])) / largest if largest else 0.0 for values in (flicker, offset)),
            )
        )
    if not groups:
        raise InputError("expected sensors that measure the axes", field="sensors", value=[one.name for one in sensors])
    return tuple(groups)
