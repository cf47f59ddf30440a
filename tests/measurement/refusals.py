"""Files that are refused, for the tests of the formats."""

from __future__ import annotations

import pytest

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.formats import read_measurements


def refused(message, path, *columns, **hints):
    """The one line that ends the reading: it begins with the file and matches the message (None: any)."""
    with pytest.raises(InputError, match=message) as caught:
        read_measurements(path, *columns, **hints)
    said = str(caught.value)
    assert said.startswith((f"{path}: ", f"{path}/")) and "\n" not in said
    return said
