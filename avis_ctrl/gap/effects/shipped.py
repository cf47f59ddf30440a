"""The effects that come with the product; importing this registers them."""

from avis_ctrl.gap.effects import drives, mounts, payload, sensors

__all__ = ["drives", "mounts", "payload", "sensors"]
