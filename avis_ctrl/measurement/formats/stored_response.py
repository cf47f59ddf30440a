"""Frequency response in an HDF5 campaign: the group /frf.

Data sets frequency_Hz (n,), value (n, n_y, n_u) complex, and one of: variance (n, n_y, n_u); coherence with the
attribute averages; noise (n, n_y, n_y) with gram (n, n_u, n_u), as `FrequencyResponse` holds them. Attributes inputs,
outputs, input_unit, output_unit; optional method, dof, and data sets measurement_noise, distortion.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats.common import (
    INPUT_UNITS,
    OUTPUT_UNITS,
    as_names,
    as_number,
    as_text,
    existing_file,
    kind_of,
    reading,
    require,
    require_small,
    unit_of,
)
from avis_ctrl.measurement.formats.hdf5 import FORMAT, VERSION, check_root, listed
from avis_ctrl.measurement.formats.hdf5_writing import replacing
from avis_ctrl.measurement.formats.response import response_from
from avis_ctrl.measurement.formats.stored import attributes, layout, member, open_hdf5, values
from avis_ctrl.measurement.frequency_response import FrequencyResponse

ATTRIBUTES = ("inputs", "outputs", "input_unit", "output_unit", "method", "dof", "averages")
COVARIANCES = ("noise", "gram", "measurement_noise", "distortion")


def write_frequency_response(path: str | Path, response: FrequencyResponse, rig: str = "unnamed") -> None:
    """Write a frequency response as an HDF5 campaign without records; under its name only when complete.

    Raises
    ------
    InputError : a place that cannot be written; the file is then as it was.
    ComputationError : the disk refuses; the file is then as it was.
    """
    with replacing(Path(path)) as file:
        file.attrs.update({"format": FORMAT, "version": VERSION, "rig": rig})
        group = file.create_group("frf")
        group["frequency_Hz"], group["value"] = response.frequency_Hz, np.asarray(response.value, complex)
        for field in (*COVARIANCES, "coherence"):
            if getattr(response, field) is not None:
                group[field] = getattr(response, field)
        if response.entry_variance is not None:
            group["variance"] = response.entry_variance
        for field in ("inputs", "outputs"):
            group.attrs[field] = np.array(getattr(response, field), dtype=h5py.string_dtype())
        for field in ("input_unit", "output_unit", "method", "dof"):
            group.attrs[field] = getattr(response, field)


def read_frequency_response(path: str | Path, averages: float | None = None,
                            relative_standard_deviation: float | None = None) -> FrequencyResponse:
    """The frequency response of an HDF5 campaign.

    averages, relative_standard_deviation : used where the file does not state them, see `response_from`.

    Raises
    ------
    InputError : not such a file, a missing or wrong attribute or data set; names file and field.
    """
    path = existing_file(path)
    with reading(path, "the HDF5 file"), open_hdf5(path) as file:
        check_root(file)
        group = member(file, "frf")
        if not isinstance(group, h5py.Group):
            raise InputError(f"missing; expected a group with frequency responses; the file holds {listed(file)}",
                             field="/frf")
        return _response(path, group, averages, relative_standard_deviation)


def _response(path: Path, group: h5py.Group, averages: float | None, relative: float | None) -> FrequencyResponse:
    frequency, value = _numbers(path, group, "frequency_Hz", "fiu"), _numbers(path, group, "value", "fiuc")
    if frequency is None or value is None:
        raise InputError(f"expected frequency_Hz and value; the group holds {listed(group)}", field="/frf")
    stated = attributes(group, *ATTRIBUTES)
    names = {field: as_names(require(stated, field, "/frf", "the channels' names"), f"/frf: {field}")
             for field in ("inputs", "outputs")}
    units = {field: unit_of(as_text(require(stated, field, "/frf", "such as 'V'"), f"/frf: {field}"),
                            f"/frf: {field}", allowed)
             for field, allowed in (("input_unit", INPUT_UNITS), ("output_unit", OUTPUT_UNITS))}
    factor = units["output_unit"].factor / units["input_unit"].factor
    method = as_text(stated.get("method", ""), "/frf: method")
    common = {"input_unit": units["input_unit"].si, "output_unit": units["output_unit"].si, "method": method}
    covariances = {field: _numbers(path, group, field, "fiuc") for field in COVARIANCES}
    coherence, variance = _numbers(path, group, "coherence", "fiu"), _numbers(path, group, "variance", "fiu")
    if covariances["noise"] is not None and covariances["gram"] is not None:
        if factor != 1.0:
            raise InputError("expected SI units beside noise and gram", field="/frf: units",
                             value=str(stated["output_unit"]))
        dof = stated.get("dof", np.inf)
        dof = np.inf if np.array_equal(dof, np.inf) else as_number(dof, "/frf: dof")
        return FrequencyResponse(frequency, value, inputs=names["inputs"], outputs=names["outputs"], dof=dof,
                                 coherence=coherence, **covariances, **common)  # type: ignore[arg-type]
    if "averages" in stated:
        averages = as_number(stated["averages"], "/frf: averages")
    response = response_from(frequency, value * factor, names["inputs"], names["outputs"], coherence=coherence,
                             variance=None if variance is None else variance * factor ** 2, averages=averages,
                             relative_standard_deviation=relative, **common)
    if variance is not None and coherence is not None and coherence.shape == response.value.shape[:2]:
        response = replace(response, coherence=coherence)
    return response


def _numbers(path: Path, group: h5py.Group, name: str, kinds: str) -> Any:
    """The data set of that name, None if there is none."""
    dataset = member(group, name)
    if dataset is None:
        return None
    if not isinstance(dataset, h5py.Dataset):
        raise InputError("expected numbers, found a group", field=f"/frf/{name}")
    shape, dtype = layout(dataset)
    if dtype.kind not in kinds:
        raise InputError(f"expected numbers, found {kind_of(dtype)}", field=f"/frf/{name}")
    require_small(path, math.prod(shape or ()) * dtype.itemsize)
    return values(dataset)
