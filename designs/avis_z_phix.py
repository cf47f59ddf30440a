"""The air-mount AVIS, z and phi_x under one mu controller: avis_z_phix.toml in Python.   avis_z_phix.py [FOLDER]"""

import sys

import avis_ctrl as ac

rig = "avis"
sections = {
    "title": "AVIS: z and phi_x under one controller",
    "keep": ["z", "phi_x"],
    "loop": {"amplifier_corner_Hz": 300.0},
    "uncertainty": {"parameters_percent": {"mass": 10.0, "isolator*.k_z": 15.0, "isolator*.c_z": 30.0},
                    "actuator_chains": {"low_percent": 10.0, "crossover_Hz": 80.0, "high_percent": 400.0}},
    "transmissibility": {"peak_dB": 3.5, "band_dB": -7.0, "band_Hz": [1.0, 10.0], "transition_octaves": 0.8,
                         "tolerance_dB": 1.0},
    "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0, "reduction": 30.0},
    "synthesis": {"max_iterations": 8, "target_mu": 0.88},
    "simulation": {"duration_s": 40.0, "random_plants": 20, "seed": 1},
    "requirement": [{"quantity": "mu_upper", "at_most": 1.0},
                    {"quantity": "mu_gap_percent", "at_most": 5.0},
                    {"quantity": "worst_case_peak_transmissibility_dB", "at_most": 4.0},
                    {"quantity": "worst_case_band_transmissibility_dB", "at_most": -6.0},
                    {"quantity": "passive_peak_transmissibility_dB", "at_least": 20.0},
                    {"quantity": "advantage_over_skyhook_dB", "at_least": 6.0},
                    {"quantity": "fastest_controller_pole_Hz", "at_most": 250.0}],
}

if __name__ == "__main__":
    study = ac.design(rig, **sections, progress=print)
    print(study.summary())
    study.save(sys.argv[1] if len(sys.argv) > 1 else "reports/avis_z_phix")
