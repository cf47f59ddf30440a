"""Estimates of the same response, from different records or pieces, pooled into one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.frequency_response.response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.spectra import hermitian_solve


def pool(responses: Sequence[FrequencyResponse], method: str = "") -> FrequencyResponse:
    """Minimum-variance mean of independent estimates with the same noise: G = (sum G_p S_p) inv(sum S_p).

    S_p are the Gram matrices; the noise covariances are averaged by their degrees of freedom. Noise and distortion
    stay separated where every estimate separated them.

    Raises
    ------
    InputError : none, estimates without Gram matrix, other lines, inputs or outputs.
    """
    if not responses:
        raise InputError("expected at least one estimate", field="responses")
    first = responses[0]
    for number, response in enumerate(responses):
        if response.gram is None or response.noise is None:
            raise InputError("expected estimates with noise covariance and Gram matrix, to pool them",
                             field=f"responses[{number}]", value=response.method)
        if (response.inputs, response.outputs) != (first.inputs, first.outputs):
            raise InputError(f"expected inputs {first.inputs} and outputs {first.outputs}",
                             field=f"responses[{number}]", value=(response.inputs, response.outputs))
        if not np.array_equal(response.frequency_Hz, first.frequency_Hz):
            raise InputError("expected the same frequencies in each estimate", field=f"responses[{number}]")
    gram = sum((np.asarray(r.gram) for r in responses), np.zeros_like(np.asarray(first.gram)))
    value = hermitian_solve(sum((r.value @ r.gram for r in responses), np.zeros_like(first.value)), gram)
    return FrequencyResponse(first.frequency_Hz, value, _mean(responses, "noise"), gram, first.inputs, first.outputs,
                             first.input_unit, first.output_unit, float(sum(r.dof for r in responses)),
                             _mean(responses, "measurement_noise"), _mean(responses, "distortion"),
                             method=method or f"{first.method}; {len(responses)} estimates pooled")


def _mean(responses: Sequence[FrequencyResponse], part: str) -> np.ndarray | None:
    """Mean of the covariances by degrees of freedom; None where one of them lacks this part."""
    parts = [getattr(r, part) for r in responses]
    if any(p is None for p in parts):
        return None
    weight = np.array([r.dof for r in responses])
    weight = np.isinf(weight).astype(float) if np.any(np.isinf(weight)) else weight
    return np.tensordot(weight / weight.sum(), np.stack(parts), axes=1)
