"""What all six degrees of freedom reach, against the equations of motion of a table without control."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from avis_ctrl.simulation.sampled_loop import lever_arms
from avis_ctrl.study.analysis import SETTINGS
from avis_ctrl.study.design_file import read_study
from avis_ctrl.study.other_axes import Companions
from avis_ctrl.study.plant import build_plant
from avis_ctrl.study.simulation import six_dof_check

KEPT = [2, 3]


def by_hand(rig, omega: np.ndarray) -> np.ndarray:
    """(n,) largest singular value from floor to payload along z and phi_x, rotations at the edge."""
    eom, s, arms = rig.equations_of_motion(), 1j * omega[:, None, None], lever_arms(rig)
    T = np.linalg.solve(s * s * eom.M + s * eom.C + eom.K, s * eom.C_floor + eom.K_floor)
    return np.linalg.norm((arms[:, None] * T / arms)[:, KEPT][:, :, KEPT], ord=2, axis=(1, 2))


@pytest.mark.parametrize("band_Hz", [[2.0, 4.0], [3.4, 3.42]])
def test_peaks_between_the_points_of_the_grid_are_found(band_Hz):
    """The resonance at 3.05 Hz lies between two points of the grid, 0.5 dB above both; the second band between two."""
    design, rig = read_study(Path(__file__).parents[2] / "designs" / "avis_z_phix.toml")
    asked = design.model_copy(
        update={"transmissibility": design.transmissibility.model_copy(update={"band_Hz": band_Hz})}
    )
    omega = 2 * np.pi * np.geomspace(*SETTINGS.plot_Hz, SETTINGS.plot_points)
    model = SimpleNamespace(omega=omega, sigma=by_hand(rig, omega))
    found = six_dof_check(
        asked, rig, build_plant(design, rig), SimpleNamespace(transmissibility=model, K=None), Companions(())
    )
    fine, inside = 2 * np.pi * np.geomspace(0.1, 200.0, 40001), 2 * np.pi * np.geomspace(*band_Hz, 2001)
    assert np.max(found.kept) == pytest.approx(np.max(by_hand(rig, fine)), rel=5e-4)
    there = (found.omega >= 2 * np.pi * band_Hz[0]) & (found.omega <= 2 * np.pi * band_Hz[1])
    assert np.max(found.kept[there]) == pytest.approx(np.max(by_hand(rig, inside)), rel=5e-4)
    assert found.deviation_dB < 0.01
