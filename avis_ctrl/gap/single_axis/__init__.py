"""What is missing from a model of one axis, named from measured records: see `find_axis_gap`."""

from avis_ctrl.gap.single_axis.find import find_axis_gap, find_axis_gap_in
from avis_ctrl.gap.single_axis.result import AxisEffect, AxisGap, AxisStage

__all__ = ["AxisEffect", "AxisGap", "AxisStage", "find_axis_gap", "find_axis_gap_in"]
