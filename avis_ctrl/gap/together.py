"""Parameters of the rig that no record tells one by one."""

from __future__ import annotations

from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.structure import structural_null_space, structure_of


def only_together(model: TableModel) -> tuple[tuple[str, ...], ...]:
    """Groups of the rig's free parameters that its equations determine as combinations only (two springs in one line):
    a fit leaves how they share where it was, and their own standard deviations do not tell of that."""
    base = model.effective
    if not base.names:
        return ()
    found = structure_of(structural_null_space(base), base.values, base.units, base.names)
    return tuple(tuple(base.names[k] for k in group.members) for group in found.groups)
