"""Robust stability and performance of uncertain systems; mixed sensitivity; covering weights."""

from __future__ import annotations

from dataclasses import replace

import control
import numpy as np
import pytest
import scipy.linalg as la

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, hinf_norm, tf
from avis_ctrl.robust.mixed_sensitivity import mixed_sensitivity
from avis_ctrl.robust.mu_peak import mu_peak
from avis_ctrl.robust.robustness import robust_performance, robust_stability, worst_case_gain, worst_values
from avis_ctrl.uncertainty.blocks import ComplexScalar, RealScalar
from avis_ctrl.uncertainty.uncertain_models import complex_disk, dynamics, matrix, real, ss
from avis_ctrl.uncertainty.uncertain_models import tf as uncertain_tf
from avis_ctrl.uncertainty.uncertainty_weight import uncertainty_weight

# Skogestad and Postlethwaite, Multivariable Feedback Control, 2005: plant of section 2.6, weights of example 2.17.
PLANT = control.tf([200], np.polymul([10, 1], np.polymul([0.05, 1], [0.05, 1])))
W_P = control.tf([1 / 1.5, 10], [1, 10 * 1e-4])
# One output: what differs between its two inputs cannot be made at the output.
ROW, TWO_INPUTS = np.array([[1.0, 1.0]]), np.array([[1.0, 0.01]])


def oscillator(percent=20.0):
    k, c = real("k", 4.0, percent=percent), real("c", 0.4, percent=percent)
    return ss([[0, 1], [-1 * k, -1 * c]], [[0], [1]], [[1, 0]])


def test_stability_ends_where_routh_says():
    """s^3 + 10 s^2 + 10 s + 10 + 25 k is stable for -0.4 < k < 3.6; k = 1 +- 20 %: first at k = -0.4, seven ranges."""
    loop = (real("k", 1.0, percent=20) * tf([25.0], [1.0, 10.0, 10.0, 10.0])).feedback()
    found = robust_stability(loop)
    assert found.upper == pytest.approx(7.0, rel=1e-6) and found.lower == pytest.approx(7.0, rel=1e-3)
    assert found.worst["k"] == pytest.approx(-0.4) and found.omega == pytest.approx(0.0, abs=1e-3) and found.robust
    other = (real("k", 3.0, percent=20) * tf([25.0], [1.0, 10.0, 10.0, 10.0])).feedback()
    edge = robust_stability(other)
    assert edge.worst["k"] == pytest.approx(3.6, rel=1e-3) and edge.upper == pytest.approx(1.0, rel=1e-3)
    assert edge.omega == pytest.approx(np.sqrt(10.0), rel=1e-2)


@pytest.mark.parametrize("around", [(0.5, 1.2), (0.8, 1.5)])
def test_an_infinite_parameter_is_no_counterexample(around):
    """k/(s + 1) is stable for every k; delta = -1/skew, where k is infinite, is found nevertheless."""
    k = real("k", 1.0, range=around)
    found = robust_stability(k * tf([1.0], [1.0, 1.0]))
    assert found.upper == np.inf and found.worst == {} and found.delta is None and found.robust
    assert found.lower == pytest.approx(1 / abs(k.uncertain["k"].skew), rel=1e-2)


@pytest.mark.parametrize(("around", "end"), [((0.5, 1.2), -0.4), ((0.8, 1.5), 3.6), ((0.2, 2.5), 3.6)])
def test_stability_ends_where_routh_says_with_an_asymmetric_range(around, end):
    """As above, stable for -0.4 < k < 3.6; the first end that delta reaches is found."""
    k = real("k", 1.0, range=around)
    found = robust_stability((k * tf([25.0], [1.0, 10.0, 10.0, 10.0])).feedback())
    assert found.worst["k"] == pytest.approx(end, rel=1e-3)
    assert found.upper == pytest.approx(abs(k.uncertain["k"].delta(end)), rel=1e-3)


def test_performance_at_its_own_margin_is_the_worst_case_gain():
    """lower = a: for a times the uncertainty the gain is at most 1/a, and just reaches it."""
    found = robust_performance(oscillator())
    a = found.lower
    scaled = worst_case_gain(oscillator(20.0 * a))
    assert scaled.upper <= 1 / a * (1 + 2e-3) and scaled.lower >= 1 / found.upper * (1 - 1e-2)
    assert found.robust is False  # the resonance has a gain above 1 with the declared uncertainty
    assert robust_stability(oscillator()).robust is True


def four_elements(seed, dt):
    """A random system with a real parameter, a disk, and dynamics of one channel (three copies) and of two."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4, 4))
    A -= (np.linalg.eigvals(A).real.max() + 0.5) * np.eye(4)
    A = (la.expm(A * dt) if dt else A).astype(object)
    A[1, 0], A[2, 3] = A[1, 0] * real("k", 1.0, percent=20), A[2, 3] * complex_disk("z", 1.0, 0.1)
    G = ss(A, rng.standard_normal((4, 2)), rng.standard_normal((3, 4)), dt=dt)
    return G @ (np.eye(2) + dynamics("f", 0.3, (2, 2))) * (1 + dynamics("s", 0.2))


@pytest.mark.parametrize(("seed", "dt"), [(2, 0.0), (6, 0.0), (10, 0.1), (7, 0.1)])
def test_the_worst_case_can_be_substituted_and_has_the_reported_gain(seed, dt):
    G = four_elements(seed, dt)
    found = worst_case_gain(G)
    worst = G.substitute(found.worst)
    assert worst.is_stable() and set(found.worst) == {"k", "z", "f", "s"}
    assert found.lower * (1 - 1e-5) <= hinf_norm(worst).gain <= found.upper * (1 + 1e-5)
    for name in "fs":
        assert found.worst[name].is_stable() and hinf_norm(found.worst[name]).gain <= 1 + 1e-6
    margin = robust_stability(G)
    poles = G.substitute(margin.worst).poles()
    assert np.max(np.abs(poles) - 1 if dt else poles.real) == pytest.approx(0.0, abs=1e-8)
    performance = robust_performance(G)
    gain = np.linalg.norm(G.substitute(performance.worst).frequency_response(performance.omega)[0], 2)
    assert gain >= (1 - 1e-5) / performance.upper


@pytest.mark.parametrize("band", [(0.0, np.inf), (5.0, 20.0), (7.0, 15.0), (9.0, 12.0)])
def test_the_worst_case_gain_near_a_resonance(band):
    """(s + 1)/(s^2 + c s + k) is largest with the least damping; the maximum over k and frequency by a search."""
    k, c = real("k", 100.0, percent=20), real("c", 0.1, percent=40)
    found = worst_case_gain(uncertain_tf([1.0, 1.0], [1.0, c, k]), band=band)
    stiffness, omega = np.linspace(80, 120, 41)[:, None], np.sqrt(80) + np.linspace(-0.05, 0.05, 20001)
    exact = np.max(np.abs((1j * omega + 1) / (-(omega**2) + 0.06j * omega + stiffness)))
    assert exact * (1 - 1e-3) <= found.lower <= exact * (1 + 1e-6) <= found.upper * (1 + 1e-6) <= exact * (1 + 2e-3)
    # The maximum is narrow in k, whose ascent must not stop that in c.
    assert np.all(found.lower_curve >= 0.99 * found.upper_curve)


def test_a_block_that_only_performance_closes_does_not_hide_an_instability():
    """delta acts from d to e only. k destabilises at 0.5 of its range: the gain is infinite."""
    k, d = real("k", 1.0, percent=200), complex_disk("d", 1.0, 0.5)
    loop = uncertain_tf([1.0], [1.0, k])
    found = worst_case_gain(d * loop)
    assert found.lower == np.inf and found.upper == np.inf and robust_stability(d * loop).upper == pytest.approx(0.5)


def test_the_upper_bound_of_the_worst_case_gain_is_tight_with_real_and_repeated_blocks():
    """With too few steps along the path of scalings it was 4.6 times too large."""
    found = worst_case_gain(four_elements(8, 0.0))
    assert found.lower <= found.upper <= 1.02 * found.lower


def test_a_complex_worst_case_at_zero_frequency_is_attained_beside_it():
    lag = tf([1.0], [1.0, 1.0])
    G = lag * (1 + dynamics("d", 0.5))
    peak = mu_peak(G.lft()[0].select([0], [0]), [ComplexScalar(1, "d")])
    P, blocks = G.lft()
    made = worst_values(replace(peak, delta=np.array([[0.6 + 0.8j]]), omega=0.0), P, blocks, G.uncertain)
    beside = G.substitute(made).frequency_response([1e-5])[0, 0, 0]
    assert beside == pytest.approx(1 + 0.5 * (0.6 + 0.8j), rel=1e-4)
    unnamed = worst_case_gain(P, [ComplexScalar()])
    assert set(unnamed.worst) == {"block 0"} and unnamed.lower == pytest.approx(1.5, rel=1e-3)


def test_an_lft_with_blocks_is_the_same_as_the_system():
    P, blocks = oscillator().lft()
    assert robust_stability(P.to_control(), blocks).lower == robust_stability(oscillator()).lower
    assert worst_case_gain(P, blocks).upper == worst_case_gain(oscillator()).upper


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda: robust_stability(tf([1.0], [1.0, 1.0])), "with its blocks"),
        (lambda: robust_stability(oscillator(), [RealScalar(1)]), "expected no blocks"),
        (lambda: robust_stability(tf([1.0], [1.0, 1.0]), []), "something uncertain"),
        (lambda: robust_stability(tf([1.0], [1.0, 1.0]), [RealScalar(3)]), "the blocks need"),
        (lambda: robust_performance(tf([1.0], [1.0, 1.0]), [RealScalar(1)]), "inputs d and outputs e"),
        (lambda: mixed_sensitivity(PLANT), "at least one weight"),
        (lambda: mixed_sensitivity(PLANT, np.ones((1, 2))), "expected 1 input"),
        (lambda: uncertainty_weight(PLANT, []), "expected responses"),
        (lambda: uncertainty_weight(PLANT, [2 * PLANT], omega=[0.0]), "one of them positive"),
        (lambda: uncertainty_weight(PLANT, [PLANT]), "differ from a nominal one"),
        (lambda: uncertainty_weight(PLANT, [np.ones((2, 2))]), "responses of shape"),
        (lambda: uncertainty_weight(ROW, [2 * TWO_INPUTS], kind="output"), "additive or input"),
    ],
)
def test_wrong_input_is_one_line(call, words):
    with pytest.raises(InputError, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_mixed_sensitivity_of_the_textbook():
    """The optimum printed in example 2.17 is 1.37; python-control (SLICOT) finds the same problem's optimum."""
    found = mixed_sensitivity(PLANT, W_P, 1.0, backoff=0.001)
    assert round(found.gamma, 2) == 1.37
    omega = np.geomspace(1e-5, 1e4, 4000)
    S, KS, T = (one.frequency_response(omega)[:, 0, 0] for one in (found.S, found.KS, found.T))
    stacked = np.sqrt(np.abs(W_P(1j * omega) * S) ** 2 + np.abs(KS) ** 2)
    assert np.max(stacked) == pytest.approx(found.gamma, rel=1e-3) and np.max(stacked) <= found.gamma * (1 + 1e-6)
    np.testing.assert_allclose(S + T, 1.0, atol=1e-8)
    np.testing.assert_allclose(S * PLANT(1j * omega) * found.K.frequency_response(omega)[:, 0, 0], T, atol=1e-8)


@pytest.mark.filterwarnings("ignore")
def test_mixed_sensitivity_against_python_control():
    *_, (gamma, _) = control.mixsyn(control.ss(PLANT), control.ss(W_P), control.ss([], [], [], [[1.0]]))
    assert mixed_sensitivity(PLANT, W_P, 1.0, backoff=1e-4).gamma == pytest.approx(gamma, rel=2e-3)


@pytest.mark.parametrize("names", [("W1", "W2"), ("w1", "w2"), ("W_S", "W_KS"), ("w_s", "wks")])
def test_weights_under_the_names_of_mixsyn(names):
    assert mixed_sensitivity(PLANT, **dict(zip(names, (W_P, 1.0), strict=True))).gamma == pytest.approx(1.37, abs=0.02)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"W_S": W_P, "w4": 1.0}, "w4: unknown; expected the weights W_S, W_KS, W_T, or options of hinfsyn: backoff"),
        ({"W_S": W_P, "W1": 1.0}, "given twice: W1 is another name of W_S"),
        ({"W_S": np.ones((1, 2))}, "a weight with 2.*expected 1 input"),
        ({"W_S": control.tf([1.0], [1.0, 0.0])}, "W_S.*into the left half-plane"),
        ({"W_S": real("k", 1.0, percent=5) * W_P}, r"its nominal system is .nominal"),
        ({}, "at least one weight"),
    ],
)
def test_wrong_weights_and_options_are_named(options, words):
    with pytest.raises(InputError, match=words):
        mixed_sensitivity(PLANT, **options)


def test_mixed_sensitivity_takes_the_nominal_plant_and_keeps_its_names():
    G = (real("k", 1.0, percent=20) * PLANT).renamed(["force"], ["x"])
    made = mixed_sensitivity(G, W_P, 1.0)
    assert made.gamma == pytest.approx(1.37, abs=0.02)
    assert made.K.outputs == made.KS.outputs == ("force",) and made.T.outputs == ("x",)
    two = matrix([[PLANT, 0.0], [0.0, PLANT]])
    both = mixed_sensitivity(two, matrix([[W_P, 0.0], [0.0, W_P]]), 1.0)
    assert both.gamma == pytest.approx(made.gamma, rel=0.02)


def test_mixed_sensitivity_of_two_channels():
    G = StateSpace([[-1.0, 0.3], [0.0, -2.0]], np.eye(2), [[1.0, 0.5], [0.2, 1.0]], np.zeros((2, 2)))
    found = mixed_sensitivity(G, tf([0.5, 2.0], [1.0, 0.02]), 0.1, tf([1.0, 1.0], [0.01, 20.0]))
    assert found.P.noutputs == 8 and found.K.inputs == ("e0", "e1") and found.T.is_stable()
    assert hinf_norm(found.S).gain < found.gamma / 0.5 * 1.01


def family():
    """Skogestad and Postlethwaite 2005, example 7.5: gain, delay and time constant from 2 to 3, here first order."""
    return [control.tf([k], [tau, 1]) for k in (2, 2.5, 3) for tau in (2, 2.5, 3)]


@pytest.mark.parametrize("kind", ["output", "input", "additive"])
def test_a_weight_covers_every_response_and_not_much_more(kind):
    nominal = control.tf([2.5], [2.5, 1])
    found = uncertainty_weight(nominal, family(), kind=kind)
    s = 1j * found.omega
    error = np.max([np.abs(one(s) - nominal(s)) for one in family()], axis=0)
    error = error if kind == "additive" else error / np.abs(nominal(s))
    np.testing.assert_allclose(found.error, error, rtol=1e-9)
    size = found.magnitude(found.omega)
    assert np.all(size >= error * (1 - 1e-9))
    followed = error > 1e-4 * error.max()
    assert 20 * np.log10(np.max(size[followed] / error[followed])) <= 2.0 + 1e-6
    assert np.all(found.shape.poles().real < 0) and np.all(found.shape.zeros().real < 0)


def test_a_weight_covers_the_error_at_zero_frequency():
    omega = np.r_[0.0, np.geomspace(1, 100, 30)]
    error = np.where(omega == 0, 1.0, 0.1)
    found = uncertainty_weight(control.frd(np.ones(31), omega), control.frd(1 + error, omega))
    np.testing.assert_array_equal(found.omega, omega)
    assert np.all(found.magnitude(omega) >= error) and found.magnitude(np.zeros(1)) <= 10 ** (2 / 20)


def test_a_weight_is_refused_for_a_system_that_no_stable_delta_makes():
    """1/(s - 0.1) has the error of a stable system from 1/(s + 1), but is not in the set; its loop is unstable."""
    nominal, other = tf([1.0], [1.0, 1.0]), tf([1.0], [1.0, -0.1])
    with pytest.raises(InputError, match="expected 0 unstable poles"):
        uncertainty_weight(nominal, [other])


def test_a_weight_from_measured_responses_goes_into_dynamics():
    omega = np.geomspace(0.01, 100, 80)
    nominal = tf([2.5], [2.5, 1.0])
    responses = [control.frd(one, omega) for one in family()]
    W = uncertainty_weight(nominal, responses)
    np.testing.assert_array_equal(W.omega, omega)
    loop = (nominal * (1 + dynamics("model", W))).feedback(2.0)
    assert robust_stability(loop).robust is True
    # Every member is G (1 + W Delta) with |Delta| <= 1.
    Delta = [
        (np.squeeze(one(1j * omega)) / nominal.frequency_response(omega)[:, 0, 0] - 1) / W.shape(1j * omega)
        for one in family()
    ]
    assert np.max(np.abs(Delta)) <= 1 + 1e-9


def test_results_are_short_in_a_terminal_and_tables_in_a_notebook():
    found = robust_performance(oscillator())
    weight = uncertainty_weight(tf([1.0], [1.0, 1.0]), [tf([1.2], [1.0, 1.0])])
    assert repr(weight) == "UncertaintyWeight(output uncertainty of 0.2 to 0.2, covered by order 0)"
    for one in (found, found.mu, mixed_sensitivity(PLANT, W_P, 1.0), weight):
        assert "\n" not in repr(one) and len(repr(one)) < 700 and repr(one).startswith(type(one).__name__)
        assert one._repr_html_().count("<tr>") >= 5
    assert f"lower={found.lower:.5g}" in repr(found) and "k: " in repr(found)
