"""The uncertain rig against the rig rebuilt with perturbed parameters, solved as Newton's law at each frequency."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.lti import lft_upper
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.uncertainty.uncertain_rig import UncertainParameter, UncertainRig, edge_name, uncertain_rig

OMEGA = 2 * np.pi * np.geomspace(0.05, 300.0, 25)

AVIS = [
    UncertainParameter("mass", 0.10),
    *(UncertainParameter(f"isolator{k}.k_z", 0.15) for k in (1, 2, 3, 4)),
    *(UncertainParameter(f"isolator{k}.c_z", 0.30) for k in (1, 2, 3, 4)),
    UncertainParameter("J1", 0.10),
    UncertainParameter("actuator.Az1", 0.05),
]
HALCYONICS = [
    UncertainParameter("k_s1", 0.15),
    UncertainParameter("k_s3", 0.15),
    UncertainParameter("d3", 0.30),
    UncertainParameter("d4", 0.30),
    UncertainParameter("Ixx", 0.05),
    UncertainParameter("mass", 0.02),
]
LOADED = [
    *HALCYONICS,
    UncertainParameter("load.mass", 0.10),
    UncertainParameter("load.L8", 0.01, absolute=True),
    UncertainParameter("load.Ixx", 0.10),
]
CASES = {
    "avis, z and phi_x": ("avis", AVIS, ("z", "phi_x")),
    "avis, phi_x alone": ("avis", AVIS, ("phi_x",)),
    "avis, six coordinates": ("avis", AVIS, COORDINATES),
    "halcyonics": ("halcyonics", HALCYONICS, ("z", "phi_x")),
    "loaded halcyonics": ("halcyonics_loaded", LOADED, ("z", "phi_x")),
    "loaded halcyonics, three coordinates": ("halcyonics_loaded", LOADED, ("y", "z", "phi_x")),
    "loaded halcyonics, six coordinates": ("halcyonics_loaded", LOADED, COORDINATES),
}


@cache
def built(case: str) -> UncertainRig:
    name, parameters, keep = CASES[case]
    return uncertain_rig(load_rig(name), parameters, keep)


def newton(rig, keep, omega) -> np.ndarray:
    """(n_omega, 3 n, m + 2 n): actuators, floor velocity, force -> relative displacement, velocity, acceleration.

    M q'' + C (q' - q_f') + K (q - q_f) = T u + f, solved for q at each frequency, rotations at the edge.
    """
    equations = rig.equations_of_motion()
    kept = [equations.coordinates.index(name) for name in keep]
    S = np.diag([1 / rig.edge_m if name.startswith("phi") else 1.0 for name in keep])
    M, C, K = (S @ X[np.ix_(kept, kept)] @ S for X in (equations.M, equations.C, equations.K))
    T, n = S @ equations.T[kept], len(keep)
    rows = []
    for s in 1j * omega:
        # Without products of s^2: the floor's velocity moves the floor by v_f / s.
        W = np.linalg.inv(s * s * M + s * C + K)
        q = np.hstack([W @ T, W @ (C + K / s), W])
        floor = np.hstack([np.zeros_like(T), np.eye(n) / s, np.zeros((n, n))])
        rows.append(np.vstack([q - floor, s * q, s * s * q]))
    return np.array(rows)


def signals(uncertain: UncertainRig, rig) -> tuple[list[str], list[str]]:
    axes = uncertain.coordinates
    return (
        [*(f"{a}_rel" for a in axes), *(f"{a}_dot" for a in axes), *(f"{a}_ddot" for a in axes)],
        [*rig.equations_of_motion().actuators, *(f"floor_{a}_dot" for a in axes), *(f"force_{a}" for a in axes)],
    )


def mismatch(uncertain: UncertainRig, case: str, delta: list[float]) -> float:
    """Largest error relative to the largest response of the same kind (output kind by input kind) at a frequency."""
    name, _, keep = CASES[case]
    rig, n = load_rig(name), len(keep)
    outputs, inputs = signals(uncertain, rig)
    Delta = uncertain.blocks.assemble(delta).real
    plant = lft_upper(uncertain.system, Delta).select(outputs, inputs)
    # Point by point: the Schur form of frequency_response loses digits of an acceleration far below resonance.
    sampled = np.array([plant(1j * omega) for omega in OMEGA])
    rebuilt = newton(rig.with_parameters(uncertain.values(delta)), keep, OMEGA)
    m = len(inputs) - 2 * n
    worst = 0.0
    for rows in (slice(0, n), slice(n, 2 * n), slice(2 * n, 3 * n)):
        for cols in (slice(0, m), slice(m, m + n), slice(m + n, None)):
            error, size = np.abs(sampled - rebuilt)[:, rows, cols], np.abs(rebuilt)[:, rows, cols]
            worst = max(worst, float(np.max(error.max(axis=(1, 2)) / size.max(axis=(1, 2)))))
    return worst


@pytest.mark.parametrize("case", CASES)
@settings(max_examples=12, deadline=None)
@given(data=st.data())
def test_sampling_the_lft_equals_rebuilding_the_rig(case, data):
    uncertain = built(case)
    n = len(uncertain.parameters)
    delta = data.draw(st.lists(st.floats(-1, 1), min_size=n, max_size=n))
    assert mismatch(uncertain, case, delta) < 1e-10


@pytest.mark.parametrize("case", CASES)
def test_it_is_exact_beyond_the_range_and_at_its_corners(case, rng):
    uncertain = built(case)
    n = len(uncertain.parameters)
    for delta in (np.ones(n), -np.ones(n), rng.choice([-1.0, 1.0], n), rng.uniform(-3, 3, n)):
        assert mismatch(uncertain, case, list(delta)) < 1e-10


@pytest.mark.parametrize("case", CASES)
def test_the_comparison_notices_a_percent(case):
    """A delta on the model that the rebuilt rig does not have is seen in each parameter."""
    uncertain = built(case)
    rig, keep = load_rig(CASES[case][0]), CASES[case][2]
    outputs, inputs = signals(uncertain, rig)
    nominal = newton(rig, keep, OMEGA)
    for k in range(len(uncertain.parameters)):
        delta = [0.0] * len(uncertain.parameters)
        delta[k] = 0.3
        sampled = lft_upper(uncertain.system, uncertain.blocks.assemble(delta).real)
        change = sampled.select(outputs, inputs).frequency_response(OMEGA) - nominal
        assert np.max(np.abs(change) / np.abs(nominal).max(axis=(1, 2), keepdims=True)) > 1e-6


def copies(uncertain: UncertainRig) -> dict[str, int]:
    return {block.name: block.rows for block in uncertain.blocks.blocks}


def test_a_stiffness_a_damping_and_a_mass_need_one_copy_each():
    """k_z of one isolator is rank one in (z, phi_x); the mass of a centred body moves z alone."""
    found = copies(built("avis, z and phi_x"))
    assert set(found) == {p.name for p in AVIS}
    assert set(found.values()) == {1}


def test_load_mass_and_position_need_two_copies_each():
    """M gains m [1, L8; L8, L8^2]: products up to m L8^2, of rank one for the mass about each position."""
    found = copies(built("loaded halcyonics"))
    assert (found["load.mass"], found["load.L8"]) == (2, 2)
    assert all(n == 1 for name, n in found.items() if name not in ("load.mass", "load.L8"))


def test_mass_of_a_centred_body_moves_each_translation():
    assert copies(built("avis, six coordinates"))["mass"] == 3


def test_a_parameter_of_locked_coordinates_has_no_copy():
    uncertain = uncertain_rig(load_rig("avis"), [UncertainParameter("mass", 0.1), UncertainParameter("J2", 0.1)])
    assert copies(uncertain) == {"mass": 1}
    assert [p.name for p in uncertain.parameters] == ["mass"]


def test_a_resting_payload_follows_the_floor_at_low_frequency():
    """Rigid-body limit: at omega -> 0 transmissibility is one."""
    system = built("loaded halcyonics").system
    T = system.select(["z_dot", "phi_x_edge_dot"], ["floor_z_dot", "floor_phi_x_edge_dot"])(1e-3j)
    np.testing.assert_allclose(T, np.eye(2), atol=1e-5)


def test_perturbations_in_words():
    relative = UncertainParameter("isolator2.k_z", 0.15)
    assert relative.words(1.0, {"isolator2.k_z": 2e5}, {"isolator2.k_z": "N/m"}) == "isolator2.k_z at +15 %"
    assert relative.words(-0.5, {"isolator2.k_z": 2e5}, {"isolator2.k_z": "N/m"}) == "isolator2.k_z at -7.5 %"
    absolute = UncertainParameter("load.L8", 0.01, absolute=True)
    assert absolute.words(-1.0, {"load.L8": 0.05}, {"load.L8": "m"}) == "load.L8 at 0.04 m"


def test_words_and_values_of_a_rig_agree():
    uncertain = built("loaded halcyonics")
    rig = load_rig("halcyonics_loaded")
    n = len(uncertain.parameters)
    values = uncertain.values([1.0] * n)
    words = [p.words(1.0, uncertain.nominal, uncertain.units) for p in uncertain.parameters]
    known = rig.parameters()
    for parameter, line in zip(uncertain.parameters, words, strict=True):
        nominal = known[parameter.name].value
        expected = nominal + parameter.spread if parameter.absolute else nominal + abs(nominal) * parameter.spread
        assert values[parameter.name] == pytest.approx(expected, rel=1e-14)
        assert line.startswith(parameter.name)
    assert words[[p.name for p in uncertain.parameters].index("load.L8")].endswith(" m")


def test_edges_are_named():
    assert [edge_name(name) for name in ("z", "phi_x")] == ["z", "phi_x_edge"]


@pytest.mark.parametrize(
    ("parameters", "keep", "words"),
    [([UncertainParameter("com_y", 0.1)], ("z",), "absolute"), ([UncertainParameter("mass", 0.1)], ("z", "w"), "'w'")],
)
def test_what_is_refused(parameters, keep, words):
    with pytest.raises(InputError, match=words):
        uncertain_rig(load_rig("avis"), parameters, keep)


def test_an_absolute_spread_may_exceed_one():
    assert UncertainParameter("isolator1.k_z", 5e4, absolute=True).half_range(2e5) == 5e4


def test_chassis_points_elsewhere_are_refused():
    """With the chassis point away from the payload point the floor does not act through q - q_floor."""
    from dataclasses import replace

    rig = load_rig("avis")
    moved = replace(rig.isolators[0], chassis_offset=(0.0, 0.0, -0.1))
    with pytest.raises(InputError, match="chassis"):
        uncertain_rig(replace(rig, isolators=(moved, *rig.isolators[1:])), AVIS)
