"""Identified masses far from the rig file's are reported; where all share one factor, the gains are blamed."""

import numpy as np
import pytest

from avis_ctrl.identification.information import Information
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.study.identification import far_from_file

NAMES = ("mass", "J1", "J2", "J3", "isolator1.k_z", "isolator2.k_z", "isolator3.k_z", "isolator1.c_z")


def start() -> ResponseModel:
    rig = load_rig("avis")
    return ResponseModel.of(
        rig, NAMES, "V", [one.name for one in rig.sensors()], rig.equations_of_motion().actuators, True
    )


def fitted(model: ResponseModel, factors, sigma: float = 1e-3) -> Information:
    """Of a fit that ended at the model's values times `factors`, each known to `sigma` (relative)."""
    found = model.at(model.values * np.array(factors))
    scale = np.abs(found.values)
    return Information(NAMES, found.values, found.units, np.diag((sigma * scale) ** -2.0), scale)


def test_common_factor_is_blamed_on_the_gains():
    (sentence,) = far_from_file(start(), fitted(start(), [5.0, 5.1, 4.9, 5.0, 5.0, 4.8, 5.2, 20.0]))
    assert "5 times the rig file's" in sentence and "force constants and sensitivities" in sentence


def test_one_mass_alone_is_named():
    (sentence,) = far_from_file(start(), fitted(start(), [2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]))
    assert sentence.startswith("mass is identified as") and "Check the rig file" in sentence


@pytest.mark.parametrize(("factors", "sigma"), [([1.2, 0.9, 1.1, 1.0, 2.0, 0.6, 1.0, 5.0], 1e-3), ([5.0] * 8, 0.5)])
def test_tolerances_and_unknown_values_are_not_told(factors, sigma):
    assert far_from_file(start(), fitted(start(), factors, sigma)) == ()
