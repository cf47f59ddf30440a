"""H-infinity synthesis: a stabilising K with u = K y and small ||F_l(P, K)||.

The optimum is bracketed by the two-Riccati test; the controller is computed at most `backoff` above it. As gamma
approaches its optimum, I - X Y / gamma^2 or an inverse of X or Y becomes singular, and poles of the central controller
go to infinity as 1 / backoff: in the limit they are a static gain (Safonov, Limebeer and Chiang, Int. J. Control 50,
1989). On request, poles far beyond those of the plant are therefore replaced by their static gain. This is done in a
controller closer to the optimum, where the replacement is nearly exact, and only if the measured norm of the loop stays
within the target of the back-off. All reported values are measured on the closed loop with the plant as given, before
any scaling or regularisation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Literal

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, balance, hinf_norm, lft_lower
from avis_ctrl.lti.bilinear import sampled_image
from avis_ctrl.robust.hinf_bounds import pointwise_bound
from avis_ctrl.robust.hinf_plant import (
    NormalForm,
    Plant,
    Signals,
    as_plant,
    normal_form,
    posed_plant,
    rank_margins,
    regularised,
)
from avis_ctrl.robust.hinf_riccati import GammaBracket, central_controller, find_gamma, gamma_test, natural_gamma
from avis_ctrl.robust.hinf_settings import SETTINGS
from avis_ctrl.robust.reduction import residualise_fast
from avis_ctrl.robust.riccati import INACCURATE, ON_AXIS
from avis_ctrl.summary import Shown


class Status(Enum):
    """Outcome of a synthesis; the value is the diagnosis."""

    OPTIMAL = "the optimum is bracketed and the closed loop was measured below its target"
    REGULARISED = (
        "the problem is singular: small extra channels were added; the closed loop measured is that "
        "of the plant without them"
    )
    BACKED_OFF = (
        "the closed loop missed its target at the requested back-off, which was raised: this usually "
        "means a badly scaled plant or a nearly singular D12 or D21"
    )
    WIDE = (
        "the optimum lies between the bounds, which are further apart than requested: between them the Riccati "
        "test is undecided"
    )
    UNPROVED = "the optimum was found to the tolerance; no lower bound of it was computed"
    SUBOPTIMAL = "a controller at the requested gamma; the optimum was not computed"


@dataclass(frozen=True, repr=False)
class Synthesis(Shown):
    """Result of an H-infinity synthesis.

    K : controller, inputs named as the plant's y, outputs as its u; positive feedback u = K y.
    gamma : measured H-infinity norm of `closed_loop` (relative accuracy 1e-6).
    gamma_optimal_bounds : (largest gamma proved infeasible, smallest gamma found feasible). If channels were added, the
        lower bound is the pointwise bound of `hinf_bounds`. In this case, or if the controller missed its target,
        the upper bound is the measured gamma.
    fastest_pole : largest magnitude [rad/s] of a controller pole (of its continuous image if P is sampled).
    limited_by : the condition that fails just below the optimum.
    notes : actions that the caller did not request, and their cost.
    """

    K: StateSpace
    gamma: float
    gamma_optimal_bounds: tuple[float, float]
    status: Status
    closed_loop: StateSpace
    fastest_pole: float
    limited_by: str
    notes: tuple[str, ...] = ()

    @property
    def abscissa(self) -> float:
        """Largest real part of the closed-loop poles (largest magnitude minus 1 if sampled)."""
        poles = self.closed_loop.poles()
        return float(np.max(np.abs(poles) - 1 if self.closed_loop.dt else poles.real, initial=-np.inf))


def hinfsyn(
    P: Any,
    nmeas: Signals,
    ncon: Signals,
    *,
    backoff: float = 0.01,
    tolerance: float = 1e-3,
    method: Literal["riccati", "lmi"] = "riccati",
    sample_rate_Hz: float | None = None,
    gamma_hint: float | None = None,
    far_poles: Literal["kept", "gain"] = "kept",
) -> Synthesis:
    """H-infinity optimal controller, `backoff` above the optimum.

    Parameters
    ----------
    P : StateSpace (avis_ctrl or python-control) from (w, u) to (z, y), u and y last; of an `UncertainSystem` the
        nominal system is used (`musyn` takes its uncertainty into account).
    nmeas, ncon : number of measurements y and of controls u; or their names, wherever they stand in P.
    backoff : relative distance of the controller from the optimum.
    tolerance : relative width to which the optimum is bracketed.
    method : "riccati" (Glover and Doyle 1988), or "lmi" (Gahinet and Apkarian 1994) as a slow independent check of the
        optimum; the controller is then computed by the Riccati formulas at the gamma of the LMI.
    sample_rate_Hz : sample rate of the implementation; the fastest controller pole is compared with half of it.
    gamma_hint : expected gamma near the optimum; shortens the search.
    far_poles : "kept", or "gain": controller poles far beyond those of the plant are replaced by their static gain if
        the measured loop stays within the target of the back-off (see `notes`). D-K iteration uses "kept".

    Raises
    ------
    InputError : wrong shapes, counts or options.
    ComputationError : a mode that cannot be stabilised (named), or no achievable gamma.

    Examples
    --------
    x' = w + u with z = (x, u) and y = x + n, where the optimum is sqrt(2) (both Riccati equations have the solution
    1/sqrt(1 - 1/gamma^2)):

    >>> P = ac.StateSpace([[0]], [[1, 0, 1]], [[1], [0], [1]], [[0, 0, 0], [0, 0, 1], [0, 1, 0]])
    >>> made = ac.hinfsyn(P, nmeas=1, ncon=1)
    >>> low, high = made.gamma_optimal_bounds
    >>> low <= 2**0.5 <= high < 1.416, made.gamma <= 1.01 * high
    (True, True)
    """
    P, nmeas, ncon = as_plant(P, nmeas, ncon)
    _check_options(backoff, tolerance, method, gamma_hint, far_poles)
    problem = _Problem.of(P, nmeas, ncon)
    form, bracket, notes = problem.solve(tolerance, gamma_hint)
    status = Status.REGULARISED if notes else Status.OPTIMAL
    bounds = bracket.lower, bracket.upper.gamma
    doubt: tuple[str, ...] = ()
    if method == "lmi":
        from avis_ctrl.robust.hinf_lmi import UNCERTIFIED, lmi_gamma

        optimum = lmi_gamma(P, nmeas, ncon)
        bounds, doubt = (optimum.lower, optimum.upper), (UNCERTIFIED,) if optimum.violation > 0 else ()
    result, raised = problem.realise(
        form, bounds[1] if not notes else bracket.upper.gamma, backoff, far_poles == "gain"
    )
    if notes and method != "lmi":
        # Extra channels only make the problem harder: a gamma that fails with them may be feasible without them.
        bounds = pointwise_bound(problem.plant), result.gamma
    if raised:
        status, notes = Status.BACKED_OFF, (*notes, raised)
        bounds = bounds[0], max(bounds[1], result.gamma)
    zero = 200 * SETTINGS.zero_gamma * natural_gamma(form.plant)
    bounds, status, notes = _consistent(bounds, result.gamma, tolerance, zero, status, notes)
    if status is Status.OPTIMAL and result.gamma <= zero and bounds[1] - bounds[0] >= 2 * tolerance * bounds[1]:
        notes = (*notes, f"the optimum is zero to working precision (gamma {result.gamma:.2g})")
    else:
        notes = (*notes, *_doubt_of_gamma(P, result))
    rate = _rate_note(result, sample_rate_Hz)
    return replace(
        result,
        gamma_optimal_bounds=(float(bounds[0]), float(bounds[1])),
        status=status,
        limited_by=bracket.limited_by,
        notes=(*notes, *doubt, *result.notes, *rate),
    )


def hinf_controller(
    P: Any, nmeas: int, ncon: int, backoff: float, gamma_hint: float | None = None, tolerance: float = 1e-3
) -> Synthesis:
    """The controller of `hinfsyn` with the same parameters, without a lower bound of the optimum; for iterations."""
    problem = _Problem.of(*as_plant(P, nmeas, ncon))
    form, bracket, notes = problem.solve(tolerance, gamma_hint, proved=False)
    result, raised = problem.realise(form, bracket.upper.gamma, backoff, False)
    # With extra channels, or if the target was missed, only the measured gamma is known to be feasible.
    upper = result.gamma if notes or raised else min(bracket.upper.gamma, result.gamma)
    return replace(
        result, gamma_optimal_bounds=(0.0, upper), status=Status.UNPROVED, notes=(*notes, raised) if raised else notes
    )


def hinf_suboptimal(P: Any, nmeas: int, ncon: int, gamma: float) -> Synthesis:
    """The central controller at a given gamma, without a search; for iterations with a known gamma.

    ComputationError if gamma cannot be achieved (with the condition that fails), or if the measured norm of the closed
    loop exceeds it.
    """
    P, nmeas, ncon = as_plant(P, nmeas, ncon)
    if not (np.isfinite(gamma) and gamma > 0):
        raise InputError("expected a positive number", field="gamma", value=gamma)
    problem = _Problem.of(P, nmeas, ncon)
    form, notes = problem.form(*problem.singular, 1e-5)
    test = gamma_test(form.plant, gamma)
    if not test.feasible and (ON_AXIS in test.reason or INACCURATE in test.reason):
        form, notes = problem.form(*problem.singular, 1e-5, of_states=True)
        test = gamma_test(form.plant, gamma)
    if not test.feasible:
        raise ComputationError(
            f"no controller reaches gamma = {gamma:.6g}",
            cause=test.reason,
            measured=f"rho(XY)/gamma^2 = {test.coupling:.4g}",
            next_step="ask for a larger gamma",
        )
    result = problem.measured(central_controller(form, test))
    if result.gamma > gamma * (1 + SETTINGS.loop_accuracy):
        raise ComputationError(
            f"the controller for gamma = {gamma:.6g} was not confirmed",
            measured=f"closed-loop norm {result.gamma:.6g}",
            cause="gamma too near the optimum for double precision, or a badly scaled plant",
            next_step="ask for a larger gamma",
        )
    return replace(result, gamma_optimal_bounds=(0.0, gamma), status=Status.SUBOPTIMAL, notes=notes)


@dataclass(frozen=True)
class _Problem:
    """The plant as given, its continuous balanced partition without hidden states, and rank deficiency of D12, D21."""

    P: StateSpace
    plant: Plant
    singular: tuple[bool, bool]

    @staticmethod
    def of(P: StateSpace, nmeas: int, ncon: int) -> _Problem:
        plant = posed_plant(P, nmeas, ncon)
        of_u, of_y = rank_margins(plant)
        return _Problem(P, plant, (of_u < SETTINGS.rank_tolerance, of_y < SETTINGS.rank_tolerance))

    def form(
        self, of_D12: bool, of_D21: bool, epsilon: float, of_states: bool = False
    ) -> tuple[NormalForm, tuple[str, ...]]:
        """Normal form, regularised as requested, with a note about the regularisation."""
        if not (of_D12 or of_D21 or of_states):
            return normal_form(self.plant), ()
        reasons = []
        if of_D12:
            reasons.append(
                f"D12 has not full column rank: not every control {list(self.plant.u)} is penalised "
                "at infinite frequency"
            )
        if of_D21:
            reasons.append(
                f"D21 has not full row rank: not every measurement {list(self.plant.y)} is noisy at infinite frequency"
            )
        if of_states:
            reasons.append("a zero of u -> z or w -> y lies on, or too near, the imaginary axis or infinity")
        extra = f"; extra channels of relative size {epsilon:.0e} were added for the synthesis alone"
        plant = regularised(self.plant, epsilon, of_D12, of_D21, of_states)
        return normal_form(plant), ("; ".join(reasons) + extra,)

    def solve(
        self, tolerance: float, hint: float | None, proved: bool = True
    ) -> tuple[NormalForm, GammaBracket, tuple[str, ...]]:
        """Bracket of the optimum; extra channels are reduced until a further reduction gains less than one per cent."""
        if not any(self.singular):
            form, _ = self.form(False, False, 0.0)
            try:
                return form, find_gamma(form.plant, tolerance, hint, proved=proved), ()
            except ComputationError:
                pass
        best: tuple[NormalForm, GammaBracket, tuple[str, ...]] | None = None
        failure: ComputationError | None = None
        for epsilon in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7):
            try:
                form, bracket, notes = self._regularised(epsilon, tolerance, hint, proved)
            except ComputationError as error:
                failure = error
                continue
            cost = np.inf if best is None else best[1].upper.gamma / bracket.upper.gamma - 1
            if best is not None and cost >= 0:
                notes = (notes[0] + f"; gamma fell by {100 * cost:.2g} % over the last decade of that size",)
            if cost >= 0:
                best, hint = (form, bracket, notes), bracket.upper.gamma
            if cost < 0.01:
                break
        if best is None:
            raise failure or ComputationError("no controller was found")
        return best

    def _regularised(
        self, epsilon: float, tolerance: float, hint: float | None, proved: bool
    ) -> tuple[NormalForm, GammaBracket, tuple[str, ...]]:
        """Bracket with extra channels on u and y as needed, and on the states if these do not suffice."""
        for of_states in (False, True) if any(self.singular) else (True,):
            form, notes = self.form(*self.singular, epsilon, of_states)
            try:
                return form, find_gamma(form.plant, tolerance, hint, proved=proved), notes
            except ComputationError as error:
                failure = error
        raise failure

    def realise(self, form: NormalForm, gamma: float, backoff: float, slow: bool) -> tuple[Synthesis, str]:
        """The first controller above the optimum whose measured norm meets its target; a note if the back-off grew."""
        best: Synthesis | None = None
        for k in range(12):
            margin = backoff * 2.0**k if backoff > 0 else 1e-6 * 4.0**k
            target = (1 + (margin if k or backoff > 0 else 0.0)) * gamma
            test = gamma_test(form.plant, target)
            if not test.feasible:
                continue
            try:
                result = self.measured(central_controller(form, test))
            except (ComputationError, np.linalg.LinAlgError):
                continue
            if best is None or result.gamma < best.gamma:
                best = result
            if result.gamma <= target * (1 + 1e-5):
                note = f"the back-off was raised from {100 * backoff:.3g} % to {100 * margin:.3g} %" if k else ""
                return self._slower(form, result, gamma, target) if slow else result, note
        if best is None or not np.isfinite(best.gamma):
            raise ComputationError(
                "no controller's closed loop was measured to be stable",
                measured=f"gamma from {gamma:.4g} upwards tried",
                cause="the plant is too badly scaled or conditioned for double precision",
                next_step="rescale signals, or raise the smallest weights",
            )
        return best, f"no back-off was confirmed; the best measured is {best.gamma:.6g} against an optimum {gamma:.6g}"

    def _slower(self, form: NormalForm, result: Synthesis, gamma: float, target: float) -> Synthesis:
        """The controller without its poles far beyond those of the plant, if it meets the target; else `result`."""
        plant_fastest = float(np.max(np.abs(la.eigvals(self.plant.A)), initial=0.0))
        if not result.fastest_pole > SETTINGS.far_beyond * plant_fastest > 0:
            return result
        for fraction in SETTINGS.closer:
            test = gamma_test(form.plant, gamma + fraction * (target - gamma))
            if not test.feasible:
                continue
            try:
                K = balance(central_controller(form, test))
                found = self.measured(residualise_fast(K, _widest_gap(K.poles(), plant_fastest), also_unstable=True))
            except (ComputationError, np.linalg.LinAlgError):
                continue
            if found.gamma <= target * (1 + SETTINGS.loop_accuracy) and found.fastest_pole < result.fastest_pole:
                note = (
                    f"the central controller has poles up to {result.fastest_pole:.3g} rad/s, the plant up to "
                    f"{plant_fastest:.3g}: those far beyond it were replaced by their gain, the fastest left has "
                    f"{found.fastest_pole:.3g}, and all figures are of that controller"
                )
                return replace(found, notes=(note,))
        return result

    def measured(self, K: StateSpace) -> Synthesis:
        """K in the time domain of the plant, with the closed loop measured on the plant as given."""
        fastest = float(np.max(np.abs(K.poles()), initial=0.0))
        K = balance(K)
        if self.P.dt:
            K = sampled_image(K, self.P.dt)
        closed = lft_lower(self.P, K)
        return Synthesis(K, hinf_norm(closed).gain, (0.0, np.inf), Status.OPTIMAL, closed, fastest, "")


def _doubt_of_gamma(P: StateSpace, result: Synthesis) -> tuple[str, ...]:
    """A note if the loop gain computed from the responses of P and K differs from that of the closed loop.

    Gamma is then a small difference of large terms. P and K are evaluated at the peak and at the magnitudes of the
    closed-loop poles: if these are dominated by round-off, the two computations peak at different frequencies.
    """
    peak = hinf_norm(result.closed_loop).omega
    poles = result.closed_loop.poles()
    at_poles = np.abs(np.angle(poles)) / P.dt if P.dt else np.abs(poles)
    p, k = (one.frequency_response(np.concatenate([[peak], at_poles[at_poles > 0]])) for one in (P, result.K))
    u, y = k.shape[1:]
    w, z = P.ninputs - u, P.noutputs - y
    # At a pole of P or K, such as an integrator at zero frequency, the response is not finite.
    there = np.all(np.isfinite(p), axis=(1, 2)) & np.all(np.isfinite(k), axis=(1, 2))
    p, k = p[there], k[there]
    loop = p[:, :z, :w] + p[:, :z, w:] @ np.linalg.solve(np.eye(u) - k @ p[:, z:, w:], k @ p[:, z:, :w])
    again = np.linalg.norm(loop, 2, axis=(1, 2))
    at_peak, highest = float(again[0]) if there[0] else result.gamma, float(np.max(again, initial=0.0))
    other = highest if highest > (1 + SETTINGS.same_gamma) * result.gamma else at_peak
    if abs(other - result.gamma) <= SETTINGS.same_gamma * result.gamma:
        return ()
    return (
        f"round-off shows in gamma: {result.gamma:.6g} from the closed loop, {other:.6g} from P and K at one frequency",
    )


def _widest_gap(poles: np.ndarray, plant_fastest: float) -> float:
    """Magnitude [rad/s] in the middle of the widest gap (as a ratio) between the poles beyond those of the plant."""
    sizes = np.sort(np.abs(poles))
    sizes = np.concatenate([[plant_fastest], sizes[sizes > plant_fastest]])
    widest = int(np.argmax(sizes[1:] / sizes[:-1]))
    return float(np.sqrt(sizes[widest] * sizes[widest + 1]))


def _consistent(
    bounds: tuple[float, float], reached: float, tolerance: float, zero: float, status: Status, notes: tuple[str, ...]
) -> tuple[tuple[float, float], Status, tuple[str, ...]]:
    """Bounds that are consistent with the measured gamma, and a status that reports if they are far apart.

    zero : width below which an optimum is zero to working precision.
    """
    lower, upper = bounds
    if lower > reached * (1 + SETTINGS.loop_accuracy):
        notes = (*notes, f"the lower bound computed, {lower:.6g}, is above the norm of the closed loop and is dropped")
        lower = 0.0
    upper = min(upper, max(reached, lower))
    if status is Status.OPTIMAL and upper - lower > max(2 * tolerance * upper, zero):
        status = Status.WIDE
    return (lower, upper), status, notes


def _check_options(backoff: float, tolerance: float, method: str, gamma_hint: float | None, far_poles: str) -> None:
    if not (np.isfinite(backoff) and backoff >= 0):
        raise InputError("expected a number of at least 0, such as 0.01", field="backoff", value=backoff)
    if not 1e-8 <= tolerance < 1:
        raise InputError("expected a relative width from 1e-8 to 1", field="tolerance", value=tolerance)
    if method not in ("riccati", "lmi"):
        raise InputError("expected 'riccati' or 'lmi'", field="method", value=method)
    if far_poles not in ("kept", "gain"):
        raise InputError("expected 'kept' or 'gain'", field="far_poles", value=far_poles)
    if gamma_hint is not None and not (np.isfinite(gamma_hint) and gamma_hint > 0):
        raise InputError("expected a positive number or None", field="gamma_hint", value=gamma_hint)


def _rate_note(result: Synthesis, sample_rate_Hz: float | None) -> tuple[str, ...]:
    if sample_rate_Hz is None:
        return ()
    if not (np.isfinite(sample_rate_Hz) and sample_rate_Hz > 0):
        raise InputError("expected a positive rate in hertz", field="sample_rate_Hz", value=sample_rate_Hz)
    if result.K.dt:  # a sampled controller is used as it is
        return ()
    ratio = result.fastest_pole / (np.pi * sample_rate_Hz)
    verdict = (
        "slow enough"
        if ratio < 0.5
        else ("too fast; a higher sample rate, a larger backoff from the optimum or fewer states help")
    )
    return (
        f"the fastest controller pole, {result.fastest_pole / (2 * np.pi):.4g} Hz, is {ratio:.3g} times half the "
        f"sample rate: {verdict}",
    )
