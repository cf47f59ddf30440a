"""Closed-loop simulation of the nonlinear table under its digital controller, and the linear prediction beside it."""

from avis_ctrl.simulation.campaign import PlantCheck, SimulationCheck, check_designs, judge
from avis_ctrl.simulation.discrete import spectral_radius
from avis_ctrl.simulation.loop import SimulationRecord, simulate
from avis_ctrl.simulation.prediction import predict_transmissibility_6dof, sampled_response
from avis_ctrl.simulation.sampled_loop import SampledLoop, SensorBank, accelerometer_bank, geophone_bank
from avis_ctrl.simulation.spectrum_check import SpectrumAgreement, check_spectrum_agreement

__all__ = ["PlantCheck", "SampledLoop", "SensorBank", "SimulationCheck", "SimulationRecord", "SpectrumAgreement",
           "accelerometer_bank", "check_designs", "check_spectrum_agreement", "geophone_bank", "judge",
           "predict_transmissibility_6dof", "sampled_response", "simulate", "spectral_radius"]
