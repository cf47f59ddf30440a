"""Skyhook damping as the baseline: decentralised velocity feedback, one loop per axis.

    F_a = -g_a  s/(s + w_tilt)  1/(s/w_roll + 1)  v_a

The high-pass filter keeps gravity (tilt) and sensor drift out of the loop. The low-pass filter rolls the loop gain off
above its band. The gains follow from the classical rule or from the tuning in `avis_ctrl.classical.tuning`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.rational import cascade
from avis_ctrl.lti.statespace import StateSpace, append


@dataclass(frozen=True)
class Skyhook:
    """Velocity feedback on some axes.

    Parameters
    ----------
    axes : names; rotations as edge displacements.
    gains : N s/m, one per axis (edge force per edge velocity for rotations).
    tilt_corner_Hz, roll_off_Hz : corners of the high-pass and of the low-pass filter.

    Raises
    ------
    InputError : a negative gain; corners that are not positive or not in ascending order.
    """

    axes: tuple[str, ...]
    gains: tuple[float, ...]
    tilt_corner_Hz: float
    roll_off_Hz: float

    def __post_init__(self) -> None:
        if len(self.axes) != len(self.gains):
            raise InputError(f"{len(self.axes)} axes but {len(self.gains)} gains", field="gains", value=self.gains)
        if not all(np.isfinite(g) and g >= 0 for g in self.gains):
            raise InputError(
                "expected gains of at least 0: a negative one feeds the motion", field="gains", value=self.gains
            )
        for field in ("tilt_corner_Hz", "roll_off_Hz"):
            value = getattr(self, field)
            if not (np.isfinite(value) and value > 0):
                raise InputError("expected a positive frequency", field=field, value=value)
        if self.tilt_corner_Hz >= self.roll_off_Hz:
            raise InputError(
                f"expected a corner below the roll-off at {self.roll_off_Hz:g} Hz",
                field="tilt_corner_Hz",
                value=self.tilt_corner_Hz,
            )

    @property
    def filter(self) -> StateSpace:
        """Both filters in series, with unit passband gain."""
        tilt, roll = 2 * np.pi * self.tilt_corner_Hz, 2 * np.pi * self.roll_off_Hz
        return cascade(np.zeros(1), [-tilt, -roll], roll)

    def loop(self, axis: str) -> StateSpace:
        """Loop of one axis: measured velocity [m/s] -> force [N]. Raises InputError for an unknown axis."""
        if axis not in self.axes:
            raise InputError(f"expected one of {list(self.axes)}", field="axis", value=axis)
        return self.filter.scaled(left=-self.gains[self.axes.index(axis)])

    def controller(self) -> StateSpace:
        """K with u = K y: inputs "seen_AXIS_dot" [m/s], outputs "command_AXIS" [N]."""
        return append(*(self.loop(axis).renamed([f"seen_{axis}_dot"], [f"command_{axis}"]) for axis in self.axes))


def critical_damping(
    mass: np.typing.ArrayLike, stiffness: np.typing.ArrayLike, damping: np.typing.ArrayLike
) -> np.ndarray:
    """The classical rule: g = 2 sqrt(k m) - c damps each axis critically if the axes are decoupled."""
    m, k, c = (np.asarray(values, float) for values in (mass, stiffness, damping))
    return np.maximum(2.0 * np.sqrt(k * m) - c, 0.0)
