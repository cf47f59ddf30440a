"""Second-order seismometer identified from sine amplitudes and phases, driven by its calibration coil or the ground.

A force F moves the mass m on the suspension omega_0, zeta by x relative to the frame, and the coil gives the voltage V:

    x/F = (1/m) / (s^2 + 2 zeta omega_0 s + omega_0^2)        V = S s x
    V/v_ground = S s^2 / (s^2 + 2 zeta omega_0 s + omega_0^2)   (Wielandt, IASPEI NMSOP chapter 5; sign of S free)

The coil, displacement and ground responses thus share one denominator, with the numerators s^1, s^0 and s^2. The
displacement sensor may have a delay delay_s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, least_squares

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.identification.single_axis.fit import SingleAxisFit, concluded, slopes

POWER = {"coil": 1, "displacement": 0, "ground": 2}
UNITS = {
    "corner_Hz": "Hz",
    "damping": "",
    "force_gain": "m/s^2 a unit of drive",
    "sensitivity": "V s/m",
    "gain": "V/s a unit of drive",
    "drive_delay_s": "s",
    "delay_s": "s",
}


@dataclass(frozen=True)
class SeismometerSettings:
    """correlated_lines : frequencies over which scores count as correlated, because misfits of neighbours are
    similar; a stepped sine has too few frequencies for more."""

    correlated_lines: int = 2


SETTINGS = SeismometerSettings()


@dataclass(frozen=True, eq=False)
class Responses:
    """Measured responses at n frequencies.

    value : by kind ("coil" V over drive, "displacement" m over drive, "ground" V over m/s), (n,) complex.
    variance : by kind, (n,) E|error|^2.
    """

    frequency_Hz: np.ndarray
    value: Mapping[str, np.ndarray]
    variance: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        n = len(self.frequency_Hz)
        if not self.value or not set(self.value) <= set(POWER) or ("ground" in self.value and len(self.value) > 1):
            raise InputError(
                "expected coil, displacement or both (driven by a force), or ground alone",
                field="responses",
                value=sorted(self.value),
            )
        for kind, H in self.value.items():
            size, variance = np.abs(H), self.variance[kind]
            if not np.all((size > 0) & np.isfinite(size) & (variance > 0) & np.isfinite(variance)):
                raise InputError("expected finite values with positive variances, none zero", field=kind)
        if n < 4 or not np.all(np.diff(self.frequency_Hz) > 0) or self.frequency_Hz[0] <= 0:
            raise InputError("expected at least four increasing, positive frequencies", field="frequency_Hz", value=n)

    def at(self, keep: np.ndarray) -> Responses:
        """The responses at some of the frequencies."""
        return Responses(
            self.frequency_Hz[keep],
            {kind: H[keep] for kind, H in self.value.items()},
            {kind: V[keep] for kind, V in self.variance.items()},
        )


def response(frequency_Hz: np.ndarray, names: tuple[str, ...], values: np.ndarray) -> dict[str, np.ndarray]:
    """The model's responses by kind, (n,) each, for parameters named as in a fit."""
    p = dict(zip(names, values, strict=True))
    s, w0 = 2j * np.pi * np.asarray(frequency_Hz, float), 2 * np.pi * p["corner_Hz"]
    D = s**2 + 2 * p["damping"] * w0 * s + w0**2
    late, driven = np.exp(-s * p.get("delay_s", 0.0)), np.exp(-s * p.get("drive_delay_s", 0.0))
    if "force_gain" in p:
        moved = p["force_gain"] / D * driven
        coil = {"coil": p["sensitivity"] * s * moved} if "sensitivity" in p else {}
        return {"displacement": moved * late} | coil
    return {"coil": p["gain"] * s / D * late} if "gain" in p else {"ground": p["sensitivity"] * s**2 / D * late}


def fit_seismometer(data: Responses, delay: bool = True) -> SingleAxisFit:
    """Fit corner frequency, damping ratio and gains.

    With coil and displacement: force_gain (m/s^2 per unit of drive), sensitivity (V s/m) and, with `delay`,
    drive_delay_s of both relative to the drive and delay_s of the displacement relative to the coil. With one channel:
    its gain, and delay_s relative to the drive.

    The noise of the responses is far smaller than the error of a linear model of a real instrument. Therefore a
    relative misfit r, equal at every frequency, is added to the noise such that chi-square per degree of freedom is
    one. The reported chi-square is relative to the noise alone. The standard deviations allow correlated misfits of
    neighbouring frequencies, and are at least those for independent misfits of size r.

    Raises
    ------
    ComputationError : no oscillator with positive corner frequency and damping fits the data.
    """
    begin = _start(data, delay)
    names, start, kinds = tuple(begin), np.array(list(begin.values())), list(data.value)
    scale = np.where(start == 0, 1e-3, np.abs(start))

    def misses(theta: np.ndarray, r: float) -> np.ndarray:
        model = response(data.frequency_Hz, names, theta)
        columns = [
            (data.value[kind] - model[kind]) / np.sqrt((data.variance[kind] + r**2 * np.abs(data.value[kind]) ** 2) / 2)
            for kind in kinds
        ]
        return np.stack([part for c in columns for part in (c.real, c.imag)], axis=1)

    def solved(r: float, begin: np.ndarray) -> np.ndarray:
        found = least_squares(
            lambda x: misses(x * scale, r).ravel(), begin / scale, x_scale="jac", xtol=1e-12, ftol=1e-12
        )
        return found.x * scale

    theta, r = _with_misfit(misses, solved, start)
    if not np.all(theta[:2] > 0):
        raise ComputationError(
            "no oscillator fits the responses",
            measured=f"corner {theta[0]:.3g} Hz, damping {theta[1]:.3g}",
            cause="channels that were exchanged, or frequencies on one side of the corner only",
            next_step="check which column is the drive and which the coil",
        )
    model = response(data.frequency_Hz, names, theta)
    measured, predicted = (np.column_stack([values[kind] for kind in kinds]) for values in (data.value, model))
    e = misses(theta, r)
    # With few frequencies the misfits may cancel in a parameter by chance, which must not reduce its variance.
    return concluded(
        f"second-order seismometer, {' and '.join(kinds)}",
        {name: UNITS[name] for name in names},
        theta,
        e,
        slopes(lambda x: misses(x, r), theta, scale),
        len(names),
        (data.frequency_Hz, measured, predicted),
        lags=SETTINGS.correlated_lines,
        relative=(measured - predicted) / np.abs(measured),
        method=f"a model error of {100 * r:.2g} % at each frequency is added to the noise; neighbouring frequencies "
        f"are correlated (Newey-West, {min(SETTINGS.correlated_lines, len(e) // 4)} lags)",
        given_chi2=float(np.sum(misses(theta, 0.0) ** 2)),
        notes=(f"columns of the figure data: {', '.join(kinds)}",),
    )


def _with_misfit(
    misses: Callable[[np.ndarray, float], np.ndarray],
    solved: Callable[[float, np.ndarray], np.ndarray],
    start: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Estimate and relative misfit r for chi2/dof = 1; r = 0 if the noise alone explains the data."""
    theta = solved(0.03, start)
    dof = misses(theta, 0.0).size - len(theta)
    for _ in range(20):

        def excess(log_r: float, at: np.ndarray = theta) -> float:
            return float(np.log(np.sum(misses(at, np.exp(log_r)) ** 2) / dof))

        if excess(np.log(1e-9)) <= 0:
            return solved(0.0, theta), 0.0
        r = float(np.exp(brentq(excess, np.log(1e-9), np.log(1e3))))
        new = solved(r, theta)
        done = np.allclose(new, theta, rtol=1e-9, atol=0)
        theta = new
        if done:
            break
    return theta, r


def _start(data: Responses, delay: bool) -> dict[str, float]:
    """Linear estimate by name: H (s^2 + a1 s + a0) = b s^p is linear in a1, a0 and b (Levy, 1959)."""
    kind = next(iter(data.value))
    H, s = data.value[kind], 2j * np.pi * data.frequency_Hz
    s0 = float(np.sqrt(np.abs(s[0] * s[-1])))
    A = np.column_stack([H * s * s0, H * s0**2, -(s ** POWER[kind]) * s0 ** (2 - POWER[kind])])
    weight = 1 / (np.abs(H) * (np.abs(s) ** 2 + s0**2))
    A, y = A * weight[:, None], -H * s**2 * weight
    size = np.maximum(np.linalg.norm(A, axis=0), np.finfo(float).tiny)
    a1, a0, b = (
        np.linalg.lstsq(np.vstack([(A / size).real, (A / size).imag]), np.concatenate([y.real, y.imag]), rcond=None)[0]
        / size
    )
    w0 = s0 * np.sqrt(a0) if a0 > 0 else s0
    zeta = a1 * s0 / (2 * w0) if a1 > 0 else 0.5
    b *= s0 ** (2 - POWER[kind])
    start = {"corner_Hz": w0 / (2 * np.pi), "damping": zeta}
    if "ground" in data.value:
        start["sensitivity"] = b
    elif "displacement" in data.value:
        D = s**2 + 2 * zeta * w0 * s + w0**2
        start["force_gain"] = float(np.median((data.value["displacement"] * D).real))
        if "coil" in data.value:
            start["sensitivity"] = float(np.median((data.value["coil"] / data.value["displacement"] / s).real))
    else:
        start["gain"] = b
    late = (["drive_delay_s"] if len(data.value) > 1 else []) + ["delay_s"]
    return start | dict.fromkeys(late if delay else [], 0.0)
