"""Physics and faults that have no name in the library, fitted in competition with its candidates.

The library is finite; the faults that a table can have are not. An unnamed fault resembles some named effect: crosstalk
of two sensors resembles a tilted sensor, a dead zone a lower force constant. With candidates from the library alone,
the closest one would win and be named in place of the fault. This module contains the faults that an engineer would
consider beyond the library, in few parameters. If one of them explains the data better, nothing is named, and the
verdict describes how the table behaves. They are never named and never part of an exported model.

They act on the table as all effects do.
"""

from __future__ import annotations

from avis_ctrl.gap.effects.unnamed.added import ADDED
from avis_ctrl.gap.effects.unnamed.base import UnnamedFault
from avis_ctrl.gap.effects.unnamed.channels import (
    MotorLate,
    SensorCrosstalk,
    SensorCrosstalkOfAll,
    SensorLate,
    SensorResonance,
)
from avis_ctrl.gap.effects.unnamed.table import Gyroscope, QuadraticDrag, QuadraticStiffness


def unnamed_faults() -> dict[str, UnnamedFault]:
    """All unnamed faults by name."""
    every = (
        SensorCrosstalk(),
        SensorCrosstalkOfAll(),
        SensorLate(),
        SensorResonance(),
        MotorLate(),
        *ADDED.values(),
        QuadraticStiffness(),
        QuadraticDrag(),
        Gyroscope(),
    )
    return {one.name: one for one in every}
