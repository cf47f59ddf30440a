"""Systems of python-control in and out, through the functions that take a system."""

from __future__ import annotations

import control
import numpy as np
import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, tf
from avis_ctrl.lti.interchange import as_system, response_of
from avis_ctrl.robust.hinfsyn import hinfsyn
from avis_ctrl.robust.mu_peak import mu_peak
from avis_ctrl.uncertainty.blocks import ComplexFull

G = control.tf([1.0, 2.0], [1.0, 3.0, 5.0])
OMEGA = np.geomspace(0.1, 10, 7)


@pytest.mark.parametrize(
    "given", [G, control.ss(G), as_system(G), tf([1.0, 2.0], [1.0, 3.0, 5.0]), control.frd(G, OMEGA)]
)
def test_responses_agree(given):
    np.testing.assert_allclose(response_of(given, OMEGA)[:, 0, 0], np.squeeze(G(1j * OMEGA)), rtol=1e-10)


def test_there_and_back():
    system = StateSpace([[-1.0, 2.0], [0.0, -3.0]], [[1.0], [1.0]], [[1.0, 0.0]], [[0.5]], 0.01, ("force",), ("x",))
    again = as_system(system.to_control())
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(again, name), getattr(system, name))
    assert (again.dt, again.inputs, again.outputs) == (0.01, ("force",), ("x",))


def test_numbers_and_matrices_are_gains():
    np.testing.assert_array_equal(as_system(3).D, [[3.0]])
    np.testing.assert_array_equal(as_system([[1, 2], [3, 4]]).D, [[1.0, 2.0], [3.0, 4.0]])


def test_synthesis_takes_python_control_and_gives_it_back():
    """The plant of a disturbance on the output of 1/(s + 1), control penalised."""
    P = control.ss([[-1.0]], [[1.0, 1.0]], [[1.0], [0.0], [1.0]], [[0.0, 0.0], [0.0, 0.3], [0.1, 0.0]])
    made = hinfsyn(P, 1, 1)
    K = made.K.to_control()
    closed = P.lft(K)
    assert closed.poles().real.max() < 0
    response = np.moveaxis(np.reshape(closed(1j * np.geomspace(1e-3, 1e3, 400)), (2, 1, -1)), -1, 0)
    assert np.linalg.norm(response, axis=(1, 2)).max() == pytest.approx(made.gamma, rel=1e-3)
    peak = mu_peak(closed, [ComplexFull(1, 2)])
    assert peak.upper == pytest.approx(made.gamma, rel=2e-3)


@pytest.mark.parametrize(
    "given, words",
    [
        (control.frd(G, OMEGA), "has no states|none"),
        ("G", "expected a StateSpace"),
        (None, "expected a StateSpace"),
        (control.tf([1.0, 0.0, 0.0], [1.0, 1.0]), "proper system"),
        (np.array([["a"]]), "proper system"),
        ([[1.0], [1.0, 2.0]], "proper system"),
    ],
)
def test_what_is_no_system_is_refused_in_one_line(given, words):
    with pytest.raises(InputError, match=words) as caught:
        as_system(given)
    assert "\n" not in str(caught.value)
