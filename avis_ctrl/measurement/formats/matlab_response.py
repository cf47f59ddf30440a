"""Frequency response in a .mat file: frequency_Hz, H, variance or coherence with averages, inputs, outputs, units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats.common import INPUT_UNITS, OUTPUT_UNITS, as_names, as_number, as_text, unit_of
from avis_ctrl.measurement.formats.flat import Hints
from avis_ctrl.measurement.formats.matlab_tree import Matrix, describe
from avis_ctrl.measurement.formats.response import response_from
from avis_ctrl.measurement.frequency_response import FrequencyResponse


def response(tree: Mapping[str, Any], hints: Hints) -> FrequencyResponse:
    """The frequency response that the variables hold.

    H is (n, n_y, n_u) or, as in an frd object's ResponseData, (n_y, n_u, n); MATLAB drops trailing ones.

    Raises
    ------
    InputError : a variable that is missing, of another kind or shape, or whose dimensions cannot be told apart.
    """
    frequency = _array(tree, "frequency_Hz").reshape(-1)
    H = _array(tree, "H")
    sizes = (len(frequency), *_sizes(tree, H, len(frequency)))
    names = {field: as_names(tree[field], field, count) if field in tree else
             tuple(f"{letter}{i + 1}" for i in range(count))
             for field, letter, count in (("outputs", "y", sizes[1]), ("inputs", "u", sizes[2]))}
    output_unit = unit_of(hints.y_unit or as_text(tree.get("output_unit", "V"), "output_unit"), "output_unit",
                          OUTPUT_UNITS)
    input_unit = unit_of(hints.u_unit or as_text(tree.get("input_unit", "V"), "input_unit"), "input_unit", INPUT_UNITS)
    factor = output_unit.factor / input_unit.factor
    variance = lines_first(_array(tree, "variance"), sizes, "variance") * factor ** 2 if "variance" in tree else None
    coherence = lines_first(_array(tree, "coherence"), sizes, "coherence") if "coherence" in tree else None
    averages = hints.averages
    if averages is None and "averages" in tree:
        averages = as_number(_array(tree, "averages"), "averages")
    return response_from(frequency, lines_first(H, sizes, "H") * factor, names["inputs"], names["outputs"],
                         variance=variance, coherence=coherence, averages=averages, input_unit=input_unit.si,
                         output_unit=output_unit.si, relative_standard_deviation=hints.relative_standard_deviation)


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
