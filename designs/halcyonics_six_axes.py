"""The loaded Halcyonics table, six axes: halcyonics_six_axes.toml in Python. python halcyonics_six_axes.py [FOLDER]"""

import sys

import avis_ctrl as ac

rig = "halcyonics_loaded"
sections = {
    "title": "Halcyonics, loaded: all six axes under one controller",
    "keep": ["x", "y", "z", "phi_x", "phi_y", "phi_z"],
    "electronics": {"anti_alias_order": 3, "anti_alias_corner_Hz": 300.0},
    "loop": {"amplifier_corner_Hz": 300.0, "integrator_corner_Hz": 0.1},
    "uncertainty": {"parameters_percent": {"load.mass": 10.0, "k_s?": 15.0, "k_t": 15.0, "k_r": 15.0, "d?": 30.0},
                    "parameters_absolute": {"load.L7": 0.01, "load.L8": 0.01},
                    "actuator_chains": {"low_percent": 10.0, "crossover_Hz": 150.0, "high_percent": 400.0}},
    "transmissibility": {"peak_dB": 4.65, "band_dB": -12.0, "band_Hz": [6.0, 16.0], "transition_octaves": 0.5,
                         "tolerance_dB": 1.0},
    "control_effort": {"floor_velocity_m_per_s": 1e-4, "bandwidth_Hz": 150.0, "reduction": 300.0},
    "floor": {"velocity_rms_m_per_s": 2e-5},
    "synthesis": {"max_iterations": 8, "target_mu": 0.985, "polish": False, "reduction_cost_percent": 2.0},
    "simulation": {"duration_s": 40.0, "random_plants": 20, "seed": 1},
    "requirement": [{"quantity": quantity, limit: value} for quantity, limit, value in (
        ("mu_upper", "at_most", 1.0), ("mu_gap_percent", "at_most", 5.0),
        ("worst_case_peak_transmissibility_dB", "at_most", 4.0),
        ("worst_case_band_transmissibility_dB", "at_most", -6.0), ("advantage_over_skyhook_dB", "at_least", 6.0),
        ("advantage_on_each_axis_dB", "at_least", 0.0), ("fastest_controller_pole_Hz", "at_most", 250.0))],
}

if __name__ == "__main__":
    study = ac.design(rig, **sections, progress=print)
    print(study.summary())
    study.save(sys.argv[1] if len(sys.argv) > 1 else "reports/halcyonics_six_axes")
