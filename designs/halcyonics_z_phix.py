"""The loaded Halcyonics table, z and phi_x under one mu controller: halcyonics_z_phix.toml in Python.

    python designs/halcyonics_z_phix.py [FOLDER]
"""

import sys
import time

from avis_ctrl.report import render_html, render_pdf
from avis_ctrl.rigs import load_rig
from avis_ctrl.study.design_file import (
    ChainUncertainty,
    Design,
    EffortSection,
    FloorSection,
    LoopSection,
    RequirementSection,
    SimulationSection,
    SynthesisSection,
    TransmissibilitySection,
    UncertaintySection,
)
from avis_ctrl.study.files import open_folder
from avis_ctrl.study.output import write_study
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.runner import compare, conclude, synthesise

rig = load_rig("halcyonics_loaded")

uncertainty = UncertaintySection(
    parameters_percent={"load.mass": 10.0, "k_s?": 15.0, "d3": 30.0, "d4": 30.0},
    parameters_absolute={"load.L8": 0.01},
    actuator_chains=ChainUncertainty(low_percent=10.0, crossover_Hz=150.0, high_percent=400.0),
)

asked = TransmissibilitySection(
    peak_dB=3.5, band_dB=-12.0, band_Hz=[4.0, 16.0], transition_octaves=0.8, tolerance_dB=1.0
)

design = Design(
    title="Halcyonics, loaded: z and phi_x under one controller",
    rig="halcyonics_loaded",
    keep=["z", "phi_x"],
    loop=LoopSection(amplifier_corner_Hz=300.0, integrator_corner_Hz=0.1),
    uncertainty=uncertainty,
    transmissibility=asked,
    control_effort=EffortSection(floor_velocity_m_per_s=1.0e-4, bandwidth_Hz=150.0, reduction=30.0),
    floor=FloorSection(velocity_rms_m_per_s=2.0e-5),
    synthesis=SynthesisSection(max_iterations=8, target_mu=0.95),
    simulation=SimulationSection(duration_s=40.0, random_plants=20, seed=1),
    requirement=[
        RequirementSection(quantity="mu_upper", at_most=1.0),
        RequirementSection(quantity="mu_gap_percent", at_most=5.0),
        RequirementSection(quantity="worst_case_peak_transmissibility_dB", at_most=4.0),
        RequirementSection(quantity="worst_case_band_transmissibility_dB", at_most=-6.0),
        RequirementSection(quantity="advantage_over_skyhook_dB", at_least=6.0),
        RequirementSection(quantity="fastest_controller_pole_Hz", at_most=250.0),
    ],
)


def main(folder: str = "reports/halcyonics_z_phix") -> None:
    """Synthesise, compare with skyhook, simulate, write the report."""
    began, out = time.monotonic(), open_folder(folder)
    plant = build_plant(design, rig)
    candidates, failed, synthesis = synthesise(design, plant, rig, print)
    compared = compare(design, plant, rig, candidates, failed, print)
    result = conclude(design, plant, rig, synthesis, compared, time.monotonic() - began)
    for line in result.requirements:
        print(f"{line.name}: {line.value:.3g} {line.unit}, {line.comparison} {line.limit:g}: "
              f"{'met' if line.met else 'not met'}")
    write_study(result, out, render_html(result), render_pdf(result))


if __name__ == "__main__":
    main(*sys.argv[1:2])
