"""Search for the effects that a single-axis model lacks: see `find`."""

from avis_ctrl.gap.axis.find import find_axis_gap, find_axis_gap_in
from avis_ctrl.gap.axis.records import Signals

__all__ = ["Signals", "find_axis_gap", "find_axis_gap_in"]
