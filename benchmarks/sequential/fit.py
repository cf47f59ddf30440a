"""The sequential parameter identification of Beadle, Hurlebaus, Stoebener and Gaul, section 3.

Test by test the squared distance of the measured from the theoretical transfer function (eq. 33) over 2.5-20 Hz is
minimised over the parameters of that test, the model is updated, and the round of tests is repeated until every
parameter moves by less than 5 %.

Moving by less than 5 % is not being within 5 %: where a round of tests shrinks the distance to the rest point by a
factor rate, a move m leaves m rate/(1 - rate). Each result carries that distance (`to_rest`).

Beside the source (benchmarks/sequential computes all of this; data simulated from the printed values): the
loaded fit needs 6 rounds where the source needed 4. The rounds depend on the load's mass, which the source does not
print: with 2.5 or 5 kg they are 4, with the 10 kg assumed in the rig file the rate is 0.83 and the 5 % rule leaves L7
12 % and I_yy 4 % from the rest point. Unfinished rounds leave I_yy low, I_zz high and k_r above its unloaded value, as
in the source's final column; but they leave L7 too large where the source's is too small, and L8 nearly right where
the source's is a third too small, so they are not the whole of it. Measurement noise is no explanation: it moves L7 by
some 0.2 %. Small errors of what is taken as known move the rest point far more: e_1 high by 2 % moves L7 by 11 %, in
the source's direction, d_3 changed by 10 % under the load moves L8 by 14 %. Which of these acted on the source's
hardware cannot be said from what it prints.

What is compared is X/V, displacement per volt, for every test. The source divides the measured X/V by e_r and
compares X/F_r (eq. 32). With e_r known both are the same but for a constant factor. Where e_r is what the test
identifies they are not: the theoretical X/F_1 of test 1 does not contain e_1, the measured X/V over e_1 does, and its
squared distance favours a large e_1, which shrinks signal and noise together. X/V has e_r on the side of the theory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.halcyonics import Halcyonics
from benchmarks.sequential.data import MeasuredTests
from benchmarks.sequential.problem import Problem, Spread, Weighting, spread_at
from benchmarks.sequential.published import SIGNED, TestCase, unit_of, values_of, with_values

BAND_HZ = (2.5, 20.0)
DRAWN_HZ = (2.5, 40.0)


@dataclass(frozen=True)
class TableRow:
    """A row of Table 1 or 2 with its error.

    `deviation` is the standard deviation of the sequential estimate; `actual` and `source` (the source's own final
    value) are None where there is none.
    """

    test: int
    actuators: str
    displacement: str
    parameter: str
    unit: str
    initial: float
    final: float
    deviation: float
    actual: float | None
    source: float | None


@dataclass(frozen=True, eq=False)
class FigureData:
    """A figure such as the source's 8-13: X/F_r, experiment and theory, (n,) each; dB of m/N, unwrapped degrees."""

    test: TestCase
    frequency_Hz: np.ndarray
    experiment_dB: np.ndarray
    theory_dB: np.ndarray
    experiment_deg: np.ndarray
    theory_deg: np.ndarray


@dataclass(frozen=True, eq=False)
class SequentialResult:
    """Outcome of `sequential_fit`.

    Attributes
    ----------
    rig : with the final values.
    names : (p,) parameters in the tables' order; history : (iterations + 1, p) values, the start first.
    converged : every parameter moved by less than the tolerance in the last iteration; iterations : rounds done.
    spread : errors at the final values.
    misfit : by test number, r.m.s. distance of theory and experiment over the band, relative to the experiment.
    chi_square : by test number, the mean over lines of |distance|^2 / variance: near 1 where the noise explains it.
        None without variances.
    """

    tests: tuple[TestCase, ...]
    rig: Halcyonics
    names: tuple[str, ...]
    history: np.ndarray
    converged: bool
    iterations: int
    tolerance: float
    spread: Spread
    misfit: Mapping[int, float]
    chi_square: Mapping[int, float] | None
    measured: MeasuredTests

    @property
    def final(self) -> dict[str, float]:
        return dict(zip(self.names, self.history[-1].tolist(), strict=True))

    @property
    def to_rest(self) -> dict[str, float]:
        """What each parameter still has to go to the scheme's rest point, B (I - B)^-1 (last move); NaN if it diverges.

        First order: where it is not small it is itself inaccurate.
        """
        B, move = self.spread.iteration, self.history[-1] - self.history[-2]
        left = B @ np.linalg.solve(np.eye(len(B)) - B, move) if self.spread.rate < 1 else np.full(len(B), np.nan)
        return dict(zip(self.names, left.tolist(), strict=True))

    def extrapolated(self) -> Halcyonics:
        """The rig moved by `to_rest`: a start from which few further rounds remain. The source does not do this.

        Raises InputError where the values are no longer those of a body.
        """
        return with_values(self.rig, {name: value + self.to_rest[name] for name, value in self.final.items()})

    @property
    def standard_deviation(self) -> dict[str, float]:
        """Of the sequential estimate, by parameter."""
        return dict(zip(self.names, np.sqrt(np.diag(self.spread.sequential)).tolist(), strict=True))

    def rows(self, actual: Halcyonics | None = None, source: Mapping[str, float] | None = None) -> list[TableRow]:
        """Rows as in Tables 1 and 2; `actual` the rig that was measured, where it is known."""
        truth = None if actual is None else dict(zip(self.names, values_of(actual, self.names).tolist(), strict=True))
        start, final, deviation = (
            dict(zip(self.names, self.history[0], strict=True)),
            self.final,
            self.standard_deviation,
        )
        return [
            TableRow(
                test.number,
                test.actuators,
                test.displacement,
                name,
                unit_of(self.rig, name),
                float(start[name]),
                final[name],
                deviation[name],
                None if truth is None else truth[name],
                (source or {}).get(name),
            )
            for test in self.tests
            for name in test.parameters
        ]

    def figure(self, number: int) -> FigureData:
        """Experiment and theory of one test over 2.5-40 Hz, as far as it was measured."""
        test = next((test for test in self.tests if test.number == number), None)
        if test is None:
            raise InputError(f"expected one of {[t.number for t in self.tests]}", field="test", value=number)
        problem = Problem(self.rig, [test], self.measured.between(*DRAWN_HZ))
        e_r = self.rig.e[test.reference - 1]
        measured, theory = problem.measured.transfers[number] / e_r, problem.theory(self.rig, [test])[0] / e_r
        return FigureData(
            test,
            problem.measured.frequency_Hz,
            _decibel(measured),
            _decibel(theory),
            _degrees(measured),
            _degrees(theory),
        )


def _decibel(transfer: np.ndarray) -> np.ndarray:
    return 20 * np.log10(np.maximum(np.abs(transfer), np.finfo(float).tiny))


def _degrees(transfer: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.unwrap(np.angle(transfer)))


def sequential_fit(
    rig: Halcyonics,
    tests: Sequence[TestCase],
    measured: MeasuredTests,
    *,
    band_Hz: tuple[float, float] = BAND_HZ,
    tolerance: float = 0.05,
    max_iterations: int = 50,
    weighting: Weighting = "equal",
) -> SequentialResult:
    """Fit the tests' parameters one test after the other, round after round.

    Parameters
    ----------
    rig : holds the starting values and everything that is not fitted.
    tests : `UNLOADED_TESTS`, `LOADED_TESTS` or others; a group is fitted where its first test stands.
    measured : X/V of each test, real or simulated, on any lines; those in `band_Hz` are fitted.
    tolerance : largest move of any parameter in one iteration, relative to its value before. A parameter that was
        zero has moved by less than that when it moved by less than tolerance times 1 mm (1 g m^2).
    weighting : "equal" is eq. 33.

    Returns a result with converged = False after `max_iterations`. Raises InputError for tests without data or
    a rig without the load that they ask for, ComputationError where a test has no minimum.
    """
    if not (np.isfinite(tolerance) and tolerance > 0):
        raise InputError("expected a positive number", field="tolerance", value=tolerance)
    if max_iterations < 1:
        raise InputError("expected at least one iteration", field="max_iterations", value=max_iterations)
    problem = Problem(rig, tests, measured.between(*band_Hz), weighting)
    smallest = np.array([SIGNED.get(name, 0.0) for name in problem.names])
    history, converged = [problem.start], False
    while not converged and len(history) <= max_iterations:
        theta = history[-1]
        for step in problem.steps:
            theta = problem.minimise(step.tests, step.parameters, theta)
        converged = bool(np.all(np.abs(theta - history[-1]) <= tolerance * np.maximum(np.abs(history[-1]), smallest)))
        history.append(theta)
    final = problem.rig_at(history[-1])
    misfit, chi_square = _quality(problem, final)
    return SequentialResult(
        tuple(tests),
        final,
        problem.names,
        np.array(history),
        converged,
        len(history) - 1,
        tolerance,
        spread_at(problem, history[-1]),
        misfit,
        chi_square,
        measured,
    )


@dataclass(frozen=True, eq=False)
class JointResult:
    """Outcome of `joint_fit`: rig with the values, and their covariance (p, p).

    chi_square : by test number, as in `SequentialResult`; far above 1 the minimum is a wrong one, or the model is.
    """

    rig: Halcyonics
    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    chi_square: Mapping[int, float]

    @property
    def final(self) -> dict[str, float]:
        return dict(zip(self.names, self.values.tolist(), strict=True))


def joint_fit(
    rig: Halcyonics, tests: Sequence[TestCase], measured: MeasuredTests, *, band_Hz: tuple[float, float] = BAND_HZ
) -> JointResult:
    """All parameters from all tests at once, weighted by the measured variances: what the sequential fit is judged by.

    `rig` holds the starting values: take those of a sequential fit. From the printed start of Table 2 the search ended
    in a wrong minimum or ran away in 2 of 30 noises, from the sequential fit in none. Raises as `sequential_fit`.
    """
    problem = Problem(rig, tests, measured.between(*band_Hz), "variance")
    theta = problem.minimise(problem.tests, problem.names, problem.start)
    rig = problem.rig_at(theta)
    chi_square = _quality(problem, rig)[1]
    assert chi_square is not None  # the problem insists on variances
    return JointResult(rig, problem.names, theta, spread_at(problem, theta).joint, chi_square)


def _quality(problem: Problem, rig: Halcyonics) -> tuple[dict[int, float], dict[int, float] | None]:
    variance = problem.measured.variance
    misfit, chi_square = {}, {}
    for test in problem.tests:
        experiment = problem.measured.transfers[test.number]
        distance = np.abs(problem.theory(rig, [test])[0] - experiment) ** 2
        misfit[test.number] = float(np.sqrt(np.sum(distance) / np.sum(np.abs(experiment) ** 2)))
        if variance is not None:
            chi_square[test.number] = float(np.mean(distance / variance[test.number]))
    return misfit, None if variance is None else chi_square
