"""Columns that are exchanged, and signs that contradict each other: told before anything is named.

A mass is positive. Where the model fits with the input's sign turned, or with input and output exchanged, and not as
the columns are, the columns are wrong and not the model.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.single_axis.settings import SETTINGS


def require_oriented(fitted: Callable[[np.ndarray, np.ndarray], tuple[float, bool]], u: np.ndarray, y: np.ndarray,
                     roles: str) -> None:
    """Refuse exchanged columns and a flipped sign.

    fitted : input and output (n,) to the part of the response that the base model leaves, and whether its mass (and
    stiffness) is positive; (1.0, False) where none fits. roles : names of the columns.

    Raises
    ------
    InputError : as above.
    """
    left, positive = fitted(u, y)
    if positive and left < SETTINGS.no_model:
        return
    turned, sensible = fitted(-u, y)
    if sensible and turned < SETTINGS.no_model:
        raise InputError("expected a positive mass: with the input's sign turned the model fits "
                         f"({100 * turned:.2g} % are left), so that the sign of one column looks flipped; give it a "
                         "scale of -1", field=roles)
    swapped, sensible = fitted(y, u)
    if sensible and swapped < SETTINGS.much_better * min(left, 1.0) and swapped < SETTINGS.no_model:
        raise InputError(f"the model leaves {100 * left:.3g} % of these columns and {100 * swapped:.2g} % with input "
                         "and output exchanged: the columns look exchanged", field=roles)
