"""Write excitation signals to HDF5, CSV or MATLAB .mat (v5) files. Every file includes the seed and settings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.io import savemat

from avis_ctrl.errors import InputError
from avis_ctrl.files import whole_file
from avis_ctrl.measurement.excitation.design import ExcitationSignals
from avis_ctrl.measurement.formats.hdf5_writing import replacing

SUFFIXES = (".h5", ".hdf5", ".csv", ".mat")
# Size limit of a variable in a version 5 .mat file.
MAT5_BYTES = 2**31


def require_suffix(path: Path) -> None:
    """Raise InputError if the name of the file does not end in one of the formats."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"expected a file name that ends in {', '.join(SUFFIXES)}", file=path)


def write_signals(signals: ExcitationSignals, path: str | Path, periods: int = 1, rig: str = "") -> None:
    """Write all records; a multisine is repeated `periods` times.

    .h5, .hdf5 : as a campaign without y: /records/NN/u with the campaign's attributes; file attributes
        format = "avis-excitation", version = 1, seed, and settings as JSON.
    .csv : settings as lines "# key = value", a header record,time_s,DRIVE.., and one line per sample.
    .mat : u (samples, drives, records), names, sample_rate_Hz, period_s, level_V, seed, settings (JSON).

    Raises
    ------
    InputError : another suffix, a number of periods below 1 (or other than 1 for noise), a file that cannot be written,
        too many samples for .mat.
    ComputationError : the disk is full; an existing file is then unchanged.
    """
    path = Path(path)
    require_suffix(path)
    if not isinstance(periods, (int, np.integer)) or periods < 1 or (periods > 1 and signals.period_s is None):
        message = "expected a whole number, 1 or more (noise is not periodic: 1)"
        raise InputError(message, field="periods", value=periods)
    writer = {".csv": _write_csv, ".mat": _write_mat}.get(path.suffix.lower(), _write_hdf5)
    writer(signals, int(periods), path, rig)


def _write_hdf5(signals: ExcitationSignals, periods: int, path: Path, rig: str) -> None:
    rate = signals.settings.sample_rate_Hz
    with replacing(path) as file:
        file.attrs.update(
            {
                "format": "avis-excitation",
                "version": 1,
                "rig": rig,
                "seed": signals.settings.seed,
                "settings": json.dumps(signals.stated()),
            }
        )
        for k, (one, level) in enumerate(zip(signals.u, signals.rms_V, strict=True)):
            record = np.tile(one, (periods, 1))
            group = file.create_group(f"records/{k:02d}")
            group.attrs.update(
                {
                    "sample_rate_Hz": rate,
                    "excitation": signals.kind,
                    "level_V": float(np.sqrt(np.mean(level**2))),
                    "start_s": k * len(record) / rate,
                }
            )
            if signals.period_s is not None:
                group.attrs["period_s"] = signals.period_s
            volts = group.create_dataset("u", data=record)
            volts.attrs.update({"names": list(signals.settings.inputs), "unit": "V"})


def _write_csv(signals: ExcitationSignals, periods: int, path: Path, rig: str) -> None:
    settings = {"rig": rig, "excitation": signals.kind, "period_s": signals.period_s, **signals.stated()}
    time = np.arange(periods * signals.u.shape[1]) / signals.settings.sample_rate_Hz
    with whole_file(path) as file:
        file.writelines(f"# {key} = {json.dumps(value)}\n".encode() for key, value in settings.items())
        file.write((",".join(["record", "time_s", *signals.settings.inputs]) + "\n").encode())
        for k, record in enumerate(signals.u):
            rows = zip(time.tolist(), np.tile(record, (periods, 1)).tolist(), strict=True)
            file.writelines(f"{k},{t!r},{','.join(map(repr, row))}\n".encode() for t, row in rows)


def _write_mat(signals: ExcitationSignals, periods: int, path: Path, rig: str) -> None:
    if (total := signals.u.nbytes * periods) >= MAT5_BYTES:
        message = f"expected less than {MAT5_BYTES / 2**30:g} GiB in a .mat file; write .h5 instead"
        raise InputError(message, file=path, field="u", value=f"{total / 2**30:.1f} GiB")
    content = {
        "u": np.moveaxis(np.tile(signals.u, (1, periods, 1)), 0, -1),
        "names": np.array(signals.settings.inputs, object),
        "rig": rig,
        "sample_rate_Hz": signals.settings.sample_rate_Hz,
        "period_s": np.nan if signals.period_s is None else signals.period_s,
        "excitation": signals.kind,
        "level_V": signals.rms_V,
        "seed": signals.settings.seed,
        "settings": json.dumps(signals.stated()),
    }
    with whole_file(path) as file:
        savemat(file, content, do_compression=True, appendmat=False)
