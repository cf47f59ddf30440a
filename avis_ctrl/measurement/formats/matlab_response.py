"""Frequency response in a .mat file: frequency_Hz, H, variance or coherence with averages, inputs, outputs, units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats.common import as_names
from avis_ctrl.measurement.formats.matlab_tree import Matrix, describe
from avis_ctrl.measurement.formats.records import Hints
from avis_ctrl.measurement.formats.response import stated_response
from avis_ctrl.measurement.frequency_response import FrequencyResponse


def response(tree: Mapping[str, Any], hints: Hints) -> FrequencyResponse:
    """The frequency response that the variables hold.

    H is (n, n_y, n_u) or, as in an frd object's ResponseData, (n_y, n_u, n); MATLAB drops trailing ones.

    Raises
    ------
    InputError : a variable that is missing, of another kind or shape, or whose dimensions cannot be told apart.
    """
    frequency, H = _array(tree, "frequency_Hz").reshape(-1), _array(tree, "H")
    n_y, n_u = _sizes(tree, H, len(frequency))
    fields = {"input_unit": "V", "output_unit": "V", "outputs": [f"y{i + 1}" for i in range(n_y)],
              "inputs": [f"u{i + 1}" for i in range(n_u)]}
    fields |= {field: tree[field] for field in fields if field in tree}
    for field, count in (("outputs", n_y), ("inputs", n_u)):
        as_names(fields[field], field, count)
    shaped = {field: lines_first(_array(tree, field), (len(frequency), n_y, n_u), field)
              for field in ("H", "variance", "coherence") if field in tree}
    averages = {"averages": _array(tree, "averages")} if "averages" in tree else {}
    return stated_response({"frequency_Hz": frequency, "value": shaped.pop("H"), **fields, **shaped, **averages}, hints)


def _array(tree: Mapping[str, Any], name: str) -> np.ndarray:
    value = tree[name]
    if not isinstance(value, Matrix) or value.kind not in "fiuc":
        raise InputError("expected a numeric array", field=name, value=describe(value))
    return value.read()


def _sizes(tree: Mapping[str, Any], H: np.ndarray, lines: int) -> tuple[int, int]:
    """Numbers of outputs and inputs, from their names or from a three-dimensional H."""
    if "outputs" in tree and "inputs" in tree:
        return len(as_names(tree["outputs"], "outputs")), len(as_names(tree["inputs"], "inputs"))
    if H.size == lines:
        return 1, 1
    if H.ndim == 3 and (H.shape[0] == lines) != (H.shape[2] == lines):
        return H.shape[1:] if H.shape[0] == lines else H.shape[:2]
    raise InputError("expected inputs and outputs, names that tell which dimension is what", field="H", value=H.shape)


def lines_first(array: np.ndarray, sizes: tuple[int, int, int], field: str) -> np.ndarray:
    """(n, n_y, n_u) of an array of that shape or of (n_y, n_u, n), trailing ones dropped."""
    n, n_y, n_u = sizes

    def padded(shape: tuple[int, ...]) -> tuple[int, ...]:
        while len(shape) > 2 and shape[-1] == 1:
            shape = shape[:-1]
        return shape
    first = padded(array.shape) == padded((n, n_y, n_u))
    last = padded(array.shape) == padded((n_y, n_u, n))
    if n_y == n_u == 1 and array.size == n:
        return array.reshape(sizes)
    if first and last:
        raise InputError(f"as many lines as channels ({n}): which dimension is the frequency cannot be told",
                         field=field, value=array.shape)
    if not first and not last:
        raise InputError(f"expected shape {sizes} or {(n_y, n_u, n)}: lines, outputs, inputs", field=field,
                         value=array.shape)
    return array.reshape(sizes) if first else np.moveaxis(array.reshape(n_y, n_u, n), 2, 0)
