"""The two rigs: rigid-body mechanics, linear and nonlinear, their files and their subsystems."""

from avis_ctrl.rigs.avis import AvisTable
from avis_ctrl.rigs.halcyonics import Halcyonics
from avis_ctrl.rigs.rig import Parameter, Rig
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rigid_body import COORDINATES, EquationsOfMotion

__all__ = ["COORDINATES", "AvisTable", "EquationsOfMotion", "Halcyonics", "Parameter", "Rig", "load_rig"]
