"""avis_ctrl: a workbench for active vibration isolation tables.

Names are loaded on first use, so that `import avis_ctrl` and `avis --help` answer at once.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.4.0"

_PLACES = {
    "StateSpace": "avis_ctrl.lti",
    "RealScalar": "avis_ctrl.uncertainty.blocks",
    "ComplexScalar": "avis_ctrl.uncertainty.blocks",
    "ComplexFull": "avis_ctrl.uncertainty.blocks",
    "BlockStructure": "avis_ctrl.uncertainty.blocks",
    "hinfsyn": "avis_ctrl.robust.hinfsyn",
    "musyn": "avis_ctrl.robust.musyn",
    "mu": "avis_ctrl.robust.mu",
    "mu_peak": "avis_ctrl.robust.mu_peak",
    "worst_case_gain": "avis_ctrl.robust.mu_peak",
}

__all__ = ["__version__", *_PLACES]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'avis_ctrl' has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
