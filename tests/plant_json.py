"""Reader of the blocks in plant.json (docs/contracts/design.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull, ComplexScalar, RealScalar


def blocks_of(items: Sequence[Mapping[str, Any]]) -> BlockStructure:
    scalars = {"real": RealScalar, "complex": ComplexScalar}
    return BlockStructure.of(
        [
            ComplexFull(one["rows"], one["cols"], one["name"])
            if one["kind"] == "full"
            else scalars[one["kind"]](one["rows"], one["name"])
            for one in items
        ]
    )
