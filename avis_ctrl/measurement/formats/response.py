"""Frequency responses from other instruments: entries with coherence, variance, or a stated standard deviation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats.common import (
    INPUT_UNITS,
    OUTPUT_UNITS,
    as_names,
    as_number,
    as_text,
    kind_of,
    unit_of,
)
from avis_ctrl.measurement.formats.records import Hints
from avis_ctrl.measurement.frequency_response import FrequencyResponse

COVARIANCES = ("noise", "gram", "measurement_noise", "distortion")
SINGLE_PRECISION = 2.0**-24


@dataclass(frozen=True)
class CoherenceSettings:
    """rounding : excess of a coherence over 1 that is accepted [1]: printed numbers are rounded."""

    rounding: float = 1e-5


SETTINGS = CoherenceSettings()


def coherence_variance(value: np.ndarray, coherence: np.ndarray, averages: float) -> np.ndarray:
    """E|error|^2 of H1 estimates of one input at a time, from ordinary coherence and the number of averages.

    Bendat and Piersol (Random Data, 4th ed., 2010, chapter 9) give the normalised random error of the gain,
    sqrt(1 - c) / sqrt(2 c n_d), and the same in radians for the phase. Gain and phase errors are orthogonal, so
    E|error|^2 is the sum of both squares, |G|^2 (1 - c) / (c n_d). Their c is the true coherence. The sample coherence
    is computed from the residual of one coefficient fitted to n_d averages, so that n_d - 1 instead of n_d makes the
    estimate unbiased. Overlapping averages count as fewer than their number.

    value, coherence : of the same shape, 0 < coherence <= 1; a coherence of 1 counts as 1 - 2^-24, the resolution of
    single precision; averages : number of independent blocks, at least 2.
    """
    lost = np.maximum(1.0 - coherence, SINGLE_PRECISION)
    return np.abs(value) ** 2 * lost / (coherence * (averages - 1.0))


def stated_response(fields: Mapping[str, Any], hints: Hints) -> FrequencyResponse:
    """The frequency response of a file.

    Without noise and gram the entries count as independent. Lines where some coherence is 0 are left out, because the
    response is not determined there; `FrequencyResponse.method` states this.

    fields : frequency_Hz (n,), value (n, n_y, n_u), inputs, outputs, input_unit, output_unit; one of variance (n, n_y,
    n_u) E|error|^2, ordinary coherence (n, n_y, n_u) with averages, noise with gram; optional: method, dof,
    measurement_noise, distortion. hints : relative_standard_deviation, sqrt(E|error|^2) / |G|, is used only if the file
    states none of these.

    Raises
    ------
    InputError : a unit that does not suit a response; noise with units other than SI; no information on the errors, a
        coherence outside 0 .. 1, fewer than 2 averages, wrong shapes.
    """
    inputs, outputs = (as_names(fields[field], field) for field in ("inputs", "outputs"))
    over = unit_of(hints.y_unit or as_text(fields["output_unit"], "output_unit"), "output_unit", OUTPUT_UNITS)
    under = unit_of(hints.u_unit or as_text(fields["input_unit"], "input_unit"), "input_unit", INPUT_UNITS)
    factor, method = over.factor / under.factor, as_text(fields.get("method", ""), "method")
    labels: dict[str, Any] = {"inputs": inputs, "outputs": outputs, "input_unit": under.si, "output_unit": over.si}
    if fields.get("noise") is not None and fields.get("gram") is not None:
        if factor != 1.0:
            raise InputError("expected SI units for noise and gram", field="units", value=str(fields["output_unit"]))
        dof = fields.get("dof", np.inf)
        labels["dof"] = np.inf if np.array_equal(dof, np.inf) else as_number(dof, "dof")
        labels |= {field: fields.get(field) for field in COVARIANCES}
        return FrequencyResponse(fields["frequency_Hz"], fields["value"], method=method, **labels)
    frequency = _plain(fields["frequency_Hz"], "frequency_Hz", "fiu")
    value = _plain(fields["value"], "value", "fiuc").astype(complex) * factor
    shape = (len(frequency), len(outputs), len(inputs)) if frequency.ndim == 1 else None
    if value.shape != shape:
        raise InputError(f"expected shape {shape}: lines, outputs, inputs", field="value", value=value.shape)
    keep, how = np.ones(len(frequency), bool), ""
    if fields.get("variance") is not None:
        variance = _plain(fields["variance"], "variance", "fiu") * factor**2
        if variance.shape != shape or not np.all(variance >= 0):
            message = f"expected shape {shape} and no negative or missing value"
            raise InputError(message, field="variance", value=variance.shape)
    elif fields.get("coherence") is not None:
        coherence, averages = _coherence(fields["coherence"], value.shape), _averages(fields, hints)
        keep = np.all(coherence > 0, axis=(1, 2))
        if not keep.any():
            raise InputError("expected a line at which no entry is 0", field="coherence")
        variance = np.zeros(value.shape)
        variance[keep] = coherence_variance(value[keep], coherence[keep], averages)
        how = f"variance from coherence, {averages:g} averages"
    elif (share := hints.relative_standard_deviation) is not None:
        if share <= 0:
            raise InputError("expected a positive number", field="relative_standard_deviation", value=share)
        variance = (share * np.abs(value)) ** 2
        how = f"stated relative standard deviation {share:g}"
    else:
        message = (
            "the file has neither variance nor coherence; pass relative_standard_deviation (such as 0.05) to state the "
            "errors"
        )
        raise InputError(message, field="uncertainty of the frequency response")
    lost = frequency[~keep]
    left_out = f"{len(lost)} lines of coherence 0 left out, the first at {lost[0]:g} Hz" if lost.size else ""
    method = "; ".join(filter(None, (method, how, left_out)))
    return FrequencyResponse(
        frequency[keep], value[keep], None, None, entry_variance=variance[keep], method=method, **labels
    )


def _averages(fields: Mapping[str, Any], hints: Hints) -> float:
    averages = hints.averages
    if averages is None:
        if fields.get("averages") is None:
            raise InputError("missing; the errors follow from coherence and the number of averages", field="averages")
        averages = as_number(fields["averages"], "averages")
    if averages < 2:
        message = "expected 2 or more; with one average the coherence is always 1"
        raise InputError(message, field="averages", value=averages)
    return averages


def _plain(array: np.ndarray, field: str, kinds: str) -> np.ndarray:
    array = np.asarray(array)
    if array.dtype.kind not in kinds:
        raise InputError("expected numbers", field=field, value=f"array of {kind_of(array.dtype)}")
    if (bad := ~np.isfinite(array)).any():
        found = f"{np.count_nonzero(bad)}, the first at line {np.argwhere(bad)[0][0]}"
        raise InputError(f"expected finite numbers; NaN or infinite: {found}", field=field)
    return array


def _coherence(coherence: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    coherence = _plain(coherence, "coherence", "fiu").astype(float)
    if coherence.shape == shape[:2] and shape[2] == 1:
        coherence = coherence[:, :, None]
    if coherence.shape == shape[:2]:
        message = (
            f"multiple coherence of {shape[2]} inputs does not determine the errors of single entries; expected the "
            "ordinary coherence of each entry, or variance"
        )
        raise InputError(message, field="coherence", value=coherence.shape)
    if coherence.shape != shape:
        raise InputError(f"expected shape {shape}", field="coherence", value=coherence.shape)
    if np.any(coherence < 0) or np.any(coherence > 1 + SETTINGS.rounding):
        worst = coherence.flat[np.argmax(np.abs(coherence - 0.5))]
        raise InputError("expected values from 0 to 1", field="coherence", value=float(worst))
    return np.minimum(coherence, 1.0)
