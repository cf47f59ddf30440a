"""The gap between a table's model and its measurement: the engine of `avis gap`.

The package can also be called: `avis_ctrl.gap(campaign, rig)` searches for the effects that the model of a table
misses, as `avis gap` does. Its parameters are those of `avis_ctrl.interface.workflow.gap`: see the help of this
function, or docs/reference/workflow.md.
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
