"""A study's files follow the contract, and their figures are reproduced from the files alone."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
from plant_json import blocks_of

from avis_ctrl.lti import StateSpace, lft_upper
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.robust.mu import mu
from avis_ctrl.robust.musyn_state import HINF, Iteration
from avis_ctrl.robust.slycot_adapter import hinf_norm_slicot, mu_upper_slicot
from avis_ctrl.study import runner
from avis_ctrl.study.analysis import analyse
from avis_ctrl.study.controllers import passive
from avis_ctrl.study.design_file import Design, design_from_table, read_study
from avis_ctrl.study.design_result import Candidate, DesignResult
from avis_ctrl.study.output import write_study
from avis_ctrl.study.plant import DesignPlant, build_plant
from avis_ctrl.study.random_plants import random_perturbations
from avis_ctrl.study.runner import design_provenance, run_design
from avis_ctrl.study.simulation import bare_loop, with_delta
from avis_ctrl.study.skyhooks import classical_skyhook
from avis_ctrl.uncertainty.blocks import BlockStructure, ComplexScalar, RealScalar

DESIGNS = Path(__file__).resolve().parents[2] / "designs"
FLOOR_HZ = np.geomspace(0.1, 100.0, 40)

PLANT_KEYS = {
    "format",
    "version",
    "A",
    "B",
    "C",
    "D",
    "dt",
    "inputs",
    "outputs",
    "nmeas",
    "ncon",
    "blocks",
    "performance",
}
CONTROLLER_KEYS = {
    "format",
    "version",
    "name",
    "A",
    "B",
    "C",
    "D",
    "dt",
    "inputs",
    "outputs",
    "input_units",
    "output_units",
}
RESULT_KEYS = {"format", "version", "plant", "controllers", "dk_history", "requirements", "simulation", "seconds"}
ROW_KEYS = {
    "name",
    "kind",
    "file",
    "order",
    "gamma",
    "mu_upper",
    "mu_lower",
    "guaranteed",
    "mu_peak_Hz",
    "stable",
    "peak_transmissibility_dB",
    "worst_case_peak_transmissibility_dB",
    "note",
    "at_rest",
}


def read(path: Path) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{path.name} holds {constant}, which JSON does not have")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def system(stored: dict[str, Any]) -> Any:
    """python-control's state space of a stored system."""
    n = np.size(stored["A"], 0)
    return control.ss(
        np.reshape(stored["A"], (n, n)),
        np.reshape(stored["B"], (n, len(stored["inputs"]))),
        np.reshape(stored["C"], (len(stored["outputs"]), n)),
        stored["D"],
    )


def check_plant(plant: dict[str, Any]) -> None:
    assert set(plant) == PLANT_KEYS
    assert (plant["format"], plant["version"], plant["dt"]) == ("avis-plant", 1, 0.0)
    D = np.array(plant["D"])
    assert D.shape == (len(plant["outputs"]), len(plant["inputs"]))
    rows, cols = (sum(block[key] for block in plant["blocks"]) for key in ("rows", "cols"))
    for block in plant["blocks"]:
        assert set(block) == {"kind", "rows", "cols", "name"}
        assert block["kind"] == "full" or block["rows"] == block["cols"]
    assert D.shape == (
        cols + plant["performance"]["cols"] + plant["nmeas"],
        rows + plant["performance"]["rows"] + plant["ncon"],
    )
    # Order (w_delta, w, u) and (z_delta, z, y); u and y last.
    assert all(name.startswith("w:") for name in plant["inputs"][:rows])
    assert all(name.startswith("z:") for name in plant["outputs"][:cols])
    assert all(name.startswith("command_") for name in plant["inputs"][-plant["ncon"] :])
    assert all(name.startswith("seen_") for name in plant["outputs"][-plant["nmeas"] :])
    names = [name[2:].partition("[")[0] for name in plant["inputs"][:rows]]
    # Signal names are the blocks' without the dots that python-control forbids.
    assert names == [block["name"].replace(".", "_") for block in plant["blocks"] for _ in range(block["rows"])]


def check_controller(stored: dict[str, Any], plant: dict[str, Any], row: dict[str, Any]) -> None:
    assert set(stored) == CONTROLLER_KEYS
    assert (stored["format"], stored["version"], stored["name"]) == ("avis-controller", 1, row["name"])
    assert stored["dt"] == 0.0
    assert stored["inputs"] == plant["outputs"][-plant["nmeas"] :]
    assert stored["outputs"] == plant["inputs"][-plant["ncon"] :]
    assert stored["input_units"] == ["m/s"] * plant["nmeas"]
    assert stored["output_units"] == ["N"] * plant["ncon"]
    assert np.shape(stored["A"])[0] == row["order"]


def closed_loop(plant: dict[str, Any], controller: dict[str, Any] | None) -> Any:
    """F_l(P, K) by python-control."""
    P = system(plant)
    n_u, n_y = plant["ncon"], plant["nmeas"]
    if controller is None:
        return P[: P.noutputs - n_y, : P.ninputs - n_u]
    return P.lft(system(controller), n_u, n_y)


def single(structure: BlockStructure) -> BlockStructure:
    """Every repeated scalar as so many independent ones: a larger set, hence an upper bound that is no smaller."""
    return BlockStructure.of(
        [
            RealScalar(1) if block.kind == "real" else ComplexScalar(1) if block.kind == "complex" else block
            for block in structure.blocks
            for _ in range(block.rows if block.repeated else 1)
        ]
    )


def check_figures(plant: dict[str, Any], controller: dict[str, Any] | None, row: dict[str, Any]) -> None:
    """gamma by SLICOT's norm; mu by SLICOT's upper bound on a grid and at the reported peak.

    SLICOT does not treat repeated scalars. There it bounds the lower bound from above with independent ones, and the
    upper bound is compared with `mu` on the grid.
    """
    N = closed_loop(plant, controller)
    rows, cols = (sum(block[key] for block in plant["blocks"]) for key in ("rows", "cols"))
    stable = bool(np.all(N.poles().real < 0))
    assert row["stable"] == stable
    if not stable:
        return
    nominal = N[cols:, rows:]
    assert row["gamma"] == pytest.approx(
        hinf_norm_slicot(StateSpace(nominal.A, nominal.B, nominal.C, nominal.D)), rel=1e-5
    )
    if row["mu_upper"] is None:  # the set holds an unstable plant
        return
    structure = blocks_of(plant["blocks"]).with_performance(plant["performance"]["rows"], plant["performance"]["cols"])
    assert row["mu_lower"] <= row["mu_upper"] * (1 + 1e-9)
    grid = np.array([N(2j * np.pi * f) for f in [*FLOOR_HZ, row["mu_peak_Hz"]]])
    repeated = any(block.repeated for block in structure.blocks)
    upper = mu(grid, structure).upper if repeated else np.array([mu_upper_slicot(M, structure) for M in grid])
    assert np.max(upper) <= row["mu_upper"] * (1 + 2e-3)
    assert mu_upper_slicot(grid[-1], single(structure)) >= row["mu_lower"] * (1 - 1e-6)


def check_folder(folder: Path) -> dict[str, Any]:
    """Everything that the contract says of a folder of results."""
    result, plant = read(folder / "result.json"), read(folder / "plant.json")
    assert set(result) >= RESULT_KEYS
    assert (result["format"], result["version"], result["plant"]) == ("avis-design", 1, "plant.json")
    check_plant(plant)
    for row in result["controllers"]:
        assert result["gamma_slicot"][row["name"]] == pytest.approx(row["gamma"], rel=1e-4)
        assert set(row) == ROW_KEYS
        assert row["kind"] in ("mu", "hinf", "skyhook", "passive")
        assert (row["file"] is None) == (row["kind"] == "passive")
        stored = None
        if row["file"] is not None:
            assert row["file"] == f"controllers/{row['name']}.json"
            check_controller(stored := read(folder / row["file"]), plant, row)
        check_figures(plant, stored, row)
    for row in result["dk_history"]:
        assert set(row) == {"iteration", "gamma", "mu_upper", "order", "d_fit_error", "seconds"}
    for row in result["requirements"]:
        assert set(row) == {"name", "limit", "value", "unit", "met"}
    return result


def small_design(**changes: Any) -> Design:
    """z alone, mass and one stiffness uncertain: bounds in a second."""
    table = {
        "title": "small",
        "rig": "avis",
        "keep": ["z"],
        "uncertainty": {"parameters_percent": {"mass": 10.0, "isolator1.k_z": 15.0}},
        "transmissibility": {"peak_dB": 6.0, "band_dB": -3.0, "band_Hz": [2.0, 6.0]},
        "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0},
    }
    return design_from_table(table | changes)


@pytest.fixture(scope="module")
def small() -> tuple[Design, DesignPlant]:
    design = small_design()
    return design, build_plant(design, load_rig("avis"))


def partial_result(**given: Any) -> DesignResult:
    """A result with the parts that are not written to JSON left empty."""
    return DesignResult(**{field.name: given.get(field.name) for field in fields(DesignResult)})


def test_files_of_a_small_study_follow_the_contract(small, tmp_path):
    design, plant = small
    rig = load_rig("avis")
    samples = random_perturbations(plant, 5, 1)
    controllers = [analyse(design, plant, c, samples) for c in (passive(), classical_skyhook(plant, rig, design))]
    result = partial_result(
        design=design,
        rig=rig,
        plant=plant,
        controllers=tuple(controllers),
        dk_history=(),
        requirements=(),
        provenance=design_provenance(design, None, rig, 1.0),
        seconds=1.0,
        notes=(),
    )
    written = write_study(result, tmp_path, b"<html>", b"%PDF")
    assert written[-1] == tmp_path / "result.json"
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()} == {
        "result.json",
        "study.json",
        "plant.json",
        "controllers/skyhook_classical.json",
        "report.html",
        "report.pdf",
    }
    stored = check_folder(tmp_path)
    assert [row["name"] for row in stored["controllers"]] == ["passive", "skyhook_classical"]
    passive_row, skyhook_row = stored["controllers"]
    assert passive_row["peak_transmissibility_dB"] > 20 > skyhook_row["peak_transmissibility_dB"]
    # Samples lie inside the worst case, the worst case at or above the nominal.
    for row, c in zip(stored["controllers"], controllers, strict=True):
        assert row["worst_case_peak_transmissibility_dB"] >= row["peak_transmissibility_dB"] - 1e-6
        assert 20 * np.log10(c.transmissibility.high.max()) <= row["worst_case_peak_transmissibility_dB"] + 1e-6


def test_a_failed_rewrite_leaves_the_old_result_whole(small, tmp_path, monkeypatch):
    """Nothing of a study that could not be written stands beside files of the one before."""
    from avis_ctrl import files
    from avis_ctrl.errors import ComputationError

    design, plant = small
    rig = load_rig("avis")
    result = partial_result(
        design=design, rig=rig, plant=plant, controllers=(), dk_history=(), requirements=(), provenance={}, seconds=1.0
    )
    write_study(result, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert tmp_path / "result.json" in before
    written, real = [], files.write_whole

    def full(path: Path, content: bytes) -> None:
        if written:
            raise ComputationError("disk full")
        written.append(path)
        real(path, content)

    monkeypatch.setattr(files, "write_whole", full)
    with pytest.raises(ComputationError, match="untouched"):
        write_study(partial_result(**{**vars(result), "seconds": 2.0}), tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_uncertain_parameters_come_in_the_order_of_the_blocks(small):
    _, plant = small
    assert plant.synthesis.blocks == BlockStructure.of([RealScalar(1, "mass"), RealScalar(1, "isolator1.k_z")])
    assert plant.synthesis.w == ("floor_z_dot", "noise_z")
    assert plant.synthesis.z == ("e_z", "effort_z")


def test_transmissibility_of_the_plant_is_that_of_the_rig(small):
    """Passive, nominal: v over v_f of m, c, k by hand."""
    _, plant = small
    rig = load_rig("avis")
    equations = rig.equations_of_motion()
    m, c, k = equations.M[2, 2], equations.C[2, 2], equations.K[2, 2]
    s = 2j * np.pi * FLOOR_HZ
    passive_loop = plant.full.closed(None).select("z_dot", "floor_z_dot").frequency_response(2 * np.pi * FLOOR_HZ)
    np.testing.assert_allclose(passive_loop[:, 0, 0], (c * s + k) / (m * s**2 + c * s + k), rtol=1e-9)


def test_compliance_bound_joins_the_weights():
    design = small_design(compliance={"limit_m_per_N": 1e-5})
    plant = build_plant(design, load_rig("avis"))
    assert plant.synthesis.w == ("floor_z_dot", "noise_z", "force_z")
    assert plant.synthesis.z == ("e_z", "effort_z", "compliance_z")
    # compliance_z over force_z at rest: 1/k over the bound.
    k = load_rig("avis").equations_of_motion().K[2, 2]
    loop = plant.synthesis.closed(None).select("compliance_z", "force_z")
    assert abs(loop(1e-4j)[0, 0]) == pytest.approx(1 / k / 1e-5, rel=1e-6)


@pytest.mark.parametrize("rig_name", ["avis", "halcyonics_loaded"])
def test_sensor_chains_err_where_they_stand(rig_name):
    """A real Delta of one sensor's chain: seen = (I + decoding W delta rows) clean, two axes, by hand."""
    chains = {"low_percent": 10.0, "crossover_Hz": 60.0, "high_percent": 400.0}
    floor = {"velocity_rms_m_per_s": 2e-6}
    design = small_design(rig=rig_name, keep=["z", "phi_x"], uncertainty={"sensor_chains": chains}, floor=floor)
    rig = load_rig(rig_name)
    plant = build_plant(design, rig)
    blocks = plant.full.blocks
    assert len(blocks.blocks) >= 3
    assert all(block.name.startswith("sensor chain ") for block in blocks.blocks)
    omega = 2 * np.pi * FLOOR_HZ
    names, rows = rig.sensor_rows()
    W = plant.weights["sensor chain *"].system("u", "y").frequency_response(omega)[:, 0, 0]
    nominal = plant.full.nominal().P.select([f"seen_{a}_dot" for a in plant.axes], plant.floor_velocities)
    clean = nominal.frequency_response(omega)
    for place, block in enumerate(blocks.blocks):
        values = [0.0] * len(blocks.blocks)
        values[place] = 0.7
        k = names.index(block.name.removeprefix("sensor chain "))
        row = rows[k, 2:4] / np.array([1.0, rig.edge_m])
        sampled = lft_upper(plant.full.P, blocks.assemble(values).real)
        seen = sampled.select([f"seen_{a}_dot" for a in plant.axes], plant.floor_velocities).frequency_response(omega)
        expected = clean + 0.7 * W[:, None, None] * (plant.decoding[:, k, None] * row) @ clean
        np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_simulated_plants_have_their_sensor_chains():
    design = small_design(
        uncertainty={"sensor_chains": {"low_percent": 10.0, "crossover_Hz": 60.0, "high_percent": 400.0}}
    )
    rig = load_rig("avis")
    plant = build_plant(design, rig)
    nominal = bare_loop(design, rig, plant, None)
    blocks = plant.synthesis.blocks
    changed = with_delta(rig, plant, nominal, "random", blocks.assemble([0.5j] * len(blocks.blocks)), 60.0)
    chained = {block.name.removeprefix("sensor chain ") for block in blocks.blocks}
    for name, before, after in zip(plant.sensors, nominal.sensors.chains, changed.sensors.chains, strict=True):
        # 1 + W delta at the frequency that the phase belongs to.
        W = plant.weights["sensor chain *"].system("u", "y")(60j)[0, 0] if name in chained else 0.0
        assert after(60j)[0, 0] == pytest.approx((1 + 0.5j * W) * before(60j)[0, 0], rel=1e-9)


@pytest.mark.parametrize("name", ["avis_z_phix", "halcyonics_z_phix"])
def test_shipped_designs_build(name):
    design, rig = read_study(DESIGNS / f"{name}.toml")
    plant = build_plant(design, rig)
    check_plant(plant.synthesis.as_dict())
    assert plant.axes == ("z", "phi_x_edge")
    assert plant.synthesis.P.is_stable()
    # Voltages that push one axis push no other: decoding what allocation does is the identity on the axes.
    equations = rig.equations_of_motion()
    used = [equations.actuators.index(name) for name in plant.actuators]
    lever = np.diag([1.0, 1.0 / rig.edge_m])
    np.testing.assert_allclose(lever @ equations.T[2:4][:, used] @ plant.allocation, np.eye(2), atol=1e-12)
    others = np.delete(equations.T, [2, 3], axis=0)[:, used] @ plant.allocation
    assert np.max(np.abs(others)) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", ["avis_z_phix", "halcyonics_z_phix"])
def test_whole_study_of_a_shipped_design(name, tmp_path):
    """Few iterations, plants and seconds; the figures are reproduced from the files alone."""
    design, rig = read_study(DESIGNS / f"{name}.toml")
    short = design.model_copy(
        update={
            "synthesis": design.synthesis.model_copy(update={"max_iterations": 3}),
            "simulation": design.simulation.model_copy(update={"duration_s": 20.0, "random_plants": 2}),
        }
    )
    said: list[str] = []
    result = run_design(short, rig, said.append)
    from avis_ctrl.report import rendered
    from avis_ctrl.report.content import document

    files = write_study(result, tmp_path, *rendered(document(result)))
    stored = check_folder(tmp_path)
    assert {row["name"] for row in stored["controllers"]} >= {"passive", "skyhook", "hinf", "mu"}
    assert len(stored["dk_history"]) >= 1
    # Stability, limits, agreement and the voltage for the electronics' offset belong to each.
    assert len(stored["requirements"]) == 4 + len(design.requirement)
    assert all(path.stat().st_size > 0 for path in files)
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    assert any("D-K iteration" in line for line in said)
    numbers = [int(line.split()[1].rstrip(",")) for line in said if line.startswith("step ")]
    assert numbers == [row["iteration"] for row in stored["dk_history"]] == [*range(len(numbers))]


def test_a_stop_request_is_heard_from_the_first_initial_controller_on(monkeypatch):
    """Ctrl-C after the line of step 0 keeps this controller, also before the first D-K step is done."""
    answers, events = [], []

    def mu_optimal(design, plant, rig, callback, rivals):
        answers.append(callback(Iteration(0, 2.0, 1.9, 30, 0.0, 0, 0.1, HINF)))
        return Candidate("mu", "mu synthesis", "mu", None, ("stopped",)), None

    def stop_requested():
        events.append("listens")
        return True

    monkeypatch.setattr(runner, "mu_optimal", mu_optimal)
    given: Any = None
    runner.synthesise(given, given, given, [], lambda line: events.append(line[:6]), nullcontext(stop_requested))
    assert answers == [False] and events[:2] == ["listens", "step 0"]
