"""A controller of fewer states for the processor, by descent on mu itself instead of truncation."""

from __future__ import annotations

from dataclasses import replace

from threadpoolctl import threadpool_limits

from avis_ctrl.errors import InputError
from avis_ctrl.export.design_folder import DesignFolder
from avis_ctrl.robust.fixed_order import fixed_order


def with_fewer_states(folder: DesignFolder, name: str, order: int) -> tuple[DesignFolder, str]:
    """The folder with one controller more, of at most `order` states in the logical axes, and that controller's name.

    It is made from the controller `name` by descent on the peak of mu (`fixed_order`). The states that decode the
    sensors and those of the other axes' loops are not counted.

    Raises
    ------
    InputError : an order that is not below that of the controller in the folder.
    ComputationError : no controller of so few states that stabilises the nominal plant was found.
    """
    K, P = folder.controller(name), folder.plant.synthesis
    if not 1 <= order < K.nstates:
        raise InputError(f"expected 1 to {K.nstates - 1}: the controller {name!r} of this design has {K.nstates} "
                         "states", field="--order", value=order)
    with threadpool_limits(1):
        found, _ = fixed_order(P.P, P.all_blocks.complexified(), K, order)
    made = f"{name}_{order}"
    return replace(folder, added={made: found.renamed(K.inputs, K.outputs)}), made
