"""One axis at a time, from measured files: a seismometer, a drive with friction, an oscillator with a hardening spring.

    python designs/single_axis.py FOLDER

FOLDER holds seismometer_sm3/, emps/ and silverbox/ (tychoaussie/Sigcal_v1; EMPS of Janot, Gautier and Brunot; the
Silverbox of Wigren and Schoukens). Those that are absent are passed over.
"""

import sys
from pathlib import Path

from avis_ctrl.identification.single_axis.identify import identify_single_axis

folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("data")

# What each recorded count means, from the calibration file beside the records.
microvolt = {"drive": 0.9425e-6, "coil": 0.9425e-6}
metre = 0.9442e-6 * 0.9932e-3 * 0.579

requests = [
    ("SM-3 seismometer, stepped sine", "seismometer", "seismometer_sm3",
     {"drive": "FuncGen", "coil": "Current", "displacement": "Laser", "t": "Seconds"},
     {"scale": microvolt | {"displacement": metre}}),
    ("SM-3 seismometer, free decay with an open coil, its last ten seconds", "decay",
     "seismometer_sm3/SM3_SN001_freeperiod.csv", {"y": "Laser", "t": "Seconds"},
     {"corner_Hz": 0.5, "damping": 0.01, "start_s": 39.0}),
    ("EMPS drive, instruments from the reference", "drive", "emps/DATA_EMPS.mat",
     {"force": "vir", "position": "qm", "reference": "qg", "t": "t"}, {"scale": {"force": 35.15065188}}),
    ("EMPS drive without Coulomb friction", "drive", "emps/DATA_EMPS.mat",
     {"force": "vir", "position": "qm", "t": "t"},
     {"scale": {"force": 35.15065188}, "coulomb": "none", "offset": False}),
    ("EMPS drive, friction of each direction", "drive", "emps/DATA_EMPS.mat",
     {"force": "vir", "position": "qm", "t": "t"}, {"scale": {"force": 35.15065188}, "coulomb": "asymmetric"}),
    ("Silverbox, whole record", "oscillator", "silverbox/Schroeder80mV.mat", {"u": "V1", "y": "V2"},
     {"sample_rate_Hz": 1e7 / 2 ** 14, "band_Hz": (1.0, 200.0)}),
]

for title, kind, where, columns, options in requests:
    if not (folder / where).exists():
        print(f"{title}: {folder / where} is absent\n")
        continue
    fit = identify_single_axis(kind, folder / where, columns, **options)
    print(f"{title}\n  {fit.model}")
    print("\n".join(f"  {line}" for line in fit.lines()) + "\n")
