"""Simulated campaigns with effects that the rig file does not contain, to test the search for them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial, reduce

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.base import EffectParameter
from avis_ctrl.gap.model_files import effect_at
from avis_ctrl.gap.simulation import simulate
from avis_ctrl.gap.table_model import ActiveEffect, TableModel, active
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.simulation.campaign_data import Progress, SensorChange, open_loop
from avis_ctrl.simulation.campaign_plan import CampaignPlan, EffectPlan
from avis_ctrl.simulation.perturbed_campaign import PerturbedCampaign, perturbed_campaign


def campaign_with_effects(
    rig: Rig, plan: CampaignPlan, seed: int = 1, progress: Progress | None = None
) -> PerturbedCampaign:
    """The campaign of a plan, simulated with its effects on the perturbed table.

    Raises as `perturbed_campaign` and `hidden_effects`.
    """
    if not plan.effect:
        return perturbed_campaign(rig, plan, seed, progress)
    corner = open_loop(rig, plan).amplifier_corner_Hz
    return perturbed_campaign(
        rig, plan, seed, progress, partial(hidden_effects, plan.effect, amplifier_corner_Hz=corner)
    )


def hidden_effects(plans: Sequence[EffectPlan], truth: Rig, amplifier_corner_Hz: float | None = None) -> SensorChange:
    """Change of the sensor signals of a table by the effects of a plan.

    It is the difference of two simulations of the linearised table by `gap.simulation`, with and without the effects.

    Raises InputError: an effect, place or parameter that does not exist; values outside their range, or without any
    effect.
    """
    without = TableModel(ResponseModel.of(truth, (), amplifier_corner_Hz=amplifier_corner_Hz))
    effects = [_active(without, plan, f"effect[{k}]") for k, plan in enumerate(plans, 1)]
    with_all = reduce(TableModel.with_effect, effects, without)

    def change(u: np.ndarray, floor: np.ndarray, start_s: float, campaign_s: tuple[float, float]) -> np.ndarray:
        y, before = (
            simulate(model, u, floor, truth.sample_rate_Hz, start_s=start_s, campaign_s=campaign_s).y
            for model in (with_all, without)
        )
        return y - before

    return change


def _active(model: TableModel, plan: EffectPlan, field: str) -> ActiveEffect:
    """The effect of a plan; parameters that the plan omits have the first starting value of a search."""
    effect, place = effect_at(model, plan.name, plan.place or None, field)
    begun = active(effect, model, place)
    known = {one.name: one for one in begun.parameters}
    for name, value in plan.values.items():
        if name not in known:
            listed = ", ".join(f"{one.name} ({one.description}; {_range(one)})" for one in begun.parameters)
            raise InputError(f"expected parameters of this effect: {listed}", field=f"{field}.values", value=name)
        one = known[name]
        if not one.low <= value <= one.high:
            raise InputError(f"expected {_range(one)}", field=f"{field}.values.{name}", value=value)
    values = begun.by_name | plan.values
    if all(values[name] == one.none for name, one in known.items() if one.linear or not plan.values):
        strengths = [name for name, one in known.items() if one.linear] or list(known)
        raise InputError(
            f"with these values the effect does nothing; give at least one of {', '.join(strengths)}",
            field=f"{field}.values",
            value=plan.values,
        )
    return begun.at(list(values.values()))


def _range(one: EffectParameter) -> str:
    """Limits of a parameter, with its unit."""
    return f"{one.low:g} to {one.high:g}{'' if one.unit == '1' else f' {one.unit}'}"
