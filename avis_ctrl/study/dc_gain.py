"""DC gain: drive voltages that a controller demands for a constant offset of the sensor electronics.

Velocity sensors and accelerometers have no output at zero frequency, so the loop is open there: the voltages are the DC
gain of the controller times the offsets. The signals of position sensors are differentiated; their DC gain is zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.simulation.discrete import digital_controller, gain_at_rest
from avis_ctrl.simulation.sampled_loop import SampledLoop


@dataclass(frozen=True, eq=False)
class AtRest:
    """A sampled controller at zero frequency.

    gain_V_per_V : (n_u, n_y) drive volts per sensor volt. offset_V : (n_y,) largest offset of each channel.
    limits_V : (n_u,) of the drives. drives : their names.
    gain_Ns_per_m : largest gain from the velocities of the controlled axes to forces, rotations at the edge.
    """

    gain_V_per_V: np.ndarray
    offset_V: np.ndarray
    limits_V: np.ndarray
    drives: tuple[str, ...]
    gain_Ns_per_m: float

    @property
    def drive_V(self) -> np.ndarray:
        """(n_u,) largest voltage caused by the offsets, each with the worst sign for the drive."""
        return np.abs(self.gain_V_per_V) @ self.offset_V

    @property
    def worst(self) -> int:
        """Index of the drive with the largest fraction of its range used."""
        return int(np.argmax(self.drive_V / self.limits_V))

    @property
    def percent(self) -> float:
        """Percentage of that drive's range used."""
        return 100 * float(self.drive_V[self.worst] / self.limits_V[self.worst])

    @property
    def worst_offset_V(self) -> np.ndarray:
        """(n_y,) offsets, with signs, that cause this voltage."""
        return np.where(self.gain_V_per_V[self.worst] < 0, -1.0, 1.0) * self.offset_V

    def words(self) -> str:
        """The effect of the offsets as a sentence without a full stop."""
        return (
            f"offsets of up to {1e3 * np.max(self.offset_V, initial=0.0):.3g} mV per channel require up to "
            f"{self.drive_V[self.worst]:.3g} V of {self.limits_V[self.worst]:g} V (drive "
            f"{self.drives[self.worst]}; gain at zero frequency {np.max(np.abs(self.gain_V_per_V)):.3g} V/V, "
            f"{self.gain_Ns_per_m:.3g} N s/m)"
        )

    def as_dict(self) -> dict[str, Any]:
        """For result.json and certificate.json."""
        return {
            "gain_V_per_V": float(np.max(np.abs(self.gain_V_per_V))),
            "gain_Ns_per_m": self.gain_Ns_per_m,
            "offset_V": float(np.max(self.offset_V, initial=0.0)),
            "drive_V": float(self.drive_V[self.worst]),
            "drive": self.drives[self.worst],
            "percent_of_limit": self.percent,
        }


def at_rest(loop: SampledLoop) -> AtRest:
    """DC behaviour of a loop's controller with the offsets of its rig's channels; inf if the controller integrates."""
    rig = loop.rig
    return AtRest(
        gain_at_rest(digital_controller(loop)),
        np.array([one.offset_V for one in rig.sensors()]),
        loop.limits_V,
        rig.equations_of_motion().actuators,
        float(np.linalg.norm(gain_at_rest(loop.K), 2)),
    )
