"""Plans of simulated measurement campaigns: TOML files, and a sensible plan for a rig that has none.

Every key carries its unit in its name; whatever is wrong is one line that names file, field, value and what was
expected.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

from avis_ctrl.rigs.file_errors import read_toml, validated
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.simulation.campaign_plan import CampaignPlan

__all__ = ["CampaignPlan", "default_plan", "plan_from_table", "plan_toml", "read_plan"]

# Where the rig's file does not say how much its floor moves: what the AVIS file says, and a floor shaken by
# hundred times as much, which the drives' noise does not hide [m/s].
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
    """Check a plan given as a table."""
    return validated(CampaignPlan, table, file)


def default_plan(rig: Rig, scheme: Literal["zippered", "orthogonal"] = "zippered", *, perturbed: bool = False,
                 duration_s: float = 60.0) -> CampaignPlan:
    """Multisines at three levels, noise, rest and a shaken floor.

    scheme : "zippered" makes 4 multisine records, in which each drive has its own lines, dealt on from one record to
        the next; "orthogonal" makes as many records as there are drives at each of the three levels, from which all
        entries of the frequency response come at every line.
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
    """The plan as a file that `read_plan` reads back; keys that are absent by default stay so."""
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
    # JSON writes numbers, booleans, strings and lists as TOML does, but for one character, which TOML wants escaped.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
