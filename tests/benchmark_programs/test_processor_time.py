"""What a process costs: against what it does."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from benchmarks.processor_time import cost_of  # noqa: E402

WORK = """
import os, sys, time
data = bytearray(60_000_000)
while time.process_time() < 0.5:
    pass
print(os.environ["PYTHONPATH"], os.getcwd())
sys.exit(3)
"""


def test_seconds_memory_and_code_of_a_process(tmp_path):
    cost = cost_of([WORK], tmp_path, tmp_path / "log.txt")
    assert cost.code == 3
    assert 0.5 <= cost.seconds < 5 and 57 < cost.memory_MB < 500
    assert (tmp_path / "log.txt").read_text().split() == [str(tmp_path)] * 2


def test_children_of_the_process_count(tmp_path):
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {WORK!r}])"
    assert cost_of([parent], tmp_path, tmp_path / "log.txt").seconds >= 0.5
