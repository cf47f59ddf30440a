"""Frequency response in an HDF5 campaign: the group /frf.

Data sets frequency_Hz (n,), value (n, n_y, n_u) complex, and one of: variance (n, n_y, n_u); coherence with the
attribute averages; noise (n, n_y, n_y) with gram (n, n_u, n_u), as `FrequencyResponse` holds them. Attributes inputs,
outputs, input_unit, output_unit; optional method, dof, and data sets measurement_noise, distortion.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats.common import existing_file, kind_of, reading, require, require_small, within
from avis_ctrl.measurement.formats.hdf5 import FORMAT, VERSION, check_root, listed
from avis_ctrl.measurement.formats.hdf5_writing import replacing
from avis_ctrl.measurement.formats.records import Hints
from avis_ctrl.measurement.formats.response import COVARIANCES, stated_response
from avis_ctrl.measurement.formats.stored import attributes, layout, member, open_hdf5, values
from avis_ctrl.measurement.frequency_response import FrequencyResponse

# Attributes that have to be there, and data sets with the kinds of numbers that they hold.
NAMED = {"inputs": "the channels' names", "outputs": "the channels' names", "input_unit": "such as 'V'",
         "output_unit": "such as 'V'"}
DATASETS = {"frequency_Hz": "fiu", "value": "fiuc", "coherence": "fiu", "variance": "fiu",
            **dict.fromkeys(COVARIANCES, "fiuc")}


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
        for field in COVARIANCES:
            if getattr(response, field) is not None:
                group[field] = getattr(response, field)
        if response.entry_variance is not None:
            group["variance"] = response.entry_variance
        for field in ("inputs", "outputs"):
            group.attrs[field] = np.array(getattr(response, field), dtype=h5py.string_dtype())
        for field in ("input_unit", "output_unit", "method", "dof"):
            group.attrs[field] = getattr(response, field)


def read_frequency_response(path: str | Path, hints: Hints | None = None) -> FrequencyResponse:
    """The frequency response of an HDF5 campaign.

    hints : averages, relative_standard_deviation, see `response_from`.

    Raises
    ------
    InputError : not such a file, a missing or wrong attribute or data set; names file and field.
    """
    path = existing_file(path)
    with reading(path, "the HDF5 file"), open_hdf5(path) as file:
        check_root(file)
        group = member(file, "frf")
        if not isinstance(group, h5py.Group):
            raise InputError(f"missing; the file holds {listed(file)}", field="/frf")
        with within("/frf"):
            fields = {name: _numbers(path, group, name, kinds) for name, kinds in DATASETS.items()}
            if fields["frequency_Hz"] is None or fields["value"] is None:
                raise InputError(f"expected frequency_Hz and value; the group holds {listed(group)}")
            stated = attributes(group, *NAMED, "method", "dof", "averages")
            for field, expected in NAMED.items():
                require(stated, field, expected)
            return stated_response(fields | stated, hints or Hints())


def _numbers(path: Path, group: h5py.Group, name: str, kinds: str) -> Any:
    """The data set of that name, None if there is none."""
    dataset = member(group, name)
    if dataset is None:
        return None
    if not isinstance(dataset, h5py.Dataset):
        raise InputError("expected numbers, found a group", field=name)
    shape, dtype = layout(dataset)
    if dtype.kind not in kinds:
        raise InputError(f"expected numbers, found {kind_of(dtype)}", field=name)
    require_small(path, math.prod(shape or ()) * dtype.itemsize)
    return values(dataset)
