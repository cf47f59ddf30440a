"""The `avis` command as a new user meets it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from avis_command import ENVIRONMENT, avis

import avis_ctrl
from avis_ctrl import cli
from avis_ctrl.cli.console import StopRequest
from avis_ctrl.errors import ComputationError, InputError

DESIGNS = Path(__file__).resolve().parents[1] / "designs"
ONE_THREAD = os.environ | ENVIRONMENT


def of_compiled_code() -> SystemError:
    """What numba makes of Ctrl-C while it loads compiled code."""
    error, inner = SystemError("returned a result with an exception set"), SystemError("the same")
    error.__cause__, inner.__cause__ = inner, KeyboardInterrupt()
    return error


def test_help_names_the_commands_and_loads_no_arrays():
    code = (
        "import sys\nsys.argv = ['avis', '--help']\nfrom avis_ctrl.cli import main\ntry:\n    main()\n"
        "except SystemExit as stop:\n    assert not stop.code, stop.code\n"
        "print('loaded:', *{'numpy', 'scipy', 'pydantic', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=ONE_THREAD)
    assert "design" in done.stdout
    assert "doctor" in done.stdout
    assert done.stdout.splitlines()[-1] == "loaded:"


def test_help_answers_at_once():
    """Under half a second of processor time, Python's own start included (about 0.2 s alone)."""
    before = os.times()
    assert avis("--help").returncode == 0
    after = os.times()
    used = (after.children_user - before.children_user) + (after.children_system - before.children_system)
    assert used < 1.0


def test_help_of_a_command():
    done = avis("design", "--help")
    assert done.returncode == 0
    assert "--out" in done.stdout
    assert "DESIGN.toml" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("design", "missing.toml", "--out", "OUT"), "missing.toml"),
        (("design",), "DESIGN.toml"),
        (("design", str(DESIGNS / "avis_z_phix.toml")), "--out"),
        (("desing",), "desing"),
        (("design", "x.toml", "--out", "OUT", "--fast"), "--fast"),
        (("doctor", "now"), "now"),
        (("gap", "missing.h5", "--rig", "avis", "--out", "OUT", "--design-file", "other.toml"), "other.toml"),
    ],
    ids=[
        "no such file",
        "no file given",
        "no folder given",
        "unknown command",
        "unknown option",
        "too many words",
        "no such design, before the measurement is read",
    ],
)
def test_wrong_usage_is_one_line_and_code_2(arguments, words, tmp_path):
    arguments = tuple(str(tmp_path / "out") if one == "OUT" else one for one in arguments)
    done = avis(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("avis: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    assert not (tmp_path / "out").exists()


def test_without_a_command_the_help_answers():
    done = avis()
    assert done.returncode == 2
    assert "design" in done.stdout
    assert done.stderr == ""


def test_a_folder_that_cannot_be_written_is_code_2(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    done = avis("design", str(DESIGNS / "avis_z_phix.toml"), "--out", str(tmp_path / "file" / "out"))
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "--out" in done.stderr


@pytest.mark.parametrize(
    ("raised", "code", "words"),
    [
        (
            InputError("expected a positive number", file="d.toml", field="mass", value=-1),
            2,
            "avis: d.toml: mass = -1: expected a positive number\n",
        ),
        (
            ComputationError("no controller found", measured="gamma 7", cause="too much asked", next_step="ask less"),
            3,
            "avis: no controller found; measured: gamma 7; likely cause: too much asked; next: ask less\n",
        ),
        (KeyboardInterrupt(), 130, "avis: interrupted; no partial results were written\n"),
        (of_compiled_code(), 130, "avis: interrupted; no partial results were written\n"),
    ],
)
def test_errors_end_in_their_line_and_code(raised, code, words, monkeypatch, capsys):
    def stop(*args, **kwargs):
        raise raised

    monkeypatch.setattr(cli, "app", stop)
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == code
    assert capsys.readouterr().err == words


def test_an_error_that_is_not_ours_is_not_hidden(monkeypatch):
    def stop(*args, **kwargs):
        raise ZeroDivisionError

    monkeypatch.setattr(cli, "app", stop)
    with pytest.raises(ZeroDivisionError):
        cli.main()


def test_doctor_finds_that_everything_works_here():
    done = avis("doctor", timeout=120.0, new_interpreter=True)
    assert done.returncode == 0, done.stdout
    for word in ("numpy", "slycot", "clarabel", "typst", "H-infinity"):
        assert word in done.stdout
    assert "does not work" not in done.stdout


def test_doctor_that_finds_something_broken_is_code_3(monkeypatch, capsys):
    from avis_ctrl.study import doctor

    monkeypatch.setattr(doctor, "examine", lambda: [doctor.Check("clarabel solves an LMI", "0 instead of 1", False)])
    monkeypatch.setattr("sys.argv", ["avis", "doctor"])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 3
    assert "does not work" in capsys.readouterr().out


def test_interrupt_leaves_nothing_half_written(tmp_path):
    """Ctrl-C while the study computes."""
    out = tmp_path / "out"
    child = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "from avis_ctrl.cli import main; main()",
            "design",
            str(DESIGNS / "avis_z_phix.toml"),
            "--out",
            str(out),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ONE_THREAD,
        start_new_session=True,
    )
    try:
        for _ in range(300):
            time.sleep(0.1)
            if out.is_dir():
                break
        time.sleep(1.0)
        os.killpg(child.pid, signal.SIGINT)  # as a terminal does: to the whole group
        said, complained = child.communicate(timeout=60)
    finally:
        child.kill()
    assert child.returncode == 130
    assert complained.splitlines()[-1] == "avis: interrupted; no partial results were written"
    assert "Traceback" not in complained + said
    assert not out.exists()


@pytest.mark.slow
def test_an_interrupt_of_the_iteration_keeps_the_best_controller(tmp_path):
    out = tmp_path / "out"
    child = subprocess.Popen(
        [
            sys.executable,
            "-u",
            "-c",
            "from avis_ctrl.cli import main; main()",
            "design",
            str(DESIGNS / "avis_z_phix.toml"),
            "--out",
            str(out),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ONE_THREAD,
    )
    try:
        assert child.stdout is not None
        next(line for line in child.stdout if "D-K iteration" in line)
        child.send_signal(signal.SIGINT)
        child.communicate(timeout=500)
    finally:
        child.kill()
    assert child.returncode == 0
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    mu = next(one for one in result["controllers"] if one["name"] == "mu")
    assert "stopped on request (callback or Ctrl-C)" in mu["note"]
    assert len(result["dk_history"]) <= 6 and mu["mu_upper"] < 2


def test_the_first_interrupt_asks_and_the_second_ends():
    said = []

    def usual(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, usual)
    try:
        with pytest.raises(KeyboardInterrupt), StopRequest(said.append):
            os.kill(os.getpid(), signal.SIGINT)  # nothing to keep yet
            time.sleep(1)
        with StopRequest(said.append) as asked:
            assert not asked()
            os.kill(os.getpid(), signal.SIGINT)
            assert asked() and len(said) == 1 and "Ctrl-C again" in said[0]
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(1)
        assert signal.getsignal(signal.SIGINT) is usual
    finally:
        signal.signal(signal.SIGINT, before)


SWALLOWS = """
import ctypes
import time
import avis_ctrl.cli as cli

def app(**options):
    print("ready", flush=True)
    callback = ctypes.CFUNCTYPE(None)(lambda: time.sleep(30))
    callback()  # an exception in a callback of a compiled library is lost, and Python prints its traceback
    time.sleep(30)

cli.app, cli.SETTINGS = app, cli.InterruptSettings(0.5)
cli.main()
"""


def test_an_interrupt_that_is_lost_comes_again():
    child = subprocess.Popen(
        [sys.executable, "-c", SWALLOWS], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert child.stdout.readline() == "ready\n"
        child.send_signal(signal.SIGINT)
        _, complained = child.communicate(timeout=20)
    finally:
        child.kill()
    assert child.returncode == 130
    assert complained == "avis: interrupted; no partial results were written\n"


def test_public_names_load_on_first_use():
    assert set(avis_ctrl.__all__) >= {
        "hinfsyn",
        "musyn",
        "mu",
        "mu_peak",
        "worst_case_gain",
        "RealScalar",
        "ComplexScalar",
        "ComplexFull",
        "StateSpace",
    }
    assert all(callable(getattr(avis_ctrl, name)) for name in set(avis_ctrl.__all__) - {"__version__", "plot"})
    with pytest.raises(AttributeError, match="no attribute 'musin'"):
        avis_ctrl.musin  # noqa: B018
