"""Faults of the signals themselves, looked for before physics is blamed: converter, hum, noise, floor motion."""
