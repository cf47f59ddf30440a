"""Linear systems: state-space models with named signals, connection by name, norms, realisations."""

from avis_ctrl.lti.connect import connect, lft_lower, lft_upper, summing_junction
from avis_ctrl.lti.norms import hinf_norm
from avis_ctrl.lti.realisation import balance, balanced_truncation, discretise, minimal
from avis_ctrl.lti.statespace import StateSpace, append, gain, tf

__all__ = [
    "StateSpace",
    "append",
    "balance",
    "balanced_truncation",
    "connect",
    "discretise",
    "gain",
    "hinf_norm",
    "lft_lower",
    "lft_upper",
    "minimal",
    "summing_junction",
    "tf",
]
