"""Uncertain arithmetic against plain arithmetic, textbooks and python-control."""

from __future__ import annotations

import pickle

import control
import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, hinf_norm, tf
from avis_ctrl.robust import robustness
from avis_ctrl.robust.mu_peak import mu_peak, worst_case_gain
from avis_ctrl.uncertainty import uncertain_models
from avis_ctrl.uncertainty.uncertain_models import complex_disk, connect, dynamics, matrix, real, ss

NAMES = ("p", "q", "r")
ELEMENTS = {
    "p": real("p", 2.0, percent=30),
    "q": real("q", 3.0, range=(2.0, 5.0)),
    "r": real("r", -1.5, plus_minus=(0.2, 0.4)),
}
RANGES = {"p": (1.4, 2.6), "q": (2.0, 5.0), "r": (-1.7, -1.1)}

leaves = st.one_of(st.sampled_from(NAMES), st.floats(-2, 2).filter(lambda x: abs(x) > 0.1))
expressions = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.tuples(st.sampled_from("+-*/"), inner, inner), st.tuples(st.just("^"), inner, st.integers(-2, 3))
    ),
    max_leaves=8,
)


def evaluated(expression, values):
    """The same expression with any kind of number."""
    if isinstance(expression, str):
        return values[expression]
    if isinstance(expression, float):
        return expression
    sign, left, right = expression
    a = evaluated(left, values)
    if sign == "^":
        return a**right if not isinstance(a, float) else a ** float(right)
    b = evaluated(right, values)
    return {"+": lambda: a + b, "-": lambda: a - b, "*": lambda: a * b, "/": lambda: a / b}[sign]()


def parts(expression, values):
    """Values of all divisors and of all partial results, to keep away from division by zero."""
    if not isinstance(expression, tuple):
        return [], [abs(evaluated(expression, values))]
    sign, left, right = expression
    divisors, sizes = parts(left, values)
    if sign == "^":
        return divisors + ([sizes[-1]] if right < 0 else []), [*sizes, abs(evaluated(expression, values))]
    more, others = parts(right, values)
    divisors += more + ([others[-1]] if sign == "/" else [])
    return divisors, [*sizes, *others, abs(evaluated(expression, values))]


def size_of(expression, values, nearest=0.05, largest=1e3):
    """The largest partial result at some values and at the nominal ones; far from a pole 1e-10 means round-off."""
    sizes = []
    for point in (values, {"p": 2.0, "q": 3.0, "r": -1.5}):
        try:
            divisors, partial = parts(expression, point)
        except (OverflowError, ZeroDivisionError):
            assume(False)
        assume(all(one > nearest for one in divisors) and max(partial) < largest)
        sizes.append(max(partial))
    return max(sizes)


@settings(max_examples=150, deadline=None)
@given(expressions, st.tuples(*(st.floats(0, 1) for _ in NAMES)))
def test_an_expression_has_the_value_of_plain_arithmetic(expression, where):
    values = {name: low + w * (high - low) for (name, (low, high)), w in zip(RANGES.items(), where, strict=True)}
    size = size_of(expression, values)
    plain = evaluated(expression, values)
    made = evaluated(expression, ELEMENTS)
    if isinstance(made, float):
        return
    own = made.substitute({name: values[name] for name in made.uncertain})
    assert np.squeeze(getattr(own, "nominal", own)) == pytest.approx(plain, rel=1e-10, abs=1e-10 * size)


@settings(max_examples=30, deadline=None)
@given(st.lists(expressions, min_size=4, max_size=4), st.integers(0, 10**6))
def test_a_system_with_uncertain_entries_is_the_system_with_their_values(entries, seed):
    rng = np.random.default_rng(seed)
    values = {name: rng.uniform(*RANGES[name]) for name in NAMES}
    size = max(size_of(one, values) for one in entries)
    table = [
        [evaluated(entries[0], ELEMENTS), evaluated(entries[1], ELEMENTS)],
        [evaluated(entries[2], ELEMENTS), evaluated(entries[3], ELEMENTS)],
    ]
    plain = np.array(
        [
            [evaluated(entries[0], values), evaluated(entries[1], values)],
            [evaluated(entries[2], values), evaluated(entries[3], values)],
        ]
    )
    B, C = np.array([[1.0], [0.5]]), np.array([[1.0, -1.0]])
    made = ss(table, B, C)
    if not isinstance(made, StateSpace):
        made = made.substitute({name: values[name] for name in made.uncertain})
    # The realisation keeps the states of the user.
    np.testing.assert_allclose(made.A, plain, rtol=1e-10, atol=1e-10 * size)


def mass_spring_damper():
    m, c, k = real("m", 3.0, percent=40), real("c", 1.0, percent=20), real("k", 2.0, percent=30)
    return ss([[0, 1], [-k / m, -c / m]], [[0], [1 / m]], [[1, 0]])


def test_mass_spring_damper_of_zhou_and_doyle():
    """Zhou, Doyle and Glover 1996, section 10.2 (figure 10.4): m, c, k each once; M as printed there, with the matrix
    of the system in the same normalisation m = 3 (1 + 0.4 d_m), c = 1 (1 + 0.2 d_c), k = 2 (1 + 0.3 d_k)."""
    P, blocks = mass_spring_damper().lft()
    assert {b.name: b.rows for b in blocks.blocks} == {"m": 1, "c": 1, "k": 1}
    m, c, k = 3.0, 1.0, 2.0
    printed = {  # rows: x1', x2', y_m, y_c, y_k; columns: x1, x2, u, u_m, u_c, u_k
        "x": np.array([[0, 1], [-k / m, -c / m]]),
        "loop_m": -0.4,
    }
    np.testing.assert_allclose(P.A, printed["x"])
    place = [b.name for b in blocks.blocks].index("m")
    assert P.D[place, place] == pytest.approx(printed["loop_m"])
    rng = np.random.default_rng(5)
    for d_m, d_c, d_k in rng.uniform(-1, 1, (10, 3)):
        delta = blocks.assemble([{"m": d_m, "c": d_c, "k": d_k}[b.name] for b in blocks.blocks]).real
        closed = P.A + P.B[:, :3] @ delta @ np.linalg.solve(np.eye(3) - P.D[:3, :3] @ delta, P.C[:3])
        mass, damping, stiff = m * (1 + 0.4 * d_m), c * (1 + 0.2 * d_c), k * (1 + 0.3 * d_k)
        np.testing.assert_allclose(closed, [[0, 1], [-stiff / mass, -damping / mass]], rtol=1e-12)


def test_worst_case_gain_of_the_mass_spring_damper_against_a_search_of_the_corners():
    """|G| of an oscillator peaks at 1/(2 zeta sqrt(1 - zeta^2)) / k: the worst corner is a closed form."""
    G = mass_spring_damper()
    found = worst_case_gain(*G.lft())
    peaks = []
    for m in (1.8, 4.2):
        for c in (0.8, 1.2):
            for k in (1.4, 2.6):
                zeta = c / (2 * np.sqrt(k * m))
                peaks.append(1 / (2 * zeta * np.sqrt(1 - zeta**2)) / k)
    assert found.lower <= max(peaks) * 1.001 and found.upper >= max(peaks) and found.upper < 1.01 * max(peaks)
    assert max(hinf_norm(one).gain for one in G.sample(100, seed=1)) <= found.upper


def test_robust_stability_of_a_scalar_loop_is_that_of_the_root():
    """x' = -(a - b) x with a in 3 +- 1, b in 1 +- 0.5: unstable from delta = 4/3 on, so mu = 3/4."""
    a, b = real("a", 3.0, plus_minus=1.0), real("b", 1.0, plus_minus=0.5)
    P, blocks = ss([[b - a]], [[1.0]], [[1.0]]).lft()
    found = mu_peak(P.select(slice(2), slice(2)), blocks)
    assert found.lower == pytest.approx(0.75, rel=1e-6) and found.upper == pytest.approx(0.75, rel=1e-3)


def test_copies_that_nothing_needs_are_removed():
    p, q = ELEMENTS["p"], ELEMENTS["q"]
    assert not (p - p).uncertain and not (p * q - q * p).uncertain and not (p / p - 1).uncertain
    assert (p + p + 3 * p).copies == (1,)
    assert matrix([[p, 2 * p], [3 * p, 6 * p]]).copies == (1,)  # rank one
    assert matrix([[p, 0], [0, p]]).copies == (2,)


def test_nominal_is_at_delta_zero_even_where_the_range_is_lopsided():
    q = real("q", 3.0, range=(2.9, 5.0))
    assert q.nominal == pytest.approx(3.0)
    for value in (2.9, 3.0, 3.7, 5.0):
        assert q.substitute(q=value) == pytest.approx(value, rel=1e-13)
    P, _ = ss([[-1 * q]], [[1.0]], [[1.0]]).lft()
    for delta, value in ((-1, 2.9), (0, 3.0), (1, 5.0)):
        pole = P.A + P.B[:, :1] * delta / (1 - P.D[0, 0] * delta) @ P.C[:1]
        assert pole[0, 0] == pytest.approx(-value)


@given(st.floats(-5, 5), st.floats(0.01, 10), st.floats(0.01, 10), st.floats(-1, 1))
def test_values_and_deltas_of_any_range_belong_together(nominal, down, up, delta):
    one = real("k", nominal, range=(nominal - down, nominal + up)).uncertain["k"]
    value = one.value(delta)
    assert one.low - 1e-9 <= value <= one.high + 1e-9
    assert one.delta(value) == pytest.approx(delta, abs=1e-6)
    if abs(one.skew) > 1e-3:
        assert one.value(-1 / one.skew) == one.value(-1.1 / one.skew) == np.inf
        assert np.isfinite(one.value(-0.999 / one.skew))


def test_badly_scaled_parameters_keep_their_values():
    k, m = real("k", 2.0e9, percent=10), real("m", 1e-7, percent=1)
    G = ss([[0, 1], [-k / m, 0]], [[0], [1 / m]], [[1, 0]])
    one = G.substitute(k=2.1e9, m=1.005e-7)
    np.testing.assert_allclose(one.A, [[0, 1], [-2.1e9 / 1.005e-7, 0]], rtol=1e-12)
    np.testing.assert_allclose(one.B, [[0], [1 / 1.005e-7]], rtol=1e-12)


def test_connections_against_python_control():
    """Series, parallel, feedback and inverse at a sample, against control's own arithmetic."""
    G = mass_spring_damper()
    K = tf([2.0, 1.0], [0.1, 1.0])
    W = control.tf([1.0], [1.0, 2.0])
    values = {"m": 2.5, "c": 1.1, "k": 1.8}
    g = control.ss([[0, 1], [-1.8 / 2.5, -1.1 / 2.5]], [[0], [1 / 2.5]], [[1, 0]], 0)
    k = K.to_control()
    omega = np.geomspace(0.05, 20, 30)
    for mine, theirs in (
        (G @ K, g * k),
        (G + W, g + W),
        (G - W, g - W),
        (W * G, W * g),
        (G.feedback(K), control.feedback(g, k)),
        (G.feedback(K, sign=1), control.feedback(g, k, 1)),
        (K @ G, k * g),
        (2 * G, 2 * g),
        (G / 2, g / 2),
        (1 / (1 + G), 1 / (1 + control.tf(g))),
        (K - G, k - g),
        (G**2, g * g),
    ):
        own = mine.substitute(values).frequency_response(omega)[:, 0, 0]
        np.testing.assert_allclose(own, np.squeeze(theirs(1j * omega)), rtol=1e-9)
    assert G.feedback(K).nstates == 3 and set(G.feedback(K).copies[1:]) == {1}


def test_connection_by_name_is_the_loop_in_closed_form():
    G = mass_spring_damper().renamed(["force"], ["x"])
    K = tf([4.0], [1.0]).renamed(["error"], ["force"])
    error = StateSpace(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), [[1.0, -1.0]], 0.0, ("r", "x"), ("error",))
    loop = connect({"plant": G, "controller": K, "sum": error}, ["r"], ["x", "force"])
    assert loop.inputs == ("r",) and loop.outputs == ("x", "force") and set(loop.copies[1:]) == {1}
    one = loop.substitute(m=2.0, c=0.9, k=2.2)
    assert one.dcgain()[0, 0] == pytest.approx(4 / (4 + 2.2))
    np.testing.assert_allclose(np.sort_complex(one.poles()), np.sort_complex(np.roots([2.0, 0.9, 2.2 + 4])), rtol=1e-9)
    plain = connect({"plant": G.nominal, "controller": K, "sum": error}, ["r"], ["x"])
    assert isinstance(plain, StateSpace)


def test_dynamics_enter_as_a_block_of_norm_one():
    """mu of W T with multiplicative uncertainty is the norm of W T."""
    W, L = tf([1.0, 0.2], [0.25, 1.0]), tf([4.0], [1.0, 2.0, 0.5])
    loop = (L * (1 + dynamics("chain", W))).feedback(1.0)
    P, blocks = loop.lft()
    assert [b.as_dict()["kind"] for b in blocks.blocks] == ["complex"] and blocks.n_w == 1
    T = control.feedback(control.tf([4.0], [1.0, 2.0, 0.5]), 1)
    WT = control.ss(control.tf([1.0, 0.2], [0.25, 1.0]) * T)
    norm = control.linfnorm(WT)[0] if hasattr(control, "linfnorm") else hinf_norm(StateSpace.from_control(WT)).gain
    found = mu_peak(P.select(slice(1), slice(1)), blocks)
    assert found.upper == pytest.approx(norm, rel=2e-3)
    Delta = tf([-0.9, 2.7], [1.0, 3.0])
    own = loop.substitute(chain=Delta).frequency_response(np.array([0.3, 1.0, 5.0]))[:, 0, 0]
    s = 1j * np.array([0.3, 1.0, 5.0])
    l = 4 / (s**2 + 2 * s + 0.5) * (1 + (s + 0.2) / (0.25 * s + 1) * (-0.9 * s + 2.7) / (s + 3))
    np.testing.assert_allclose(own, l / (1 + l), rtol=1e-10)


def test_dynamics_of_several_channels():
    Delta = dynamics("flex", 0.5, (2, 3))
    assert Delta.shape == (2, 3) and Delta.lft()[1].blocks[0].as_dict() == {
        "kind": "full",
        "rows": 2,
        "cols": 3,
        "name": "flex",
    }
    D = np.arange(6.0).reshape(2, 3) / 10
    np.testing.assert_allclose(Delta.substitute(flex=D), D / 2)
    for one in Delta.values(20, seed=3):
        assert hinf_norm(one["flex"]).gain <= 1 + 1e-9
    with pytest.raises(InputError, match="once only"):
        (Delta @ np.ones((3, 2)) @ Delta).lft()


def test_a_complex_disk_is_sampled_inside():
    z = complex_disk("z", 2.0, 0.5)
    system = z * tf([1.0], [1.0, 1.0])
    for value in system.values(20, seed=1):
        response = np.squeeze(value["z"].frequency_response(np.geomspace(0.01, 100, 50)))
        assert np.all(np.abs(response - 2.0) <= 0.5 + 1e-9)
    assert system.lft()[1].blocks[0].as_dict()["kind"] == "complex"


def test_samples_are_seeded_and_inside():
    G = mass_spring_damper()
    first, again = G.values(5, seed=2), G.values(5, seed=2)
    assert first == again and first != G.values(5, seed=3)
    assert all(1.8 <= one["m"] <= 4.2 and 0.8 <= one["c"] <= 1.2 for one in first)


def test_two_parameters_of_one_name_are_refused():
    with pytest.raises(InputError, match="two different uncertain elements"):
        _ = real("k", 1.0, percent=5) + real("k", 1.0, percent=6)
    assert (real("k", 1.0, percent=5) + real("k", 1.0, percent=5)).copies == (1,)


@pytest.mark.parametrize(
    "call, error, words",
    [
        (lambda: real("k", 1.0), InputError, "exactly one of"),
        (lambda: real("k", 1.0, percent=5, plus_minus=1), InputError, "exactly one of"),
        (lambda: real("k", 1.0, plus_minus=(-0.5, 0.5)), InputError, "not negative"),
        (lambda: real("k", 1.0, percent=np.int64(-10)), InputError, "not negative"),
        (lambda: real("k", 0.0, percent=5), InputError, "low < nominal < high"),
        (lambda: real("k", 1.0, range=(2, 3)), InputError, "low < nominal < high"),
        (lambda: real("k", 1.0, range=3), InputError, "expected numbers"),
        (lambda: real("", 1.0, percent=5), InputError, "expected a name"),
        (lambda: complex_disk("z", 0.0, -1.0), InputError, "positive radius"),
        (lambda: dynamics("d", tf([1.0], [1.0, -1.0])), InputError, "stable weight"),
        (lambda: dynamics("d", 1.0, 2), InputError, r"expected \(outputs, inputs\)"),
        (lambda: dynamics("d", np.eye(3), (2, 2)), InputError, "expected one output and input, or 2"),
        (lambda: ELEMENTS["p"] / real("z", 0.0, plus_minus=1.0), ComputationError, "cannot be inverted"),
        (lambda: ELEMENTS["p"] ** 0.5, InputError, "whole number"),
        (lambda: ELEMENTS["p"] + "x", InputError, "expected a StateSpace"),
        (lambda: ELEMENTS["p"].substitute(x=1.0), InputError, "expected some of p"),
        (lambda: ELEMENTS["p"].substitute(p="wide"), InputError, "expected a number"),
        (lambda: real("k", 1.0, range=(0.0, 4.0)).substitute(k=-2.0), InputError, "nearer to the range"),
        (lambda: ELEMENTS["p"] / 0, ComputationError, "cannot be inverted"),
        (lambda: matrix([[1.0, 2.0], [ELEMENTS["p"]]]), InputError, "rows of one length"),
        (lambda: ss([[ELEMENTS["p"]]], [[1.0], [1.0]], [[1.0]]), InputError, "shapes do not fit"),
        (lambda: ss([[ELEMENTS["p"]]], [[1.0]], [[1.0]], inputs=["a", "b"]), InputError, "expected 1 input names"),
        (lambda: ss([[ELEMENTS["p"]]], [], [[1.0]]), InputError, "shapes do not fit"),
        (lambda: uncertain_models.tf([1, 1, 1], [1, ELEMENTS["p"]]), InputError, "improper"),
        (lambda: uncertain_models.tf([1], [0, 0 * ELEMENTS["p"]]), InputError, "denominator is zero"),
        (lambda: uncertain_models.tf([[[ELEMENTS["p"]]]], [1, 1]), InputError, "expected one input and one output"),
        (lambda: matrix([[1, 2]]) @ matrix([[ELEMENTS["p"], 1]]), InputError, "product of shapes"),
        (lambda: (ELEMENTS["p"] - 3).inverse().substitute(p=3.0), ComputationError, "has no value here"),
    ],
)
def test_wrong_input_is_one_line(call, error, words):
    with pytest.raises(error, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_a_system_crosses_a_process_boundary():
    G = mass_spring_damper()
    again = pickle.loads(pickle.dumps(G))
    assert again.nstates == 2 and again.uncertain == G.uncertain
    assert (again + G).copies == (4, 2, 2, 2)
    np.testing.assert_array_equal(again.nominal.A, G.nominal.A)


def test_sampled_dynamics_are_all_pass_up_to_their_gain():
    for one in (dynamics("d") * tf([1.0], [1.0])).values(5, seed=2):
        assert hinf_norm(one["d"]).gain <= 1 + 1e-9
    sampled = StateSpace([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1) * dynamics("d")
    for one in sampled.values(10, seed=4):
        size = np.abs(one["d"].frequency_response(np.linspace(0.01, 31.0, 40))[:, 0, 0])
        assert one["d"].is_stable() and one["d"].dt == 0.1
        np.testing.assert_allclose(size, size[0], rtol=1e-9)
        assert size[0] <= 1


def test_short_and_rich_texts():
    G = mass_spring_damper()
    assert "\n" not in repr(G) and "m = 3 +-40 %, 1 copy" in repr(G) and "<table>" in G._repr_html_()


def named_plant():
    k = real("k", 2.0, percent=10)
    return ss(
        [[0, 1], [-k, -1]], [[0, 0], [1, 2]], np.eye(2), 0, inputs=["f", "g"], outputs=["x", "v"], states=["p", "q"]
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda G: 3 * G,
        lambda G: G / 2,
        lambda G: real("m", 1.0, percent=5) * G,
        lambda G: G * real("m", 1.0, percent=5),
        lambda G: np.eye(2) - G,
        lambda G: -G,
        lambda G: G + G.nominal,
        lambda G: G.feedback(),
        lambda G: G.renamed({"f": "a"}).renamed({"a": "f"}),
    ],
)
def test_numbers_and_feedback_change_no_names(change):
    made = change(named_plant())
    assert (made.inputs, made.outputs) == (("f", "g"), ("x", "v")) and made.states[:2] == ("p", "q")


def test_names_of_products_are_those_of_certain_systems():
    G, W = named_plant(), tf([1.0], [1.0, 1.0], ["e"], ["f"])
    made, certain = G[:, "f"] @ W, G.nominal[:, "f"] @ W
    assert (made.inputs, made.outputs, made.states) == (certain.inputs, certain.outputs, certain.states)
    assert (G[0, 0] ** 2).inputs == ("f",) and (1 - G[0, 0]).outputs == ("x",)
    assert connect([G], ["f", "g"], "v").states == ("p", "q") == G.substitute(k=2.1).states
    back = StateSpace.from_control(G.nominal.to_control())
    assert (back.inputs, back.outputs, back.states) == (G.inputs, G.outputs, G.states)


def test_an_attribute_of_certain_systems_is_refused_with_a_hint():
    with pytest.raises(AttributeError, match=r"use \.nominal\.poles"):
        _ = named_plant().poles


def test_a_system_of_python_control_is_converted():
    G = ss(control.tf([1.0], [1.0, 2.0]))
    assert isinstance(G, StateSpace) and G.dcgain() == pytest.approx(0.5)
    assert ss([[1.0, 2.0]]).nstates == 0 and ss(named_plant()).uncertain


@pytest.mark.parametrize("empty", [[], [[]], np.zeros((0, 0))], ids=["list", "row", "array"])
def test_a_static_gain_has_empty_matrices(empty):
    G = ss(empty, empty, empty, [[1.0, 2.0]], inputs=["a", "b"], outputs="c")
    np.testing.assert_array_equal(G.dcgain(), [[1.0, 2.0]])
    assert (G.nstates, G.inputs, G.outputs) == (0, ("a", "b"), ("c",))
    assert ss(empty, empty, empty, [[ELEMENTS["p"]]]).substitute(p=2.5) == [[2.5]]


@pytest.mark.parametrize(
    "num, den",
    [
        (lambda m, c, k: [1.0], lambda m, c, k: [m, c, k]),
        (lambda m, c, k: [c, k], lambda m, c, k: [m, c, k]),
        (lambda m, c, k: [m, 0, 0], lambda m, c, k: [m, c, k]),
        (lambda m, c, k: [0, k], lambda m, c, k: [1.0, m, c, 2.0, 1e4 * k]),
        (lambda m, c, k: k, lambda m, c, k: [1e-6, c, 1e6 * m]),
    ],
)
def test_a_transfer_function_with_uncertain_coefficients(num, den):
    elements = [real(name, 1.0, percent=50) for name in "mck"]
    values = {"m": 1.3, "c": 0.6, "k": 1.1}
    for dt in (0.0, 0.1):
        G = uncertain_models.tf(num(*elements), den(*elements), "f", "x", dt=dt)
        exact = control.tf(num(*values.values()), den(*values.values()), dt)
        member = G.substitute({name: values[name] for name in G.uncertain})
        assert member(0.3 + 0.7j)[0, 0] == pytest.approx(exact(0.3 + 0.7j), rel=1e-9)
        assert G.dt == dt and max(n for one, n in zip(G.elements, G.copies, strict=True) if one.name in values) <= 2
        assert (G.inputs, G.outputs) == (("f",), ("x",))


def test_sampled_systems_keep_their_clock():
    p = real("p", 0.5, percent=20)
    G = ss([[p]], [[1.0]], [[1.0]], dt=0.1)
    assert G.nominal.dt == 0.1 and (G @ G).substitute(p=0.55).dt == 0.1
    with pytest.raises(InputError, match="different sample times"):
        _ = G + tf([1.0], [1.0, 1.0])
    np.testing.assert_allclose(la.eigvals((G @ G).substitute(p=0.55).A), [0.55, 0.55], atol=1e-7)


def test_an_asymmetric_range_adds_no_copies():
    """Two masses on springs: each entry of a row is divided by the same mass, whatever the ranges."""

    def plant(k2):
        m1, m2 = real("m1", 2.0, percent=20), real("m2", 0.8, percent=30)
        k1, c = real("k1", 120.0, percent=15), real("c", 0.8, plus_minus=0.3)
        A = [
            [0, 0, 1, 0],
            [0, 0, 0, 1],
            [-(k1 + k2) / m1, k2 / m1, -2 * c / m1, c / m1],
            [k2 / m2, -k2 / m2, c / m2, -c / m2],
        ]
        return ss(A, [[0, 0], [0, 0], [1 / m1, 0], [0, 1 / m2]], [[1, 0, 0, 0], [0, 1, 0, 0]])

    skewed, even = plant(real("k2", 60.0, range=(45, 80))), plant(real("k2", 62.5, plus_minus=17.5))
    assert list(skewed.uncertain) == list(even.uncertain) and skewed.copies == even.copies
    assert sorted(skewed.copies[1:]) == [1, 1, 1, 1, 2]
    # The same set of plants: the same worst case, up to the gap between the bounds.
    gains = [robustness.worst_case_gain(one) for one in (skewed, even)]
    assert gains[0].upper == pytest.approx(gains[1].upper, rel=1e-2)
    corner = skewed.substitute(m1=2.4, m2=1.04, k1=102.0, k2=45.0, c=0.5)
    assert hinf_norm(corner).gain <= gains[0].upper < 1.1


def test_a_number_of_dynamics_with_several_channels_is_multiplied():
    number = matrix([[1.0, 1.0, 1.0]]) @ dynamics("D", 0.2, (3, 2)) @ matrix([[1.0], [1.0]])
    product = number * real("k", 2.0, range=(1.0, 4.0))
    D = np.arange(6.0).reshape(3, 2) / 20
    np.testing.assert_allclose(product.substitute(D=D, k=3.0), [[3.0 * 0.2 * D.sum()]])
