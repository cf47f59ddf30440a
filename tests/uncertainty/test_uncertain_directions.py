"""One delta that moves several parameters: the LFT against the rig rebuilt, and its words."""

from __future__ import annotations

import numpy as np
import pytest

from avis_ctrl.lti import lft_upper
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.uncertainty.uncertain_rig import UncertainDirection, UncertainParameter, UncertainRig, uncertain_rig

OMEGA = 2 * np.pi * np.geomspace(0.05, 300.0, 25)
NAMES = {
    "avis": [
        "mass",
        "J1",
        "J2",
        *(f"isolator{i}.{kind}_{axis}" for i in (1, 2, 3, 4) for kind in "kc" for axis in "yz"),
    ],
    "halcyonics_loaded": ["load.mass", "load.L8", "load.Ixx", "k_s1", "k_s3", "d3", "d4"],
}


def directions(name: str, count: int, size: float, seed: int = 0) -> list[UncertainDirection]:
    """Random directions of the rig's parameters, changes of about `size` relative."""
    rng, known = np.random.default_rng(seed), load_rig(name).parameters()
    return [
        UncertainDirection(
            f"direction {k}",
            tuple((one, size * (abs(known[one].value) or 0.1) * rng.uniform(-1, 1)) for one in NAMES[name]),
        )
        for k in range(1, count + 1)
    ]


def response(rig, keep) -> np.ndarray:
    """(n, 2 k, m + 2 k): actuators, floor velocity, force -> relative displacement and velocity, by Newton's law."""
    eom = rig.equations_of_motion()
    kept = [eom.coordinates.index(name) for name in keep]
    S = np.diag([1 / rig.edge_m if name.startswith("phi") else 1.0 for name in keep])
    M, C, K = (S @ X[np.ix_(kept, kept)] @ S for X in (eom.M, eom.C, eom.K))
    T, n, found = S @ eom.T[kept], len(keep), []
    for s in 1j * OMEGA:
        W = np.linalg.inv(s * s * M + s * C + K)
        q = np.hstack([W @ T, W @ (C + K / s), W])
        floor = np.hstack([np.zeros_like(T), np.eye(n) / s, np.zeros((n, n))])
        found.append(np.vstack([q - floor, s * q]))
    return np.array(found)


def mismatch(uncertain: UncertainRig, name: str, keep, deltas) -> float:
    """Largest error relative to the largest response of its kind at a frequency."""
    rig, n = load_rig(name), len(keep)
    axes, actuators = uncertain.coordinates, rig.equations_of_motion().actuators
    plant = lft_upper(uncertain.system, uncertain.blocks.assemble(list(deltas)).real).select(
        [*(f"{a}_rel" for a in axes), *(f"{a}_dot" for a in axes)],
        [*actuators, *(f"floor_{a}_dot" for a in axes), *(f"force_{a}" for a in axes)],
    )
    sampled = np.array([plant(1j * omega) for omega in OMEGA])
    rebuilt = response(rig.with_parameters(uncertain.values(deltas)), keep)
    m, worst = len(actuators), 0.0
    for rows in (slice(0, n), slice(n, 2 * n)):
        for cols in (slice(0, m), slice(m, m + n), slice(m + n, None)):
            error, size = np.abs(sampled - rebuilt)[:, rows, cols], np.abs(rebuilt)[:, rows, cols]
            worst = max(worst, float(np.max(error.max(axis=(1, 2)) / size.max(axis=(1, 2)))))
    return worst


@pytest.mark.parametrize(
    ("name", "keep", "count", "size"),
    [
        ("avis", ("z", "phi_x"), 3, 0.1),
        ("avis", ("z", "phi_x"), 6, 1e-5),
        ("avis", COORDINATES, 2, 1e-3),
        ("halcyonics_loaded", ("z", "phi_x"), 2, 0.02),
        ("halcyonics_loaded", ("z", "phi_x"), 3, 1e-4),
    ],
)
def test_sampling_the_lft_equals_rebuilding_the_rig(name, keep, count, size, rng):
    given = [*directions(name, count, size), UncertainParameter(NAMES[name][0], 0.05)]
    uncertain = uncertain_rig(load_rig(name), given, keep)
    assert [p.name for p in uncertain.parameters] == [p.name for p in given]
    for deltas in (np.zeros(count + 1), np.ones(count + 1), -np.ones(count + 1), *rng.uniform(-1, 1, (4, count + 1))):
        assert mismatch(uncertain, name, keep, deltas) < 1e-10


def test_the_comparison_notices_what_one_direction_changes(rng):
    """Its smallest change that it could miss is far below what the directions do."""
    given = directions("avis", 2, 1e-5)
    uncertain = uncertain_rig(load_rig("avis"), given)
    swapped = UncertainRig(
        uncertain.system,
        uncertain.blocks,
        uncertain.parameters[::-1],
        uncertain.nominal,
        uncertain.units,
        uncertain.coordinates,
    )
    assert mismatch(uncertain, "avis", ("z", "phi_x"), [1.0, -1.0]) < 1e-10
    assert mismatch(swapped, "avis", ("z", "phi_x"), [1.0, -1.0]) > 1e-6


def test_tiny_changes_need_no_more_copies_than_large_ones():
    """Two coordinates: whatever a direction changes has rank 2 at most, where no product of changes enters."""
    for size in (0.1, 1e-3, 1e-6):
        blocks = uncertain_rig(load_rig("avis"), directions("avis", 4, size)).blocks.blocks
        assert [block.rows for block in blocks] == [2] * 4


def test_what_several_deltas_move_adds_up():
    known = load_rig("avis").parameters()
    uncertain = uncertain_rig(
        load_rig("avis"),
        [
            UncertainDirection("one", (("mass", 2.0), ("isolator1.k_z", -30.0))),
            UncertainDirection("two", (("mass", -0.5),)),
            UncertainParameter("mass", 0.1),
        ],
    )
    values = uncertain.values([0.5, 1.0, -0.2])
    assert values["mass"] == pytest.approx(known["mass"].value * (1 - 0.02) + 1.0 - 0.5, rel=1e-14)
    assert values["isolator1.k_z"] == pytest.approx(known["isolator1.k_z"].value - 15.0, rel=1e-14)
    assert set(values) == {"mass", "isolator1.k_z"}


def test_words():
    changes = (("mass", 1.0), ("isolator1.k_z", 2000.0), ("com_y", 1e-4))
    direction = UncertainDirection("identified direction 1", changes)
    told = direction.words(
        0.8, {"mass": 500.0, "isolator1.k_z": 2e5, "com_y": 0.0}, {"mass": "kg", "isolator1.k_z": "N/m", "com_y": "m"}
    )
    assert told == "identified direction 1 at +0.8: com_y +8e-05 m, isolator1.k_z +0.8 %, mass +0.16 %"
    many = UncertainDirection("d", tuple((f"p{k}", 1.0 + k) for k in range(7)))
    told = many.words(-1.0, {f"p{k}": 100.0 for k in range(7)}, {})
    assert told == "d at -1: p6 -7 %, p5 -6 %, p4 -5 %, p3 -4 %, and 3 parameters by less"
