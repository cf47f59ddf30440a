"""Parameters of a rig that are worth estimating: those that a tape measure or a data sheet does not give."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from fnmatch import fnmatchcase

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs.rig import Rig

_SPRINGS = tuple(f"k_s{k}" for k in range(1, 5))
_HALCYONICS = (
    "Ixx",
    "Iyy",
    "Izz",
    *_SPRINGS,
    "k_a",
    "k_t",
    "k_r",
    "d1",
    "d3",
    "d4",
    "d5",
    "d6",
    *(f"e{k}" for k in range(1, 9)),
)
_LOAD = ("load.L7", "load.L8", "load.L9", "load.Ixx", "load.Iyy", "load.Izz", "load.Ixy")


def default_parameters(rig: Rig) -> tuple[str, ...]:
    """Free parameters if the user names none.

    AVIS: mass, principal inertias, stiffness and damping of every mount along every axis; positions and motor constants
    are known (Rademakers, section 3.2). Halcyonics: the parameters identified in Table 1, each spring separately, and
    the actuators' k_a; with a load, that of Table 2 instead of the plate; mass and lengths are known.
    """
    known = rig.parameters()
    if "mass" in known and "J1" in known:
        mounts = [name for name in known if name.startswith("isolator") and name.rpartition(".")[2][:2] in ("k_", "c_")]
        return ("mass", "J1", "J2", "J3", *mounts)
    if "load.mass" in known:
        return (*_SPRINGS, "k_a", "k_t", "k_r", "d1", "d3", "d4", "d5", "d6", *_LOAD)
    return _HALCYONICS


def named_parameters(model_of: Rig, patterns: Sequence[str], unit: str = "V") -> tuple[str, ...]:
    """Parameters that match names or wildcards such as "isolator*.k_z" or "sensor.*", each once.

    Raises
    ------
    InputError : a pattern that matches nothing.
    """
    known = tuple(ResponseModel.of(model_of, (), unit).all_parameters())
    found: dict[str, None] = {}
    for pattern in patterns:
        matching = [name for name in known if fnmatchcase(name, pattern)]
        if not matching:
            near = difflib.get_close_matches(pattern, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(known)}"
            raise InputError(
                f"the rig {model_of.name} has no parameter that matches; {hint}", field="parameters", value=pattern
            )
        found |= dict.fromkeys(matching)
    return tuple(found)
