"""What the report reads of a finding: the shape of `study.gap.GapFinding`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from avis_ctrl.gap.result import Gap
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.finding import Finding

if TYPE_CHECKING:
    from avis_ctrl.study.gap_design import DesignEffect


class Found(Protocol):
    """What `avis gap` found; design is None where no controller was asked for."""

    @property
    def gap(self) -> Gap: ...

    @property
    def measured(self) -> Campaign: ...

    @property
    def findings(self) -> Sequence[Finding]: ...

    @property
    def provenance(self) -> Mapping[str, Any]: ...

    @property
    def design(self) -> DesignEffect | None: ...
