"""Simulation of the nonlinear table under digital control, its linear prediction, and simulated campaigns."""

from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.simulation.campaign_plan import CampaignPlan
from avis_ctrl.simulation.design_check import PlantCheck, SimulationCheck, check_designs, judge
from avis_ctrl.simulation.discrete import spectral_radius
from avis_ctrl.simulation.loop import SimulationRecord, simulate
from avis_ctrl.simulation.rehearsal import Rehearsal, perturbed_truth, rehearse
from avis_ctrl.simulation.sampled_loop import SampledLoop, SensorBank, rig_bank
from avis_ctrl.simulation.sampled_response import predict_transmissibility_6dof, sampled_response
from avis_ctrl.simulation.spectrum_check import SpectrumAgreement, check_spectrum_agreement

__all__ = [
    "CampaignPlan",
    "PlantCheck",
    "Rehearsal",
    "SampledLoop",
    "SensorBank",
    "SimulationCheck",
    "SimulationRecord",
    "SpectrumAgreement",
    "check_designs",
    "check_spectrum_agreement",
    "judge",
    "perturbed_truth",
    "predict_transmissibility_6dof",
    "rehearse",
    "rig_bank",
    "sampled_response",
    "simulate",
    "simulate_campaign",
    "spectral_radius",
]
