"""The runner of blind campaigns, with a stand-in truth and a stand-in finder that fail in every way they can."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from avis_ctrl.errors import InputError  # noqa: E402
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader  # noqa: E402
from benchmarks.blind.case import nrmse, plain, stripped  # noqa: E402
from benchmarks.blind.lines import Settings, read_lines  # noqa: E402
from benchmarks.blind.run import main, run  # noqa: E402

# Even seeds hide an effect; what the finder sees is only the first sample, which says what it is to do.
TRUTH = """
from types import SimpleNamespace as Thing
import numpy as np
from avis_ctrl.measurement.campaign import Campaign, Record, RecordHeader

def draw_case(seed, kind=None, effect=None, strength=None, duration_s=60.0):
    if seed == 90:
        raise ValueError("no such case")
    effects = () if seed % 2 else (Thing(name="sensor_gain", location="Sz2", strength="clear",
                                         parameters={"gain": np.float64(1.05)}, details={}),)
    return Thing(seed=seed, kind="one" if effects else "none", effects=effects, excitation="noise",
                 floor_recorded=False, duration_s=duration_s)

def simulate_case(case, unseen=False):
    header = RecordHeader(f"secret {case.seed}", 1000.0, round(1000 * case.duration_s), ("u",), ("y",), "noise")
    y = np.ones((header.samples, 1))
    y[:2, 0] = case.seed, -1
    return Campaign("avis", (Record(header, 0 * y, y),), source=f"seed {case.seed}", notes=("sensor_gain",))

def relative_change(case):
    return 0.1
"""
FINDER = """
import os, time
from dataclasses import dataclass

@dataclass
class GapOptions:
    pass

class Finding:
    def __init__(self, seed):
        self.seed = seed
    def to_json(self):
        answer = {"format": "avis-gap", "version": 1, "verdict": "none", "effects": [], "gap": [], "where": [],
                  "next_experiment": None, "seconds": 0.1}
        return answer | ({"seconds": float("nan")} if self.seed == 4 else {"verdict": "sure"} if self.seed == 5 else {})

def find_gap(campaign, rig, options):
    assert rig.name == "avis" and os.environ["OPENBLAS_NUM_THREADS"] == "1"
    assert campaign.source == "" and campaign.notes == () and campaign.records[0].header.name == "00"
    seed = int(campaign.records[0].y[0, 0])
    if seed == 2:
        raise ValueError("a reason")
    if seed == 3:
        os._exit(7)
    if seed in (6, 91):
        time.sleep(300)
    if seed == 7:
        held = bytearray(300_000_000)
    return Finding(seed)

def predict(finding, campaign):
    for record in campaign.records:
        yield 0 * record.y, record.y
"""


@pytest.fixture
def modules(tmp_path, monkeypatch):
    (tmp_path / "standin_truth.py").write_text(TRUTH)
    (tmp_path / "standin_finder.py").write_text(FINDER)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.setenv(name, "1")
    return {"truth": "standin_truth", "finder": "standin_finder"}


def settings(**changed) -> Settings:
    return Settings(**({"duration_s": 0.1, "jobs": 2} | changed))


def test_every_way_to_fail_is_a_line(modules, tmp_path):
    out, said = tmp_path / "b.jsonl", []
    failed = run(settings(), [1, 2, 3, 4, 5, 6, 90], out, limit_s=4.0, say=said.append, **modules)
    assert failed == [90] and any("no such case" in text for text in said)
    lines = {line.seed: line for line in read_lines(out)}
    assert sorted(lines) == [1, 2, 3, 4, 5, 6]
    assert lines[1].crash is None and lines[1].answer.verdict == "none" and lines[1].hidden == []
    for seed, text in (
        (2, "ValueError: a reason"),
        (3, "code 7"),
        (4, "not JSON compliant"),
        (5, "contract"),
        (6, "no answer within 4 s"),
    ):
        assert lines[seed].answer is None and text in lines[seed].crash, seed
    assert lines[2].hidden[0].parameters == {"gain": 1.05}
    assert lines[2].seconds > 0 and lines[3].seconds is None
    assert any("7/7 cases" in text and "min left" in text for text in said)
    assert not any("sensor_gain" in text for text in said if "cases," in text)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the peak is restarted through /proc")
def test_memory_is_the_case_s_own(modules, tmp_path):
    """The worker of seed 7 holds 300 MB more than others; the one after it does not inherit them."""
    run(settings(jobs=1), [7, 9], tmp_path / "b.jsonl", **modules)
    held, other = (line.memory_MB for line in read_lines(tmp_path / "b.jsonl"))
    assert 280 < held - other < 320


def test_resume_skips_what_is_done_and_cuts_what_is_not(modules, tmp_path):
    out = tmp_path / "b.jsonl"
    run(settings(), [1, 9], out, **modules)
    before = out.read_text()
    out.write_text(before + '{"seed": 11, "ki')
    with pytest.raises(InputError, match="--resume"):
        run(settings(), [1, 9, 11], out, **modules)
    with pytest.raises(InputError, match="campaign that the file holds"):
        run(settings(duration_s=0.2), [11], out, resume=True, **modules)
    run(settings(jobs=1), [1, 9, 11], out, resume=True, **modules)
    assert out.read_text().startswith(before)
    assert [line.seed for line in read_lines(out)] == [1, 9, 11]


def test_unseen_campaigns_are_predicted(modules, tmp_path):
    """Records are a spike beside ones: the updated model is perfect, the baseline says zero."""
    run(settings(unseen=True), [1], tmp_path / "b.jsonl", **modules)
    (line,) = read_lines(tmp_path / "b.jsonl")
    y = np.ones(100)
    y[:2] = 1, -1
    assert line.unseen.baseline == pytest.approx(np.sqrt(np.mean(y**2) / y.var()))
    assert line.unseen.updated == 0.0 and line.unseen_error is None


def command(tmp_path, *words):
    where = os.environ | {"PYTHONPATH": str(tmp_path)}
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "benchmarks.blind",
            "--truth",
            "standin_truth",
            "--finder",
            "standin_finder",
            "--duration",
            "0.1",
            "--out",
            str(tmp_path / "b.jsonl"),
            *words,
        ],
        cwd=ROOT,
        env=where,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="finds workers in /proc")
@pytest.mark.slow
def test_a_kill_leaves_whole_lines_and_no_worker(modules, tmp_path):
    """Seed 91 sleeps: killed while it does, the other job's lines are there, and its worker ends by itself."""
    running = command(tmp_path, "--seed", "91", "--cases", "5")
    out = tmp_path / "b.jsonl"
    for _ in range(300):
        if out.exists() and out.read_text().count("\n") >= 4:
            break
        time.sleep(0.1)
    workers = children(running.pid)
    assert workers
    running.send_signal(signal.SIGKILL)
    running.communicate()
    assert [line.seed for line in read_lines(out)] == [92, 93, 94, 95]
    for _ in range(100):
        if not any(alive(pid) for pid in workers):
            break
        time.sleep(0.1)
    assert not any(alive(pid) for pid in workers)


def children(pid: int) -> list[int]:
    return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")")[1].split()[0] != "Z"
    except OSError:
        return False


def test_modules_are_checked_before_hours_are_spent(modules, tmp_path, capsys):
    for words, said in (
        (["--truth", "absent_module"], "expected a module that loads"),
        (["--truth", "standin_finder"], "expected draw_case, simulate_case, relative_change"),
        (["--truth", "standin_truth", "--out", str(tmp_path / "no" / "b.jsonl")], "a folder"),
    ):
        with pytest.raises(SystemExit) as caught:
            main(["--finder", "standin_finder", "--out", str(tmp_path / "b.jsonl"), *words])
        error = capsys.readouterr().err
        assert caught.value.code == 2 and said in error and "Traceback" not in error
    with pytest.raises(SystemExit) as caught:
        main(["--out", str(tmp_path / "b.jsonl"), "--cases", "0"])
    assert caught.value.code == 2 and "--cases 0" in capsys.readouterr().err


def test_a_campaign_is_stripped_of_all_words():
    header = RecordHeader("sensor_gain", 10.0, 3, ("u",), ("y",), "noise", start_s=5.0)
    found = stripped(Campaign("avis", (Record(header, np.zeros((3, 1)), np.ones((3, 1))),), "gross", ("clear",)))
    assert "sensor_gain" not in repr(found.records[0].header) and (found.source, found.notes) == ("", ())
    assert found.records[0].header.start_s == 5.0


def test_nrmse_weighs_channels_alike():
    """Errors of 1 % and 2 % of the deviation in channels of very different size: the root of the mean square."""
    y = np.outer([1.0, -1.0, 1.0, -1.0], [1.0, 1000.0])
    assert nrmse([y], [y * [1.01, 1.02]]) == pytest.approx(np.sqrt((0.01**2 + 0.02**2) / 2))
    with pytest.raises(ValueError, match="shape"):
        nrmse([y], [y[:2]])


def test_truths_are_written_as_json_has_them():
    assert plain({"a": np.arange(2), "b": np.float64(0.5), "c": (np.bool_(True), None), "d": float("inf")}) == {
        "a": [0, 1],
        "b": 0.5,
        "c": [True, None],
        "d": "inf",
    }


HOLDER = """
import multiprocessing, time
from concurrent.futures import ProcessPoolExecutor
import numpy as np
from benchmarks.blind.case import PeakMemory, held_MB

def more():
    own = np.ones(10_000_000)  # 80 MB
    time.sleep(0.5)
    return int(own.sum())

memory, before = PeakMemory(), held_MB()
shared = np.ones(20_000_000)  # 160 MB, in both processes, but once in memory
with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool:
    assert pool.submit(more).result() == 10_000_000
print(memory.end_MB() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="proportional set sizes are Linux's")
def test_memory_of_parent_and_child_counts_shared_pages_once():
    """In a process of its own, whose memory nobody else changes."""
    done = subprocess.run([sys.executable, "-c", HOLDER], cwd=ROOT, capture_output=True, text=True, check=True)
    assert 220 < float(done.stdout) < 300


def test_cases_as_points_of_a_sweep(modules, tmp_path, capsys):
    """The same lines as the runner's, but for what was measured; a truth that fails is a row that says why."""
    from avis_ctrl.sweep.local import on_this_machine
    from avis_ctrl.sweep.output import write_sweep
    from avis_ctrl.sweep.run import plan_sweep, run_sweep
    from benchmarks.blind import sweep

    out = tmp_path / "out"
    (out / "points").mkdir(parents=True)
    (tmp_path / "blind.toml").write_text(
        f'kind = "function"\nbase = "{ROOT}/benchmarks/blind/sweep.py:case"\n'
        + "".join(
            f'[[vary]]\nkey = "{key}"\nvalues = {values!r}\n'
            for key, values in {
                "seed": [1, 2, 8, 90],
                "duration_s": [0.1],
                **{name: [one] for name, one in modules.items()},
            }.items()
        )
    )
    found = run_sweep(plan_sweep(tmp_path / "blind.toml", out), lambda tasks: on_this_machine(tasks, 1))
    write_sweep(found, out)
    assert [row.status for row in found.rows] == ["done", "done", "done", "failed"]
    assert found.rows[3].message == "seed = 90: the truth failed: ValueError: no such case"
    assert [row.figures["named"] for row in found.rows[:3]] == ["", "crash", ""]
    sweep.main([str(out), "--out", str(tmp_path / "swept.jsonl")])
    measured = {"seconds", "cpu_seconds", "memory_MB", "simulation_seconds", "crash", "settings"}
    run(settings(jobs=1), [1, 2, 8], tmp_path / "run.jsonl", **modules)
    both = [
        [line.model_dump(exclude=measured) for line in read_lines(tmp_path / name)]
        for name in ("swept.jsonl", "run.jsonl")
    ]
    assert sorted(both[0], key=lambda line: line["seed"]) == sorted(both[1], key=lambda line: line["seed"])
    with pytest.raises(SystemExit) as stopped:
        sweep.main([str(tmp_path), "--out", str(tmp_path / "none.jsonl")])
    assert stopped.value.code == 2 and "expected the folder of a sweep" in capsys.readouterr().err
