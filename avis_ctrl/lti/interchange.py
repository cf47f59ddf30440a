"""Conversion of python-control systems, numbers and matrices to StateSpace, and frequency responses of all of them.

The StateSpace, TransferFunction and FRD of python-control are recognised by their attributes, so that the library is
not imported (which takes two seconds) unless one of its systems is used.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.statespace import StateSpace, operand


def as_system(given: Any, field: str = "system") -> StateSpace:
    """Convert a python-control StateSpace or TransferFunction, a number or a matrix to a StateSpace.

    A StateSpace is returned unchanged; an UncertainSystem must have no uncertainty left. An object with a method
    `system` is replaced by the result of that method.

    Raises
    ------
    InputError : any other type, an improper transfer function, a frequency response (which has no states).
    """
    if hasattr(given, "frdata"):
        raise InputError("expected a system with states; a frequency response has none", field=field)
    if hasattr(given, "system") and callable(given.system):
        return given.system()
    if getattr(given, "uncertain", None) == {}:
        given = given.nominal
    try:
        found = operand(np.asarray(given, float) if isinstance(given, list) else given)
    except (TypeError, ValueError) as error:
        raise InputError(f"expected a proper system: {' '.join(str(error).split())}", field=field) from None
    if found is not None:
        return found
    kind = type(given).__name__
    raise InputError(
        "expected a StateSpace (avis_ctrl or python-control), a TransferFunction, a real number or a real matrix"
        + ("; its nominal system is .nominal" if hasattr(given, "nominal") else ""),
        field=field,
        value=f"complex {kind}" if np.iscomplexobj(given) and kind != "complex" else kind,
    )


def is_response(given: Any) -> bool:
    """Whether `given` is a python-control FRD, defined only at its frequencies."""
    return hasattr(given, "frdata")


def frequencies_of(given: Any) -> np.ndarray:
    """(n,) frequencies [rad/s] of a python-control FRD."""
    return np.asarray(given.omega, float)


def response_of(given: Any, omega: np.ndarray, field: str = "system") -> np.ndarray:
    """(n, n_y, n_u) response of a system or an FRD at the frequencies omega (n,) [rad/s].

    Raises
    ------
    InputError : as in `as_system`, or frequencies that the FRD does not contain.
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
    """(n,) frequencies [rad/s] for a plot: one decade beyond the poles on both sides, denser at resonances.

    The grid of a sampled system ends at the Nyquist frequency. An FRD is plotted at its frequencies.
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
        # The response is infinite at a pole on the axis: keep away from it.
        steps = np.linspace(-5, 5, 21) * damping if damping > 1e-7 else np.linspace(-5, 5, 20) * 1e-3
        near.append(abs(p.imag) * np.exp(steps))
    every = np.unique(np.concatenate([grid, *near]))
    return every[(every >= low) & (every <= high)]
