"""What a model of one axis lacks: see `find`."""

from avis_ctrl.gap.axis.find import find_axis_gap, find_axis_gap_in
from avis_ctrl.gap.axis.records import Signals

__all__ = ["Signals", "find_axis_gap", "find_axis_gap_in"]
