"""Small results for reports: of a design (the shipped plant with a plain velocity feedback, its bounds made up), of an
identification, and of a gap.
"""

from __future__ import annotations

from pathlib import Path

import gap_stand_in
import numpy as np
import pytest
from reading import Written, written

from avis_ctrl.classical.skyhook import Skyhook
from avis_ctrl.report.content import document as design_document
from avis_ctrl.report.gap.content import document as gap_document
from avis_ctrl.report.identification.content import document as identification_document
from avis_ctrl.rigs.reduction_error import reduction_error
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.robust.musyn_state import Iteration
from avis_ctrl.simulation.perturbed_campaign import perturbed_campaign
from avis_ctrl.study.design_file import read_design
from avis_ctrl.study.design_result import (
    Bound,
    ControllerResult,
    DesignResult,
    Requirement,
    SiteResponse,
    SixDofCheck,
    Transmissibility,
)
from avis_ctrl.study.identification import Identification, IdentifyOptions, identify
from avis_ctrl.study.plan_file import plan_from_table
from avis_ctrl.study.plant import DesignPlant, build_plant

DESIGN = Path(__file__).parents[2] / "designs" / "avis_z_phix.toml"
GAINS = {"passive": None, "skyhook": 8e3, "skyhook_classical": 3e4, "hinf": 1.2e4, "mu": 1.5e4}
KINDS = {"skyhook_classical": "skyhook"}
TITLES = {
    "skyhook": "skyhook, tuned",
    "skyhook_classical": "skyhook, critical damping",
    "hinf": "H-infinity, nominal",
    "mu": "mu synthesis",
}

FREE = ("mass", "isolator*.k_x", "isolator*.k_z", "isolator1.c_z")
PLAN = {
    "title": "small",
    "duration_s": 8.0,
    "settle_s": 2.0,
    "band_Hz": [1.0, 20.0],
    "truth": {"perturb_percent": 5.0, "perturb_damping_percent": 20.0},
    "record": [{"excitation": "noise", "records": 3}, {"excitation": "rest"}],
}


def _bound(upper: float, frequencies: np.ndarray) -> Bound:
    curve = 0.9 * np.exp(-(np.log(frequencies / 20) ** 2))
    return Bound(
        upper,
        0.9,
        20.0,
        None,
        True,
        "",
        frequencies,
        np.where(np.isinf(upper), np.inf, curve),
        0.98 * curve,
        ("mass at -10 %", "isolator2.k_z at +15 %"),
    )


def _controller(name: str, plant: DesignPlant) -> ControllerResult:
    gain, n = GAINS[name], len(plant.axes)
    K = None if gain is None else Skyhook(plant.axes, (gain,) * n, 0.1, 60.0).controller()
    omega = 2 * np.pi * np.geomspace(0.1, 200, 60)
    blocks = plant.synthesis.blocks
    motion = plant.full.restricted(plant.floor_velocities, plant.velocities).closed(K)
    T = motion.select(slice(blocks.n_z, None), slice(blocks.n_w, None)).frequency_response(omega)
    sigma = np.linalg.norm(T, ord=2, axis=(1, 2))
    upper = np.inf if name == "skyhook_classical" else 0.93
    bound = _bound(upper, np.geomspace(1, 2000, 50))
    bands = 10.0 ** (np.arange(20) / 10)
    volts = dict.fromkeys(plant.actuators, 0.01 if K is not None else 0.0)
    site = SiteResponse(
        dict.fromkeys(plant.axes, 2e-6),
        dict.fromkeys(plant.axes, 1e-7),
        bands,
        3e-6 / bands,
        np.stack([2e-6 / bands] * n, axis=1),
        "VC-E",
        None,
        volts,
        volts,
    )
    fastest = 0.0 if K is None else 60.0
    return ControllerResult(
        name,
        TITLES.get(name, name),
        KINDS.get(name, name),
        K,
        stable=name != "skyhook_classical",
        gamma=1.1,
        mu=bound,
        stability=bound,
        worst_peak=bound,
        worst_band=bound,
        transmissibility=Transmissibility(omega, T, sigma, 0.8 * sigma, 1.2 * sigma),
        compliance=1e-5 * sigma,
        site=site,
        peak_transmissibility=float(sigma.max()),
        fastest_pole_Hz=fastest,
    )


@pytest.fixture(scope="session")
def fabricated() -> DesignResult:
    design, rig = read_design(DESIGN), load_rig("avis")
    plant = build_plant(design, rig)
    requirements = (
        Requirement("upper bound of mu", 1.0, 0.93, "", True, "at most", "guaranteed at every frequency"),
        Requirement("worst-case peak", 4.0, np.inf, "dB", False, "at most"),
        Requirement("advantage over the skyhook", 6.0, 7.25, "dB", True, "at least"),
    )
    history = tuple(Iteration(k, 1.0 + 1 / k, 1.0 + 0.9 / k, 10 + k, 0.01, k, 0.2, "K-step") for k in range(1, 4))
    provenance = {
        "avis_ctrl": "0.1.0",
        "design_file": "avis_z_phix.toml",
        "inputs_sha256": "0123456789abcdef" * 4,
        "seed": 1,
        "date": "2025-01-02T03:04:05+00:00",
        "seconds": 12.5,
    }
    controllers = tuple(_controller(name, plant) for name in GAINS)
    mu = controllers[-1].transmissibility
    return DesignResult(
        design,
        rig,
        plant,
        controllers,
        history,
        requirements,
        reduction_error(rig, design.keep),
        SixDofCheck(mu.omega, mu.sigma, 0.1 * mu.sigma, np.full((mu.omega.size, 6), 0.5), 0.0),
        None,
        provenance,
        12.5,
        ("a remark",),
    )


@pytest.fixture(scope="session")
def identified() -> Identification:
    """A small campaign: three records of noise and one at rest."""
    rig = load_rig("avis")
    campaign = perturbed_campaign(rig, plan_from_table(PLAN), seed=2).campaign
    return identify(campaign, rig, IdentifyOptions(parameters=FREE, starts=1, despite_gates=True))


@pytest.fixture(scope="session")
def gap_found() -> gap_stand_in.Finds:
    return gap_stand_in.finding(gap_stand_in.records())


@pytest.fixture(scope="session")
def design_report(fabricated: DesignResult) -> Written:
    return written(design_document(fabricated))


@pytest.fixture(scope="session")
def identification_report(identified: Identification) -> Written:
    return written(identification_document(identified))


@pytest.fixture(scope="session")
def gap_report(gap_found: gap_stand_in.Finds) -> Written:
    return written(gap_document(gap_found))
