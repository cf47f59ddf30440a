"""Two-Riccati test and central controller for any D11, and search for the minimum gamma.

Formulas of Glover and Doyle, Systems & Control Letters 11 (1988) 167-172, for a plant in normal form
(D12 = [0; I], D21 = [0 I], D22 = 0). A controller with ||F_l(P, K)|| < gamma exists if and only if

    gamma > max(sigma [D1111 D1112], sigma [D1111; D1121]),   X >= 0,   Y >= 0,   rho(X Y) < gamma^2 .

In double precision the test can also be undecided. A gamma is proved infeasible only if the failing condition fails by
more than its numerical error, or if the response at one frequency excludes it (Parrott's bound at the frequency of the
Hamiltonian eigenvalue on the axis). A gamma that passes in doubt counts as feasible only if the computed norm of the
closed loop with the central controller is below it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti import StateSpace, balance, lft_lower
from avis_ctrl.lti.norms import norm_is_below
from avis_ctrl.robust.hinf_plant import NormalForm, Plant, pointwise
from avis_ctrl.robust.hinf_settings import SETTINGS
from avis_ctrl.robust.riccati import refined_balanced, solve_riccati

IN_DOUBT = "the Riccati test is undecided and its controller does not reach this gamma"


@dataclass(frozen=True)
class GammaTest:
    """Result of the test at one gamma: feasible with X, Y, or the condition that fails.

    coupling : rho(X Y) / gamma^2, nan if X or Y does not exist or is indefinite.
    forbidden : proved lower bound of the optimum, up to gamma if the failure exceeds round-off; 0 if in doubt.
    doubtful : feasible only if the negative eigenvalues of X or Y are round-off.
    """

    gamma: float
    feasible: bool
    reason: str
    coupling: float = np.nan
    X: np.ndarray | None = None
    Y: np.ndarray | None = None
    forbidden: float = 0.0
    doubtful: bool = False


@dataclass(frozen=True)
class GammaBracket:
    """lower: largest gamma proved infeasible; upper: the test at the smallest gamma that passed.

    limited_by : the reason for the failure at the largest gamma at which the test did not pass, proved or not.
    """

    lower: float
    upper: GammaTest
    limited_by: str


def direct_term_bound(plant: Plant) -> float:
    """Lower bound of gamma from infinite frequency (Parrott's theorem on D11)."""
    m2, p2 = plant.D12.shape[1], plant.D21.shape[0]
    p, m = plant.D11.shape
    top, left = plant.D11[: p - m2, :], plant.D11[:, : m - p2]
    return float(max(la.norm(top, 2) if top.size else 0.0, la.norm(left, 2) if left.size else 0.0))


def gamma_test(plant: Plant, gamma: float) -> GammaTest:
    """Existence test at one gamma, for a plant in normal form."""
    if gamma <= direct_term_bound(plant):
        return GammaTest(gamma, False, "gamma is not above the bound of D11 at infinite frequency", forbidden=gamma)
    solutions = []
    for name, letter, data in (("control", "X", control_riccati), ("filter", "Y", filter_riccati)):
        try:
            found = solve_riccati(*data(plant, gamma), rounding(plant if letter == "X" else _dual(plant), gamma))
        except (np.linalg.LinAlgError, ValueError) as error:
            return GammaTest(gamma, False, f"the Riccati equation is singular ({error})")
        if found.X is None:
            return GammaTest(
                gamma,
                False,
                f"{name} Riccati equation: {found.reason}",
                forbidden=_forbidden(plant, gamma, found.omega),
            )
        if not found.semidefinite:
            return GammaTest(
                gamma, False, f"{name} Riccati equation: {letter} is not positive semidefinite", forbidden=gamma
            )
        solutions.append(found)
    x, y = solutions
    assert x.X is not None and y.X is not None
    coupling = float(np.max(la.eigvals(x.X @ y.X).real, initial=0.0)) / gamma**2
    doubtful = x.doubtful or y.doubtful
    if coupling < 1:
        return GammaTest(gamma, True, "", coupling, x.X, y.X, doubtful=doubtful)
    certain = not doubtful and _coupled_for_certain(plant, gamma, x.X, y.X)
    return GammaTest(
        gamma,
        False,
        "control and filter together: rho(X Y) is not below gamma^2",
        coupling,
        x.X,
        y.X,
        forbidden=gamma if certain else 0.0,
    )


def _forbidden(plant: Plant, gamma: float, omega: np.ndarray) -> float:
    """Lower bound of gamma from the response at these frequencies, at most gamma; 0 if it is clearly below gamma."""
    best = max((pointwise(plant, 1j * w) for w in omega), default=0.0)
    return min(best, gamma) if best > (1 - SETTINGS.norm_accuracy) * gamma else 0.0


def _coupled_for_certain(plant: Plant, gamma: float, X: np.ndarray, Y: np.ndarray) -> bool:
    """Whether rho(X Y) of the refined X and Y exceeds gamma^2 by more than its first-order error."""
    of_x, of_y = (
        refined_balanced(*control_riccati(one, gamma), solution, rounding(one, gamma))
        for one, solution in ((plant, X), (_dual(plant), Y))
    )
    if of_x is None or of_y is None:
        return False
    (X, E_x), (Y, E_y) = of_x, of_y
    values, vectors = la.eig(X @ Y)
    r = vectors[:, int(np.argmax(values.real))].real
    # Y r is the left eigenvector of X Y.
    rho, q = float(np.max(values.real)), Y @ r
    return bool(q @ r > 0 and rho - (q @ E_x @ q + rho * r @ E_y @ r) / (q @ r) > gamma**2)


def norm_is_confirmed(plant: Plant, test: GammaTest) -> bool:
    """Whether the measured norm of the loop with the central controller of a passed test is below its gamma."""
    m2, p2 = plant.D12.shape[1], plant.D21.shape[0]
    form = NormalForm(plant, np.eye(m2), np.eye(p2), np.zeros((p2, m2)))
    try:
        K = central_controller(form, test)
        P = StateSpace(
            plant.A,
            np.hstack([plant.B1, plant.B2]),
            np.vstack([plant.C1, plant.C2]),
            np.block([[plant.D11, plant.D12], [plant.D21, plant.D22]]),
        )
        return norm_is_below(lft_lower(P, balance(K)), test.gamma * (1 + SETTINGS.norm_accuracy))
    except (ComputationError, InputError, np.linalg.LinAlgError):
        return False


def find_gamma(
    plant: Plant, tolerance: float, hint: float | None = None, limit: float = 1e10, proved: bool = True
) -> GammaBracket:
    """Bracket the optimum to a relative tolerance: geometric steps, then regula falsi on rho(X Y), or bisection.

    proved : search for a proved lower bound if the test is in doubt just below the optimum.
    ComputationError if even gamma = limit times the initial value, or that without a hint, fails.
    """
    floor, natural = direct_term_bound(plant), natural_gamma(plant)
    nothing = SETTINGS.zero_gamma * natural
    start = max(hint or natural, floor * (1 + 2 * tolerance), nothing)
    search = _Search(plant, floor)
    step, factor, largest = start, 1.05 if hint else 4.0, limit * max(start, natural)
    while not search.try_gamma(step):
        if step >= largest:
            raise ComputationError(
                "no controller was found at any gamma",
                measured=f"gamma up to {step:.3g} tried",
                cause=search.reason,
                next_step="check weights and scaling of the plant",
            )
        step, factor = min(step * factor, largest), factor**2
    assert search.upper is not None
    factor = 1.05 if hint else 4.0
    while search.failed <= max(floor, 0.0) and search.upper.gamma > nothing:
        step = search.upper.gamma / factor
        if step <= floor * (1 + tolerance):
            step = floor * (1 + tolerance / 2)
            if step == 0.0 or search.upper.gamma <= step * (1 + tolerance / 4):
                break
        search.try_gamma(step)
        factor = min(factor**2, 1e3)
    if search.upper.gamma <= 100 * nothing:
        return GammaBracket(0.0, search.upper, "nothing: the optimum is zero to working precision")
    search.refine(tolerance, nothing)
    if proved:
        search.prove(tolerance)
    return GammaBracket(search.lower, search.upper, search.reason or "the direct term D11")


class _Search:
    """State of the search for gamma: the bracket and the last couplings rho(X Y) / gamma^2."""

    def __init__(self, plant: Plant, floor: float):
        # `failed` controls the search, `lower` is the proved bound.
        self.plant, self.lower, self.failed = plant, floor, floor
        self.upper: GammaTest | None = None
        self.below: GammaTest | None = None
        self.second: GammaTest | None = None
        self.reason = ""

    def try_gamma(self, gamma: float) -> bool:
        outcome = gamma_test(self.plant, gamma)
        passed = outcome.feasible and (not outcome.doubtful or norm_is_confirmed(self.plant, outcome))
        self.lower = max(self.lower, outcome.forbidden)
        if passed:
            self.second, self.upper = self.upper, outcome
        elif gamma >= self.failed:
            self.failed, self.below, self.reason = gamma, outcome, outcome.reason or IN_DOUBT
        return passed

    def prove(self, tolerance: float) -> None:
        """Bisection for a proved failure if the last failure was in doubt; few steps, because each costs a test."""
        unproved = self.failed
        for _ in range(6):
            if unproved - self.lower <= tolerance * unproved:
                return
            middle = np.sqrt(self.lower * unproved) if self.lower > 0.1 * unproved else unproved / 3
            before = self.lower
            outcome = gamma_test(self.plant, middle)
            self.lower = max(self.lower, outcome.forbidden)
            if self.lower == before:
                unproved = middle

    def refine(self, tolerance: float, absolute: float) -> None:
        """Shrink the bracket to the tolerance, or to an absolute width if the optimum is zero."""
        for count in range(200):
            assert self.upper is not None
            low, high = self.failed, self.upper.gamma
            if high - low <= max(tolerance * low, absolute):
                return
            middle = np.sqrt(low * high) if low > 0 and high > 2 * low else (low + high) / 2
            guess = self._predicted()
            # Every third test halves the bracket, so that a bad prediction costs at most a factor of 1.5.
            if count % 3 == 2 or not low < guess < high:
                self.try_gamma(middle)
                continue
            below, above = guess * (1 - 0.4 * tolerance), guess * (1 + 0.4 * tolerance)
            if below > low and self.try_gamma(below):
                continue
            if self.upper.gamma > above > self.failed:
                self.try_gamma(above)

    def _predicted(self) -> float:
        """Root of 1 / coupling = 1 by the secant through the two nearest couplings; nan if they do not exist."""
        other = self.below if self.below is not None and np.isfinite(self.below.coupling) else self.second
        if self.upper is None or other is None or not min(self.upper.coupling, other.coupling) > 0:
            return np.nan
        f_high, f_other = 1 / self.upper.coupling - 1, 1 / other.coupling - 1
        if f_high == f_other:
            return np.nan
        return self.upper.gamma - f_high * (self.upper.gamma - other.gamma) / (f_high - f_other)


def central_controller(form: NormalForm, test: GammaTest) -> StateSpace:
    """The central (maximum entropy) controller of the original plant at a feasible gamma, state dimension n.

    If its loop around D22 is nearly singular, another controller of the family F_l(M, Q), |Q| < gamma, with a constant
    Q is used. This happens in discrete time: entropy is evaluated at z = -1, where a K with a pole may cancel y.
    """
    assert test.X is not None and test.Y is not None
    P, gamma, X, Y = form.plant, test.gamma, test.X, test.Y
    m2, p2 = P.D12.shape[1], P.D21.shape[0]
    p1, m1 = P.D11.shape[0] - m2, P.D11.shape[1] - p2
    B, C = np.hstack([P.B1, P.B2]), np.vstack([P.C1, P.C2])
    D1, R = _row_terms(P, gamma)
    Dc, Rt = _column_terms(P, gamma)
    F = -np.linalg.solve(R, D1.T @ P.C1 + B.T @ X)
    L = -np.linalg.solve(Rt, Dc @ P.B1.T + C @ Y).T
    F12, F2 = F[m1 : m1 + p2], F[m1 + p2 :]
    L12, L2 = L[:, p1 : p1 + m2], L[:, p1 + m2 :]
    D1111, D1112 = P.D11[:p1, :m1], P.D11[:p1, m1:]
    D1121, D1122 = P.D11[p1:, :m1], P.D11[p1:, m1:]
    D = -D1121 @ D1111.T @ np.linalg.solve(gamma**2 * np.eye(p1) - D1111 @ D1111.T, D1112) - D1122
    left = np.eye(m2) - D1121 @ np.linalg.solve(gamma**2 * np.eye(m1) - D1111.T @ D1111, D1121.T)
    right = np.eye(p2) - D1112.T @ np.linalg.solve(gamma**2 * np.eye(p1) - D1111 @ D1111.T, D1112)
    D = D + _off_centre(form, D, left, right, gamma)
    inner = P.C2 + F12
    # Z = inv(I - Y X / gamma^2); the controller's states are chosen so that Z appears only in its input matrix.
    B_hat = np.linalg.solve(np.eye(P.n) - Y @ X / gamma**2, (P.B2 + L12) @ D - L2)
    C_hat = F2 - D @ inner
    A_hat = P.A + B @ F - B_hat @ inner
    return _restored(form, A_hat, B_hat, C_hat, D)


def _off_centre(form: NormalForm, D: np.ndarray, left: np.ndarray, right: np.ndarray, gamma: float) -> np.ndarray:
    """D12 Q D21 of the family (Glover and Doyle 1988), left = D12 D12', right = D21' D21, to regularise I + D_K D22.

    Zero if the central controller's loop is well conditioned; otherwise Q of norm `off_centre` gamma that raises all
    singular values of I + D_K D22 most, to first order.
    """
    direct = form.T @ form.D22 @ form.S
    U, sigma, Vt = la.svd(np.eye(D.shape[0]) + D @ direct)
    if sigma[-1] * SETTINGS.well_posed > 1 + la.norm(D @ direct, 2):
        return np.zeros_like(D)
    L, R = la.cholesky(left, lower=True), la.cholesky(right)
    q, _, pt = la.svd(L.T @ U @ Vt @ (R @ direct).T, full_matrices=False)
    return SETTINGS.off_centre * gamma * L @ q @ pt @ R


def _restored(form: NormalForm, A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> StateSpace:
    """Undo the removal of D22, u = K (y - D22 u), in normal coordinates, which have no units; then the scalings."""
    direct = form.T @ form.D22 @ form.S
    loop = np.eye(D.shape[0]) + D @ direct
    if np.linalg.cond(loop) > 1e12:
        raise ComputationError(
            "the controller's loop around D22 is not well posed",
            measured=f"condition of I + D_K D22 is {np.linalg.cond(loop):.1e}",
            cause="a direct term from u to y that cancels the controller's own",
            next_step="put a low-pass filter in the plant's actuators or sensors",
        )
    M = np.linalg.inv(loop)
    C, D = M @ C, M @ D
    return StateSpace(
        A - B @ direct @ C,
        B @ (np.eye(B.shape[1]) - direct @ D) @ form.T,
        form.S @ C,
        form.S @ D @ form.T,
        0.0,
        form.plant.y,
        form.plant.u,
    )


def _row_terms(P: Plant, gamma: float) -> tuple[np.ndarray, np.ndarray]:
    """D1. = [D11 D12] and R = D1.' D1. - diag(gamma^2 I, 0)."""
    D1 = np.hstack([P.D11, P.D12])
    R = D1.T @ D1
    w = P.D11.shape[1]
    R[:w, :w] -= gamma**2 * np.eye(w)
    return D1, R


def _column_terms(P: Plant, gamma: float) -> tuple[np.ndarray, np.ndarray]:
    """D.1 = [D11; D21] and R~ = D.1 D.1' - diag(gamma^2 I, 0)."""
    Dc, Rt = _row_terms(_dual(P), gamma)
    return Dc.T, Rt


def _dual(P: Plant) -> Plant:
    return Plant(P.A.T, P.C1.T, P.C2.T, P.B1.T, P.B2.T, P.D11.T, P.D21.T, P.D12.T, P.D22.T, P.y, P.u)


def control_riccati(P: Plant, gamma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A, R, Q) of the Riccati equation of X."""
    D1, R = _row_terms(P, gamma)
    B = np.hstack([P.B1, P.B2])
    solved = np.linalg.solve(R, np.hstack([D1.T @ P.C1, B.T]))
    K, G = solved[:, : P.n], solved[:, P.n :]
    quadratic, constant = -B @ G, _difference(P.C1.T @ P.C1, P.C1.T @ D1, K)
    return _difference(P.A, B, K), (quadratic + quadratic.T) / 2, (constant + constant.T) / 2


def rounding(P: Plant, gamma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bounds of the round-off in the entries of (A, R, Q) of `control_riccati`."""
    D1, R = _row_terms(P, gamma)
    B, d, c = np.abs(np.hstack([P.B1, P.B2])), np.abs(D1), np.abs(P.C1)
    w = P.D11.shape[1]
    # |R| is bounded by the sum of its terms, because R is a difference, too.
    terms = d.T @ d
    terms[:w, :w] += gamma**2 * np.eye(w)
    right = np.hstack([d.T @ c, B.T])
    inverse = np.abs(np.linalg.inv(R))
    solved = inverse @ (terms @ np.abs(np.linalg.solve(R, np.hstack([D1.T @ P.C1, np.hstack([P.B1, P.B2]).T]))) + right)
    K, G = solved[:, : P.n], solved[:, P.n :]
    size = np.abs(P.A) + B @ K, B @ G, c.T @ c + c.T @ d @ K
    return tuple(SETTINGS.round_off * one for one in size)


def _difference(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """a - b c with entries that are pure round-off set to zero, because balancing would treat them as couplings."""
    result = a - b @ c
    noise = SETTINGS.round_off * (np.abs(a) + np.abs(b) @ np.abs(c))
    return np.where(np.abs(result) <= noise, 0.0, result)


def filter_riccati(P: Plant, gamma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A', R, Q) of the Riccati equation of Y: the control equation of the transposed plant."""
    return control_riccati(_dual(P), gamma)


def natural_gamma(plant: Plant) -> float:
    """Initial gamma of the right order of magnitude: the open-loop channel w -> z, off the imaginary axis."""
    return float(plant.size(plant.B1, plant.C1, plant.D11))
