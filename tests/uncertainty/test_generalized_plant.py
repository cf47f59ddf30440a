"""The generalized plant by signal name: wiring errors, restriction, closure, JSON."""

from __future__ import annotations

import numpy as np
import pytest
from plant_json import blocks_of

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, gain, lft_lower, lft_upper, summing_junction, tf
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexFull, RealScalar
from avis_ctrl.uncertainty.generalized_plant import Diagram, GeneralizedPlant

OMEGA = np.geomspace(0.01, 100.0, 30)


def mass_on_a_spring() -> Diagram:
    """1/(s^2 + 0.2 s + 1 + 0.3 delta) pushed by u and d, seen with noise, weighted by a low-pass."""
    diagram = Diagram()
    diagram.add("body", tf([1.0], [1.0, 0.2, 1.0], ["force"], ["position"]), "rig")
    diagram.add("spring error", gain([[0.3]], ["position"], ["z:k"]), "uncertainty")
    diagram.add("sum of forces", summing_junction("force", ["u", "d", "-w:k"]))
    diagram.uncertain(RealScalar(1, "k"), ["w:k"], ["z:k"])
    diagram.add("W", tf([1.0], [1.0, 1.0], ["position"], ["e"]), "weight")
    diagram.add("W_u", tf([1.0, 1.0], [0.01, 1.0], ["u"], ["effort"]), "weight")
    diagram.add("sensor", summing_junction("y", ["position", "n"]), "sensor")
    diagram.means("position", "displacement of the mass", "m")
    return diagram


def plant(diagram: Diagram | None = None) -> GeneralizedPlant:
    return (diagram or mass_on_a_spring()).plant(w=["d", "n"], z=["e", "effort", "position"], u=["u"], y=["y"])


def test_order_of_signals_and_roles():
    made = plant()
    assert made.P.inputs == ("w:k", "d", "n", "u")
    assert made.P.outputs == ("z:k", "e", "effort", "position", "y")
    assert (made.nmeas, made.ncon) == (1, 1)
    assert made.all_blocks == BlockStructure.of([RealScalar(1, "k"), ComplexFull(2, 3, "performance")])


def test_connection_table_names_source_readers_and_meaning():
    table = {signal.name: signal for signal in plant().signals}
    position = table["position"]
    assert (position.source, position.role, position.unit) == ("body", "z", "m")
    assert set(position.readers) == {"spring error", "W", "sensor"}
    assert table["d"].source == "external input"
    assert table["force"].role == "internal"
    assert {name: table[name].role for name in ("w:k", "z:k", "u", "y", "e")} == {
        "w:k": "w_delta",
        "z:k": "z_delta",
        "u": "u",
        "y": "y",
        "e": "z",
    }


def test_response_is_the_algebra_on_paper():
    s = 1j * OMEGA
    body = 1 / (s**2 + 0.2 * s + 1)
    response = plant().P.frequency_response(OMEGA)
    np.testing.assert_allclose(response[:, 3, 1], body, rtol=1e-10)
    np.testing.assert_allclose(response[:, 0, 0], -0.3 * body, rtol=1e-10)
    np.testing.assert_allclose(response[:, 1, 3], body / (s + 1), rtol=1e-10)
    np.testing.assert_allclose(response[:, 2, 3], (s + 1) / (0.01 * s + 1), rtol=1e-10)
    np.testing.assert_allclose(response[:, 4, 2], 1.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("spoil", "signals", "words"),
    [
        (
            lambda d: d.add("odd", gain([[1.0]], ["nowhere"], ["e2"])),
            ["e", "effort", "position", "e2"],
            ["nowhere", "odd"],
        ),
        (lambda d: d.add("second", gain([[1.0]], ["u"], ["e"])), ["e", "effort", "position"], ["e", "W", "second"]),
        (
            lambda d: d.add("driver", gain([[1.0]], ["u"], ["d"])),
            ["e", "effort", "position"],
            ["d", "external input", "driver"],
        ),
        (lambda d: d.add("deaf", gain([[1.0]], ["u"], ["lost"])), ["e", "effort", "position"], ["lost", "deaf"]),
        (lambda d: None, ["e", "effort", "position", "absent"], ["absent"]),
    ],
    ids=[
        "read but not driven",
        "driven by two parts",
        "driven by a part and from outside",
        "made but not read",
        "asked for but absent",
    ],
)
def test_wrong_connections_name_signal_and_parts(spoil, signals, words):
    diagram = mass_on_a_spring()
    spoil(diagram)
    with pytest.raises(InputError) as refused:
        diagram.plant(w=["d", "n"], z=signals, u=["u"], y=["y"])
    for word in words:
        assert word in str(refused.value)


def test_an_external_input_that_nobody_reads_is_an_error():
    with pytest.raises(InputError, match="idle"):
        mass_on_a_spring().plant(w=["d", "n", "idle"], z=["e", "effort", "position"], u=["u"], y=["y"])


def test_an_output_twice_is_an_error():
    with pytest.raises(InputError, match="e"):
        mass_on_a_spring().plant(w=["d", "n"], z=["e", "e", "effort", "position"], u=["u"], y=["y"])


def test_two_parts_of_one_name_are_refused():
    diagram = mass_on_a_spring()
    with pytest.raises(InputError, match="W_u"):
        diagram.add("W_u", gain([[1.0]], ["u"], ["other"]))


def test_a_block_of_another_size_is_refused():
    with pytest.raises(InputError, match="2 x 2"):
        Diagram().uncertain(RealScalar(2, "k"), ["w:k"], ["z:k"])


def test_restricted_is_the_selected_response_with_fewer_parts():
    made = plant()
    small = made.restricted(["d"], ["e"])
    assert [part.name for part in small.parts] == ["body", "spring error", "sum of forces", "W", "sensor"]
    assert small.P.nstates == made.P.nstates - 1  # W_u is gone
    assert (small.w, small.z, small.nmeas, small.ncon) == (("d",), ("e",), 1, 1)
    selected = made.P.select(list(small.P.outputs), list(small.P.inputs))
    np.testing.assert_allclose(small.P.frequency_response(OMEGA), selected.frequency_response(OMEGA), rtol=1e-10)
    assert {signal.name for signal in small.signals}.isdisjoint({"n", "effort"})


def test_restricted_refuses_what_is_no_performance_signal():
    with pytest.raises(InputError, match="force"):
        plant().restricted(["d"], ["force"])


def test_nominal_is_delta_zero():
    made = plant()
    nominal = made.nominal()
    assert nominal.blocks.blocks == ()
    assert nominal.P.inputs == ("d", "n", "u")
    at_rest = lft_upper(made.P, np.zeros((1, 1)))
    np.testing.assert_allclose(nominal.P.frequency_response(OMEGA), at_rest.frequency_response(OMEGA), rtol=1e-12)


def test_a_sample_is_the_stiffer_spring():
    made = plant()
    s = 1j * OMEGA
    sampled = lft_upper(made.P, np.array([[0.7]])).select("position", "d").frequency_response(OMEGA)
    np.testing.assert_allclose(sampled[:, 0, 0], 1 / (s**2 + 0.2 * s + 1 + 0.3 * 0.7), rtol=1e-9)


def test_closed_without_a_controller_leaves_the_actuators_at_rest():
    made = plant()
    resting, zero = made.closed(None), made.closed(gain([[0.0]]))
    assert resting.inputs == zero.inputs == ("w:k", "d", "n")
    np.testing.assert_allclose(resting.frequency_response(OMEGA), zero.frequency_response(OMEGA), rtol=1e-12)


def test_closed_is_positive_feedback():
    """u = -2 y adds 2 to the stiffness."""
    made = plant()
    K = gain([[-2.0]])
    s = 1j * OMEGA
    closed = made.closed(K).select("position", "d").frequency_response(OMEGA)[:, 0, 0]
    np.testing.assert_allclose(closed, 1 / (s**2 + 0.2 * s + 3), rtol=1e-9)
    np.testing.assert_array_equal(made.closed(K).A, lft_lower(made.P, K).A)


def test_json_holds_the_whole_plant():
    made = plant()
    stored = made.as_dict()
    assert (stored["format"], stored["version"], stored["dt"]) == ("avis-plant", 1, 0.0)
    assert (stored["nmeas"], stored["ncon"]) == (1, 1)
    assert stored["performance"] == {"rows": 2, "cols": 3}
    again = StateSpace(
        stored["A"], stored["B"], stored["C"], stored["D"], stored["dt"], stored["inputs"], stored["outputs"]
    )
    np.testing.assert_array_equal(again.frequency_response(OMEGA), made.P.frequency_response(OMEGA))
    assert blocks_of(stored["blocks"]) == made.blocks
