"""From a campaign (here simulated; ac.campaign("file.h5") reads one) to a certified controller and its report."""

import sys

import avis_ctrl as ac

rig, truth = "avis", {"perturb_percent": 5.0, "perturb_damping_percent": 20.0}
plan = {"title": "AVIS: short campaign", "duration_s": 25.0, "truth": truth,
        "record": [{"excitation": "noise", "level_percent": 50.0, "records": 3, "band_Hz": [0.5, 60.0]}]}
sections = {
    "title": "AVIS from a campaign: z and phi_x under one controller",
    "keep": ["z", "phi_x"],
    "loop": {"amplifier_corner_Hz": 300.0},
    "uncertainty": {"parameters_percent": {"mass": 10.0, "isolator*.k_z": 15.0, "isolator*.c_z": 30.0},
                    "actuator_chains": {"low_percent": 10.0, "crossover_Hz": 80.0, "high_percent": 400.0}},
    "transmissibility": {"peak_dB": 3.5, "band_dB": -7.0, "band_Hz": [1.0, 10.0], "transition_octaves": 0.8,
                         "tolerance_dB": 1.0},
    "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0, "reduction": 30.0},
    "synthesis": {"max_iterations": 8, "target_mu": 0.9},
    "simulation": {"duration_s": 15.0, "random_plants": 2, "seed": 1},
    "requirement": [{"quantity": "mu_upper", "at_most": 1.0},
                    {"quantity": "worst_case_peak_transmissibility_dB", "at_most": 4.0},
                    {"quantity": "worst_case_band_transmissibility_dB", "at_most": -6.0}]}


def main(folder="reports/from_campaign"):
    identified = ac.identify(ac.simulate_campaign(rig, plan, seed=3), rig, starts=1, progress=print)
    identified.save(f"{folder}/identified", **sections)
    study = ac.design(identified, **sections, progress=print)
    study.save(f"{folder}/design")
    print(study.summary())


if __name__ == "__main__":
    main(*sys.argv[1:2])
