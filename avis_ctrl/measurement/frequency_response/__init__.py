"""Frequency responses from measurements: what an estimate holds, and the estimators."""

from avis_ctrl.measurement.frequency_response.response import FrequencyResponse

__all__ = ["FrequencyResponse"]
