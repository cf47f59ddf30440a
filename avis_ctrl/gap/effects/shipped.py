"""The effects that come with the product; importing this registers them."""

from avis_ctrl.gap.effects import chassis, drives, mounts, payload, sensors

__all__ = ["chassis", "drives", "mounts", "payload", "sensors"]
