"""Provenance of a result: versions, hash of the inputs, seed, date, computing time."""

from __future__ import annotations

import hashlib
import platform
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

import avis_ctrl
from avis_ctrl.rigs.rig import Rig


def provenance(
    rig: Rig | None, inputs: str, seed: int | None, seconds: float, libraries: tuple[str, ...], /, **own: Any
) -> dict[str, Any]:
    """The section `provenance` of a result file.

    Parameters
    ----------
    rig : its parameters are part of the hashed inputs; None if `inputs` identifies it. inputs : everything else that
        the result depends on, as text.
    seconds : computing time. libraries : distributions whose versions may change the last digits. own : further entries
        for this kind of result, listed first.
    """
    values = [] if rig is None else sorted((name, one.value) for name, one in rig.parameters().items())
    text = repr(values) + inputs
    return {
        "avis_ctrl": avis_ctrl.__version__,
        **own,
        "inputs_sha256": hashlib.sha256(text.encode()).hexdigest(),
        "seed": seed,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": seconds,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in libraries},
    }
