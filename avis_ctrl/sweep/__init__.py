"""Many designs, skyhooks, gaps or functions from one file of points, on one machine or on a cluster."""
