"""What a model of one axis lacks: see `find_axis_gap` and `find_axis_gap_in`."""
