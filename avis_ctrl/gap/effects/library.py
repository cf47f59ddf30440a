"""The library of effects: those supplied with the product, and those that a user has registered."""

from __future__ import annotations

from avis_ctrl.gap.effects import attached_oscillator, cable, chassis, drives, flexible_mode, mounts, payload, sensors
from avis_ctrl.gap.effects.base import Effect, registered

# Importing one of these files registers its effects.
FILES = (attached_oscillator, cable, chassis, drives, flexible_mode, mounts, payload, sensors)


def library() -> dict[str, Effect]:
    """All effects by name."""
    return registered()
