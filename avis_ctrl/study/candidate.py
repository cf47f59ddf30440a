"""A controller of a study before it is analysed."""

from __future__ import annotations

from dataclasses import dataclass

from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.study.design_result import ControllerKind


@dataclass(frozen=True, eq=False)
class Candidate:
    """A controller to be analysed."""

    name: str
    title: str
    kind: ControllerKind
    K: StateSpace | None
    notes: tuple[str, ...] = ()
