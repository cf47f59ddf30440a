"""Single-axis models identified from records, in the same framework as the rig: see `identify_single_axis`."""
