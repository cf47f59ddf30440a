"""Simulation of the nonlinear table under digital control, its linear prediction, and simulated campaigns."""
