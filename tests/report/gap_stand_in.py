"""A finding of `avis gap` made up around real models and records, for the report: its numbers are not computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from avis_ctrl.gap.effects.base import Reported
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.result import Considered, Gap, HeatMap, NamedEffect, PowerShares, RecordGap, Remainder, Stage, Where
from avis_ctrl.gap.table_model import TableModel, active
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.finding import Finding
from avis_ctrl.rigs import load_rig
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.study.gap_design import DesignEffect, LoopFigures
from avis_ctrl.study.plan_file import plan_from_table

OFFSET = (0.02, -0.012, 0.0)
OUTPUTS = ("Sy1", "Sz1", "Sx2", "Sz2", "Sy3", "Sz3")


@dataclass(frozen=True, eq=False)
class Finds:
    gap: Gap
    measured: Campaign
    findings: tuple[Finding, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    design: DesignEffect | None = None


def records(duration_s: float = 8.0, count: int = 3) -> Campaign:
    """Noise records of a table whose centre of mass is off, and one at rest."""
    rig = load_rig("avis")
    plan = plan_from_table(
        {
            "title": "small",
            "duration_s": duration_s,
            "settle_s": 2.0,
            "band_Hz": [0.7, 60.0],
            "record": [{"excitation": "noise", "records": count}, {"excitation": "rest"}],
        }
    )
    truth = rig.with_parameters({"com_x": OFFSET[0], "com_y": OFFSET[1]})
    return simulate_campaign(rig, plan, 3, truth=truth)


def models(campaign: Campaign) -> tuple[TableModel, TableModel]:
    """The rig as it is, and with the centre of mass that the records were made with."""
    rig = load_rig("avis")
    base = TableModel(
        ResponseModel.of(rig, default_parameters(rig), "V", campaign.y_names, campaign.u_names, True, None)
    )
    return base, base.with_effect(active(library()["com_offset"], base, "payload", OFFSET))


def heat() -> HeatMap:
    """A bump at the resonances of two channels, which goes."""
    edges = np.geomspace(0.8, 60.0, 25)
    centre = np.sqrt(edges[1:] * edges[:-1])
    columns = tuple(f"{record}: {name}" for record in ("04", "05") for name in OUTPUTS)
    bump = np.exp(-((np.log(centre / 3.1) / 0.4) ** 2))[:, None]
    strength = np.array([3.0, 900.0, 10.0, 250.0, 0.5, 60.0] * 2)
    scatter = np.random.default_rng(4).chisquare(60, (len(centre), 12)) / 60
    before = scatter * (1 + bump * strength)
    before[-1, 3] = np.nan
    return HeatMap(edges, columns, before, scatter)


def shares() -> tuple[PowerShares, ...]:
    """Two levels; noise falls and nonlinearity rises with the level."""
    edges = np.geomspace(0.8, 60.0, 13)
    hump = np.repeat(
        np.exp(-((np.log(np.sqrt(edges[1:] * edges[:-1]) / 3.1) / 0.4) ** 2))[:, None], len(OUTPUTS), axis=1
    )
    made = []
    for volts, names in ((0.05, ("00", "04")), (0.2, ("01", "02", "05"))):
        parts = {
            "missing": 1e-4 + 0 * hump,
            "nonlinear": 0.1 * volts * hump,
            "unmeasured": 1e-4 / volts**2 * hump,
            "sensors": 1e-6 / volts**2 + 0 * hump,
        }
        parts = {"model": 1 - sum(parts.values()), **parts}
        made.append(
            PowerShares(
                volts,
                "noise",
                names,
                edges,
                OUTPUTS,
                parts,
                {key: value.mean(axis=0) for key, value in parts.items()},
                "levels",
            )
        )
    return tuple(made)


def by_record() -> tuple[RecordGap, ...]:
    """A gap that grows with the level; two records held out."""
    return tuple(
        RecordGap(f"{k:02d}", volts, 70.0 * k, k > 3, 40 * volts, 1.0 + 0.01 * k)
        for k, volts in enumerate((0.05, 0.1, 0.2, 0.1, 0.05, 0.2))
    )


def explained(campaign: Campaign) -> Gap:
    """A gap that an offset of the centre of mass accounts for."""
    base, updated = models(campaign)
    sizes = {
        "offset_x_m": Reported(0.0201, 0.0002, "m"),
        "offset_y_m": Reported(-0.0119, 0.0002, "m"),
        "offset_z_m": Reported(0.0004, 0.003, "m"),
    }
    named = NamedEffect(
        "com_offset",
        "payload",
        library()["com_offset"].title,
        sizes,
        0.9996,
        (),
        "com_offset@payload",
        "found by its score, refitted on all lines",
    )
    considered = tuple(
        Considered(name, place, chi2, p, reason, size)
        for name, place, chi2, p, reason, size in (
            (
                "product_of_inertia",
                "Jxz",
                41.3,
                3e-9,
                "leaves a significant residual at the roll mode",
                {"value_kgm2": Reported(1.7, 0.03, "kg m^2")},
            ),
            ("cable_stiffness", "payload", 33.0, 1e-7, "its point lies outside the table", {}),
            (
                "actuator_gain",
                "Az2",
                120.0,
                0.0,
                "the size differs between the halves of the band by 14 standard deviations",
                {"gain": Reported(0.93, 0.004, "1")},
            ),
        )
    )
    where = (Where(2.1, 4.6, "Az1", "Sz1", 0.61, 320.0, 1e-12), Where(2.3, 5.0, "", "Sz2", 0.22, 95.0, 1e-9))
    n = len(updated.names)
    return Gap(
        "explained",
        (named,),
        (Stage("nominal", 0.31, 900.0), Stage("re-identified", 0.12, 140.0), Stage("com_offset", 0.0104, 1.03)),
        where,
        (),
        0.0101,
        None,
        base,
        updated,
        considered,
        heat(),
        (
            "The centre of mass is not where the model has it: com offset at the payload, (20.1 ± 0.2) mm along x "
            "and (−11.9 ± 0.2) mm along y; probability above 99.9 %.",
            "The held-out records confirm it at both levels.",
        ),
        "records 04 and 05 (for each of them, another record of the same level is fitted)",
        1,
        41.5,
        np.diag((1e-3 * np.maximum(np.abs(updated.values), 1e-3)) ** 2) if n else None,
        shares=shares(),
        records=by_record(),
        left=Remainder(0.0104, 1.03, 0.004, False),
    )


def minimal(gap: Gap, verdict: str = "none") -> Gap:
    """Everything empty that a gap may have empty."""
    return replace(
        gap,
        verdict=verdict,
        effects=(),
        where=(),
        remaining=(),
        next_experiment=None,
        updated=gap.baseline,
        considered=(),
        covariance=None,
        shares=(),
    )


def with_verdict(gap: Gap, verdict: str) -> Gap:
    """The gap as another verdict would have it."""
    left = (Where(11.0, 14.0, "Az2", "Sz2", 0.7, 12.0, 1e-8),)
    if verdict == "partly explained":
        return replace(
            gap,
            verdict=verdict,
            remaining=left,
            sentences=("The centre of mass is off, and something else near 12 Hz remains.",),
            stages=(*gap.stages[:2], Stage("com_offset", 0.03, 9.0)),
        )
    if verdict == "unexplained":
        return replace(
            gap,
            verdict=verdict,
            effects=(),
            updated=gap.baseline,
            remaining=left,
            stages=gap.stages[:2],
            sentences=("A significant disagreement near 12 Hz that no effect of the library accounts for.",),
            next_experiment="Drive Az2 alone with a stepped sine from 10 to 15 Hz.",
            covariance=None,
        )
    if verdict == "none":
        assert gap.heat is not None
        return replace(
            gap,
            verdict=verdict,
            effects=(),
            updated=gap.baseline,
            where=(),
            considered=(),
            heat=replace(gap.heat, before=gap.heat.after),
            stages=(Stage("nominal", 0.02, 3.0), Stage("re-identified", 0.0103, 1.01)),
            covariance=None,
            sentences=(
                "No disagreement beyond the measured noise.",
                "An actuator lag below 3.1e-05 s would not have been seen.",
            ),
        )
    return gap


def design() -> DesignEffect:
    """The controller designed without the effect, which the effect spoils, and a new one; without the controllers "
    "themselves."""
    nothing: Any = None
    return DesignEffect(
        LoopFigures(True, True, 0.95, 0.94, 3.1, -12.0, 5.2, -9.1, 60.0),
        LoopFigures(True, True, 1.32, 1.3, 5.9, -9.5, float("inf"), -4.0, 60.0),
        LoopFigures(True, True, 0.97, 0.96, 3.2, -11.8, 5.4, -8.9, 60.0),
        nothing,
        nothing,
        nothing,
        (),
        ("com_offset@payload",),
        {},
        (
            "The controller designed on the re-identified model has mu of at most 0.95 on this model and of at most "
            "1.32 on the updated model.",
            "A controller designed on the updated model has mu 0.97 there.",
        ),
        30.0,
    )


def finding(campaign: Campaign) -> Finds:
    """The whole."""
    gates = (
        Finding("saturation", "ok", "No output reaches the converter's range."),
        Finding("hum", "note", "50 Hz is 0.3 mV."),
    )
    made = {
        "avis_ctrl": "0.4.0",
        "measurement": "campaign.h5",
        "measurement_sha256": "0123456789abcdef" * 4,
        "inputs_sha256": "fedcba9876543210" * 4,
        "date": "2026-01-02T03:04:05+00:00",
    }
    return Finds(explained(campaign), campaign, gates, made, design())
