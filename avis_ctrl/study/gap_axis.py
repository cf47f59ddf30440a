"""Files of `avis gap-axis`: gap.json, reports, the model, and its predictions of other records."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.files import write_together
from avis_ctrl.gap.axis.find import Reading, signals_in
from avis_ctrl.gap.axis.result import AxisGap
from avis_ctrl.gap.axis.settings import SETTINGS
from avis_ctrl.gap.axis.simulation import predicted
from avis_ctrl.measurement.formats.hdf5_writing import replacing
from avis_ctrl.rigs.file_errors import read_json
from avis_ctrl.study.files import as_json
from avis_ctrl.study.provenance import provenance

MODEL_FILE, MODEL_FORMAT = "axis_model.json", "avis-axis-model"
FILES = "gap.json", "gap.html", "gap.pdf", MODEL_FILE


def write_axis_gap(
    folder: Path,
    gap: AxisGap,
    source: str,
    options: dict[str, Any],
    reports: Callable[[AxisGap, str, dict[str, Any]], Sequence[bytes]],
) -> list[str]:
    """Write gap.json, gap.html, gap.pdf and, for a drive or an oscillator, axis_model.json; returns their names.

    reports : makes the two reports from gap, source and provenance.
    """
    inputs = json.dumps(options, sort_keys=True, default=str)
    libraries = ("numpy", "scipy", "numba")
    made = provenance(
        None, inputs, None, gap.seconds, libraries, measurement=source, options=options, settings=asdict(SETTINGS)
    )
    files = {
        "gap.json": as_json({**gap.to_json(), "provenance": made}),
        **dict(zip(FILES[1:3], reports(gap, source, made), strict=True)),
    }
    if "reading" in gap.model:
        files[MODEL_FILE] = as_json({"format": MODEL_FORMAT, "version": 1, **gap.model})
    # A model of an earlier run of another kind is removed: `avis predict` would use it.
    write_together(folder, files, [folder / name for name in FILES])
    return list(files)


def is_axis_gap(folder: Path) -> bool:
    """Whether a folder contains the output of `avis gap-axis`."""
    try:
        return json.loads((folder / "gap.json").read_text(encoding="utf-8")).get("format") == "avis-gap-axis"
    except (OSError, ValueError, AttributeError):
        return False


def write_axis_predictions(folder: Path, paths: Sequence[Path], out: Path) -> list[tuple[str, float, float]]:
    """Write /records/NAME/y_baseline and y_updated; returns the name and both relative r.m.s. errors of each record.

    The force of a drive is predicted from its motion. The motion of an oscillator is predicted from its input and its
    measured initial state. The errors exclude the start and the end of the records.

    Raises
    ------
    InputError : a folder without a model, records that do not fit. ComputationError : a motion that diverges.
    """
    path = folder / MODEL_FILE
    expected = "the model of a drive or an oscillator: other kinds are responses, which predict no record"
    model = read_json(path, MODEL_FORMAT, expected)
    try:
        reading = Reading(**{**model["reading"], "range_s": None})
    except (KeyError, TypeError) as error:
        raise InputError(f"expected a model as avis gap-axis writes it: {error}", file=path) from None
    kind = model["kind"]
    records, rate = signals_in(kind, paths, reading)
    if abs(rate / model["rate_Hz"] - 1) > 1e-3:
        raise InputError(
            f"expected records of {model['rate_Hz']:g} Hz, as the model's", field="sample_rate_Hz", value=rate
        )
    errors = []
    with replacing(out) as file:
        file.attrs.update({"format": "avis-prediction", "version": 1, "kind": kind})
        for one in records:
            group, left = file.require_group(f"records/{one.name}"), []
            group.attrs["sample_rate_Hz"] = rate
            measured = one.force if kind == "drive" else one.position
            settled = slice(len(measured) // 20, len(measured) - len(measured) // 100)
            for which in ("baseline", "updated"):
                y = predicted(model, which, one, rate)
                group.create_dataset(f"y_{which}", data=y)
                left.append(float(np.std((y - measured)[settled]) / np.std(measured[settled])))
            errors.append((one.name, left[0], left[1]))
    return errors
