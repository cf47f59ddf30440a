"""Plans of simulated measurement campaigns: TOML files, and a default plan for a rig.

Every key has its unit in its name. Errors are one line that names file, field, value and what was expected.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from avis_ctrl.rigs.file_errors import read_toml, validated
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.toml_text import toml_text
from avis_ctrl.simulation.campaign_plan import CampaignPlan


@dataclass(frozen=True)
class PlanSettings:
    """ambient_m_per_s : r.m.s. floor motion if the rig file does not state it: the value of the AVIS file.
    shaken_m_per_s : r.m.s. motion of a shaken floor, a hundred times as much, which exceeds the effect of the drives'
        noise.
    """

    ambient_m_per_s: float = 2e-6
    shaken_m_per_s: float = 2e-4


SETTINGS = PlanSettings()


def read_plan(path: str | Path) -> CampaignPlan:
    """Read and check a plan.

    Raises InputError: one line naming file, field, value and what was expected.
    """
    path = Path(path)
    return plan_from_table(read_toml(path, "a campaign plan with [[record]] sections"), path)


def plan_from_table(table: dict[str, Any], file: object = None) -> CampaignPlan:
    """Check a plan given as nested dictionaries."""
    return validated(CampaignPlan, table, file)


def default_plan(
    rig: Rig,
    scheme: Literal["zippered", "orthogonal"] = "zippered",
    *,
    perturbed: bool = False,
    duration_s: float = 60.0,
) -> CampaignPlan:
    """Multisines at three levels, noise, rest and a shaken floor.

    scheme : "zippered" gives 4 multisine records, in which each drive has its own lines; the lines are permuted from
        record to record. "orthogonal" gives as many records as drives at each of the three levels; they determine all
        entries of the frequency response at every line.
    perturbed : stiffness, mass and inertia within 5 %, damping within 20 %.
    """
    ambient = {} if rig.ambient is not None else {"velocity_rms_m_per_s": SETTINGS.ambient_m_per_s}
    most = 2 if scheme == "zippered" else 1
    records: list[dict[str, Any]] = [
        {"excitation": "multisine", "level_percent": level, "records": count}
        for level, count in ((12.5, 1), (25.0, 1), (50.0, most))
    ]
    records += [
        {"excitation": "noise", "level_percent": 50.0},
        {"excitation": "rest"},
        {"excitation": "floor", "floor_rms_m_per_s": SETTINGS.shaken_m_per_s, "band_Hz": [0.5, 60.0]},
    ]
    truth = {"perturb_percent": 5.0, "perturb_damping_percent": 20.0} if perturbed else {}
    return plan_from_table(
        {
            "title": f"Default campaign of {rig.name}",
            "duration_s": duration_s,
            "ambient": ambient,
            "multisine": {"scheme": scheme},
            "truth": truth,
            "record": records,
        }
    )


def plan_toml(plan: CampaignPlan) -> str:
    """The plan as a file that `read_plan` reads back; keys that are absent by default remain absent."""
    return toml_text({key: value for key, value in plan.model_dump(exclude_none=True).items() if value != []})
