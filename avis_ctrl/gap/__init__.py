"""The gap between the model of a table and its measurement: the engine of `avis gap`.

The package is callable: `avis_ctrl.gap(campaign, rig)` searches for effects that are missing from the model of a table,
as `avis gap` does. It takes the parameters of `avis_ctrl.interface.workflow.gap`: see the help of that function, or
docs/reference/workflow.md.
"""

import importlib
import sys
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    def __call__(self, *arguments: Any, **options: Any) -> Any:
        # Imported at call time: the interface depends on this package.
        return importlib.import_module("avis_ctrl.interface.workflow").gap(*arguments, **options)


sys.modules[__name__].__class__ = _Callable
