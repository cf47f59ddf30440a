"""The measuring commands as a user meets them: every hostile file is one clear line and exit code 2."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from avis_command import avis

from avis_ctrl.measurement.formats import write_campaign
from avis_ctrl.rigs import load_rig
from avis_ctrl.simulation.campaign_data import simulate_campaign
from avis_ctrl.study.plan_file import plan_from_table

DESIGN = Path(__file__).resolve().parents[1] / "designs/avis_z_phix.toml"
PLAN = {
    "title": "short",
    "duration_s": 20.0,
    "multisine": {"period_s": 5.0},
    "record": [{"excitation": "noise", "level_percent": 40.0, "records": 2, "band_Hz": [0.5, 50.0]}],
}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("campaign") / "c.h5"
    rig = load_rig("avis")
    write_campaign(path, simulate_campaign(rig, plan_from_table(PLAN), seed=1))
    return path


def changed(campaign: Path, folder: Path, change: Callable[[h5py.File], None]) -> Path:
    path = folder / "hostile.h5"
    path.write_bytes(campaign.read_bytes())
    with h5py.File(path, "a") as file:
        change(file)
    return path


def set_y(value: float, rows: slice, column: int) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file["records/00/y"][rows, column] = value

    return change


def other_rate(file: h5py.File) -> None:
    file["records/01"].attrs["sample_rate_Hz"] = 500.0


def wrong_names(file: h5py.File) -> None:
    for record in file["records"].values():
        record["y"].attrs["names"] = [f"S{k}" for k in range(6)]


def shorter_y(file: h5py.File) -> None:
    y = file["records/00/y"][:-5]
    names, unit = file["records/00/y"].attrs["names"], file["records/00/y"].attrs["unit"]
    del file["records/00/y"]
    file["records/00"].create_dataset("y", data=y).attrs.update({"names": names, "unit": unit})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_y(np.nan, slice(100, 101), 2), "Sx2"),
        (set_y(0.25, slice(None), 1), "Sz1"),
        (other_rate, "sample_rate_Hz"),
        (wrong_names, "sensors of the rig avis"),
        (shorter_y, "y"),
        (lambda file: file.attrs.update(version=9), "version"),
        (lambda file: file.attrs.update(format="x"), "format"),
        (lambda file: file.pop("records"), "records"),
    ],
    ids=["NaN", "constant channel", "unequal rates", "names", "shapes", "version", "format", "no records"],
)
def test_hostile_campaigns_are_one_line(campaign, tmp_path, change, said):
    done = avis("identify", str(changed(campaign, tmp_path, change)), "--rig", "avis", "--out", str(tmp_path / "out"))
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("avis: ") and done.stderr.count("\n") == 1
    assert said in done.stderr
    assert not (tmp_path / "out" / "result.json").exists()


@pytest.mark.parametrize("keep", [0, 7, 2000, -1000])
def test_truncated_files_are_one_line(campaign, tmp_path, keep):
    path = tmp_path / "cut.h5"
    path.write_bytes(campaign.read_bytes()[:keep])
    done = avis("identify", str(path), "--rig", "avis", "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "cut.h5" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("identify", "none.h5", "--rig", "avis", "--out", "o"), "none.h5"),
        (("identify", "C", "--rig", "avos", "--out", "o"), "avos"),
        (("identify", "C", "--rig", "halcyonics", "--out", "o"), "acc_A1"),
        (("identify", "C", "--rig", "avis", "--out", "o", "--prior", "mass=heavy"), "heavy"),
        (("identify", "C", "--rig", "avis", "--out", "o", "--parameter", "weight"), "weight"),
        (("identify", "C", "--rig", "avis", "--out", "o", "--hold-out", "77"), "77"),
        (("identify", "C", "--rig", "avis", "--out", "o", "--columns", "u"), "columns"),
        (("identify", "C", "--rig", "avis"), "--out"),
        (("identify", "C", "--rig", "avis", "--out", "o", "--design", "none.toml"), "none.toml: no such file"),
        (("identify", "C", "--rig", str(DESIGN), "--out", "o"), "this is a design file"),
        (("predict", "nowhere", "C", "--out", "p.h5"), "nowhere"),
        (("excite", "--rig", "avis", "--out", "s.h5", "--kind", "chirp"), "chirp"),
        (("excite", "--rig", "avis", "--out", "s.h5", "--rms", "9"), "9"),
        (("excite", "--rig", "avis", "--out", "s.doc"), "s.doc"),
        (("simulate-campaign", "--rig", "avis", "--out", "no/where/c.h5", "--duration", "20"), "no/where"),
        (("simulate-campaign", "--rig", "avis", "--out", "c.h5", "--plan", "none.toml"), "none.toml"),
        (("convert", "C", "no/where/c.h5"), "no/where"),
        (("convert", "C"), "--out: missing"),
        (("convert", "C", "a.h5", "--out", "b.h5"), "a.h5 and --out were both given"),
        (("single-axis", "pendulum", "C", "--columns", "u=u"), "pendulum"),
        (("single-axis", "drive", "C", "--columns", "force"), "force"),
    ],
    ids=lambda value: " ".join(value)[:50] if isinstance(value, tuple) else str(value),
)
def test_wrong_usage_is_one_line(campaign, tmp_path, arguments, said, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = avis(*(str(campaign) if one == "C" else one for one in arguments))
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("avis: ") and done.stderr.count("\n") == 1
    assert said in done.stderr


def test_convert_and_predict_go_through(campaign, tmp_path):
    done = avis("convert", str(campaign), str(tmp_path / "copy.h5"))
    assert done.returncode == 0 and "2 records" in done.stdout
    with h5py.File(tmp_path / "copy.h5") as copy, h5py.File(campaign) as file:
        assert np.array_equal(copy["records/01/y"], file["records/01/y"])


@pytest.fixture(scope="module")
def flat(campaign, tmp_path_factory) -> tuple[Path, Path]:
    """The first record as flat u, y, t; and with the first two sensors exchanged."""
    folder = tmp_path_factory.mktemp("flat")
    with h5py.File(campaign) as file:
        u, y = (file[f"records/00/{role}"][:] for role in "uy")
    t = np.arange(len(u)) / 1000.0
    scipy.io.savemat(folder / "flat.mat", {"u": u, "y": y, "t": t})
    scipy.io.savemat(folder / "swapped.mat", {"u": u, "y": y[:, [1, 0, 2, 3, 4, 5]], "t": t})
    return folder / "flat.mat", folder / "swapped.mat"


@pytest.mark.parametrize("command", ["convert", "identify"])
def test_help_says_the_layouts_of_files(command):
    done = avis(command, "--help")
    words = " ".join(done.stdout.split())
    assert done.returncode == 0
    for said in (
        "struct array records",
        "u, y and t or sample_rate_Hz (or fs) are required",
        "y_names=Sy1+Sz1",
        "--period",
        "--excitation",
        "--sample-rate",
        "--unit-y",
    ):
        assert said in words, said


def test_a_flat_file_without_names_is_held_against_the_rig(flat, tmp_path):
    """The order of the rig is taken with a note, and the gate stops what it is not."""
    done = avis("identify", str(flat[1]), "--rig", "avis", "--out", str(tmp_path / "out"))
    words = " ".join(done.stdout.split())
    assert "y: the file does not name its channels; assumed to be in the order of the rig avis: Sy1, Sz1" in words
    assert "the file does not name its rig; assumed to be avis" in words
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "Sensors 'Sy1' and 'Sz1' are exchanged" in done.stderr
    named = avis(
        "identify",
        str(flat[1]),
        "--rig",
        "avis",
        "--out",
        str(tmp_path / "out"),
        "--band",
        "0.01",
        "0.011",
        "--columns",
        "y_names=Sz1+Sy1+Sx2+Sz2+Sy3+Sz3",
    )
    assert "exchanged" not in named.stderr
    assert "y: the file does not name its channels" not in " ".join(named.stdout.split())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ("identify", "F", "--rig", "avis", "--out", "o", "--columns", "y_names=a+b+c+d+e+f"),
            "--columns y_names=Sy1+Sz1+...",
        ),
        (("identify", "C", "--rig", "halcyonics", "--out", "o"), "the file is a campaign of avis"),
        (("convert", "F", "o.h5", "--excitation", "chirp"), "excitation = 'chirp': expected one of multisine"),
        (("convert", "F", "o.h5", "--unit-y", "Pa"), "y unit = 'Pa'"),
        (("convert", "F", "o.h5", "--sample-rate", "500"), "expected 1000 Hz, the rate of the time stamps"),
        (("convert", "C", "o.h5", "--period", "5"), "an HDF5 campaign states this itself"),
        (("convert", __file__, "o.h5"), "not a measurement file (.py)"),
    ],
    ids=lambda value: " ".join(map(str, value))[-40:] if isinstance(value, tuple) else "",
)
def test_files_that_say_little_are_refused_in_one_line(campaign, flat, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    done = avis(*({"C": str(campaign), "F": str(flat[0])}.get(one, one) for one in arguments))
    assert done.returncode == 2 and done.stderr.startswith("avis: ") and done.stderr.count("\n") == 1
    assert said in done.stderr and not list(tmp_path.glob("o*/result.json"))


def test_columns_with_other_names_are_refused_with_the_names_of_the_rig(tmp_path):
    path = tmp_path / "m.csv"
    path.write_text("t,out0,in0\n" + "".join(f"{k / 1000},0,0\n" for k in range(20)), encoding="utf-8")
    done = avis("identify", str(path), "--rig", "avis", "--out", str(tmp_path / "o"))
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "--columns u=NAME+NAME,y=NAME+NAME" in done.stderr and "drives Ay1, Az1" in done.stderr
    assert "sensors Sy1, Sz1" in done.stderr


def test_what_the_file_does_not_say_may_be_said(flat, tmp_path):
    out = tmp_path / "c.h5"
    done = avis("convert", str(flat[0]), "--out", str(out), "--period", "5", "--unit-y", "mV", "--rig", "avis")
    assert done.returncode == 0, done.stderr
    with h5py.File(out) as file:
        record = file["records/00"]
        assert (record.attrs["excitation"], record.attrs["period_s"], file.attrs["rig"]) == ("multisine", 5.0, "avis")
        np.testing.assert_allclose(record["y"][:], 1e-3 * scipy.io.loadmat(flat[0])["y"], rtol=1e-15)


def test_single_axis_says_what_it_took_the_columns_for(data):
    drive = ("single-axis", "drive", str(data / "emps" / "DATA_EMPS.mat"), "--columns", "force=vir,position=qm,t=t")
    plain, scaled = avis(*drive), avis(*drive, "--scale", "force=35.15")
    assert plain.stdout.splitlines()[0] == (
        "assumed units: force = vir in N, position = qm in m, t in s "
        "(not scaled; if the file has another unit: --scale force=FACTOR)"
    )
    assert "force = vir times 35.15 in N" in scaled.stdout


def test_what_the_rig_cannot_play_names_the_plan_and_its_record(tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text('title = "t"\nduration_s = 20.0\n[[record]]\nexcitation = "noise"\nband_Hz = [10.0, 600.0]\n')
    done = avis("simulate-campaign", "--rig", "avis", "--plan", str(plan), "--out", str(tmp_path / "c.h5"))
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"avis: {plan}: record[1].band_Hz = "), done.stderr
    for option in ("--perturbed", "--orthogonal"):
        done = avis("simulate-campaign", "--rig", "avis", "--plan", str(plan), option, "--out", str(tmp_path / "c.h5"))
        assert done.returncode == 2 and "belong to the default plan" in done.stderr
