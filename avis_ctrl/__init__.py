"""avis_ctrl: a workbench for active vibration isolation tables and for robust control of any plant.

    import avis_ctrl as ac

From measurements to a controller; results have .summary(), .plot_...() and .save(folder):

rig                 a table: "avis", "halcyonics", "halcyonics_loaded" or a rig file
campaign            measured records or frequency responses from a file (HDF5, .mat, UFF 58, CSV)
simulate_campaign   records of the simulated nonlinear table
identify            parameters of a table and their uncertainty, from a campaign
gap                 the physical effects that the model of a table lacks
design              certified controllers for a table, with comparison, simulation and report
single_axis         a small model of one axis: seismometer, decay, drive, oscillator

Linear systems and robust control of any plant:

StateSpace          a linear system with named inputs and outputs
tf                  a system from the coefficients of a transfer function
ss                  a system from A, B, C, D, whose entries may be uncertain
connect             interconnection of systems by signal names
real                an uncertain real parameter
complex_disk        an uncertain complex number
dynamics            norm-bounded unknown stable dynamics
matrix              a matrix with uncertain entries
RealScalar          block of a (repeated) real parameter
ComplexScalar       block of a (repeated) complex number
ComplexFull         block of a full complex matrix
BlockStructure      the blocks of a structured perturbation
hinf_norm           largest gain of a system over frequency
uncertainty_weight  a weighting filter that covers the differences between responses
hinfsyn             H-infinity controller
mixed_sensitivity   H-infinity controller for weights on S, KS and T
musyn               mu controller (D-K iteration)
mu                  bounds of the structured singular value of matrices
mu_peak             peak of mu over frequency, with bounds that are also valid between grid points
worst_case_gain     the largest gain over all perturbations
robust_stability    robust stability margin: the largest uncertainty for which a loop is stable
robust_performance  robust performance margin: the same with a bound on the gain
disk_margin         simultaneous gain and phase margins in all channels
plot                bode, sigma, mu, transmissibility, dk_history, order, vc_curves
InputError          raised for invalid input, with a one-line message
ComputationError    raised if a computation fails, with a one-line message

Names are loaded on first use to keep `import avis_ctrl` and `avis --help` fast.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.4.0"

_MODULES = {
    "interface.workflow": "rig campaign simulate_campaign identify design single_axis",
    "lti": "StateSpace hinf_norm",
    "uncertainty.uncertain_models": "tf ss connect real complex_disk dynamics matrix",
    "errors": "InputError ComputationError",
    "uncertainty.blocks": "RealScalar ComplexScalar ComplexFull BlockStructure",
    "robust.hinfsyn": "hinfsyn",
    "robust.musyn": "musyn",
    "robust.mu": "mu",
    "robust.mu_peak": "mu_peak",
    "robust.robustness": "worst_case_gain robust_stability robust_performance",
    "robust.disk_margin": "disk_margin",
    "robust.mixed_sensitivity": "mixed_sensitivity",
    "uncertainty.uncertainty_weight": "uncertainty_weight",
}
_PLACES = {name: f"avis_ctrl.{module}" for module, names in _MODULES.items() for name in names.split()}
# Subpackages that are public names as well; `gap` is callable.
_PACKAGES = ("gap", "plot")

# Names of the same functions in MATLAB and in python-control (docs/reference/index.md).
_ELSEWHERE = {
    "ureal": "real",
    "ucomplex": "complex_disk",
    "ultidyn": "dynamics",
    "umat": "matrix",
    "uss": "ss",
    "robstab": "robust_stability",
    "robustperf": "robust_performance",
    "wcgain": "worst_case_gain",
    "mussv": "mu or mu_peak",
    "mixsyn": "mixed_sensitivity",
    "dksyn": "musyn",
    "diskmargin": "disk_margin",
    "disk_margins": "disk_margin",
    "ucover": "uncertainty_weight",
    "hinfnorm": "hinf_norm",
    "linfnorm": "hinf_norm",
    "bode": "plot.bode",
    "bode_plot": "plot.bode",
    "sigma": "plot.sigma",
    "singular_values_plot": "plot.sigma",
    "interconnect": "connect",
}

__all__ = ["__version__", *_PACKAGES, *_PLACES]


def __getattr__(name: str) -> Any:
    if name in _PACKAGES:
        return importlib.import_module(f"avis_ctrl.{name}")
    if name not in _PLACES:
        hint = f"; here its name is {_ELSEWHERE[name]}" if name in _ELSEWHERE else ""
        raise AttributeError(f"module 'avis_ctrl' has no attribute {name!r}{hint}")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
