"""Physics and faults that the library has no name for, refitted beside its candidates.

The library is fixed; what can go wrong on a table is not. A fault without a name looks like some effect that has one:
crosstalk of two sensors like a tilted sensor, a dead zone like a lower force constant. Of candidates from the library
alone the nearest would win, and be named in the place of the fault. Here stands what an engineer would think of beside
the library, in few parameters: where one of these explains the data better, nothing is named, and the verdict says in
words what the table behaves like. None of them is ever named or part of a model that is handed out.

They act as all effects do.
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
    """Every one of them by name."""
    every = (SensorCrosstalk(), SensorCrosstalkOfAll(), SensorLate(), SensorResonance(), MotorLate(), *ADDED.values(),
             QuadraticStiffness(), QuadraticDrag(), Gyroscope())
    return {one.name: one for one in every}
