"""Shared fixtures: measured data, a seeded generator, one BLAS thread."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

SHARED = Path(__file__).resolve().parents[2] / "shared"


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
    folder = Path(os.environ.get("AVIS_DATA", SHARED / "data"))
    if not folder.is_dir():
        pytest.skip(f"measured data absent: {folder} (set AVIS_DATA)")
    return folder


@pytest.fixture(scope="session")
def shared() -> Path:
    if not SHARED.is_dir():
        pytest.skip("the shared folder with rig numbers and papers is absent")
    return SHARED
