"""Gates: checks of measured records before any model is fitted to them."""

from avis_ctrl.measurement.gates.examine import GATES, examine
from avis_ctrl.measurement.gates.finding import Expectation, Finding, Limit, Picture, Series, Severity

__all__ = ["GATES", "Expectation", "Finding", "Limit", "Picture", "Series", "Severity", "examine"]
