"""Fit of stable, minimum-phase rational functions to a given magnitude.

`magnitude_fit` minimises the squared error of the log magnitude (errors in dB have equal weight at any level).
`covering_fit` keeps the magnitude at or above a lower curve and minimises the largest excess over an upper curve (a
Chebyshev problem in dB). It is intended for weights that must not require less than was specified.

The unknowns are the logarithms of corner frequencies and dampings, so that every iterate is stable and minimum phase.
A fit of higher order starts from the fit two orders below, with a pair of factors added where the error is largest.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, minimize

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.rational import Rational, log_modulus

DB = 20.0 / np.log(10.0)


class MagnitudeFit(NamedTuple):
    """A fitted function with its r.m.s. and maximum error over the given points [dB]."""

    function: Rational
    error_rms_dB: float
    error_max_dB: float


@dataclass(frozen=True)
class _Layout:
    """Numbers of factors; the vector of unknowns is log gain, then log w and log zeta of pairs, log w of real roots."""

    zero_pairs: int
    pole_pairs: int
    real_zeros: int
    real_poles: int

    @property
    def size(self) -> int:
        return 1 + 2 * (self.zero_pairs + self.pole_pairs) + self.real_zeros + self.real_poles

    @property
    def order(self) -> int:
        return 2 * self.pole_pairs + self.real_poles

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        a = 1 + 2 * self.zero_pairs
        b = a + 2 * self.pole_pairs
        c = b + self.real_zeros
        return x[1:a].reshape(-1, 2), x[a:b].reshape(-1, 2), x[b:c], x[c:]

    def join(self, gain: float, zp: np.ndarray, pp: np.ndarray, rz: np.ndarray, rp: np.ndarray) -> np.ndarray:
        return np.concatenate([[gain], zp.ravel(), pp.ravel(), rz, rp])

    def function(self, x: np.ndarray) -> Rational:
        zp, pp, rz, rp = (np.exp(part) for part in self.split(x))
        return Rational(
            float(np.exp(x[0])),
            tuple((float(w), float(z)) for w, z in zp),
            tuple((float(w), float(z)) for w, z in pp),
            tuple(map(float, rz)),
            tuple(map(float, rp)),
        )

    def log_magnitude(self, x: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """log|H| at omega and its Jacobian (n_omega, n_unknowns)."""
        zp, pp, rz, rp = self.split(x)
        (zeros, by_zeros), (poles, by_poles) = log_modulus(zp, rz, omega), log_modulus(pp, rp, omega)
        a, b = zp.size, pp.size
        columns = (np.ones((omega.size, 1)), by_zeros[:, :a], -by_poles[:, :b], by_zeros[:, a:], -by_poles[:, b:])
        return x[0] + zeros - poles, np.hstack(columns)

    def bounds(self, omega: np.ndarray, min_damping: float, reach: float) -> tuple[np.ndarray, np.ndarray]:
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        w_low, w_high = np.log(omega[0] / reach), np.log(omega[-1] * reach)
        pairs = 2 * (self.zero_pairs + self.pole_pairs)
        low[1 : 1 + pairs : 2], high[1 : 1 + pairs : 2] = w_low, w_high
        low[2 : 1 + pairs : 2], high[2 : 1 + pairs : 2] = np.log(min_damping), np.log(10.0)
        low[1 + pairs :], high[1 + pairs :] = w_low, w_high
        return low, high


def magnitude_fit(
    omega: np.ndarray,
    magnitude: np.ndarray,
    order: int,
    relative_degree: int = 0,
    min_damping: float = 0.02,
    reach: float = 10.0,
) -> MagnitudeFit:
    """Stable, minimum-phase rational function by a least-squares fit of the log magnitude.

    Parameters
    ----------
    omega : (n,) increasing positive frequencies [rad/s]; their density determines the weighting.
    magnitude : (n,) positive values.
    order : number of poles.
    relative_degree : number of poles minus number of zeros.
    min_damping : minimum damping of any factor; prevents the fit of single narrow peaks.
    reach : corner frequencies stay within [omega[0]/reach, omega[-1]*reach].

    Raises
    ------
    InputError : frequencies not positive, finite and increasing, magnitudes not positive and finite, or an order
        below the relative degree.
    """
    omega, log_target = _checked(omega, magnitude)
    if not (order >= relative_degree >= 0):
        raise InputError(
            "the order must be at least the relative degree, and that at least 0", field="order", value=order
        )
    path = _growth(omega, log_target, relative_degree, (order - relative_degree) % 2, min_damping, reach)
    layout, x = next(step for step in path if step[0].order == order)
    error = DB * (layout.log_magnitude(x, omega)[0] - log_target)
    return MagnitudeFit(layout.function(x), float(np.sqrt(np.mean(error**2))), float(np.max(np.abs(error))))


def covering_fit(
    omega: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    order: int,
    target: np.ndarray | None = None,
    min_damping: float = 0.1,
    reach: float = 10.0,
) -> MagnitudeFit:
    """Biproper function with |H| >= lower at all points and the smallest maximum excess of |H| over upper in dB.

    Parameters
    ----------
    omega : (n,) increasing positive frequencies [rad/s].
    lower, upper : (n,) positive, lower <= upper; equal where the magnitude is to be matched closely.
    target : (n,) initial magnitude of the search; None for the geometric mean of lower and upper.
    order, min_damping, reach : as in `magnitude_fit`.

    Returns
    -------
    MagnitudeFit with error_max_dB the largest excess over `upper` (0 if there is none), error_rms_dB its r.m.s. value.

    Raises
    ------
    InputError : as in `magnitude_fit`, or lower exceeds upper.
    """
    *_, last = covering_fits(omega, lower, upper, range(order % 2, order + 1, 2), target, min_damping, reach)
    return last


def covering_fits(
    omega: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    orders: Iterable[int],
    target: np.ndarray | None = None,
    min_damping: float = 0.1,
    reach: float = 10.0,
) -> Iterator[MagnitudeFit]:
    """Generate `covering_fit` for increasing orders; each starts from the least-squares fit of the same order."""
    omega, log_lower = _checked(omega, lower)
    _, log_upper = _checked(omega, upper)
    if np.any(log_lower > log_upper + 1e-12):
        raise InputError("the lower curve must not exceed the upper one", field="lower")
    _, log_target = (omega, (log_lower + log_upper) / 2) if target is None else _checked(omega, target)
    paths = [_growth(omega, log_target, 0, parity, min_damping, reach) for parity in (0, 1)]
    for order in orders:
        layout, x = next(step for step in paths[order % 2] if step[0].order == order)
        if order:
            x = _chebyshev(layout, x, omega, log_lower, log_upper, min_damping, reach)
        x = x.copy()
        x[0] += np.max(log_lower - layout.log_magnitude(x, omega)[0])
        excess = DB * np.maximum(layout.log_magnitude(x, omega)[0] - log_upper, 0.0)
        yield MagnitudeFit(layout.function(x), float(np.sqrt(np.mean(excess**2))), float(np.max(excess)))


def _chebyshev(
    layout: _Layout,
    x: np.ndarray,
    omega: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    min_damping: float,
    reach: float,
) -> np.ndarray:
    """Minimise t subject to lower <= log|H| <= upper + t, by sequential quadratic programming from x."""

    def slack(y: np.ndarray) -> np.ndarray:
        value, _ = layout.log_magnitude(y[:-1], omega)
        return np.concatenate([value - lower, upper + y[-1] - value])

    def slope(y: np.ndarray) -> np.ndarray:
        _, J = layout.log_magnitude(y[:-1], omega)
        return np.block([[J, np.zeros((omega.size, 1))], [-J, np.ones((omega.size, 1))]])

    value, _ = layout.log_magnitude(x, omega)
    x = x.copy()
    x[0] += np.max(lower - value)
    t0 = np.max(value + np.max(lower - value) - upper)
    low, high = layout.bounds(omega, min_damping, reach)
    gradient = np.append(np.zeros(layout.size), 1.0)
    result = minimize(
        lambda y: y[-1],
        np.append(x, t0),
        jac=lambda y: gradient,
        method="SLSQP",
        bounds=[*zip(low, high, strict=True), (0.0, None)],
        constraints=[{"type": "ineq", "fun": slack, "jac": slope}],
        options={"maxiter": 200, "ftol": 1e-8},
    )
    better = np.all(np.isfinite(result.x)) and result.x[-1] < t0 and np.min(slack(result.x)) > -1e-3
    return np.asarray(result.x[:-1]) if better else x


def _checked(omega: np.ndarray, magnitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    omega, magnitude = np.asarray(omega, float), np.asarray(magnitude, float)
    if omega.ndim != 1 or omega.shape != magnitude.shape or omega.size < 2:
        raise InputError(f"expected two vectors of one length, got {omega.shape} and {magnitude.shape}", field="omega")
    if not (np.all(np.isfinite(omega)) and np.all(omega > 0) and np.all(np.diff(omega) > 0)):
        raise InputError("frequencies must be finite, positive and increasing", field="omega")
    if not (np.all(np.isfinite(magnitude)) and np.all(magnitude > 0)):
        raise InputError("magnitudes must be finite and positive", field="magnitude")
    return omega, np.log(magnitude)


def _growth(
    omega: np.ndarray, log_target: np.ndarray, relative_degree: int, odd: int, min_damping: float, reach: float
) -> Iterator[tuple[_Layout, np.ndarray]]:
    """Least-squares fits of order relative_degree + odd, then two orders higher each time; an infinite generator."""
    layout, x = _start(omega, log_target, odd, relative_degree)
    x = _least_squares(layout, x, omega, log_target, min_damping, reach, 300)
    while True:
        yield layout, x
        trials = []
        for grown, guess in _grown(layout, x, omega, log_target):
            fitted = _least_squares(grown, guess, omega, log_target, min_damping, reach, 40)
            error = grown.log_magnitude(fitted, omega)[0] - log_target
            trials.append((float(error @ error), grown, fitted))
        _, layout, x = min(trials, key=lambda trial: trial[0])
        x = _least_squares(layout, x, omega, log_target, min_damping, reach, 300)


def _start(omega: np.ndarray, log_target: np.ndarray, odd: int, relative_degree: int) -> tuple[_Layout, np.ndarray]:
    """Initial factors: poles for the relative degree, and a lead-lag factor if order - relative_degree is odd."""
    layout = _Layout(0, relative_degree // 2, odd, odd + relative_degree % 2)
    middle = 0.5 * (np.log(omega[0]) + np.log(omega[-1]))
    x = np.zeros(layout.size)
    _, pp, rz, rp = layout.split(x)
    pp[:, 0], rz[:] = middle, middle
    rp[:] = middle + 0.1 * np.arange(rp.size)
    x[0] = np.mean(log_target - layout.log_magnitude(x, omega)[0])
    return layout, x


def _grown(
    layout: _Layout, x: np.ndarray, omega: np.ndarray, log_target: np.ndarray
) -> list[tuple[_Layout, np.ndarray]]:
    """Initial guesses with one more biquad: a peak or notch at the largest errors, or a step within the band."""
    value, _ = layout.log_magnitude(x, omega)
    error = log_target - value
    grown = _Layout(layout.zero_pairs + 1, layout.pole_pairs + 1, layout.real_zeros, layout.real_poles)
    zp, pp, rz, rp = layout.split(x)
    guesses = []
    for k, zeta in ((np.argmax(error), 0.3), (np.argmin(error), 0.3), (np.argmax(np.abs(error)), 0.1)):
        tall = np.clip(error[k], -2.0, 2.0)
        centre = np.log(omega[k])
        guesses.append(([centre, np.log(zeta) + tall / 2], [centre, np.log(zeta) - tall / 2]))
    for at in np.log(omega[[omega.size // 4, omega.size // 2, (3 * omega.size) // 4]]):
        guesses += [([at + 0.2, 0.0], [at - 0.2, 0.0]), ([at - 0.2, 0.0], [at + 0.2, 0.0])]
    return [
        (grown, grown.join(x[0], np.vstack([zp, [zero]]), np.vstack([pp, [pole]]), rz, rp)) for zero, pole in guesses
    ]


def _least_squares(
    layout: _Layout,
    x: np.ndarray,
    omega: np.ndarray,
    log_target: np.ndarray,
    min_damping: float,
    reach: float,
    evaluations: int,
) -> np.ndarray:
    low, high = layout.bounds(omega, min_damping, reach)
    result = least_squares(
        lambda y: layout.log_magnitude(y, omega)[0] - log_target,
        np.clip(x, low + 1e-6, high - 1e-6),
        jac=lambda y: layout.log_magnitude(y, omega)[1],
        bounds=(low, high),
        x_scale=1.0,
        max_nfev=evaluations,
    )
    if not np.all(np.isfinite(result.x)):
        raise ComputationError(
            "the magnitude fit diverged",
            measured=f"cost {result.cost:.3g}",
            cause="data spanning too many decades for the order",
            next_step="narrow the band or raise the order",
        )
    return np.asarray(result.x)
