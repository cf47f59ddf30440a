"""What the report reads of a finding: the shape of `study.gap.GapFinding` and of its effect on a controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from avis_ctrl.gap.result import Gap
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.finding import Finding


class LoopOnModel(Protocol):
    """A controller on a model; a figure that was not computed is nan, one without bound infinite."""

    @property
    def controller(self) -> str:
        """Such as "mu controller of the old model"."""

    @property
    def model(self) -> str:
        """Such as "updated model"."""

    @property
    def stable(self) -> bool:
        """Whether the nominal loop is."""

    @property
    def mu_upper(self) -> float:
        """Upper bound of mu, robust performance."""

    @property
    def stability_upper(self) -> float:
        """Upper bound of mu, robust stability."""

    @property
    def modulus_margin(self) -> float:
        """1 / max sigma(S) at the actuators."""

    @property
    def peak_dB(self) -> float:
        """Largest singular value of the nominal transmissibility."""

    @property
    def mu_curve(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Frequencies [Hz] (n,) and upper bounds of mu (n,)."""


class EffectOnController(Protocol):
    """What the named effects do to a design."""

    @property
    def design(self) -> str:
        """Name of the design file."""

    @property
    def loops(self) -> Sequence[LoopOnModel]:
        """Yesterday's controller on the model that it was made for and on the updated one, and a new one."""

    @property
    def notes(self) -> Sequence[str]:
        """What has to be known of them, one sentence each."""


class Found(Protocol):
    """What `avis gap` found."""

    @property
    def gap(self) -> Gap: ...

    @property
    def measured(self) -> Campaign: ...

    @property
    def findings(self) -> Sequence[Finding]: ...

    @property
    def provenance(self) -> Mapping[str, Any]: ...

    @property
    def design(self) -> EffectOnController | None: ...
