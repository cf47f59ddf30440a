"""`avis export` as a user meets it: its files, and what it says to wrong input."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import control
import matplotlib.image
import numpy as np
import pytest
import scipy.io
from avis_command import avis

from avis_ctrl.export import fewer_states, package
from avis_ctrl.export.anti_windup import AntiWindupSettings, choose_anti_windup
from avis_ctrl.export.design_folder import open_design
from avis_ctrl.export.package import CONTINUOUS, FILES, check_package
from avis_ctrl.export.sampled_controller import read_controller
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.simulation.discrete import digital_controller

CERTIFICATE_KEYS = {
    "format",
    "version",
    "controller_sha256",
    "mu_upper",
    "mu_lower",
    "guaranteed",
    "assumptions",
    "stable",
    "worst_case_peak_transmissibility_dB",
    "worst_case_band_transmissibility_dB",
    "rounding_noise_m_per_s",
    "step_time_us",
    "between_samples",
    "at_rest",
    "anti_windup",
    "files",
    "test_vectors",
    "restart_vectors",
    "design_inputs_sha256",
    "content_sha256",
}
CONTROLLER_KEYS = {
    "format",
    "version",
    "name",
    "sample_rate_Hz",
    "arithmetic",
    "A",
    "B",
    "C",
    "D",
    "inputs",
    "outputs",
    "input_units",
    "output_units",
    "limits_V",
    "delay_samples",
}


@pytest.fixture(scope="module", autouse=True)
def quick_anti_windup():
    """Simulations at one level with one record; tests of the certificate have all."""
    with pytest.MonkeyPatch.context() as patch:
        few = AntiWindupSettings(levels=(3.0,), records=1)
        patch.setattr(package, "choose_anti_windup", partial(choose_anti_windup, settings=few))
        yield


@pytest.fixture(scope="module")
def out(skyhook_dir, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("out") / "new"
    done = avis("export", skyhook_dir, "--controller", "skyhook_classical", "--out", folder, "--float32")
    assert done.returncode == 0, done.stderr
    return folder


def test_files_follow_the_contract(out):
    assert {one.name for one in out.iterdir()} == set(FILES) - {CONTINUOUS}  # which belongs to --order
    controller, certificate = (json.loads((out / name).read_text()) for name in ("controller.json", "certificate.json"))
    assert set(controller) == CONTROLLER_KEYS
    assert set(certificate) == CERTIFICATE_KEYS
    assert certificate["stable"] is True
    for name in "ABCD":
        matrix = np.array(controller[name])
        assert np.array_equal(matrix, matrix.astype(np.float32).astype(float))
    vectors = np.loadtxt(out / "test_vectors.csv", delimiter=",", skiprows=1)
    assert vectors.shape == (2000, len(controller["inputs"]) + len(controller["outputs"]))


@pytest.mark.slow
def test_fewer_states_than_the_design_allows_mu_for(skyhook_dir, tmp_path):
    """A skyhook's loops with three of their four states: refused without a file, and exported once it is accepted."""
    asked = "export", skyhook_dir, "--controller", "skyhook_classical", "--order", "3", "--out", tmp_path / "new"
    done = avis(*asked)
    assert done.returncode == 3 and "not proved to be at most 1; nothing was written" in done.stderr
    assert not (tmp_path / "new").exists()
    accepted = re.search(r"accept it with (--mu-at-most) ([0-9.]+)", done.stderr)
    done = avis(*asked, *accepted.groups())
    assert done.returncode == 0, done.stderr
    assert {one.name for one in (tmp_path / "new").iterdir()} == {*FILES, "orders.png"}
    certificate = json.loads((tmp_path / "new" / "certificate.json").read_text())
    assert 1 < certificate["mu_upper"] <= float(accepted[2]) and certificate["stable"]
    picture = matplotlib.image.imread(tmp_path / "new" / "orders.png")
    assert picture.shape[:2] == (600, 900) and np.ptp(picture) > 0.9
    assert "order against mu" in done.stdout and "exported" in done.stdout


def test_mat_file_and_python_control_have_the_same_numbers(out):
    stored, controller = scipy.io.loadmat(out / "controller.mat"), read_controller(out / "controller.json")
    for name, matrix in controller.matrices().items():
        assert np.array_equal(stored[name], matrix)
    assert [str(one[0]) for one in stored["inputs"][0]] == list(controller.system.inputs)
    system = controller.system.to_control()
    assert isinstance(system, control.StateSpace)
    assert system.dt == 1 / controller.sample_rate_Hz


def test_exported_numbers_are_those_of_the_simulated_controller(skyhook, out):
    """float32 coefficients move the response by parts in ten thousand at most, at all frequencies that matter."""
    K = digital_controller(skyhook.loop(skyhook.controller("skyhook_classical")))
    omega = np.geomspace(0.1, 0.99 * np.pi / K.dt, 80)
    a, b = K.frequency_response(omega), read_controller(out / "controller.json").system.frequency_response(omega)
    assert np.max(np.abs(a - b)) < 1e-3 * np.max(np.abs(a))


def test_a_controller_above_the_required_mu_is_reported_before_the_descent(skyhook, monkeypatch):
    K = skyhook.controller("skyhook_classical")
    shorter = StateSpace(np.zeros((0, 0)), np.zeros((0, K.ninputs)), np.zeros((K.noutputs, 0)), K.D)
    for name, value in (
        ("gain_limit", lambda *known: np.inf),
        ("Task", lambda *known, **more: None),
        ("_order_and_mu", lambda P, K: (K.nstates, 1.2)),
        ("fixed_order", lambda *known: iter([SimpleNamespace(K=shorter)])),
    ):
        monkeypatch.setattr(fewer_states, name, value)
    told = []
    folder, name = fewer_states.with_fewer_states(skyhook, "skyhook_classical", 2, told.append)
    assert folder.controller(name).nstates == 0
    assert told[0].startswith("mu of 'skyhook_classical' itself is at most 1.2, above the 1 that the design requires")


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("controller.mat", "controller.mat is missing"),
        ("avis_controller.h", "avis_controller.h is missing"),
        ("test_vectors.csv", "test_vectors.csv is missing"),
    ],
)
def test_a_deleted_file_is_named_before_anything_is_computed(skyhook, out, tmp_path, file, words, monkeypatch):
    monkeypatch.setattr(package, "certify", None)  # would be called otherwise
    folder = shutil.copytree(out, tmp_path / "out")
    (folder / file).unlink()
    told = []
    assert package.check_package(skyhook, folder, told.append) == [words] == told


def test_a_changed_byte_of_a_file_is_named(skyhook, out, tmp_path):
    folder = shutil.copytree(out, tmp_path / "out")
    with (folder / "test_vectors.csv").open("a") as file:
        file.write("\n")
    assert check_package(skyhook, folder) == ["test_vectors.csv is not the file that was exported: its hash differs"]


def test_the_hash_comes_before_what_is_wrong_in_the_file(skyhook, out, tmp_path):
    """A number edited by hand that is no float32 value."""
    folder = shutil.copytree(out, tmp_path / "out")
    text = json.loads((out / "controller.json").read_text())
    text["D"][0][0] = 0.1
    (folder / "controller.json").write_text(json.dumps(text))
    first, second = check_package(skyhook, folder)
    assert first == "controller.json is not the file that the certificate names: its hash differs"
    assert "D: expected float32 values" in second


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c["test_vectors"].update(tolerance_V=1.0), "test_vectors.tolerance_V: 1 in certificate.json"),
        (lambda c: c["restart_vectors"].update(tolerance_V=1e-9), "restart_vectors.tolerance_V: 1e-09"),
        (lambda c: c["test_vectors"].update(samples=1999), "test_vectors.samples: 1999"),
        (lambda c: c["anti_windup"].update(corner_Hz=2.0, gain=0.5), "the outputs in test_vectors.csv are not those"),
        (lambda c: c.pop("test_vectors"), "no samples and tolerance_V of test_vectors.csv"),
        (lambda c: c["files"].pop("controller.mat"), "controller.mat is not listed"),
    ],
)
def test_a_field_of_the_certificate_that_was_edited_is_named(skyhook, out, tmp_path, change, words, monkeypatch):
    """Within seconds, even if its own hash is made to fit."""
    monkeypatch.setattr(package, "certify", None)  # would be called otherwise
    folder = shutil.copytree(out, tmp_path / "out")
    content = json.loads((out / "certificate.json").read_text())
    change(content)
    (folder / "certificate.json").write_text(json.dumps(content))
    found = check_package(skyhook, folder)
    assert "content_sha256 differs" in found[0] and any(words in one for one in found[1:])
    plain = json.dumps({key: value for key, value in content.items() if key != "content_sha256"}, indent=1)
    content["content_sha256"] = hashlib.sha256(plain.encode()).hexdigest()
    (folder / "certificate.json").write_text(json.dumps(content))
    again = check_package(skyhook, folder)
    assert again == found[1:]


def test_a_figure_that_is_not_computed_again_is_protected_by_the_hash(skyhook, out, tmp_path, monkeypatch):
    stored = json.loads((out / "certificate.json").read_text())
    same = type("Same", (), {"content": {key: stored[key] for key in ("mu_upper", "stable")}})
    monkeypatch.setattr(package, "certify", lambda *arguments: same)
    assert check_package(skyhook, out) == []
    folder = shutil.copytree(out, tmp_path / "foreign")
    for name in ("controller.c", "orders.png"):
        (folder / name).write_text("")
    told = []
    assert check_package(skyhook, folder, told.append) == []
    assert [line for line in told if "controller.c" in line] == [
        "Note: certificate.json does not list controller.c; not checked"
    ]
    folder = shutil.copytree(out, tmp_path / "out")
    (folder / "certificate.json").write_text(json.dumps({**stored, "step_time_us": 0.1}))
    assert check_package(skyhook, folder) == ["certificate.json is not as it was written: its content_sha256 differs"]


def test_the_check_is_of_the_controller_that_is_asked_for(skyhook_dir, out):
    done = avis("export", skyhook_dir, "--out", out, "--check", "--controller", "mu")
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1
    assert "--controller = 'mu': expected 'skyhook_classical'" in done.stderr


def test_folders_that_are_no_export_or_swapped(skyhook_dir, out, tmp_path):
    (tmp_path / "empty").mkdir()
    for design, export, words in (
        (skyhook_dir, tmp_path / "empty", "certificate.json is missing in it"),
        (skyhook_dir, tmp_path / "none", "there is no such folder"),
        (skyhook_dir, skyhook_dir, "certificate.json is missing in it; this is a folder of avis design"),
        (out, skyhook_dir, "result.json is missing in it; this is a folder of avis export: are DESIGN_DIR and"),
    ):
        done = avis("export", design, "--out", export, "--check")
        assert done.returncode == 2 and words in done.stderr and len(done.stderr.strip().splitlines()) == 1


def test_the_program_of_the_contract_compares_the_files(out, gcc, tmp_path):
    """docs/contracts/export.md: compiled with every warning, it accepts the code and refuses another coefficient."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "contracts" / "export.md").read_text()
    folder = shutil.copytree(out, tmp_path / "out")
    (folder / "main.c").write_text(re.search(r"```c\n(.*?)```", page, re.DOTALL)[1])

    def results() -> list[int]:
        subprocess.run(
            [
                gcc,
                "-std=c99",
                "-Wall",
                "-Wextra",
                "-Wpedantic",
                "-Wconversion",
                "-Werror",
                "main.c",
                "avis_controller.c",
                "-o",
                "compare",
            ],
            cwd=folder,
            check=True,
        )
        return [
            subprocess.run(
                ["./compare", f"{name}.csv", str(certificate[name]["tolerance_V"])], cwd=folder, check=False
            ).returncode
            for name in ("test_vectors", "restart_vectors")
        ]

    certificate = json.loads((out / "certificate.json").read_text())
    assert results() == [0, 0]
    source = folder / "avis_controller.c"
    first = re.search(r"D\[8\]\[6\] = \{\s*\{(\S+?)f,", source.read_text())
    changed = source.read_text().replace(first[0], first[0].replace(first[1], str(1.01 * float(first[1]))))
    source.write_text(changed)
    assert results() == [1, 1]
    source.write_text(re.sub(r"WAIT = \d+u", "WAIT = 499u", (out / "avis_controller.c").read_text()))
    assert results() == [1, 1]
    missing = subprocess.run(["./compare", "missing.csv", "1"], cwd=folder, check=False, capture_output=True)
    assert missing.returncode == 2


def test_every_field_is_in_the_contract(out):
    page = (Path(__file__).resolve().parents[2] / "docs" / "contracts" / "export.md").read_text()

    def keys(value):
        if isinstance(value, dict):
            for key, one in value.items():
                yield from [key, *keys(one)]

    for name in ("controller.json", "certificate.json"):
        for key in keys(json.loads((out / name).read_text())):
            assert f"`{key}`" in page or key in ("format", "version"), key


def test_header_says_where_it_comes_from(out):
    text = (out / "avis_controller.h").read_text()
    certificate = json.loads((out / "certificate.json").read_text())
    for words in ("AVIS: z and phi_x", "'avis'", certificate["controller_sha256"], "mu at most", "SHA-256"):
        assert words in text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("MISSING", "--out", "OUT"), "expected a folder that avis design wrote"),
        (("DESIGN", "--controller", "mu2", "--out", "OUT"), "skyhook_classical"),
        (("DESIGN", "--controller", "passive", "--out", "OUT"), "skyhook_classical"),
        (("DESIGN", "--controller", "skyhook_classical", "--out", "OUT", "--format", "c,fortran"), "c,mat,json"),
        (("DESIGN", "--controller", "skyhook_classical", "--out", "FILE"), "--out"),
        (("DESIGN", "--controller", "skyhook_classical", "--out", "/proc/nothing"), "--out"),
        (("DESIGN", "--controller", "skyhook_classical", "--order", "4", "--out", "OUT"), "expected 1 to 3"),
        (("DESIGN", "--controller", "skyhook_classical", "--order", "999", "--out", "OUT"), "expected 1 to 3"),
        (("MISSING", "--order", "0", "--out", "OUT"), "--order = 0: expected a whole number, 1 or more"),
        (("MISSING", "--order", "-2", "--out", "OUT"), "--order = -2: expected a whole number, 1 or more"),
        (("DESIGN", "--out", "OUT", "--check", "--float32"), "either --check or --float32"),
        (("DESIGN", "--controller", "skyhook_classical", "--out", "OUT", "--mu-at-most", "2"), "together with --order"),
        (("DESIGN", "--out", "OUT", "--check", "--order", "3"), "either --check or --order"),
        (("EMPTY", "--out", "OUT"), "result.json"),
        (("DESIGN", "--out", "OUT", "--check"), "there is no such folder"),
    ],
)
def test_wrong_input_is_one_line_and_writes_nothing(skyhook_dir, tmp_path, arguments, words):
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    places = {
        "MISSING": tmp_path / "missing",
        "DESIGN": skyhook_dir,
        "OUT": tmp_path / "out",
        "FILE": tmp_path / "file",
        "EMPTY": tmp_path / "empty",
    }
    done = avis("export", *(places.get(one, one) for one in arguments))
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("result.json", {"stable": False, "verdict": "phi_y is unstable"}, "phi_y is unstable"),
        ("result.json", {"format": "avis-plant"}, "format"),
        ("study.json", {"rig": "name = 1"}, "study.json"),
        ("study.json", {"design": {}}, "study.json"),
        ("study.json", None, "study.json"),
        ("controllers/skyhook_classical.json", {"A": [[1.0]]}, "skyhook_classical.json"),
        ("controllers/skyhook_classical.json", {"A": "x"}, "skyhook_classical.json"),
    ],
)
def test_a_damaged_design_folder(skyhook_dir, tmp_path, file, change, words):
    folder = shutil.copytree(skyhook_dir, tmp_path / "design")
    if change is None:
        (folder / file).write_text("{")
    else:
        content = json.loads((folder / file).read_text())
        (folder / file).write_text(json.dumps({**content, **change}))
    done = avis("export", folder, "--controller", "skyhook_classical", "--out", tmp_path / "out")
    assert done.returncode in (2, 3)
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_study_file_reads_back_design_and_rig(skyhook):
    from avis_ctrl.study.design_file import read_study

    design, rig = read_study(Path(__file__).resolve().parents[2] / "designs" / "avis_z_phix.toml")
    assert open_design(skyhook.path).design == design
    assert skyhook.rig == rig
