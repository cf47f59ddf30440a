"""The loaded Halcyonics table, z and phi_x: halcyonics_z_phix.toml in Python.   python halcyonics_z_phix.py [FOLDER]"""

import sys

import avis_ctrl as ac

rig = "halcyonics_loaded"
sections = {
    "title": "Halcyonics, loaded: z and phi_x under one controller",
    "keep": ["z", "phi_x"],
    "electronics": {"anti_alias_order": 3, "anti_alias_corner_Hz": 300.0},
    "loop": {"amplifier_corner_Hz": 300.0, "integrator_corner_Hz": 0.1},
    "uncertainty": {"parameters_percent": {"load.mass": 10.0, "k_s?": 15.0, "d3": 30.0, "d4": 30.0},
                    "parameters_absolute": {"load.L8": 0.01},
                    "actuator_chains": {"low_percent": 10.0, "crossover_Hz": 150.0, "high_percent": 400.0}},
    "transmissibility": {"peak_dB": 3.5, "band_dB": -12.0, "band_Hz": [4.0, 16.0], "transition_octaves": 0.8,
                         "tolerance_dB": 1.0},
    "control_effort": {"floor_velocity_m_per_s": 1e-4, "bandwidth_Hz": 150.0, "reduction": 300.0},
    "floor": {"velocity_rms_m_per_s": 2e-5},
    "synthesis": {"max_iterations": 8, "target_mu": 0.95},
    "simulation": {"duration_s": 40.0, "random_plants": 20, "seed": 1},
    "requirement": [{"quantity": "mu_upper", "at_most": 1.0},
                    {"quantity": "mu_gap_percent", "at_most": 5.0},
                    {"quantity": "worst_case_peak_transmissibility_dB", "at_most": 4.0},
                    {"quantity": "worst_case_band_transmissibility_dB", "at_most": -6.0},
                    {"quantity": "advantage_over_skyhook_dB", "at_least": 6.0},
                    {"quantity": "fastest_controller_pole_Hz", "at_most": 250.0}],
}

if __name__ == "__main__":
    study = ac.design(rig, **sections, progress=print)
    print(study.summary())
    study.save(sys.argv[1] if len(sys.argv) > 1 else "reports/halcyonics_z_phix")
