"""The measured 3x3 fine steering mirror (Floren et al. 2024, CC BY 4.0) as a campaign."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader

RATE_HZ = 6400.0


def mirror(data: Path, level_mV: int) -> Campaign:
    """Six records of two periods; u measured [V], y [m]. Both have been recorded in the steady state."""
    folder = data / "fine_steering_mirror"
    u, y = (np.load(folder / f"{name}_{level_mV}mV_train.npy") for name in "uy")
    n, _, count, periods = u.shape
    records = []
    for k in range(count):
        header = RecordHeader(
            f"{level_mV}mV_{k}",
            RATE_HZ,
            n * periods,
            ("u1", "u2", "u3"),
            ("y1", "y2", "y3"),
            "multisine",
            level_mV / 1000,
            period_s=n / RATE_HZ,
            y_unit="m",
        )
        records.append(Record(header, *(np.concatenate([x[:, :, k, p] for p in range(periods)]) for x in (u, y))))
    return Campaign("fine steering mirror", tuple(records))
