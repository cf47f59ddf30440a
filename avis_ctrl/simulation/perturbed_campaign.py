"""A simulated campaign on a table that differs from its file by known amounts, to try an identification."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.rigs.halcyonics import Halcyonics
from avis_ctrl.rigs.instruments import Triple, triple
from avis_ctrl.rigs.isolator_table import INERTIA, IsolatorTable
from avis_ctrl.rigs.key_types import unit_vector
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import rig_from
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.simulation.campaign_data import Progress, SensorChange, simulate_campaign
from avis_ctrl.simulation.campaign_plan import CampaignPlan, EffectPlan

# Flat names of parameters, AVIS and Halcyonics.
STIFF_OR_HEAVY = re.compile(r"mass|J[123]|I(xx|yy|zz)|isolator\d+\.k_[xyz]|k_[atr]|k_s\d|load\.mass")
DAMPING = re.compile(r"isolator\d+\.c_[xyz]|d[13456]")


@dataclass(frozen=True)
class DrawSettings:
    """attempts : largest number of draws of a table. Physically impossible inertias are drawn again; nearly flat
    payloads need several draws."""

    attempts: int = 200


SETTINGS = DrawSettings()


@dataclass(frozen=True, eq=False)
class PerturbedCampaign:
    """A campaign and, separate from it, the truth.

    truth : the simulated table. true_values : the parameters that were changed, by flat name.
    factors : true value over the file's value, for each parameter with a nonzero value in the file.
    effects : of the table; a rig file does not contain them.
    """

    campaign: Campaign
    truth: Rig
    true_values: dict[str, float]
    factors: dict[str, float]
    effects: tuple[EffectPlan, ...] = ()

    def truth_toml(self) -> str:
        """The truth as a rig file; each changed line is marked with its factor."""
        values = {name: f"{name} x {factor:.6f}" for name, factor in self.factors.items()}
        header = ["The simulated table of a campaign: the values that an identification should find."]
        for one in self.effects:
            said = [one.name, one.place, *(f"{name} = {value:g}" for name, value in one.values.items())]
            header.append("An effect that a rig file does not contain: " + ", ".join(filter(None, said)))
        return rig_toml(self.truth, values, "\n".join(header))


def perturbed_campaign(
    rig: Rig,
    plan: CampaignPlan,
    seed: int = 1,
    progress: Progress | None = None,
    hidden: Callable[[Rig], SensorChange] | None = None,
) -> PerturbedCampaign:
    """Perturb the rig as specified in `plan.truth` and simulate the campaign on it; raises the errors of
    `simulate_campaign`.

    hidden : from the true table to what effects outside the rig file add to the sensor signals
        (`study.hidden_effects`).
    """
    truth = perturbed_truth(rig, plan.truth.perturb_percent, plan.truth.perturb_damping_percent, seed)
    old, new = rig.parameters(), truth.parameters()
    changed = {name: new[name].value for name in old if new[name].value != old[name].value}
    campaign = simulate_campaign(
        rig, plan, seed, truth=truth, progress=progress, change=None if hidden is None else hidden(truth)
    )
    return PerturbedCampaign(
        campaign,
        truth,
        changed,
        {name: value / old[name].value for name, value in changed.items() if old[name].value},
        tuple(plan.effect),
    )


def perturbed_truth(rig: Rig, percent: float = 5.0, damping_percent: float = 20.0, seed: int = 1) -> Rig:
    """Draw stiffness, mass and inertia within +-percent, damping within +-damping_percent; independent and uniform.

    Products of inertia, positions, actuators and sensors are drawn from normal distributions with the rig file's
    [tolerances] (`within_tolerances`); they are unchanged without that section, or if both percentages are zero. The
    inertia of a load is unchanged. For a spring-suspended table, masses are unchanged too, since they can be weighed,
    and with a load also the plate's inertia.

    Raises
    ------
    InputError : percentages outside 0 .. 100; no draw is a physically possible rig.
    """
    for name, value in (("perturb_percent", percent), ("perturb_damping_percent", damping_percent)):
        if not (np.isfinite(value) and 0 <= value < 100):
            raise InputError("expected 0 or more, and less than 100", field=name, value=value)
    rng, known = np.random.default_rng((seed, 5)), rig.parameters()
    spread = {
        name: (damping_percent if DAMPING.fullmatch(name) else percent) / 100
        for name in known
        if DAMPING.fullmatch(name) or STIFF_OR_HEAVY.fullmatch(name)
    }
    if isinstance(rig, Halcyonics):
        # With a load, the plate was identified before: only the sum of its inertia and the load's can be observed.
        known_before = ("mass", "load.mass", *(("Ixx", "Iyy", "Izz") if rig.load else ()))
        spread = {name: width for name, width in spread.items() if name not in known_before}
    for _ in range(SETTINGS.attempts):
        draws = rng.uniform(-1, 1, len(spread))
        changes = {
            name: known[name].value * (1 + width * draw)
            for (name, width), draw in zip(spread.items(), draws, strict=True)
            if width
        }
        try:
            truth = rig.with_parameters(changes)
            if isinstance(truth, IsolatorTable) and rig.tolerances is not None and changes:
                truth = within_tolerances(truth, rng)
            rig_from(tomllib.loads(rig_toml(truth)), loaded=getattr(rig, "load", None) is not None)
        except InputError as error:
            refused = error
        else:
            return truth
    raise InputError(
        f"none of {SETTINGS.attempts} random draws gives a physically possible table; the last error: {refused}",
        field="perturb_percent",
        value=percent,
    )


def within_tolerances(rig: IsolatorTable, rng: np.random.Generator) -> IsolatorTable:
    """A table drawn from normal distributions about the rig, with the [tolerances] of its file as standard deviations.

    Corner frequencies and damping ratios of sensors are unchanged: in a rig file a compensation filter matches its
    geophone. Motors and geophones in the isolators move with the isolators and keep their directions.
    """
    t = rig.tolerances
    if t is None:
        return rig

    def off(percent: float) -> float:
        return 1 + percent / 100 * float(rng.standard_normal())

    def placed(position: Triple, direction: Triple) -> dict[str, Triple]:
        moved = np.add(position, t.place_m * rng.standard_normal(3))
        turned = direction + np.cross(t.direction_rad * rng.standard_normal(3), direction)
        return {"position": triple(moved), "direction": unit_vector(triple(turned))}

    def moved_along(one: Any) -> Any:
        return replace(one, **placed(one.position, one.direction))

    isolators = tuple(
        replace(one, position=triple(np.add(one.position, t.place_m * rng.standard_normal(3)))) for one in rig.isolators
    )
    drives, instruments = (tuple(moved_along(one) for one in some) for some in (rig.drives, rig.instruments))
    moved = replace(rig, isolators=isolators, drives=drives, instruments=instruments)
    known, changes = moved.parameters(), dict[str, float]()
    for drive in moved.all_drives:
        changes[f"actuator.{drive.name}"] = drive.constant_N_per_V * off(t.actuator_gain_percent)
    for axis in "xyz":
        changes[f"com_{axis}"] = known[f"com_{axis}"].value + t.centre_of_mass_m * float(rng.standard_normal())
    for name in INERTIA[3:]:
        changes[name] = known[name].value + t.product_of_inertia_kgm2 * float(rng.standard_normal())
    gains = {one.name: one.gain * off(t.sensor_gain_percent) for one in moved.sensors()}
    return moved.with_parameters(changes).with_sensor_gains(gains)
