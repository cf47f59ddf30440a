"""A controller with fewer states for the processor, by minimisation of mu itself instead of truncation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.export.certificate import Progress
from avis_ctrl.export.design_folder import Added, DesignFolder
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.robust.fixed_order import fixed_order
from avis_ctrl.robust.mu_descent import Task
from avis_ctrl.robust.mu_peak import mu_peak
from avis_ctrl.study.analysis import SETTINGS as ANALYSIS
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.roll_off import gain_limit
from avis_ctrl.uncertainty.generalized_plant import GeneralizedPlant


def mu_asked(design: Design) -> float:
    """Largest mu that the design's requirements allow; inf if they do not limit it."""
    return min(design.upper_limits("mu_upper"), default=np.inf)


def with_fewer_states(
    folder: DesignFolder, name: str, order: int, progress: Progress = lambda text: None
) -> tuple[DesignFolder, str]:
    """The folder with an additional controller of at most `order` states in the logical axes, and its name.

    The controller is found by descent on the peak of mu (`fixed_order`). The initial controllers are `name`, reduced
    step by step, and the others of the folder that have at most `order` states. The states that decode the sensors and
    those of the other axes' loops are not counted.

    Raises
    ------
    InputError : an order that is not below that of the controller in the folder.
    ComputationError : no controller of this order that stabilises the nominal plant was found.
    """
    K, P = folder.controller(name), folder.plant.synthesis
    if not 1 <= order < K.nstates:
        raise InputError(
            f"expected 1 to {K.nstates - 1}: the controller {name!r} of this design has {K.nstates} states",
            field="--order",
            value=order,
        )
    with threadpool_limits(1):
        task = Task(P.P, P.all_blocks.complexified(), limit=gain_limit(folder.plant, folder.rig.sample_rate_Hz))
        tried = [_order_and_mu(P, K)]
        if tried[0][1] > (allowed := mu_asked(folder.design)):
            # No reason to refuse: the descent may reach a lower mu with fewer states, since the D-K iteration stops at
            # the target of the design.
            progress(
                f"mu of {name!r} itself is at most {tried[0][1]:.4g}, above the {allowed:g} that the design "
                "requires; fewer states meet it only if the descent lowers mu"
            )
        try:
            for step in fixed_order(task, K, order, [folder.controller(one) for one in folder.names if one != name]):
                found = step.K
                tried.append(_order_and_mu(P, found))
                progress(f"{found.nstates} states: mu at most {tried[-1][1]:.4g} with the design's model")
        except ComputationError as error:
            # The first entry is the controller of the folder.
            on_the_way = ", ".join(f"{mu:.4g} with {states} states" for states, mu in tried[1:])
            if not on_the_way:
                raise
            raise ComputationError(
                error.failed,
                measured=f"{error.measured}; mu at most {on_the_way}",
                cause=error.cause,
                next_step="--order with one of these numbers",
            ) from error
    made = f"{name}_{order}"
    return replace(folder, added={made: Added(found.renamed(K.inputs, K.outputs), tuple(tried))}), made


def _order_and_mu(P: GeneralizedPlant, K: StateSpace) -> tuple[int, float]:
    """Number of states of K, and upper bound of mu of the design model with K."""
    return K.nstates, mu_peak(P.closed(K), P.all_blocks, slack=ANALYSIS.slack).upper
