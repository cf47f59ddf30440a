"""Skyhook loops on a table of one degree of freedom: the textbook's closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from avis_ctrl.classical.skyhook import Skyhook, critical_damping
from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, gain, lft_lower

MASS, NATURAL_HZ, DAMPING_RATIO = 200.0, 2.0, 0.05
OMEGA_N = 2 * np.pi * NATURAL_HZ
STIFFNESS, DAMPING = MASS * OMEGA_N**2, 2 * DAMPING_RATIO * OMEGA_N * MASS


def table(seen: str = "seen_z_dot") -> StateSpace:
    """m x'' + c (x' - x_f') + k (x - x_f) = f; inputs floor and payload force, outputs payload and measured velocity.

    From floor velocity to payload velocity is the transmissibility.
    """
    A = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])  # (x - x_f, x')
    B = np.array([[-1.0, 0.0], [DAMPING / MASS, 1 / MASS]])
    C = np.array([[0.0, 1.0], [0.0, 1.0]])
    return StateSpace(A, B, C, np.zeros((2, 2)), 0.0, ("floor", "command_z"), ("z_dot", seen))


@pytest.mark.parametrize("velocity_gain", [0.5, 2.0, 10.0])
def test_transmissibility_is_that_of_the_thesis(velocity_gain):
    """x/x_f = (2 xi w_n s + w_n^2) / (s^2 + (2 xi w_n + K_p) s + w_n^2): Rademakers 2005, eq. 1.2, K_p = g/m.

    The filters are transparent between their corners: 1e-4 Hz and 1e5 Hz leave 0.1 % in 0.5 to 20 Hz.
    """
    g = velocity_gain * 2 * OMEGA_N * MASS
    loops = Skyhook(("z",), (g,), 1e-4, 1e5)
    omega = 2 * np.pi * np.geomspace(0.5, 20.0, 60)
    s = 1j * omega
    expected = (2 * DAMPING_RATIO * OMEGA_N * s + OMEGA_N**2) / (
        s**2 + (2 * DAMPING_RATIO * OMEGA_N + g / MASS) * s + OMEGA_N**2
    )
    closed = lft_lower(table(), loops.controller()).frequency_response(omega)[:, 0, 0]
    np.testing.assert_allclose(closed, expected, rtol=1e-3)
    passive = table().select("z_dot", "floor").frequency_response(omega)[:, 0, 0]
    assert np.max(np.abs(closed)) < 1.1 < 9 < np.max(np.abs(passive))  # eq. 1.1 has a resonance, eq. 1.2 none


def test_classical_rule_makes_an_axis_critically_damped():
    """Both poles at -w_n with the bare gain of the rule."""
    (g,) = critical_damping([MASS], [STIFFNESS], [DAMPING])
    closed = lft_lower(table(), gain([[-g]]))
    # A double root moves with the square root of round-off.
    np.testing.assert_allclose(closed.poles(), [-OMEGA_N, -OMEGA_N], rtol=1e-6)


def test_an_axis_damped_beyond_critical_gets_no_gain():
    np.testing.assert_array_equal(critical_damping([1.0, 1.0], [1.0, 1.0], [5.0, 0.5]), [0.0, 1.5])


def test_filter_is_a_first_order_pair():
    loops = Skyhook(("z",), (1.0,), 0.1, 100.0)
    s = 1j * 2 * np.pi * np.geomspace(1e-3, 1e4, 40)
    tilt, roll = 2 * np.pi * 0.1, 2 * np.pi * 100.0
    np.testing.assert_allclose(
        loops.filter.frequency_response(s.imag)[:, 0, 0], s / (s + tilt) / (s / roll + 1), rtol=1e-10
    )
    assert loops.filter.dcgain() == pytest.approx(0.0, abs=1e-14)  # gravity and drift stay outside


def test_controller_names_axes_and_keeps_them_apart():
    loops = Skyhook(("z", "phi_x_edge"), (10.0, 20.0), 0.1, 100.0)
    K = loops.controller()
    assert K.inputs == ("seen_z_dot", "seen_phi_x_edge_dot")
    assert K.outputs == ("command_z", "command_phi_x_edge")
    response = K.frequency_response(np.array([2 * np.pi * 3.0]))[0]
    assert response[0, 1] == response[1, 0] == 0
    assert response[1, 1] == pytest.approx(2 * response[0, 0])
    assert response[0, 0].real < 0  # it brakes: u = K y with positive feedback
    assert K.nstates == 4


def test_six_loops_by_axis():
    axes = ("x", "y", "z", "phi_x", "phi_y", "phi_z")
    loops = Skyhook(axes, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), 0.1, 100.0)
    middle = np.array([2 * np.pi * np.sqrt(0.1 * 100.0)])
    sizes = [abs(loops.loop(axis).frequency_response(middle)[0, 0, 0]) for axis in axes]
    np.testing.assert_allclose(np.array(sizes) / sizes[0], [1, 2, 3, 4, 5, 6], rtol=1e-12)
    assert loops.controller().nstates == 12


@pytest.mark.parametrize(
    ("gains", "tilt", "roll", "words"),
    [
        ((1.0, 2.0), 0.1, 100.0, "gains"),
        ((1.0,), 0.0, 100.0, "tilt_corner_Hz"),
        ((1.0,), -1.0, 100.0, "tilt_corner_Hz"),
        ((1.0,), 0.1, float("nan"), "roll_off_Hz"),
        ((1.0,), 0.1, float("inf"), "roll_off_Hz"),
        ((1.0,), 100.0, 0.1, "below the roll-off"),
        ((float("nan"),), 0.1, 100.0, "gains"),
        ((-1.0,), 0.1, 100.0, "gains"),
    ],
)
def test_what_is_refused(gains, tilt, roll, words):
    with pytest.raises(InputError, match=words):
        Skyhook(("z",), gains, tilt, roll)


def test_an_axis_it_does_not_have_is_refused():
    with pytest.raises(InputError, match="phi_x"):
        Skyhook(("z",), (1.0,), 0.1, 100.0).loop("phi_x")
