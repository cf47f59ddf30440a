"""Effects in a simulated campaign that the rig file does not contain: what a search for them is tested on."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial, reduce

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.model_files import effect_at
from avis_ctrl.gap.simulation import simulate
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.simulation.campaign_data import Progress, SensorChange, open_loop
from avis_ctrl.simulation.campaign_plan import CampaignPlan, EffectPlan
from avis_ctrl.simulation.rehearsal import Rehearsal, rehearse


def rehearsed(rig: Rig, plan: CampaignPlan, seed: int = 1, progress: Progress | None = None) -> Rehearsal:
    """The campaign of a plan on the perturbed table, with the plan's effects; raises as `rehearse` and below."""
    corner = open_loop(rig, plan).amplifier_corner_Hz
    hidden = partial(hidden_effects, plan.effect, amplifier_corner_Hz=corner) if plan.effect else None
    return rehearse(rig, plan, seed, progress, hidden)


def hidden_effects(plans: Sequence[EffectPlan], truth: Rig, amplifier_corner_Hz: float | None = None) -> SensorChange:
    """What the effects of a plan add to the sensor signals of a table.

    The signals of the table with the effects less those without them, both by `gap.simulation`: linear about rest, but
    for the forces and voltages of the effects.

    Raises
    ------
    InputError : an effect, place or parameter that does not exist; values outside their range, or without any effect.
    """
    without = TableModel(ResponseModel.of(truth, (), amplifier_corner_Hz=amplifier_corner_Hz))
    effects = [_active(without, plan, f"effect[{k}]") for k, plan in enumerate(plans, 1)]
    with_all = reduce(TableModel.with_effect, effects, without)

    def change(u: np.ndarray, floor: np.ndarray, start_s: float, campaign_s: tuple[float, float]) -> np.ndarray:
        y, before = (simulate(model, u, floor, truth.sample_rate_Hz, start_s=start_s, campaign_s=campaign_s).y
                     for model in (with_all, without))
        return y - before
    return change


def _active(model: TableModel, plan: EffectPlan, field: str) -> ActiveEffect:
    """The effect of a plan; parameters that the plan leaves out have the first value of a search."""
    effect = effect_at(model, plan.name, plan.place, field)
    place = plan.place or effect.places(model)[0]
    parameters = effect.parameters(model, place)
    for name, value in plan.values.items():
        known = next((one for one in parameters if one.name == name), None)
        if known is None:
            listed = ", ".join(f"{one.name} ({one.description}; {one.low:g} to {one.high:g} {one.unit})"
                               for one in parameters)
            raise InputError(f"expected parameters of this effect: {listed}", field=f"{field}.values", value=name)
        if not known.low <= value <= known.high:
            raise InputError(f"expected {known.low:g} to {known.high:g} {known.unit}", field=f"{field}.values.{name}",
                             value=value)
    start = effect.starts(model, place)[0]
    values = [plan.values.get(one.name, float(first)) for one, first in zip(parameters, start, strict=True)]
    if all(value == one.none for one, value in zip(parameters, values, strict=True) if one.linear or not plan.values):
        listed = ", ".join(one.name for one in parameters)
        raise InputError(f"expected a value with an effect; the parameters are {listed}", field=f"{field}.values",
                         value=plan.values)
    return ActiveEffect(effect, place, parameters, tuple(values))
