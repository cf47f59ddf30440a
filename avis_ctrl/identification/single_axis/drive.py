"""A one-axis drive with friction: F = M a + Fv v + Fc sign(v) + offset.

Inverse dynamic identification (Gautier, 1997; Janot, Gautier and Brunot, "Data set and reference models of EMPS",
2019): the position is filtered without phase lag and differentiated, both sides of the equation pass the same low-pass
filter (parallel filter), and a linear regression follows. In a closed loop the noise of the position reaches the force
and biases least squares. The reference is free of noise; its derivatives, or those of the loop simulated with the
current parameters, serve as instruments (Janot, Vandanjon and Gautier, IEEE T-CST 22 (2014) 132).
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from scipy import signal

from avis_ctrl.errors import InputError
from avis_ctrl.identification.single_axis.fit import SingleAxisFit, regression

Coulomb = Literal["symmetric", "asymmetric", "none"]


def fit_drive(
    time: np.ndarray,
    position: np.ndarray,
    force: np.ndarray,
    cutoff_Hz: float = 60.0,
    coulomb: Coulomb = "symmetric",
    offset: bool = True,
    reference: np.ndarray | None = None,
) -> SingleAxisFit:
    """Mass, viscous and Coulomb friction and offset of a drive.

    Parameters
    ----------
    time : (n,) s, uniform. position : (n,) m. force : (n,) N.
    cutoff_Hz : of the fourth-order Butterworth filter, run forward and backward.
    coulomb : "asymmetric" has separate viscous and Coulomb friction for each direction and no separate offset, because
        a constant force is half the difference of the two Coulomb frictions wherever the drive moves; "none" omits
        Coulomb friction.
    reference : (n,) m of a closed loop; its derivatives are the instruments. Without it, least squares.

    Raises
    ------
    InputError : a record too short, a cutoff at or above half the sample rate.
    """
    if coulomb not in get_args(Coulomb):
        raise InputError(f"expected one of {', '.join(get_args(Coulomb))}", field="coulomb", value=coulomb)
    if len(time) < 32:
        raise InputError("expected at least 32 samples", field="samples", value=len(time))
    rate = float((len(time) - 1) / (time[-1] - time[0]))
    if not 0 < cutoff_Hz < rate / 2:
        raise InputError(f"expected a cutoff between 0 and {rate / 2:g} Hz", field="cutoff_Hz", value=cutoff_Hz)
    sections = signal.butter(4, cutoff_Hz / (rate / 2), output="sos")
    units, X = _columns(position, rate, sections, coulomb, offset)
    Z = None if reference is None else _columns(reference, rate, sections, coulomb, offset)[1]
    y = signal.sosfiltfilt(sections, force)
    # Samples of the filter's transient at each end.
    edge = int(np.ceil(2 * rate / cutoff_Hz))
    if len(y) <= 4 * edge:
        raise InputError(f"expected more than {4 * edge / rate:g} s for this cutoff", field="samples", value=len(y))
    inside = slice(edge, -edge)
    how = "least squares" if Z is None else "instruments from the reference"
    model = f"F = M a + Fv v, Coulomb friction: {coulomb} ({how}, filtered to {cutoff_Hz:g} Hz)"
    return regression(model, units, X[inside], y[inside], time[inside], None if Z is None else Z[inside])


def _columns(
    position: np.ndarray, rate: float, sections: np.ndarray, coulomb: str, offset: bool
) -> tuple[dict[str, str], np.ndarray]:
    """Units by name and columns (n, p) of the inverse dynamic model after the parallel filter."""
    q = signal.sosfiltfilt(sections, position)
    v = np.gradient(q, 1 / rate)
    a = np.empty_like(q)
    a[1:-1] = (q[2:] - 2 * q[1:-1] + q[:-2]) * rate**2
    a[0], a[-1] = a[1], a[-2]
    sign = np.sign(v)
    found: list[tuple[str, str, np.ndarray]] = [("M", "kg", a)]
    if coulomb == "asymmetric":
        ahead, back = v > 0, v < 0
        found += [
            ("Fv_ahead", "N s/m", v * ahead),
            ("Fv_back", "N s/m", v * back),
            ("Fc_ahead", "N", signal.sosfiltfilt(sections, 1.0 * ahead)),
            ("Fc_back", "N", signal.sosfiltfilt(sections, -1.0 * back)),
        ]
    else:
        found.append(("Fv", "N s/m", v))
        if coulomb == "symmetric":
            found.append(("Fc", "N", signal.sosfiltfilt(sections, sign)))
        if offset:
            found.append(("offset", "N", np.ones_like(v)))
    return {name: unit for name, unit, _ in found}, np.column_stack([column for *_, column in found])
