"""The table that most tests of identification use."""

import pytest

from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.isolator_table import IsolatorTable


@pytest.fixture(scope="session")
def avis() -> IsolatorTable:
    return load_rig("avis")
