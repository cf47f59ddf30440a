"""One axis at a time, from measured files: seismometer, drive with friction, oscillator.   single_axis.py FOLDER

FOLDER holds seismometer_sm3/, emps/ and silverbox/ (tychoaussie/Sigcal_v1; EMPS of Janot, Gautier and Brunot; the
Silverbox of Wigren and Schoukens). Those that are absent are passed over.
"""
import sys
from pathlib import Path

import avis_ctrl as ac

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "data")
count = {"drive": 0.9425e-6, "coil": 0.9425e-6, "displacement": 0.9442e-6 * 0.9932e-3 * 0.579}  # V and m a count
emps, scale = {"force": "vir", "position": "qm", "t": "t"}, {"force": 35.15065188}
requests = [
    ("SM-3 seismometer, stepped sine", "seismometer", "seismometer_sm3",
     {"drive": "FuncGen", "coil": "Current", "displacement": "Laser", "t": "Seconds"}, {"scale": count}),
    ("SM-3 seismometer, free decay with an open coil, its last ten seconds", "decay",
     "seismometer_sm3/SM3_SN001_freeperiod.csv", {"y": "Laser", "t": "Seconds"},
     {"corner_Hz": 0.5, "damping": 0.01, "start_s": 39.0}),
    ("EMPS drive, instruments from the reference", "drive", "emps/DATA_EMPS.mat", {**emps, "reference": "qg"},
     {"scale": scale}),
    ("EMPS drive without Coulomb friction", "drive", "emps/DATA_EMPS.mat", emps,
     {"scale": scale, "coulomb": "none", "offset": False}),
    ("EMPS drive, friction of each direction", "drive", "emps/DATA_EMPS.mat", emps,
     {"scale": scale, "coulomb": "asymmetric"}),
    ("Silverbox, whole record", "oscillator", "silverbox/Schroeder80mV.mat", {"u": "V1", "y": "V2"},
     {"sample_rate_Hz": 1e7 / 2 ** 14, "band_Hz": (1.0, 200.0)}),
]
for title, kind, where, columns, options in requests:
    if (folder / where).exists():
        fit = ac.single_axis(kind, folder / where, columns, **options)
        print(title, fit.model, *fit.lines(), "", sep="\n  ")
    else:
        print(f"{title}: {folder / where} is absent")
