"""Rigs (isolation tables): rigid-body mechanics, linear and nonlinear, rig files, and reduced models."""

from avis_ctrl.rigs.halcyonics import Halcyonics
from avis_ctrl.rigs.isolator_table import IsolatorTable
from avis_ctrl.rigs.logical_axes import actuator_axes, sensor_axes
from avis_ctrl.rigs.reduction_error import reduction_error
from avis_ctrl.rigs.rig import Parameter, Rig
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rigid_body import COORDINATES, EquationsOfMotion

__all__ = [
    "COORDINATES",
    "EquationsOfMotion",
    "Halcyonics",
    "IsolatorTable",
    "Parameter",
    "Rig",
    "actuator_axes",
    "load_rig",
    "reduction_error",
    "sensor_axes",
]
