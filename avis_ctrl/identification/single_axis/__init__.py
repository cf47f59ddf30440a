"""Models of one axis, identified from measured records in the same frame as the rig: see `identify_single_axis`."""
