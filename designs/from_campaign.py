"""From a measurement campaign to a certified controller: identify, then design for what was identified.

    python designs/from_campaign.py [FOLDER]

As two commands, with a campaign on disk:

    avis identify CAMPAIGN --rig avis --design designs/from_campaign.toml --out DIR
    avis design DIR/design.toml --out DIR/design

The campaign here is simulated, on a table whose parameters differ from the rig file by amounts that the
identification is not told.
"""

import sys
from pathlib import Path

from avis_ctrl.report import render_html, render_pdf
from avis_ctrl.rigs import load_rig
from avis_ctrl.simulation.campaign_plan import CampaignPlan
from avis_ctrl.simulation.rehearsal import rehearse
from avis_ctrl.study.design_file import (
    ChainUncertainty,
    Design,
    EffortSection,
    LoopSection,
    RequirementSection,
    SimulationSection,
    SynthesisSection,
    TransmissibilitySection,
    UncertaintySection,
    read_study,
)
from avis_ctrl.study.files import open_folder
from avis_ctrl.study.identification import IdentifyOptions, identify
from avis_ctrl.study.identification_design import design_files
from avis_ctrl.study.identification_output import write_identification
from avis_ctrl.study.output import write_study
from avis_ctrl.study.runner import run_design

rig = load_rig("avis")

# Three noise records: two are fitted, the third is kept for validation.
plan = CampaignPlan.model_validate({
    "title": "AVIS: short campaign", "duration_s": 25.0,
    "truth": {"perturb_percent": 5.0, "perturb_damping_percent": 20.0},
    "record": [{"excitation": "noise", "level_percent": 50.0, "records": 3, "band_Hz": [0.5, 60.0]}],
})

design = Design(
    title="AVIS from a campaign: z and phi_x under one controller",
    rig="avis",
    keep=["z", "phi_x"],
    loop=LoopSection(amplifier_corner_Hz=300.0),
    uncertainty=UncertaintySection(
        parameters_percent={"mass": 10.0, "isolator*.k_z": 15.0, "isolator*.c_z": 30.0},
        actuator_chains=ChainUncertainty(low_percent=10.0, crossover_Hz=80.0, high_percent=400.0),
    ),
    transmissibility=TransmissibilitySection(
        peak_dB=3.5, band_dB=-7.0, band_Hz=[1.0, 10.0], transition_octaves=0.8, tolerance_dB=1.0
    ),
    control_effort=EffortSection(floor_velocity_m_per_s=1.0e-5, bandwidth_Hz=100.0, reduction=30.0),
    synthesis=SynthesisSection(max_iterations=8, target_mu=0.9),
    simulation=SimulationSection(duration_s=15.0, random_plants=2, seed=1),
    requirement=[
        RequirementSection(quantity="mu_upper", at_most=1.0),
        RequirementSection(quantity="worst_case_peak_transmissibility_dB", at_most=4.0),
        RequirementSection(quantity="worst_case_band_transmissibility_dB", at_most=-6.0),
    ],
)


def main(folder: str = "reports/from_campaign") -> None:
    """Measure, identify, design."""
    measured, designed = open_folder(Path(folder) / "identified"), open_folder(Path(folder) / "design")
    campaign = rehearse(rig, plan, seed=3).campaign
    found = identify(campaign, rig, IdentifyOptions(starts=1), print)
    write_identification(found, measured, more=design_files(found, design))
    # From here on as `avis design` does: everything comes from the files.
    result = run_design(*read_study(measured / "design.toml"), print)
    for line in result.requirements:
        print(f"{line.name}: {line.value:.3g} {line.unit}, {line.comparison} {line.limit:g}: "
              f"{'met' if line.met else 'not met'}")
    write_study(result, designed, render_html(result), render_pdf(result))


if __name__ == "__main__":
    main(*sys.argv[1:2])
