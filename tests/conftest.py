"""Shared fixtures: measured data, seeded generators, one BLAS thread."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

# Every draw is seeded: the same commit tests the same cases. AVIS_EXPLORE=1 looks for new ones.
settings.register_profile("seeded", derandomize=True)
settings.load_profile("default" if os.environ.get("AVIS_EXPLORE") else "seeded")

SHARED = Path(__file__).resolve().parents[2] / "shared"
# Tests of what stands beside the package and changes only with it: simulators of tables with hidden effects, written
# apart from it, and the programs in benchmarks. They take minutes.
APART = [Path(__file__).parent / name for name in ("truth", "own_tables", "benchmark_programs")]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if any(folder in item.path.parents for folder in APART):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session", autouse=True)
def one_blas_thread():
    with threadpool_limits(1):
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260101)


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of measured data (AVIS_DATA, or ../shared/data); the test is skipped where it is absent."""
    folder = Path(os.environ.get("AVIS_DATA") or SHARED / "data")
    if not folder.is_dir():
        pytest.skip(f"measured data absent: {folder} (set AVIS_DATA)")
    return folder


@pytest.fixture(scope="session")
def shared() -> Path:
    if not SHARED.is_dir():
        pytest.skip("the shared folder with rig numbers and papers is absent")
    return SHARED
