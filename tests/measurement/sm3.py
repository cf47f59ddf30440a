"""Reader of the SM-3 seismometer's stepped-sine calibration (tychoaussie/Sigcal_v1), for tests and designs.

One CSV per frequency, channels "SM-3 Z", "FuncGen", "Current", "Laser" in counts of the converter. By its label
"Current" is a
drive, and so it is read; whether that is true is for the gates to say.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader

DRIVES, SENSORS = ("FuncGen", "Current"), ("SM-3 Z", "Laser")


def sm3_record(path: Path) -> Record:
    """One CSV; named after its frequency, such as "0_2Hz"."""
    with open(path, encoding="utf-8") as file:
        columns = file.readline().strip().split(",")
    wanted = [*DRIVES, *SENSORS, "Seconds"]
    if missing := [name for name in wanted if name not in columns]:
        raise InputError(f"expected columns {wanted}", file=path, field="header", value=missing)
    table = np.loadtxt(path, delimiter=",", skiprows=1, usecols=[columns.index(name) for name in wanted])
    seconds = table[:, -1]
    rate = (len(seconds) - 1) / (seconds[-1] - seconds[0])
    # The time stamps carry microseconds of a sample time of 7.68 ms.
    rate = 1 / round(1 / rate, 6)
    level = float(np.std(table[:, 0]))
    header = RecordHeader(
        path.stem, rate, len(table), DRIVES, SENSORS, "sine", level, float(seconds[0]), None, "counts", "counts"
    )
    return Record(header, table[:, :2], table[:, 2:4])


def sm3_campaign(folder: Path) -> Campaign:
    """All stepped-sine records, by frequency."""
    paths = sorted(folder.glob("*_*Hz.csv"), key=lambda p: float(p.stem.removesuffix("Hz").replace("_", ".")))
    return Campaign("SM-3", tuple(sm3_record(path) for path in paths), str(folder))
