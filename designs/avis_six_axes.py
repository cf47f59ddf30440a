"""The air-mount AVIS, all six axes under one controller: avis_six_axes.toml in Python.   avis_six_axes.py [FOLDER]"""

import sys

import avis_ctrl as ac

rig = "avis"
sections = {
    "title": "AVIS: all six axes under one controller",
    "keep": ["x", "y", "z", "phi_x", "phi_y", "phi_z"],
    "loop": {"amplifier_corner_Hz": 300.0},
    "uncertainty": {"parameters_percent": {"mass": 10.0, "isolator*.k_?": 15.0, "isolator*.c_?": 30.0},
                    "actuator_chains": {"low_percent": 10.0, "crossover_Hz": 80.0, "high_percent": 400.0}},
    "transmissibility": {"peak_dB": 4.65, "band_dB": -6.0, "band_Hz": [2.0, 10.0], "transition_octaves": 0.5,
                         "tolerance_dB": 1.0},
    "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0, "reduction": 30.0},
    "synthesis": {"max_iterations": 8, "target_mu": 0.985, "polish": False, "reduction_cost_percent": 0.5},
    "simulation": {"duration_s": 40.0, "random_plants": 20, "seed": 1},
    "requirement": [{"quantity": quantity, "at_most": limit} for quantity, limit in (
        ("mu_upper", 1.0), ("mu_gap_percent", 5.0), ("worst_case_peak_transmissibility_dB", 4.0),
        ("worst_case_band_transmissibility_dB", -6.0))]
    + [{"quantity": "passive_peak_transmissibility_dB", "at_least": 20.0},
       {"quantity": "advantage_over_skyhook_dB", "at_least": 6.0},
       {"quantity": "advantage_on_each_axis_dB", "at_least": 0.0},
       {"quantity": "fastest_controller_pole_Hz", "at_most": 400.0}],
}

if __name__ == "__main__":
    study = ac.design(rig, **sections, progress=print)
    print(study.summary())
    study.save(sys.argv[1] if len(sys.argv) > 1 else "reports/avis_six_axes")
