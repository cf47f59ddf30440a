"""Do the tests notice? One-place changes of the code, drawn at random, each against the tests of its folder.

    .venv/bin/python -m benchmarks.mutations --count 200 --seed 1 --out mutations.jsonl
    .venv/bin/python -m benchmarks.mutations --report mutations.jsonl

A change is an arithmetic operator, a comparison, a sign or a condition replaced by cosmic-ray, made in a copy of the
tree. It counts as noticed where a test fails, or where the run takes several times as long as on the unchanged code.
Only the test files of the folder that execute the changed line are run, the tests that do so first; where no test is
known to execute it (a line of a class body, or compiled by numba), all tests of the folder. Finished changes are one
line each in the file, and are not run again.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("robust", "uncertainty", "rigs", "identification", "simulation", "measurement")
# One replacement a kind of place: an operator by its opposite, a comparison by its neighbour or its negation.
OPERATORS = (
    *(
        f"ReplaceBinaryOperator_{pair}"
        for pair in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Pow_Mul", "FloorDiv_Mul", "Mod_Mul")
    ),
    *(
        f"ReplaceComparisonOperator_{pair}"
        for pair in (
            "Lt_GtE",
            "Lt_LtE",
            "LtE_Gt",
            "LtE_Lt",
            "Gt_LtE",
            "Gt_GtE",
            "GtE_Lt",
            "GtE_Gt",
            "Eq_NotEq",
            "NotEq_Eq",
            "Is_IsNot",
            "IsNot_Is",
        )
    ),
    "ReplaceUnaryOperator_Delete_USub",
    "ReplaceUnaryOperator_Delete_Not",
    "AddNot",
    "ReplaceAndWithOr",
    "ReplaceOrWithAnd",
)
SLOWER = 4.0  # times the unchanged run, and a minute: an endless loop is noticed, a busy machine is not


def drawn(count: int, seed: int) -> list[tuple[str, str, int]]:
    """(file, operator, occurrence) of random changes, every place alike likely."""
    from cosmic_ray.ast import ast_nodes, get_ast_from_path
    from cosmic_ray.plugins import get_operator

    places: list[tuple[str, str, int]] = []
    for folder in FOLDERS:
        for path in sorted((ROOT / "avis_ctrl" / folder).rglob("*.py")):
            nodes = list(ast_nodes(get_ast_from_path(path)))
            for name in OPERATORS:
                operator = get_operator(f"core/{name}")()
                hits = sum(len(list(operator.mutation_positions(node))) for node in nodes)
                places += [(str(path.relative_to(ROOT)), name, k) for k in range(hits)]
    return random.Random(seed).sample(places, count)


def changed(path: Path, operator: str, occurrence: int) -> tuple[str, int, str]:
    """The file with one place changed, the number of the line, and the line before and after."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    before = path.read_text()
    after = mutate_code(before, get_operator(f"core/{operator}")(), occurrence)
    assert after is not None and after != before
    lines = enumerate(zip(before.splitlines(), after.splitlines(), strict=False), start=1)
    number, (was, now) = next((number, pair) for number, pair in lines if pair[0] != pair[1])
    return after, number, f"{was.strip()}  ->  {now.strip()}"


@dataclass(frozen=True)
class FolderTests:
    """The tests of a folder: {name: seconds} of each, and which tests execute a line, {file: {line: names}}."""

    folder: str
    seconds: dict[str, float]
    by_line: dict[str, dict[int, set[str]]]

    def of(self, file: str, line: int) -> list[str]:
        """The tests to run for a changed line: those that execute it, the quickest first, then the rest of their files.

        Whole files, because a shared fixture is executed in the set-up of only one of the tests that use it.
        """
        known = self.by_line.get(file, {}).get(line, set()) & set(self.seconds)
        if not known:
            return [f"tests/{self.folder}"]
        files = {name.split("::")[0] for name in known}
        rest = [name for name in self.seconds if name not in known and name.split("::")[0] in files]
        return [*sorted(known, key=self.seconds.__getitem__), *sorted(rest, key=self.seconds.__getitem__)]

    def whole_s(self, names: list[str]) -> float:
        """Seconds that these tests together take on the unchanged code."""
        return sum(
            self.seconds.values()
            if len(names) == 1 and "::" not in names[0]
            else (self.seconds[name] for name in names)
        )


def folder_tests(tree: Path, folder: str) -> FolderTests:
    """Runs a folder's tests once on the unchanged code, with coverage recorded for each test."""
    from coverage import CoverageData

    report, data = tree / "report.xml", tree / ".coverage"
    failed, said = pytest(
        tree,
        [f"tests/{folder}", f"--junitxml={report}", "--cov=avis_ctrl", "--cov-context=test", "--cov-report="],
        7200.0,
    )
    if failed:
        raise SystemExit(f"the tests of {folder} fail without a change: {said}")
    measured = CoverageData(str(data))
    measured.read()
    names = {context.rsplit("|", 1)[0] for context in measured.measured_contexts()} - {""}
    short = {}
    for case in ElementTree.parse(report).iter("testcase"):
        path = case.get("classname", "").replace(".", "/") + ".py"
        short[f"{path}::{case.get('name')}"] = float(case.get("time", 0.0))
    by_line = {}
    for file in measured.measured_files():
        lines = measured.contexts_by_lineno(file)
        by_line[str(Path(file).relative_to(tree))] = {
            line: {c.rsplit("|", 1)[0] for c in contexts} - {""} for line, contexts in lines.items()
        }
    return FolderTests(folder, {name: short.get(name, 0.0) for name in sorted(names)}, by_line)


def pytest(tree: Path, words: list[str], limit_s: float) -> tuple[bool, str]:
    """Whether a test failed in a run in a tree, and which failed first."""
    single = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")}
    (tree / "words").write_text("\n".join(words))
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider", "@words"]
    try:
        done = subprocess.run(
            command,
            cwd=tree,
            capture_output=True,
            text=True,
            timeout=limit_s,
            env={**os.environ, **single, "PYTHONPATH": str(tree)},
        )
    except subprocess.TimeoutExpired:
        return True, "took too long"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.M)
    return done.returncode != 0, failed.group(1) if failed else done.stdout[-500:] if done.returncode else ""


def copied(folder: Path) -> Path:
    """What the tests need of the repository, and the measured data beside it."""
    tree = folder / "tree"
    for name in ("avis_ctrl", "tests", "designs", "docs", "benchmarks"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "Makefile"):
        shutil.copy(ROOT / name, tree / name)
    if (shared := ROOT.parent / "shared").is_dir():
        (folder / "shared").symlink_to(shared)
    return tree


def run(count: int, seed: int, out: Path, jobs: int) -> None:
    """Make the changes that the file does not hold yet."""
    rows = [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []
    known = {(row["file"], row["operator"], row["occurrence"]) for row in rows}
    todo = [one for one in drawn(count, seed) if one not in known]
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(jobs) as pool:
        trees = []
        for k in range(jobs):
            (Path(scratch) / str(k)).mkdir()
            trees.append(copied(Path(scratch) / str(k)))
        folders = sorted({one[0].split("/")[1] for one in todo})
        unchanged = {folder: folder_tests(trees[0], folder) for folder in folders}

        def one(change: tuple[str, str, int]) -> None:
            file, operator, occurrence = change
            tree, folder = trees.pop(), file.split("/")[1]
            path = tree / file
            before = path.read_text()
            try:
                after, number, line = changed(path, operator, occurrence)
                path.write_text(after)
                began, names = time.monotonic(), unchanged[folder].of(file, number)
                noticed, by = pytest(tree, names, SLOWER * unchanged[folder].whole_s(names) + 60.0)
                seconds = time.monotonic() - began
            finally:
                path.write_text(before)
                trees.append(tree)
            row = {
                "file": file,
                "operator": operator,
                "occurrence": occurrence,
                "line": f"{number}: {line}",
                "noticed": noticed,
                "by": by,
                "tests": len(names),
                "seconds": seconds,
            }
            with out.open("a") as file_out:
                file_out.write(json.dumps(row) + "\n")
            print(f"{'noticed' if noticed else 'PASSED '} {file}: {line}", flush=True)

        list(pool.map(one, todo))


def report(out: Path) -> None:
    """Noticed and not, folder by folder, and the lines that nobody noticed."""
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    for folder in FOLDERS:
        of = [row for row in rows if row["file"].split("/")[1] == folder]
        if of:
            print(f"{folder:16s} {sum(row['noticed'] for row in of):4d} of {len(of):4d} noticed")
    print(f"{'all':16s} {sum(row['noticed'] for row in rows):4d} of {len(rows):4d} noticed")
    for row in rows:
        if not row["noticed"]:
            print(f"  {row['file']} ({row['operator']}): {row['line']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("mutations.jsonl"))
    parser.add_argument("--report", type=Path, default=None)
    given = parser.parse_args()
    if given.report is None:
        run(given.count, given.seed, given.out, given.jobs)
    report(given.report or given.out)


if __name__ == "__main__":
    main()
