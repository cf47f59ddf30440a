"""A filter that covers the differences of a set of responses from a nominal one.

Every response is G_k = G (1 + W Delta) with |Delta| <= 1 at the given frequencies: W is stable, minimum phase and at or
above the largest relative error (Skogestad and Postlethwaite, Multivariable Feedback Control, 2005, section 7.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.interchange import as_system, frequencies_of, is_response, plot_frequencies, response_of
from avis_ctrl.lti.rational import Rational
from avis_ctrl.summary import Shown
from avis_ctrl.uncertainty.weight_base import Weight, smallest_cover

Kind = Literal["output", "input", "additive"]


@dataclass(frozen=True)
class CoverSettings:
    """round_off : relative size below which the part of an error outside the range of the nominal system is round-off.
    followed : errors below this fraction of the largest are covered, but not followed closely.
    rest : frequencies at which the error at zero frequency is fitted, relative to the lowest positive one: a
        logarithmic axis has no zero, and the filter has to be constant towards it.
    margin : relative amount added to a filter that touches the error, so that round-off does not lie below it.
    """

    round_off: float = 1e-8
    followed: float = 1e-4
    rest: tuple[float, ...] = (1e-5, 1e-4, 1e-3)
    margin: float = 1e-12


SETTINGS = CoverSettings()


@dataclass(frozen=True, eq=False, repr=False)
class UncertaintyWeight(Shown, Weight):
    """The filter W and the error that it covers.

    omega, error : (n,) [rad/s] and the largest error of all responses there. order : states of W.
    `system()` is W as a StateSpace, `magnitude(omega)` its size; `dynamics(name, weight)` accepts it directly.
    """

    omega: np.ndarray
    error: np.ndarray
    kind: Kind
    tolerance_dB: float
    max_order: int

    @cached_property
    def shape(self) -> Rational:
        floor = np.maximum(self.error, SETTINGS.followed * np.max(self.error))
        omega = self.omega
        if omega[0] == 0:
            low = omega[1] * np.array(SETTINGS.rest)
            omega, floor = np.r_[low, omega[1:]], np.r_[np.full(low.size, floor[0]), floor[1:]]
        found = smallest_cover(omega, floor, floor, self.tolerance_dB, self.max_order, "the error")
        lacking = float(np.max(self.error / found.magnitude(self.omega)))
        return found.scaled(max(1.0, lacking) * (1 + SETTINGS.margin))

    @property
    def order(self) -> int:
        """Number of poles of the weight."""
        return self.shape.order

    def __repr__(self) -> str:
        return f"UncertaintyWeight({self.meaning})"

    @property
    def meaning(self) -> str:
        return (
            f"{self.kind} uncertainty of {np.min(self.error):.3g} to {np.max(self.error):.3g}, covered by order "
            f"{self.order}"
        )


def uncertainty_weight(
    nominal: Any,
    responses: Sequence[Any] | Any,
    *,
    kind: Kind = "output",
    omega: np.ndarray | None = None,
    tolerance_dB: float = 2.0,
    max_order: int = 8,
) -> UncertaintyWeight:
    """Filter of lowest order that covers the errors of all responses relative to a nominal one, at given frequencies.

    Parameters
    ----------
    nominal, responses : systems, python-control FRDs, or an `UncertainSystem`'s `sample`; one response or a list.
    kind : "output" (G_k - G) G^+, "input" G^+ (G_k - G) or "additive" G_k - G; the error is the largest singular value.
    omega : (n,) frequencies [rad/s]; by default those of the first FRD, or around the poles of the nominal system.
    tolerance_dB : maximum excess of W over the error.
    max_order : maximum number of states.

    Raises
    ------
    InputError : no responses, responses of another shape, a nominal response that is zero or not finite, an error that
        cannot be referred to this side of the nominal system (for example, with fewer inputs than outputs), a system
        with another number of unstable poles than the nominal one (no stable Delta makes it), no positive frequency.
    ComputationError : no filter up to this order is within the tolerance.

    Examples
    --------
    >>> plant = ac.ss([[0, 1], [-ac.real("k", 2.0, percent=30), -1.0]], [[0], [1]], [[1, 0]])
    >>> weight = ac.uncertainty_weight(plant.nominal, plant.sample(20, seed=1))
    >>> weight.order, bool(np.all(weight.magnitude(weight.omega) >= weight.error))
    (2, True)
    >>> model = plant.nominal * (1 + ac.dynamics("spread", weight))
    """
    every = list(responses) if isinstance(responses, (list, tuple)) else [responses]
    if not every or kind not in ("output", "input", "additive"):
        raise InputError(
            "expected responses, and output, input or additive", field="responses, kind", value=(len(every), kind)
        )
    if omega is None:
        known = [frequencies_of(one) for one in (nominal, *every) if is_response(one)]
        omega = known[0] if known else plot_frequencies(nominal, 120)
    omega = np.unique(np.asarray(omega, float))
    if not (omega.size and np.all(np.isfinite(omega)) and omega[0] >= 0 and omega[-1] > 0):
        raise InputError("expected frequencies from 0 on, one of them positive", field="omega")
    unstable = None if is_response(nominal) else _unstable_poles(nominal)
    for k, one in enumerate(every):
        if unstable is not None and not is_response(one) and (count := _unstable_poles(one)) != unstable:
            raise InputError(
                f"expected {unstable} unstable poles, as many as those of the nominal system: no stable Delta makes "
                "this system from the nominal one",
                field=f"response {k}",
                value=count,
            )
    G = response_of(nominal, omega, "nominal")
    error = np.zeros(omega.size)
    for k, one in enumerate(every):
        difference = response_of(one, omega, f"response {k}")
        if difference.shape != G.shape:
            raise InputError(
                f"expected responses of shape {G.shape[1:]} (give a measured one as control.frd(response, omega))",
                field=f"response {k}",
                value=difference.shape[1:],
            )
        if not np.all(np.isfinite(difference)):
            raise InputError("expected finite numbers", field=f"response {k}")
        difference = difference - G
        if kind != "additive":
            inverse, whole = np.linalg.pinv(G), difference
            difference = whole @ inverse if kind == "output" else inverse @ whole
            rest = whole - (difference @ G if kind == "output" else G @ difference)
            if np.linalg.norm(rest) > SETTINGS.round_off * np.linalg.norm(whole):
                raise InputError(
                    f"no error at the {kind} of the nominal system makes this response; expected kind "
                    f"additive or {'input' if kind == 'output' else 'output'}",
                    field=f"response {k}",
                )
        error = np.maximum(error, np.linalg.norm(difference, ord=2, axis=(1, 2)))
    if not (np.all(np.isfinite(error)) and np.max(error) > 0 and np.all(np.abs(G).max(axis=(1, 2)) > 0)):
        raise InputError("expected finite responses that differ from a nominal one that is not zero", field="nominal")
    made = UncertaintyWeight(omega, error, kind, tolerance_dB, max_order)
    _ = made.shape
    return made


def _unstable_poles(given: Any) -> int:
    """Number of poles that are not stable."""
    system = as_system(given)
    poles = system.poles()
    return int(np.sum(np.abs(poles) >= 1 if system.dt else poles.real >= 0))
