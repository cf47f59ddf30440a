"""The covariance of a fit as blocks of a plant: coverage, what needs no block, and what is stated of it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.lti.connect import lft_upper
from avis_ctrl.rigs.isolator_table import IsolatorTable
from avis_ctrl.rigs.logical_axes import actuator_axes
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.study.gap_design import PARAMETERS_PERCENT, without_ranges
from avis_ctrl.study.gap_plant import plant_of, wiring_of
from avis_ctrl.study.gap_uncertainty import SETTINGS, FitUncertainty, fit_uncertainty
from avis_ctrl.study.identification_design import default_design
from avis_ctrl.uncertainty.uncertain_rig import UncertainEquation, uncertain_rig

AVIS = load_rig("avis")
assert isinstance(AVIS, IsolatorTable)
RIG = AVIS.with_channels_apart()
DESIGN = without_ranges(default_design(RIG, "z and phi_x", PARAMETERS_PERCENT))
MECHANICS = (
    "mass",
    "J1",
    "com_y",
    "isolator1.k_z",
    "isolator2.k_z",
    "isolator3.k_z",
    "isolator4.k_z",
    "isolator1.c_z",
    "isolator2.p_y",
    "actuator.Az1",
    "actuator.Az2",
)
SENSORS = tuple(f"sensor.{name}" for name in RIG.sensor_rows()[0])
DRIVES = tuple(name for name in RIG.parameters() if name.startswith("actuator."))


def of(names, root: np.ndarray, design=DESIGN, **settings) -> FitUncertainty:
    """root (n_p, r) in the parameters' sizes, 0.1 for what is zero."""
    model = TableModel(ResponseModel.of(RIG, names))
    S = np.where(model.values == 0, 0.1, np.abs(model.values))[:, None] * root
    wiring = wiring_of(plant_of(DESIGN, model)[0], model)
    return fit_uncertainty(design, model, S @ S.T, wiring, replace(SETTINGS, **settings))


def matrices(rig) -> np.ndarray:
    """[M, C, K, -T] of z and phi_x, rotation at the edge."""
    eom, scale = rig.equations_of_motion(), np.diag([1.0, 1 / RIG.edge_m])
    squares = [scale @ X[2:4, 2:4] @ scale for X in (eom.M, eom.C, eom.K)]
    return np.hstack([*squares, -scale @ eom.T[2:4]])


def test_tables_drawn_from_the_covariance_lie_in_the_blocks(rng):
    """With a block for all that is felt, each drawn table, rebuilt from its parameters, is one of the set."""
    root = 1e-5 * rng.standard_normal((len(MECHANICS), len(MECHANICS)))  # products of changes are nothing
    found = of(MECHANICS, root, left_out=1e-7)
    size = np.array([RIG.parameters()[name].value or 0.1 for name in MECHANICS])
    nominal, inside = matrices(RIG), []
    A = actuator_axes(RIG, DESIGN.keep).allocation * [1.0, RIG.edge_m]

    def felt(N: np.ndarray) -> np.ndarray:
        """Of the drives only what the controller's allocation uses."""
        return np.hstack([N[..., :6], N[..., 6:] @ A])

    bases = [
        felt(np.array([one.change for one in found.blocks if one.coordinate == name])).T for name in ("z", "phi_x")
    ]
    scale = np.max(np.abs(np.hstack(bases)), axis=1)
    scale[scale == 0] = 1.0
    for _ in range(400):
        change = size * (root @ rng.standard_normal(len(MECHANICS)))
        moved = RIG.with_parameters(
            {name: RIG.parameters()[name].value + float(d) for name, d in zip(MECHANICS, change, strict=True)}
        )
        away = felt(matrices(moved) - nominal) / scale
        deltas = []
        for base, row in zip(bases, away, strict=True):
            # Multiples of the equations, added to one of them, leave the same equations.
            columns = np.column_stack([base / scale[:, None], (felt(nominal) / scale).T])
            delta = np.linalg.lstsq(columns, row)[0]
            assert np.linalg.norm(columns @ delta - row) < 1e-2 * np.linalg.norm(row)
            deltas.append(delta[:-2])
        inside.append(max(np.max(np.abs(one)) for one in deltas) <= 1)
    assert np.mean(inside) > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 400)


def test_a_mass_known_to_a_percent():
    """Closed form: one block, of the one entry of the equation of z, at the quantile of two numbers together."""
    found = of(("mass",), np.array([[0.03]]))
    assert [one.coordinate for one in found.blocks] == ["z"]
    k = 2.23648  # P(|x| < k)^2 = 0.95 for a normal x
    change = np.abs(found.blocks[0].change)
    assert change[0] == pytest.approx(k * 0.03 * RIG.mass, rel=1e-4) and np.all(change[1:] <= 1e-9 * change[0])
    eom, s = RIG.equations_of_motion(), 1j * SETTINGS.omega
    inertia = s**2 * RIG.mass
    largest = np.max(np.abs(k * 0.03 * inertia / (inertia + s * eom.C[2, 2] + eom.K[2, 2])))
    assert found.effect[0] == pytest.approx(largest, rel=1e-2)


def test_blocks_are_single_copies_and_move_one_row(rng):
    changes = [
        UncertainEquation(
            f"fit {k} of {name}",
            name,
            rng.standard_normal(6 + len(DRIVES)) * 1e-2 * np.max(np.abs(matrices(RIG)), axis=0),
        )
        for k, name in enumerate(("z", "phi_x", "z"))
    ]
    uncertain = uncertain_rig(RIG, changes)
    assert [block.rows for block in uncertain.blocks.blocks] == [1, 1, 1]
    deltas, omega = np.array([0.7, -1.0, -0.4]), 2 * np.pi * np.array([0.5, 3.0, 30.0])
    N = matrices(RIG)
    for one, delta in zip(changes, deltas, strict=True):
        N[("z", "phi_x").index(one.coordinate)] += delta * one.change
    system = lft_upper(uncertain.system, np.diag(deltas)).select(
        ["z_dot", "phi_x_edge_dot"], list(RIG.equations_of_motion().actuators)
    )
    for w, found in zip(omega, system.frequency_response(omega), strict=True):
        s = 1j * w
        B = s**2 * N[:, :2] + s * N[:, 2:4] + N[:, 4:6]
        assert np.allclose(found, -s * np.linalg.solve(B, N[:, 6:]), rtol=1e-9)


def test_the_product_of_drives_and_sensors_is_what_counts():
    """Motors that push harder by what the sensors read less are no uncertainty of the loop; either alone is."""
    names = (*DRIVES, *SENSORS)
    up = np.array([1.0] * len(DRIVES) + [0.0] * len(SENSORS))
    down = 1 - up
    together, drives, sensors = (of(names, 0.02 * one[:, None]) for one in (up - down, up, down))
    assert together.blocks == () and np.max(together.rest) < 1e-6 and np.max(together.elsewhere) < 1e-6
    assert np.max(drives.effect) == pytest.approx(np.max(sensors.effect), rel=1e-6) and len(drives.blocks) > 0


def test_what_sensors_read_is_made_up_for_by_all_drives_alike():
    """Also where motors side by side are tilted a little: no force constant moves by more than the sensors' own."""
    names = tuple(name for name in RIG.parameters() if name.startswith("direction.A"))
    model = TableModel(ResponseModel.of(RIG, (*SENSORS, *DRIVES, *names)))
    tilt = 1e-3 * np.random.default_rng(5).standard_normal(len(names))
    model = model.at(np.concatenate([model.values[: -len(names)], model.values[-len(names) :] + tilt]))
    size = np.concatenate([0.01 * model.values[: len(SENSORS)], np.zeros(len(model.names) - len(SENSORS))])
    wiring = wiring_of(plant_of(DESIGN, TableModel(ResponseModel.of(RIG, ())))[0], model)
    found = fit_uncertainty(DESIGN, model, np.diag(size**2), wiring, replace(SETTINGS, left_out=1e-3))
    own = -np.array([model.effective.rig.equations_of_motion().T[2]])
    for one in found.blocks:
        assert np.max(np.abs(one.change[6:])) < 0.1 * np.max(np.abs(own))


@pytest.mark.slow
def test_little_needs_no_block_and_what_is_left_is_within_its_share(rng):
    root = rng.standard_normal((len(MECHANICS), len(MECHANICS)))
    counts = []
    for size in (1e-6, 1e-4, 1e-3, 1e-2):
        found = of(MECHANICS, size * root)
        assert np.all(np.maximum(found.rest, found.rest_floor) <= SETTINGS.left_out * found.dynamics)
        counts.append(len(found.blocks))
    assert counts[0] == 0 and counts == sorted(counts) and counts[-1] > 2
    told = " ".join(of(MECHANICS, 1e-6 * root).sentences())
    assert "too little for a block" in told and "at most" in told
    assert json.loads(json.dumps(found.to_json()))["parameters"] == len(MECHANICS)


def test_ranges_of_the_design_stand_for_their_parameters():
    ranged = default_design(RIG, "z and phi_x", PARAMETERS_PERCENT)
    assert len(of(("mass",), np.array([[0.03]])).blocks) == 1
    assert of(("mass", "com_y"), np.diag([0.03, 0.0]), ranged).blocks == ()


def test_what_the_plant_does_not_hold_is_stated():
    """A geophone's damping ratio is in no equation. Of all alike, 2 zeta w s/(s^2 + 2 zeta w s + w^2) of its relative
    change is seen: as much as that at the corner, and nothing far from it; a gain of the drives takes a part."""
    names = tuple(one.replace("sensor", "damping") for one in SENSORS)
    found = of(names, 0.02 * np.ones((len(names), 1)))
    assert found.products == 0 and len(found.blocks) <= 2
    assert 0.5 * 1.96 * 0.02 < np.max(found.elsewhere) < 1.96 * 0.02
