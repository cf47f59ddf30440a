"""uncertainty.json: written and read back, everything wrong in one line, and what a design makes of it."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avis_ctrl.errors import InputError
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.response_error import SETTINGS, FrfSpread
from avis_ctrl.rigs.rig_file import load_rig
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.simulation.discrete import linear_part
from avis_ctrl.study.analysis import describe
from avis_ctrl.study.design_file import design_from_table, read_study
from avis_ctrl.study.identification_design import identification_design
from avis_ctrl.study.identified_uncertainty import RESPONSE, in_design
from avis_ctrl.study.plant import build_plant, channels_gain
from avis_ctrl.study.random_plants import random_perturbations
from avis_ctrl.study.runner import design_provenance
from avis_ctrl.study.simulation import bare_loop, with_delta
from avis_ctrl.study.uncertainty_file import UncertaintyFile, read_uncertainty, uncertainty_content, uncertainty_json
from avis_ctrl.uncertainty.identified_spread import IdentifiedSpread
from avis_ctrl.uncertainty.uncertain_rig import UncertainDirection

NAMES = ("mass", "J1", *(f"isolator{i}.{kind}_z" for i in (1, 2, 3, 4) for kind in "kc"), "sensor.Sz1")
DESIGN = """title = "t"
rig = "rig.toml"
keep = ["z", "phi_x"]
[uncertainty]
identified = "uncertainty.json"
parameters_percent = { mass = 5.0 }
[uncertainty.actuator_chains]
low_percent = 1.0
crossover_Hz = 80.0
high_percent = 400.0
[transmissibility]
peak_dB = 3.5
band_dB = -7.0
band_Hz = [1.0, 10.0]
[control_effort]
floor_velocity_m_per_s = 1e-5
bandwidth_Hz = 100.0
"""


def information(rig) -> Information:
    """As an identification leaves it: sums of stiffness known well, single ones badly, one combination not at all."""
    values = np.array([rig.parameters()[name].value if name in rig.parameters() else 1500.0 for name in NAMES])
    rng = np.random.default_rng(3)
    V, _ = np.linalg.qr(rng.normal(size=(len(NAMES), len(NAMES))))
    sigma = np.geomspace(1e-5, 5e-3, len(NAMES))
    kept = np.arange(len(NAMES)) != 6
    relative = (V[:, kept] / sigma[kept] ** 2) @ V[:, kept].T
    units = tuple(rig.parameters()[name].unit if name in rig.parameters() else "V s/m" for name in NAMES)
    return Information(NAMES, values, units, relative / np.outer(values, values), values)


def spread(keep=("z", "phi_x")) -> FrfSpread:
    f = np.geomspace(0.5, 60, 200)
    measured = (
        2e-3 * (1 + 10 / (1 + 30 * np.log(f / 2.2) ** 2)) * np.exp(0.2 * np.random.default_rng(1).standard_normal(200))
    )
    return FrfSpread(keep, f, measured, np.outer([1.0, 1.2, 1.4, 1.8], measured), SETTINGS.confidences)


@pytest.fixture(scope="module")
def rig():
    return load_rig("avis").with_parameters({"mass": 507.123456789012, "isolator1.k_z": 201234.56789})


@pytest.fixture(scope="module")
def content(rig):
    return uncertainty_content(rig, information(rig), [spread()], {"measurement": "c.h5"})


@pytest.fixture
def folder(tmp_path, rig, content):
    (tmp_path / "rig.toml").write_text(rig_toml(rig), encoding="utf-8")
    (tmp_path / "design.toml").write_text(DESIGN, encoding="utf-8")
    (tmp_path / "uncertainty.json").write_text(uncertainty_json(content), encoding="utf-8")
    return tmp_path


def test_what_is_written_is_read_back(folder, rig, content):
    written = uncertainty_content(rig, information(rig), [spread()], {"measurement": "c.h5"})
    (folder / "uncertainty.json").write_text(uncertainty_json(written), encoding="utf-8")
    assert read_uncertainty(folder / "uncertainty.json") == content
    made = content.factor() @ content.factor().T
    assert np.allclose(made, information(rig).covariance, rtol=1e-9, atol=1e-12 * made.max())
    assert content.undetermined == 1 and len(content.direction) == len(NAMES) - 1
    thin = spread().thinned()
    assert np.array_equal(content.spread[0].values().bound(0.95), thin.bound(0.95))
    weight = content.spread[0].weight
    s = 2j * np.pi * thin.frequency_Hz
    zeros, poles = ([complex(*root) for root in roots] for roots in (weight.zeros, weight.poles))
    W = weight.gain * np.prod([s - z for z in zeros], axis=0) / np.prod([s - p for p in poles], axis=0)
    assert np.all(np.abs(W) >= thin.bound(0.95) * (1 - 1e-9)) and len(poles) == weight.order
    assert np.all(np.real([*zeros, *poles]) < 0)
    # Within 1 dB of the envelope at the frequencies of the fit; between them the filter is compared, too.
    fit = IdentifiedSpread(2 * np.pi * thin.frequency_Hz, thin.bound(0.95))
    excess = 20 * np.log10(fit.shape.magnitude(fit.grid) / fit.envelope(fit.grid))
    assert 0 <= excess.min() <= excess.max() <= 1 and excess.max() <= weight.slack_dB <= 1.05


def test_a_design_reads_it_beside_itself(folder, content):
    design, rig = read_study(folder / "design.toml")
    assert design.uncertainty.identified == content and design.uncertainty.confidence_percent == 95.0
    plant = build_plant(design, rig)
    assert plant.identified is not None
    names = [block.name for block in plant.synthesis.blocks.blocks]
    count = len(plant.identified.directions)
    assert count >= 1
    assert names == ["mass", *(f"identified direction {k}" for k in range(1, count + 1)), RESPONSE]
    omega = plant.identified.weight.omega
    assert np.all(plant.weights[RESPONSE].magnitude(omega) >= content.spread[0].values().bound(0.95) * (1 - 1e-9))
    # The hash of the inputs follows the content, not the place of the file.
    other = design.model_copy(
        update={
            "uncertainty": design.uncertainty.model_copy(
                update={"identified": content.model_copy(update={"undetermined": 2})}
            )
        }
    )
    hashes = {design_provenance(d, None, rig, 0.0)["inputs_sha256"] for d in (design, other)}
    assert len(hashes) == 2


@pytest.mark.slow
def test_a_higher_confidence_widens_everything(rig, content):
    low, high = (in_design(content, rig, ("z", "phi_x"), confidence) for confidence in (0.8, 0.99))
    assert high.found.box > low.found.box and np.all(high.weight.data > low.weight.data)
    between = in_design(content, rig, ("z", "phi_x"), 0.93)
    assert np.allclose(between.spread.bound(between.confidence), content.spread[0].values().bound(0.95))


@pytest.mark.slow
def test_sensors_are_left_to_the_measured_spread(rig, content):
    found = in_design(content, rig, ("z", "phi_x"))
    assert all("sensor" not in name for direction in found.directions for name, _ in direction.changes)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mass": 508.0}, ["mass of the rig avis = 508.0", "the identification found 507.123"]),
        ({"isolator1.k_x": 1e5}, ["other parameters"]),
    ],
)
def test_another_rig_is_refused_in_one_line(folder, rig, change, words):
    (folder / "rig.toml").write_text(rig_toml(rig.with_parameters(change)), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_study(folder / "design.toml")
    text = str(refused.value)
    assert "\n" not in text and text.startswith(str(folder / "design.toml")) and all(word in text for word in words)


def test_other_coordinates_and_confidences_are_refused(rig, content):
    with pytest.raises(InputError, match="is valid for z, phi_x"):
        in_design(content, rig, ("z",))
    with pytest.raises(InputError, match="at most 99 %"):
        in_design(content, rig, ("z", "phi_x"), 0.999)


def complaint(folder, text: str) -> str:
    path = folder / "uncertainty.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_study(folder / "design.toml")
    said = str(refused.value)
    assert "\n" not in said and said.startswith(str(path)) and len(said) < 600
    return said


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("format",), "avis-plant", "format"),
        (("version",), 2, "version"),
        (("rig",), 3, "rig"),
        (("parameter", 0, "value"), None, "parameter[1].value"),
        (("parameter", 0, "scale"), 0.0, "parameter[1].scale"),
        (("parameter", 1, "name"), "mass", "each parameter once"),
        (("covariance", 0), [1.0], "covariance"),
        (("covariance", 0, 0), 1e6, "covariance that is that of the directions"),
        (("direction", 0, "standard_deviation"), -1.0, "direction[1].standard_deviation"),
        (("direction", 0, "vector"), [0.5], "directions with a number for each"),
        (("spread",), [], "spread"),
        (("spread", 0, "frequency_Hz", 1), 0.5, "increasing"),
        (("spread", 0, "measured", 0), -0.1, "spread[1].measured[1]"),
        (("spread", 0, "noise"), [], "row of noise"),
        (("spread", 0, "confidence", 0), 1.5, "spread[1].confidence[1]"),
        (("spread", 0, "keep"), "z", "keep"),
        (("spreads",), [], "did you mean spread"),
        (("spread", 0, "weight", "gain"), 0.0, "gain"),
    ],
)
def test_wrong_entries_are_named(folder, content, place, value, words):
    table = copy.deepcopy(content.model_dump())
    *parents, last = place
    inner = table
    for key in parents:
        inner = inner[key]
    inner[last] = value
    assert words in complaint(folder, json.dumps(table))


@pytest.mark.parametrize("text", ["", "[]", "3", "{", "{}", '{"format": NaN}', "[" * 100_000, '"x"', "null"])
def test_files_that_are_no_uncertainty(folder, text):
    complaint(folder, text)


@settings(max_examples=60, deadline=None)
@given(content=st.binary(max_size=200))
def test_any_bytes_are_refused(content, tmp_path_factory):
    path = tmp_path_factory.mktemp("fuzz") / "uncertainty.json"
    path.write_bytes(content)
    with pytest.raises(InputError):
        read_uncertainty(path)


def test_a_missing_file_and_a_wrong_kind_of_entry(folder):
    (folder / "uncertainty.json").unlink()
    with pytest.raises(InputError, match="no such file"):
        read_study(folder / "design.toml")
    (folder / "uncertainty.json").mkdir()
    with pytest.raises(InputError, match="cannot be read"):
        read_study(folder / "design.toml")
    for wrong in ("3", "true", "[]", "{ rig = 'x' }"):
        (folder / "design.toml").write_text(DESIGN.replace('"uncertainty.json"', wrong), encoding="utf-8")
        with pytest.raises(InputError, match="name of an uncertainty file"):
            read_study(folder / "design.toml")


def test_a_design_whose_file_was_not_read_says_so(rig):
    table = {
        "title": "t",
        "rig": "avis",
        "keep": ["z"],
        "uncertainty": {"identified": "u.json"},
        "transmissibility": {"peak_dB": 3.5, "band_dB": -7.0, "band_Hz": [1.0, 10.0]},
        "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0},
    }
    with pytest.raises(InputError, match="read_study"):
        build_plant(design_from_table(table), rig)


def test_channels_alike_serve_the_axes_alike():
    """Four vertical motors at the corners: an error of each channel is no larger on the axes together."""
    assert channels_gain(load_rig("avis"), ("z", "phi_x")) == pytest.approx(1.0, rel=1e-12)


def test_the_generated_design_reads_back(folder, rig, content):
    template = design_from_table(
        {
            **_table(),
            "uncertainty": {
                "parameters_percent": {"mass": 10.0, "isolator*.k_z": 15.0, "isolator*.k_x": 15.0},
                "parameters_absolute": {"com_y": 0.01},
                "actuator_chains": {"low_percent": 10.0, "crossover_Hz": 80.0, "high_percent": 400.0},
            },
        }
    )
    (folder / "design.toml").write_text(identification_design(content, template, rig), encoding="utf-8")
    design, _ = read_study(folder / "design.toml")
    assert design.uncertainty.identified == content and design.rig == "rig.toml"
    # What was identified gave way, what was not stays.
    assert design.uncertainty.parameters_percent == {"isolator*.k_x": 15.0}
    assert design.uncertainty.parameters_absolute == {"com_y": 0.01}
    median = 100 * np.median(content.spread[0].values().bound(0.95))
    assert median <= design.uncertainty.actuator_chains.low_percent <= 2 * median
    for name in set(type(design).model_fields) - {"uncertainty", "rig"}:
        assert getattr(design, name) == getattr(template, name)


def _table() -> dict:
    return {
        "title": 'A "quoted" title',
        "rig": "avis",
        "keep": ["z", "phi_x"],
        "requirement": [
            {"quantity": "mu_upper", "at_most": 1.0},
            {"quantity": "advantage_over_skyhook_dB", "at_least": 6.0},
        ],
        "transmissibility": {"peak_dB": 3.5, "band_dB": -7.0, "band_Hz": [1.0, 10.0]},
        "control_effort": {"floor_velocity_m_per_s": 1e-5, "bandwidth_Hz": 100.0},
    }


@pytest.mark.slow
def test_a_member_of_the_set_is_simulated_as_it_is(folder):
    """Volts to motion of the sampled loop's table against the plant's LFT with the same perturbation."""
    design, rig = read_study(folder / "design.toml")
    plant = build_plant(design, rig)
    delta, omega = random_perturbations(plant, 3, 1)[2], 2 * np.pi * 7.0
    words = describe(plant, plant.synthesis.blocks, delta)
    assert any(one.startswith("identified direction 1 at ") and "%" in one for one in words)
    loop = with_delta(rig, plant, bare_loop(design, rig, plant, None), "member", delta, omega)
    values = loop.plant.parameters()
    direction = plant.rig.parameters[1]
    assert isinstance(direction, UncertainDirection)
    assert values["isolator2.k_z"].value != rig.parameters()["isolator2.k_z"].value
    table = linear_part(loop)
    # Forces on the axes, made by the allocation, through amplifiers, coupling and table.
    eom = rig.equations_of_motion()
    volts = np.zeros((len(eom.actuators), len(plant.axes)))
    for name, row in zip(plant.actuators, plant.allocation, strict=True):
        volts[eom.actuators.index(name)] = row
    acting = table.select(list(eom.actuators), [f"{name}_dac" for name in eom.actuators])(1j * omega)
    forces = np.linalg.pinv(volts) @ acting @ volts
    amplifier = 1 / (1 + 1j * omega / (2 * np.pi * design.loop.amplifier_corner_Hz))
    blocks = plant.synthesis.blocks
    Delta = blocks.values(delta)[-1]
    W = plant.weights[RESPONSE].shape(np.array([1j * omega]))[0]
    assert np.allclose(forces, amplifier * (np.eye(2) + W * np.asarray(Delta)), rtol=1e-9, atol=1e-12)
    # The generalized plant, closed with the whole perturbation: commands to velocities of the table that was rebuilt.
    P, n_z, n_w = plant.full.P, blocks.n_z, blocks.n_w
    N = P.select([*P.outputs[:n_z], *plant.velocities], [*P.inputs[:n_w], *plant.full.u])(1j * omega)
    closed = N[n_z:, n_w:] + N[n_z:, :n_w] @ delta @ np.linalg.solve(np.eye(n_z) - N[:n_z, :n_w] @ delta, N[:n_z, n_w:])
    changed = loop.plant.equations_of_motion()
    kept, S = [changed.coordinates.index(name) for name in design.keep], np.diag([1.0, 1 / rig.edge_m])
    M, C, K = (S @ X[np.ix_(kept, kept)] @ S for X in (changed.M, changed.C, changed.K))
    delay = next(p.system for p in plant.full.parts if p.name == "delay and amplifier z")(1j * omega)[0, 0]
    table = 1j * omega * np.linalg.inv(K + 1j * omega * C - omega**2 * M)
    assert np.allclose(closed, delay * table @ (np.eye(2) + W * np.asarray(Delta)), rtol=1e-8, atol=1e-14)


def test_content_that_contradicts_itself_is_refused_in_python_too(content):
    with pytest.raises(ValueError, match="covariance"):
        UncertaintyFile.model_validate({**content.model_dump(), "covariance": []})
