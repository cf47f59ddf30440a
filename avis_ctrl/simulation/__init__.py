"""The nonlinear table under its digital controller, the linear prediction beside it, and campaigns measured on it."""

from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.simulation.campaign_plan import CampaignPlan
from avis_ctrl.simulation.design_check import PlantCheck, SimulationCheck, check_designs, judge
from avis_ctrl.simulation.discrete import spectral_radius
from avis_ctrl.simulation.loop import SimulationRecord, simulate
from avis_ctrl.simulation.rehearsal import Rehearsal, perturbed_truth, rehearse
from avis_ctrl.simulation.sampled_loop import SampledLoop, SensorBank, accelerometer_bank, geophone_bank
from avis_ctrl.simulation.sampled_response import predict_transmissibility_6dof, sampled_response
from avis_ctrl.simulation.spectrum_check import SpectrumAgreement, check_spectrum_agreement

__all__ = ["CampaignPlan", "PlantCheck", "Rehearsal", "SampledLoop", "SensorBank", "SimulationCheck",
           "SimulationRecord", "SpectrumAgreement", "accelerometer_bank", "check_designs", "check_spectrum_agreement",
           "geophone_bank", "judge", "perturbed_truth", "predict_transmissibility_6dof", "rehearse",
           "sampled_response", "simulate", "simulate_campaign", "spectral_radius"]
