"""Systems of other libraries, numbers and matrices taken as systems of this one, and responses taken from either.

python-control's StateSpace, TransferFunction and FRD are known by what they offer, so that the library is not imported
(which takes two seconds) before one of its systems exists.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.statespace import StateSpace, operand


def as_system(given: Any, field: str = "system") -> StateSpace:
    """A StateSpace from ours, python-control's StateSpace or TransferFunction, a number or a matrix.

    Raises
    ------
    InputError : anything else, an improper transfer function, a frequency response (which has no states).
    """
    if hasattr(given, "frdata"):
        raise InputError("expected a system with states; a frequency response has none", field=field)
    if hasattr(given, "system") and callable(given.system):
        return given.system()
    try:
        found = operand(np.asarray(given, float) if isinstance(given, list) else given)
    except (TypeError, ValueError) as error:
        raise InputError(f"expected a proper system: {' '.join(str(error).split())}", field=field) from None
    if found is not None:
        return found
    raise InputError("expected a StateSpace (avis_ctrl or python-control), a TransferFunction, a number or a matrix",
                     field=field, value=type(given).__name__)


def is_response(given: Any) -> bool:
    """Whether it is python-control's FRD: values at frequencies and nothing between them."""
    return hasattr(given, "frdata")


def frequencies_of(given: Any) -> np.ndarray:
    """(n,) frequencies [rad/s] of a python-control FRD."""
    return np.asarray(given.omega, float)


def response_of(given: Any, omega: np.ndarray, field: str = "system") -> np.ndarray:
    """(n, n_y, n_u) response at the frequencies omega (n,) [rad/s] of a system, or of an FRD that has them.

    Raises
    ------
    InputError : frequencies that an FRD does not have; as `as_system`.
    """
    omega = np.atleast_1d(np.asarray(omega, float))
    if not is_response(given):
        return as_system(given, field).frequency_response(omega)
    known = frequencies_of(given)
    place = np.array([int(np.argmin(np.abs(known - w))) for w in omega])
    if np.any(np.abs(known[place] - omega) > 1e-9 * np.abs(omega)):
        raise InputError("expected the frequencies of the frequency response", field=f"{field}: omega")
    return np.moveaxis(np.asarray(given.frdata), -1, 0)[place]


def plot_frequencies(given: Any, points: int = 400) -> np.ndarray:
    """(n,) frequencies [rad/s] that show a system: two decades about its poles, denser at resonances; those of an FRD.

    Up to the Nyquist frequency for a sampled system.
    """
    if is_response(given):
        return frequencies_of(given)
    system = as_system(given)
    poles = system.poles()
    if system.dt:
        with np.errstate(divide="ignore"):
            poles = np.log(poles[np.abs(poles) > 0]) / system.dt
    size = np.abs(poles)
    size = size[size > 1e-9 * np.max(size, initial=0.0)]
    low, high = (0.01, 100.0) if not size.size else (size.min() / 10, size.max() * 10)
    if system.dt:
        high = np.pi / system.dt
        low = min(low, high / 1e3)
    grid = np.geomspace(low, high, points)
    near = []
    for p in poles[np.abs(poles.imag) > 0.9 * np.abs(poles)]:
        damping = abs(p.real) / abs(p)
        # A pole on the axis has no peak to show: keep away from it.
        steps = np.linspace(-5, 5, 21) * damping if damping > 1e-7 else np.linspace(-5, 5, 20) * 1e-3
        near.append(abs(p.imag) * np.exp(steps))
    every = np.unique(np.concatenate([grid, *near]))
    return every[(every >= low) & (every <= high)]
