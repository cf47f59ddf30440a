"""Faults of the signals themselves, checked before the physics: converter, hum, noise, floor motion."""
