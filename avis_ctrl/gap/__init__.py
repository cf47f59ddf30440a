"""The gap between a table's model and its measurement: the engine of `avis gap`.

As a name of the interface the package can be called: `avis_ctrl.gap(campaign, rig)` is
`avis_ctrl.interface.workflow.gap`.
"""

import importlib
import sys
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    def __call__(self, *arguments: Any, **options: Any) -> Any:
        # By name: the interface lies above this package.
        return importlib.import_module("avis_ctrl.interface.workflow").gap(*arguments, **options)


sys.modules[__name__].__class__ = _Callable
