"""Residuals and first-order errors of the sequential and the joint fit of section 3 (Beadle et al.)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import least_squares

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.rigs.halcyonics import Halcyonics
from benchmarks.sequential.data import MeasuredTests, row_of, voltage_transfers
from benchmarks.sequential.published import SIGNED, TestCase, parameters_of, values_of, with_values

Weighting = Literal["equal", "variance"]
# Unit of the search for a parameter that may vanish [m or kg m^2]; positive ones are searched by their logarithm.
_SIGNED_UNIT = 0.1
# A positive parameter a thousand times above or below its start is none that was fitted.
_RUNAWAY = np.log(1e3)


@dataclass(frozen=True)
class Step:
    """Tests fitted together and the parameters that they are fitted over."""

    tests: tuple[TestCase, ...]
    parameters: tuple[str, ...]


def steps_of(tests: Sequence[TestCase]) -> tuple[Step, ...]:
    """The tests in order; those of one group at the place of its first."""
    groups: dict[str, list[TestCase]] = {}
    for test in tests:
        groups.setdefault(test.group or f"test {test.number}", []).append(test)
    return tuple(Step(tuple(group), parameters_of(group)) for group in groups.values())


class Problem:
    """Measured against theoretical transfers X/V of one band, as functions of all parameters theta at once.

    weighting : "equal" is eq. 33, every line alike. "variance" divides each line by its measured variance.
    """

    def __init__(
        self, rig: Halcyonics, tests: Sequence[TestCase], measured: MeasuredTests, weighting: Weighting = "equal"
    ):
        if weighting not in ("equal", "variance"):
            raise InputError("expected equal or variance", field="weighting", value=weighting)
        if weighting == "variance" and measured.variance is None:
            raise InputError(
                "the measured transfers carry no variance to weight with", field="weighting", value=weighting
            )
        self.rig, self.tests, self.measured = rig, tuple(tests), measured
        self.names, self.steps = parameters_of(tests), steps_of(tests)
        self.start = values_of(rig, self.names)
        if missing := [test.number for test in tests if test.number not in measured.transfers]:
            raise InputError("expected a measured transfer for each test", field="measured", value=missing)
        if wrong := [name for name in self.names if name in ("M2_arm", "M3_arm")]:
            raise InputError("the measured points are fixed; expected another parameter", field="tests", value=wrong)
        self.rows = {test.number: row_of(rig, test) for test in tests}
        self.scale = {test.number: self._scale(step, test, weighting) for step in self.steps for test in step.tests}
        self.positive = np.array([name not in SIGNED for name in self.names])
        if np.any(self.start[self.positive] <= 0):
            wrong = [
                name for name, value in zip(self.names, self.start, strict=True) if name not in SIGNED and value <= 0
            ]
            raise InputError("expected positive starting values", field="rig", value=wrong)
        for step in self.steps:
            if 2 * measured.omega.size <= len(step.parameters):
                raise InputError(
                    f"expected more lines in the band for {', '.join(step.parameters)}",
                    field="measured",
                    value=measured.omega.size,
                )

    def _scale(self, step: Step, test: TestCase, weighting: Weighting) -> np.ndarray:
        """Divisor of each line: makes the residual a number near one, alike within a step for eq. 33."""
        if weighting == "variance":
            assert self.measured.variance is not None
            return np.sqrt(self.measured.variance[test.number] / 2)
        power = sum(float(np.sum(np.abs(self.measured.transfers[t.number]) ** 2)) for t in step.tests)
        if power == 0:
            raise InputError("expected a transfer that is not zero everywhere", field=f"test {test.number}")
        return np.full(self.measured.omega.size, np.sqrt(power))

    def rig_at(self, theta: np.ndarray) -> Halcyonics:
        return with_values(self.rig, dict(zip(self.names, theta.tolist(), strict=True)))

    def theory(self, rig: Halcyonics, tests: Sequence[TestCase]) -> np.ndarray:
        """Theoretical X/V [m/V] of some tests, (tests, n)."""
        rows = np.array([self.rows[test.number] for test in tests])
        patterns = np.array([test.pattern for test in tests])
        return voltage_transfers(rig, rows, patterns, self.measured.omega)

    def residual(self, tests: Sequence[TestCase], theta: np.ndarray) -> np.ndarray:
        """Real and imaginary parts of theory minus experiment over `scale`, stacked."""
        parts = [
            (transfer - self.measured.transfers[test.number]) / self.scale[test.number]
            for test, transfer in zip(tests, self.theory(self.rig_at(theta), tests), strict=True)
        ]
        return np.concatenate([part.view(float) for part in parts])

    def jacobian(self, tests: Sequence[TestCase], theta: np.ndarray) -> np.ndarray:
        """Derivative of `residual` by all parameters in their units, by central differences."""
        columns = []
        for k, value in enumerate(theta):
            h = 1e-5 * (abs(value) if self.positive[k] else max(abs(value), _SIGNED_UNIT))
            step = h * np.eye(theta.size)[k]
            columns.append((self.residual(tests, theta + step) - self.residual(tests, theta - step)) / (2 * h))
        return np.column_stack(columns)

    def minimise(self, tests: Sequence[TestCase], names: Sequence[str], theta: np.ndarray) -> np.ndarray:
        """theta with some parameters at the least sum of squares over some tests, from theta on.

        Raises ComputationError where the search ends without a minimum or runs away.
        """
        free = [self.names.index(name) for name in names]
        positive, base = self.positive[free], theta[free]

        def at(x: np.ndarray) -> np.ndarray:
            moved = theta.copy()
            moved[free] = np.where(positive, base * np.exp(np.where(positive, x, 0.0)), base + _SIGNED_UNIT * x)
            return moved

        refused = 10 * np.ones_like(self.residual(tests, theta)) * (1 + np.abs(self.residual(tests, theta)).max())

        def residual(x: np.ndarray) -> np.ndarray:
            try:
                found = self.residual(tests, at(x))
            except InputError:  # no positive definite mass matrix there: the search steps back
                return refused
            return found if np.all(np.isfinite(found)) else refused

        found = least_squares(
            residual, np.zeros(len(free)), jac="3-point", xtol=1e-9, ftol=1e-12, gtol=1e-14, max_nfev=200
        )
        if not found.success:
            raise ComputationError(
                f"the fit of {', '.join(names)} to test {', '.join(str(t.number) for t in tests)} found no minimum",
                measured=f"{found.nfev} evaluations, cost {found.cost:.3g}",
                cause="a start far off, or transfers that do not hold these parameters",
                next_step="start nearer, or look at the measured transfer of that test",
            )
        away = [name for name, up, x in zip(names, positive, found.x, strict=True) if up and abs(x) > _RUNAWAY]
        if away:
            raise ComputationError(
                f"the fit to test {', '.join(str(t.number) for t in tests)} ran away",
                measured=", ".join(f"{name} = {at(found.x)[self.names.index(name)]:.3g}" for name in away),
                cause="a start too far off, or transfers that do not hold these parameters",
                next_step="start nearer: for the joint fit, from the result of the sequential one",
            )
        return at(found.x)

    def line_variance(self, test: TestCase, theta: np.ndarray) -> np.ndarray:
        """E|error|^2 [m^2/V^2] of each line, (n,): measured, otherwise the mean of what the fit leaves in this test."""
        if self.measured.variance is not None:
            return self.measured.variance[test.number]
        left = np.abs(self.theory(self.rig_at(theta), [test])[0] - self.measured.transfers[test.number]) ** 2
        n = self.measured.omega.size
        return np.full(n, float(np.sum(left)) / (n - len(test.parameters) / 2))


@dataclass(frozen=True, eq=False)
class Spread:
    """First-order errors of the estimates at the end of the fit, by parameter in the tables' order.

    Attributes
    ----------
    conditional : (p,) standard deviation with the parameters of all other tests known exactly: what a single test
        gives.
    sequential : (p, p) covariance of the point where the sequential scheme comes to rest. With the conditions
        g_s = J_ss^T r_s = 0 of the steps s, it is A^-1 cov(g) A^-T, A_s = J_ss^T J_s,all.
    joint : (p, p) covariance of the joint fit of all tests weighted by variance, (J^T V^-1 J)^-1: no unbiased
        estimate from the same data has less (Cramer-Rao).
    iteration : (p, p) B: near the rest point one round of tests takes the distance d from it to B d (block
        Gauss-Seidel on A).
    """

    conditional: np.ndarray
    sequential: np.ndarray
    joint: np.ndarray
    iteration: np.ndarray

    @property
    def rate(self) -> float:
        """Spectral radius of B: the factor by which the distance shrinks per round; at 1 or more the scheme diverges.

        A round that moves theta by m leaves about m rate/(1 - rate) to go.
        """
        return float(np.abs(np.linalg.eigvals(self.iteration)).max())


def spread_at(problem: Problem, theta: np.ndarray) -> Spread:
    """Errors and convergence rate at theta.

    Raises ComputationError where the tests do not determine the parameters, or where the mass matrix is at the edge of
    being positive definite.
    """
    p = theta.size
    A, noise, fisher = np.zeros((p, p)), np.zeros((p, p)), np.zeros((p, p))
    for step in problem.steps:
        own = [problem.names.index(name) for name in step.parameters]
        try:
            J = problem.jacobian(step.tests, theta)
        except InputError as error:
            raise ComputationError(
                "the fit came to rest where the inertia is no longer that of a body",
                measured=f"{', '.join(problem.names)} = {np.array2string(theta, precision=4)}",
                cause="a wrong start, load mass or measured point: the scheme has such rest points",
                next_step="check them, or fit all tests jointly",
            ) from error
        half = np.concatenate(
            [np.repeat(problem.line_variance(t, theta) / problem.scale[t.number] ** 2 / 2, 2) for t in step.tests]
        )
        A[own] = J[:, own].T @ J
        noise[np.ix_(own, own)] = J[:, own].T @ (half[:, None] * J[:, own])
        if np.all(half > 0):
            fisher += J.T @ (J / half[:, None])
    unit = np.where(problem.positive, np.abs(theta), _SIGNED_UNIT)
    scaled = A * unit
    size = np.linalg.norm(scaled, axis=1, keepdims=True)
    condition = np.linalg.cond(scaled / size) if np.all(size > 0) else np.inf
    if not np.all(np.diag(A) > 0) or not condition < 1e12:
        raise ComputationError(
            "the tests do not determine their parameters",
            measured=f"condition {condition:.2g}",
            cause="a parameter that its test does not see",
            next_step="use another test for it",
        )
    lower = np.zeros_like(A)
    conditional = np.zeros(p)
    before: list[int] = []
    for step in problem.steps:
        own = [problem.names.index(name) for name in step.parameters]
        before += own
        lower[np.ix_(own, before)] = A[np.ix_(own, before)]
        inverse = np.linalg.inv(A[np.ix_(own, own)])
        conditional[own] = np.sqrt(np.diag(inverse @ noise[np.ix_(own, own)] @ inverse))
    inverse = np.linalg.inv(A)
    joint = np.linalg.inv(fisher * np.outer(unit, unit)) * np.outer(unit, unit) if np.any(fisher) else 0 * fisher
    return Spread(conditional, inverse @ noise @ inverse.T, joint, np.linalg.solve(lower, lower - A))
