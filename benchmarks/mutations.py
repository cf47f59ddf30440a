"""Do the tests notice? One-place changes of the code, drawn at random, each against the tests of its folder.

    .venv/bin/python -m benchmarks.mutations --count 200 --seed 1 --out mutations.jsonl
    .venv/bin/python -m benchmarks.mutations --report mutations.jsonl

A change is an arithmetic operator, a comparison, a sign or a condition replaced by cosmic-ray. It is made
in a copy of the tree. A test that fails, and a run that takes several times as long as the unchanged one, has noticed
it. Finished changes are one line each in the file, and are not run again.
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
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("robust", "uncertainty", "rigs", "identification", "simulation", "measurement")
# One replacement a kind of place: an operator by its opposite, a comparison by its neighbour or its negation.
OPERATORS = (*(f"ReplaceBinaryOperator_{pair}" for pair in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Pow_Mul",
                                                              "FloorDiv_Mul", "Mod_Mul")),
             *(f"ReplaceComparisonOperator_{pair}" for pair in (
                 "Lt_GtE", "Lt_LtE", "LtE_Gt", "LtE_Lt", "Gt_LtE", "Gt_GtE", "GtE_Lt", "GtE_Gt", "Eq_NotEq", "NotEq_Eq",
                 "Is_IsNot", "IsNot_Is")),
             "ReplaceUnaryOperator_Delete_USub", "ReplaceUnaryOperator_Delete_Not", "AddNot", "ReplaceAndWithOr",
             "ReplaceOrWithAnd")
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


def changed(path: Path, operator: str, occurrence: int) -> tuple[str, str]:
    """The file with one place changed, and the line before and after."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    before = path.read_text()
    after = mutate_code(before, get_operator(f"core/{operator}")(), occurrence)
    assert after is not None and after != before
    lines = zip(before.splitlines(), after.splitlines(), strict=False)
    return after, next((f"{a.strip()}  ->  {b.strip()}" for a, b in lines if a != b), "")


def tests_run(tree: Path, folder: str, limit_s: float) -> tuple[bool, float, str]:
    """(a test failed, seconds, the first that did) of a folder's tests in a tree."""
    began = time.monotonic()
    single = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")}
    pytest = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider"]
    try:
        done = subprocess.run([*pytest, f"tests/{folder}"], cwd=tree, capture_output=True, text=True, timeout=limit_s,
                              env={**os.environ, **single, "PYTHONPATH": str(tree)})
    except subprocess.TimeoutExpired:
        return True, time.monotonic() - began, "took too long"
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.M)
    return done.returncode != 0, time.monotonic() - began, failed.group(1) if failed else ""


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
        unchanged = {}
        for folder in sorted({one[0].split("/")[1] for one in todo}):
            failed, seconds, name = tests_run(trees[0], folder, 3600.0)
            if failed:
                raise SystemExit(f"the tests of {folder} fail without a change: {name}")
            unchanged[folder] = seconds

        def one(change: tuple[str, str, int]) -> None:
            file, operator, occurrence = change
            tree, folder = trees.pop(), file.split("/")[1]
            path = tree / file
            before = path.read_text()
            try:
                after, line = changed(path, operator, occurrence)
                path.write_text(after)
                noticed, seconds, by = tests_run(tree, folder, SLOWER * unchanged[folder] + 60.0)
            finally:
                path.write_text(before)
                trees.append(tree)
            row = {"file": file, "operator": operator, "occurrence": occurrence, "line": line, "noticed": noticed,
                   "by": by, "seconds": seconds}
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
