"""What is missing from a model of one axis, named from measured records: see `find_axis_gap`."""


from avis_ctrl.gap.single_axis.result import AxisEffect, AxisGap, AxisStage


