"""The first sentence of a design, and the exit code that goes with it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from avis_ctrl.errors import ComputationError
from avis_ctrl.robust.musyn_iteration import STOPPED
from avis_ctrl.simulation.design_check import PlantCheck
from avis_ctrl.simulation.instability_cause import InstabilityCause
from avis_ctrl.study.design_result import DesignResult, Requirement, Simulated
from avis_ctrl.study.verdict import all_axes, check_loop, first_sentence, refuse_unstable, requirement_rows

CULPRIT = InstabilityCause("nominal", 1.00016, 0.99, 0.16, ("x", "phi_y"), "companions", ("x", "y"))


def plant(name: str, radius: float, diverged: bool = False, clipped: int = 0) -> PlantCheck:
    agrees = SimpleNamespace(agrees=True) if radius < 1 and not diverged else None
    return PlantCheck(name, diverged, radius, agrees, 1.0, 0.1, 10.0, clipped, 0, {})


def result(plants, culprit=None, asked=()) -> DesignResult:
    check = SimpleNamespace(plants=tuple(plants), duration_s=20.0, false_alarm=0.01)
    loop = Simulated(None, check, None, 1.0, culprit)
    rows = (*check_loop(check), *asked)
    return DesignResult(None, None, None, (), (), rows, None, None, loop, {}, 1.0)


def test_a_value_beyond_its_limit_does_not_look_equal_to_it():
    missed = Requirement("mu", 1.0, 1.00036, "", False, "at most")
    assert requirement_rows(result([], asked=[missed]))[-1] == ("mu", "at most 1", "1.0004", False)


def test_an_unstable_loop_comes_before_requirements_that_are_met():
    met = Requirement("mu", 1.0, 0.895, "", True, "at most")
    found = result([plant("nominal", 1.00016), plant("random 1", 0.999)], CULPRIT, [met])
    text = first_sentence(found)
    assert text.startswith("UNSTABLE: ") and "1 of 2 plants" in text
    assert "x and phi_y" in text and "0.99 Hz" in text and "loops of x and y" in text
    with pytest.raises(ComputationError, match="UNSTABLE") as refused:
        refuse_unstable(found)
    assert refused.value.exit_code == 3 and refused.value.next_step
    assert [row.met for row in found.requirements] == [False, True, False, True]


def test_a_synthesis_that_was_stopped_says_so_first():
    """Its controller is one of the first steps: no reason to relax the specification."""
    mu = SimpleNamespace(name="mu", notes=(STOPPED,), stability=SimpleNamespace(upper=1.2))
    found = replace(result([plant("nominal", 1.01)], replace(CULPRIT, kind="controller")), controllers=(mu,))
    assert first_sentence(found).startswith("The synthesis was stopped") and "UNSTABLE" in first_sentence(found)
    with pytest.raises(ComputationError) as refused:
        refuse_unstable(found)
    assert "run it again to the end" in refused.value.next_step


@pytest.mark.parametrize(
    "bad", [plant("nominal", 1.0 + 1e-9), plant("nominal", 0.99, diverged=True), plant("nominal", np.nan)]
)
def test_a_slow_growth_a_divergence_and_a_radius_that_is_no_number_are_all_unstable(bad):
    found = result([bad], CULPRIT)
    assert not found.stable and first_sentence(found).startswith("UNSTABLE")


def test_stable_loops_count_and_nothing_is_raised():
    found = result([plant("nominal", 0.9999), plant("random 1", 0.999, clipped=3)])
    refuse_unstable(found)
    assert first_sentence(found) == (
        "1 of 3 requirements is not met: voltages stay within the limits of drives and converter."
    )
    stable, limits, _ = found.requirements
    assert (stable.value, stable.limit, stable.met) == (2, 2, True) and (limits.value, limits.met) == (1, False)


@pytest.mark.parametrize(
    "band_bound, said",
    [
        (0.5, "is at most +6.0 dB, and at most -8.0 dB from 1 to 10 Hz."),
        (0.3, "loop exceeds them: -8.0 dB from 1 to 10 Hz (bound -10.5 dB)."),
    ],
)
def test_all_six_degrees_of_freedom_stand_beside_the_bounds_of_the_design_model(band_bound, said):
    """The band is 1 to 10 Hz; 2 at 0.5 Hz is outside, 0.4 at 2 Hz inside."""
    mu = SimpleNamespace(worst_peak=SimpleNamespace(upper=2.5), worst_band=SimpleNamespace(upper=band_bound))
    six = SimpleNamespace(
        omega=2 * np.pi * np.array([0.5, 2.0, 20.0]),
        kept=np.array([2.0, 0.4, 1.0]),
        alone=np.array([[9.0] * 6, [2.0, 1.0, 0.4, 0.3, 0.5, 4.0], [9.0] * 6]),
    )
    design = SimpleNamespace(transmissibility=SimpleNamespace(band_Hz=[1.0, 10.0]), keep=["z", "phi_x"])
    found = all_axes(SimpleNamespace(controller=lambda name: mu, six_dof=six, design=design))
    assert said in found and "z and phi_x" in found and "locked" in found
    # Of the band only, and of the axes that the design leaves out.
    assert "is at most +6.0 dB (x), +0.0 dB (y), -6.0 dB (phi_y) and +12.0 dB (phi_z)" in found


def test_without_bounds_none_are_said_to_hold():
    """Robust stability is not proved: the worst cases are infinite, and the nominal loop alone can be told."""
    nothing = SimpleNamespace(upper=np.inf)
    six = SimpleNamespace(
        omega=2 * np.pi * np.array([0.5, 2.0, 20.0]),
        kept=np.array([2.0, 0.4, 1.0]),
        alone=np.array([[9.0] * 6, [2.0, 1.0, 0.4, 0.3, 0.5, 4.0], [9.0] * 6]),
    )
    design = SimpleNamespace(transmissibility=SimpleNamespace(band_Hz=[1.0, 10.0]), keep=["z", "phi_x"])
    mu = SimpleNamespace(worst_peak=nothing, worst_band=nothing)
    found = all_axes(SimpleNamespace(controller=lambda name: mu, six_dof=six, design=design))
    assert "bounds hold" not in found and "+6.0 dB" in found and "-8.0 dB from 1 to 10 Hz" in found


@pytest.mark.parametrize(
    ("stability", "moving", "advice"),
    [
        (1.66, ("z", "phi_x"), "too demanding: mu of the controller is 3.59"),
        (0.8, ("z", "x", "phi_y"), "add x and phi_y to keep"),
        (0.8, ("z", "phi_x"), "reduce the bandwidth, or use a higher sample rate"),
    ],
)
def test_the_advice_fits_the_cause(stability, moving, advice):
    """Axes are to be added only if axes outside the design move and the design itself is stable for its set."""
    mu = SimpleNamespace(
        name="mu", notes=(), stability=SimpleNamespace(upper=stability), mu=SimpleNamespace(upper=3.59)
    )
    found = result(
        [plant("worst case", 1.00003)], InstabilityCause("worst case", 1.00003, 18.2, 0.03, moving, "controller")
    )
    found = replace(found, controllers=(mu,), design=SimpleNamespace(keep=["z", "phi_x"]))
    with pytest.raises(ComputationError) as refused:
        refuse_unstable(found)
    assert advice in refused.value.next_step
