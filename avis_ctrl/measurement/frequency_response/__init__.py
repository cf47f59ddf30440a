"""Frequency responses from measurements: the class for estimates, and the estimators."""

from avis_ctrl.measurement.frequency_response.response import FrequencyResponse

__all__ = ["FrequencyResponse"]
