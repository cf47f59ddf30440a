"""Plots: axes in, axes out, the right numbers on them, units on the axes."""

from __future__ import annotations

from dataclasses import replace

import control
import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot as plt

from avis_ctrl import plot
from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, tf
from avis_ctrl.lti.interchange import plot_frequencies
from avis_ctrl.rigs.vibration_criteria import CRITERIA
from avis_ctrl.robust.mu_peak import MuPeak, mu_peak
from avis_ctrl.robust.musyn import musyn
from avis_ctrl.robust.musyn_state import Iteration
from avis_ctrl.uncertainty.blocks import ComplexScalar
from avis_ctrl.uncertainty.uncertain_models import matrix, real, ss

matplotlib.use("Agg")
LAG = control.tf([2.0], [0.5, 1.0])
OMEGA = np.geomspace(0.01, 100, 50)


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


def curve(ax, k=0):
    return tuple(np.asarray(part, float) for part in ax.lines[k].get_data())


@pytest.mark.parametrize(
    "system",
    [LAG, control.ss(LAG), tf([2.0], [0.5, 1.0]), control.frd(LAG, OMEGA)],
    ids=["TransferFunction", "StateSpace of python-control", "StateSpace", "FRD"],
)
def test_bode_and_sigma_of_a_lag_in_closed_form(system):
    top, bottom = plot.bode(system, None if hasattr(system, "frdata") else OMEGA)
    f, dB = curve(top)
    w = 2 * np.pi * f
    np.testing.assert_allclose(w, OMEGA, rtol=1e-12)
    np.testing.assert_allclose(dB, 20 * np.log10(2 / np.sqrt(1 + (0.5 * w) ** 2)), atol=1e-9)
    np.testing.assert_allclose(curve(bottom)[1], -np.degrees(np.arctan(0.5 * w)), atol=1e-9)
    assert top.get_ylabel() == "magnitude [dB]" and bottom.get_ylabel() == "phase [degrees]"
    assert bottom.get_xlabel() == "frequency [Hz]" and top.get_xscale() == "log"
    ax = plot.sigma(system, OMEGA, label="lag")
    np.testing.assert_allclose(curve(ax)[1], dB, atol=1e-9)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["lag"]


def test_frequencies_may_be_in_hertz():
    for draw in (plot.bode, plot.sigma):
        ax = draw(LAG, frequency_Hz=[0.1, 1.0, 10.0])
        np.testing.assert_allclose(curve(np.ravel(ax)[0])[0], [0.1, 1.0, 10.0], rtol=1e-12)
        uncertain = draw(real("k", 1.0, percent=10) * LAG, frequency_Hz=[0.1, 1.0])
        np.testing.assert_allclose(curve(np.ravel(uncertain)[0])[0], [0.1, 1.0], rtol=1e-12)
        with pytest.raises(InputError, match="omega or frequency_Hz"):
            draw(LAG, OMEGA, frequency_Hz=OMEGA)


@pytest.mark.parametrize("system", [LAG, real("k", 1.0, percent=20) * tf([2.0], [0.5, 1.0])])
def test_options_of_a_line_may_be_abbreviated(system):
    for ax in (plot.bode(system, OMEGA, c="red", lw=3)[1], plot.sigma(system, OMEGA, c="red", lw=3)):
        assert (ax.lines[0].get_color(), ax.lines[0].get_linewidth()) == ("red", 3)


def test_axes_given_are_the_axes_returned():
    _, pair = plt.subplots(2)
    assert plot.bode(LAG, ax=pair) is pair
    for draw in (
        lambda ax: plot.sigma(LAG, ax=ax),
        lambda ax: plot.vc_curves(ax=ax),
        lambda ax: plot.mu(peak(), ax),
        lambda ax: plot.dk_history(history(), ax),
        lambda ax: plot.order([(3, 1.2)], ax),
    ):
        _, one = plt.subplots()
        assert draw(one) is one
    with pytest.raises(InputError, match="expected 2 axes"):
        plot.bode(LAG, ax=plt.subplots()[1])


def test_singular_values_of_several_channels():
    G = control.ss(np.diag([-1.0, -2.0]), np.eye(2), np.diag([3.0, 1.0]), np.zeros((2, 2)))
    ax = plot.sigma(G, OMEGA)
    np.testing.assert_allclose(curve(ax, 0)[1], 20 * np.log10(3 / np.sqrt(1 + OMEGA**2)), atol=1e-9)
    np.testing.assert_allclose(curve(ax, 1)[1], 20 * np.log10(1 / np.sqrt(4 + OMEGA**2)), atol=1e-9)
    assert len(plot.bode(G, OMEGA)[0].get_legend().get_texts()) == 4


def test_an_uncertain_system_is_drawn_with_its_family():
    G = real("k", 2.0, percent=20) * tf([1.0], [0.5, 1.0])
    top, _ = plot.bode(G, OMEGA)
    curves = np.array([curve(top, k)[1] for k in range(len(top.lines))])
    assert len(curves) == 21
    np.testing.assert_allclose(curves[0], 20 * np.log10(2 / np.sqrt(1 + (0.5 * OMEGA) ** 2)), atol=1e-9)
    assert np.all(np.abs(curves - curves[0]) <= -20 * np.log10(0.8) + 1e-9) and np.ptp(curves[:, 0]) > 1.0
    assert words(top) == ["nominal", "20 random samples"]
    assert len(plot.sigma(G).lines) == 21
    k = real("k", 2.0, percent=20)
    two, _ = plot.bode(ss([[-1.0, 0.0], [0.0, -2.0]], np.eye(2), [[k, 0.0], [0.0, 1.0]]), OMEGA)
    assert words(two).count("20 random samples (thin)") == 1 and len(words(two)) == 5


def words(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


def test_a_list_of_systems_is_drawn_over_one_another():
    slow, fast = tf([1.0], [10.0, 1.0]), tf([1.0], [0.01, 1.0])
    for draw in (plot.bode, plot.sigma):
        ax = np.ravel(draw([slow, fast]))[0]
        assert words(ax) == ["system 1", "system 2"] and len({one.get_color() for one in ax.lines}) == 2
        np.testing.assert_array_equal(curve(ax, 0)[0], curve(ax, 1)[0])  # one range, from the slow to the fast pole
        assert curve(ax)[0][0] < 0.1 / 60 and curve(ax)[0][-1] > 100 / 7
        assert words(np.ravel(draw([slow, fast], label=["a", "b"]))[0]) == ["a", "b"]
        mixed = np.ravel(draw([fast, control.frd(LAG, OMEGA), control.tf([0.1], [1.0, -0.9], 0.1)]))[0]
        np.testing.assert_allclose(curve(mixed, 1)[0], OMEGA / (2 * np.pi))
        assert curve(mixed, 2)[0][-1] <= 5.0 < curve(mixed, 0)[0][-1]
        with pytest.raises(InputError, match="one label for each; systems: 2"):
            draw([slow, fast], label=["a"])
        with pytest.raises(InputError, match=r"a list, bode\(\[G, H\]\)"):
            draw(slow, fast)


def test_each_pair_of_an_uncertain_system_has_its_colour_and_one_label():
    k = real("k", 2.0, percent=20)
    top, bottom = plot.bode(matrix([[k * tf([1.0], [1.0, 1.0]), 0.0], [tf([1.0], [0.1, 1.0]), 1.0]]))
    assert words(top) == ["y0 / u0", "y0 / u1", "y1 / u0", "y1 / u1", "20 random samples (thin)"]
    assert len({one.get_color() for one in top.lines}) == 4
    assert np.all(np.isnan(curve(bottom, 21)[1]))  # the phase of zero


def test_singular_values_that_are_round_off_are_not_drawn():
    column, row = np.array([[1.0], [0.3]]), np.array([[0.7, 0.1]])
    ax = plot.sigma((column @ row) @ tf([[[1.0], [0.0]], [[0.0], [1.0]]], [[[1.0, 1.0], [1.0]], [[1.0], [1.0, 1.0]]]))
    assert len(ax.lines) == 1 and ax.get_ylim()[0] > -100
    blocked = plot.sigma(control.tf([1e-13], [1.0, 1e-3, 1.0]) - 0.0)
    low, high = blocked.get_ylim()
    assert high - low < 200 + 1e-9
    steep = plot.bode(tf([1.0], np.poly([-1.0] * 8)), np.geomspace(1e-3, 1e5, 100))[0]
    assert np.ptp(steep.get_ylim()) == pytest.approx(200)


def test_default_frequencies_show_a_narrow_resonance():
    f, dB = curve(plot.bode(control.tf([1.0], [1.0, 2e-4 * 5.0, 25.0]))[0])
    assert np.max(dB) == pytest.approx(20 * np.log10(1 / (2 * 1e-4 * 25.0)), abs=0.1)
    assert f[0] < 0.3 and f[-1] > 3
    assert plot_frequencies(control.ss([[0.5]], [[1]], [[1]], [[0]], 0.1))[-1] <= np.pi / 0.1


def peak():
    w = np.array([0.0, 1.0, 10.0])
    return MuPeak(0.91, 0.9, 1.0, None, True, "", w, np.array([0.5, 0.905, 0.2]), np.array([0.0, 0.9, 0.1]))


def history():
    rows = [(3.0, 2.0, 4), (1.5, 1.2, 8), (1.1, 1.0, 6), (np.inf, np.nan, 9)]
    return [Iteration(k, gamma, mu, order, 0.0, 0, 0.1, "D-K") for k, (gamma, mu, order) in enumerate(rows, 1)]


def test_mu_says_what_its_bound_is_worth():
    ax = plot.mu(peak())
    assert "peak at most 0.91, proved between all points" in words(ax)
    f, upper = curve(ax)
    np.testing.assert_allclose(f, np.array([1.0, 10.0]) / (2 * np.pi))  # zero has no place on a logarithmic axis
    np.testing.assert_allclose(upper, [0.905, 0.2])
    assert "reached: 0.9 at 0 Hz" in words(plot.mu(replace(peak(), omega=0.0)))


def test_history_and_order():
    ax = plot.dk_history(history())
    np.testing.assert_allclose(curve(ax, 1), [[1, 2, 3], [2.0, 1.2, 1.0]])
    ax = plot.order(history())
    np.testing.assert_allclose(curve(ax, 0), [[4, 6, 8], [2.0, 1.0, 1.2]])
    np.testing.assert_allclose(curve(ax, 1)[1], [2.0, 1.0, 1.0])
    with pytest.raises(InputError, match="at least one iteration"):
        plot.dk_history([])


def test_vibration_criteria_are_those_of_the_table():
    f = np.array([4.0, 8.0, 16.0])
    ax = plot.vc_curves({"floor": (f, np.array([1e-6, 2e-6, 0.0]))})
    assert [text.get_text() for text in ax.texts] == [one.name for one in CRITERIA]
    np.testing.assert_allclose(curve(ax, len(CRITERIA)), [[4.0, 8.0], [1.0, 2.0]])
    assert ax.get_ylabel() == "velocity, r.m.s. [µm/s]"
    with pytest.raises(InputError, match="two vectors of one length"):
        plot.vc_curves({"floor": (f, f[:2])})


def test_what_is_no_system_is_refused():
    with pytest.raises(InputError, match="expected a StateSpace"):
        plot.bode("G")
    with pytest.raises(InputError, match="frequencies of the frequency response"):
        plot.sigma(control.frd(LAG, OMEGA), np.array([3.3]))


def test_mu_of_a_synthesis_names_the_call_that_has_the_curves():
    # A lag with uncertain gain and a disturbance; its output and half the effort are to be small, y has noise.
    P = StateSpace(
        [[-1.0]],
        [[0.3, 1.0, 0.0, 1.0]],
        [[0.0], [1.0], [0.0], [1.0]],
        [[0, 0, 0, 1.0], [0, 0, 0, 0], [0, 0, 0, 0.5], [0, 0, 0.1, 0]],
    )
    found = musyn(P, [ComplexScalar(1, "gain")], 1, 1, max_iterations=2, polish=False)
    with pytest.raises(InputError, match=r"mu_peak\(result.closed_loop, result.blocks\)"):
        plot.mu(found)
    curves = mu_peak(found.closed_loop, found.blocks)
    assert curves.upper == pytest.approx(found.mu_upper, rel=0.01)
    assert curve(plot.mu(curves))[1].max() <= curves.upper
