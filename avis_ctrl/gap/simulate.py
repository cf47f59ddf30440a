"""Simulation in time of a table with effects."""

from avis_ctrl.gap.record_motion import motion_of

__all__ = ["motion_of"]
