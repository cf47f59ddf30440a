"""Many designs, skyhooks, gap searches or function calls from one points file, on one machine or on a cluster."""
