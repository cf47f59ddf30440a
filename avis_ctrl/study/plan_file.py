"""Plans of simulated measurement campaigns: TOML files, and a default plan for a rig.

Every key has its unit in its name. Errors are one line that names file, field, value and what was expected.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from avis_ctrl.rigs.file_errors import read_toml, validated
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.simulation.campaign_plan import CampaignPlan

__all__ = ["CampaignPlan", "default_plan", "plan_from_table", "plan_toml", "read_plan"]

# Floor motion if the rig file does not state it: the value of the AVIS file; and motion of a shaken floor, a hundred
# times as much, which exceeds the effect of the drives' noise [m/s].
AMBIENT_M_PER_S, SHAKEN_M_PER_S = 2e-6, 2e-4


def read_plan(path: str | Path) -> CampaignPlan:
    """Read and check a plan.

    Raises
    ------
    InputError : one line naming file, field, value and what was expected.
    """
    path = Path(path)
    return plan_from_table(read_toml(path, "a campaign plan with [[record]] sections"), path)


def plan_from_table(table: dict, file: object = None) -> CampaignPlan:
    """Check a plan given as nested dictionaries."""
    return validated(CampaignPlan, table, file)


def default_plan(rig: Rig, scheme: Literal["zippered", "orthogonal"] = "zippered", *, perturbed: bool = False,
                 duration_s: float = 60.0) -> CampaignPlan:
    """Multisines at three levels, noise, rest and a shaken floor.

    scheme : "zippered" gives 4 multisine records, in which each drive has its own lines; the lines are permuted from
        record to record. "orthogonal" gives as many records as drives at each of the three levels; they determine all
        entries of the frequency response at every line.
    perturbed : stiffness, mass and inertia within 5 %, damping within 20 %.
    """
    ambient = {} if rig.ambient is not None else {"velocity_rms_m_per_s": AMBIENT_M_PER_S}
    most = 2 if scheme == "zippered" else 1
    records: list[dict] = [{"excitation": "multisine", "level_percent": level, "records": count}
                           for level, count in ((12.5, 1), (25.0, 1), (50.0, most))]
    records += [{"excitation": "noise", "level_percent": 50.0}, {"excitation": "rest"},
                {"excitation": "floor", "floor_rms_m_per_s": SHAKEN_M_PER_S, "band_Hz": [0.5, 60.0]}]
    truth = {"perturb_percent": 5.0, "perturb_damping_percent": 20.0} if perturbed else {}
    return plan_from_table({"title": f"Default campaign of {rig.name}", "duration_s": duration_s, "ambient": ambient,
                            "multisine": {"scheme": scheme}, "truth": truth, "record": records})


def plan_toml(plan: CampaignPlan) -> str:
    """The plan as a file that `read_plan` reads back; keys that are absent by default remain absent."""
    content = plan.model_dump(exclude_none=True)
    records, effects = content.pop("record"), content.pop("effect")
    sections = [("", {key: value for key, value in content.items() if not isinstance(value, dict)})]
    sections += [(f"[{key}]", value) for key, value in content.items() if isinstance(value, dict)]
    sections += [("[[effect]]", effect) for effect in effects]
    sections += [("[[record]]", record) for record in records]
    return "\n".join("\n".join([title] * bool(title) + [f"{key} = {_toml(value)}" for key, value in lines.items()])
                     + "\n" for title, lines in sections)


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_toml(key)} = {_toml(one)}" for key, one in value.items()) + " }"
    # JSON and TOML write numbers, booleans, strings and lists alike, except for one character that TOML requires
    # escaped.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
