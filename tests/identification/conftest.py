"""The table that most tests of identification use."""

import pytest

from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.avis import AvisTable


@pytest.fixture(scope="session")
def avis() -> AvisTable:
    return load_rig("avis")
