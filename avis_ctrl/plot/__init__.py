"""Plots in matplotlib. Each function takes a system or a result and optional axes, and returns the axes.

bode, sigma : responses of any system (ours, python-control's StateSpace, TransferFunction or FRD).
mu : both bounds over frequency, with the certified peak.
transmissibility : floor to payload, for the controllers of a design, with their certified worst cases.
dk_history, order : progress of a mu synthesis; mu against controller order.
vc_curves : generic vibration criteria, with third-octave spectra.

Examples
--------
>>> magnitude, phase = ac.plot.bode(ac.tf([25.0], [1.0, 10.0, 10.0, 10.0]))
>>> magnitude.get_ylabel()
'magnitude [dB]'
"""

from avis_ctrl.plot.results import dk_history, mu, order, transmissibility, vc_curves
from avis_ctrl.plot.systems import bode, sigma

__all__ = ["bode", "dk_history", "mu", "order", "sigma", "transmissibility", "vc_curves"]
