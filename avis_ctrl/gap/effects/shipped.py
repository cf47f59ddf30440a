"""The effects that come with the product; importing this registers them."""

from avis_ctrl.gap.effects import attached, cable, chassis, drives, flexible_mode, mounts, payload, sensors

__all__ = ["attached", "cable", "chassis", "drives", "flexible_mode", "mounts", "payload", "sensors"]
