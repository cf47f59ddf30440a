"""The sequential parameter identification of Beadle et al. on simulated transfer functions, beside the source's tables.

    python -m benchmarks.sequential [--seeds N]

Printed: Table 1 and its basin of starts; Table 2, round by round, with what the 5 % rule leaves; the same over the
load's mass, which the source does not print; rest points of a rig known slightly wrongly; and a Monte Carlo of the
sequential against the joint fit. Nothing here is the source's hardware: the "actual" rig is the model with the
printed values.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import AvisError
from avis_ctrl.rigs import load_rig
from avis_ctrl.rigs.halcyonics import Halcyonics
from benchmarks.sequential.data import Analyser, MeasuredTests, simulate_tests
from benchmarks.sequential.fit import SequentialResult, joint_fit, sequential_fit
from benchmarks.sequential.problem import Weighting
from benchmarks.sequential.published import (
    LOADED_SOURCE_FINAL,
    LOADED_TESTS,
    SOURCE_ITERATIONS,
    UNLOADED_TESTS,
    TestCase,
    loaded_start,
    perturbed_start,
    values_of,
)


def bare_and_loaded() -> tuple[Halcyonics, Halcyonics]:
    bare, loaded = load_rig("halcyonics"), load_rig("halcyonics_loaded")
    assert isinstance(bare, Halcyonics) and isinstance(loaded, Halcyonics)
    return bare, loaded


def print_table(result: SequentialResult, actual: Halcyonics, source: Mapping[str, float] | None = None) -> None:
    print(
        f"{'test':>4s} {'actuators':>17s} {'':>4s} {'parameter':>10s} {'':>10s} {'initial':>10s} {'final':>10s} "
        f"{'st. dev.':>10s} {'actual':>10s} {'source':>10s} {'to rest':>10s}"
    )
    for row in result.rows(actual, source):
        print(
            f"{row.test:4d} {row.actuators:>17s} {row.displacement:>4s} {row.parameter:>10s} {row.unit:>10s} "
            f"{row.initial:10.5g} {row.final:10.5g} {row.deviation:10.2g} {row.actual or 0:10.5g} "
            f"{'-' if row.source is None else format(row.source, '.5g'):>10s} {result.to_rest[row.parameter]:10.2g}"
        )
    print(
        f"{'converged' if result.converged else 'not converged'} after {result.iterations} iterations; "
        f"distance to rest shrinks by {result.spread.rate:.3g} per iteration"
    )


def at_rest(
    start: Halcyonics,
    tests: Sequence[TestCase],
    measured: MeasuredTests,
    weighting: Weighting = "equal",
    rounds: int = 12,
) -> SequentialResult:
    """Where the scheme comes to rest: single rounds, each followed by the extrapolation to the rest point."""
    result = sequential_fit(start, tests, measured, weighting=weighting)
    for _ in range(rounds):
        result = sequential_fit(result.extrapolated(), tests, measured, max_iterations=1, weighting=weighting)
        left = np.array([abs(result.to_rest[name]) for name in result.names])
        if np.all(left < 1e-2 * np.sqrt(np.diag(result.spread.sequential)) + 1e-7 * np.abs(result.history[-1])):
            break
    return result


def table_1(bare: Halcyonics, starts: int = 20) -> None:
    print("\nTable 1 (unloaded), start 20-30 % off (ours; the source prints none), seed 0")
    measured = simulate_tests(bare, UNLOADED_TESTS, Analyser(), 0)
    result = sequential_fit(perturbed_start(bare, UNLOADED_TESTS, 0), UNLOADED_TESTS, measured)
    print_table(result, bare)
    iterations, worst = [], 0.0
    for seed in range(starts):
        measured = simulate_tests(bare, UNLOADED_TESTS, Analyser(), seed)
        one = sequential_fit(perturbed_start(bare, UNLOADED_TESTS, seed), UNLOADED_TESTS, measured)
        iterations.append(one.iterations if one.converged else -1)
        worst = max(worst, float(np.abs(one.history[-1] / values_of(bare, one.names) - 1).max()))
    print(
        f"{starts} starts and noises: iterations {sorted(iterations)} (-1: not converged), largest error of any "
        f"parameter {100 * worst:.2g} %"
    )


def table_2(bare: Halcyonics, loaded: Halcyonics) -> None:
    print("\nTable 2 (loaded), start as printed, seed 0")
    assert loaded.load is not None
    measured = simulate_tests(loaded, LOADED_TESTS, Analyser(), 0)
    start = loaded_start(bare, loaded.load.mass)
    result = sequential_fit(start, LOADED_TESTS, measured)
    print_table(result, loaded, LOADED_SOURCE_FINAL)
    print(f"\nround by round (the source stopped after {SOURCE_ITERATIONS})")
    print("      " + "".join(f"{name:>11s}" for name in result.names))
    for k, values in enumerate(result.history):
        print(f"{k:5d} " + "".join(f"{value:11.5g}" for value in values))
    rest, joint = at_rest(start, LOADED_TESTS, measured), joint_fit(result.rig, LOADED_TESTS, measured)
    print(" rest " + "".join(f"{value:11.5g}" for value in rest.history[-1]))
    print("joint " + "".join(f"{value:11.5g}" for value in joint.values))
    print("truth " + "".join(f"{value:11.5g}" for value in values_of(loaded, result.names)))
    for name, one in (("stop", result), ("rest", rest)):
        assert one.chi_square is not None
        print(
            f"mean squared distance over variance by test, at {name}: "
            + " ".join(f"{value:.3g}" for value in one.chi_square.values())
        )


def other_masses(bare: Halcyonics, loaded: Halcyonics) -> None:
    print("\nNo noise, other loads (the source does not print m_e), and with the stiffnesses that the source ended at")
    cases: dict[str, dict[str, float]] = {
        f"m_e = {mass:g} kg": {"load.mass": mass} for mass in (2.5, 5, 7.5, 10, 15, 20)
    }
    cases["source's k_s, k_t, k_r"] = {name: LOADED_SOURCE_FINAL[name] for name in ("k_s", "k_t", "k_r")}
    for label, change in cases.items():
        truth = loaded.with_parameters(change)
        assert truth.load is not None
        result = sequential_fit(loaded_start(bare, truth.load.mass), LOADED_TESTS, simulate_tests(truth, LOADED_TESTS))
        print(
            f"{label:>24s}: {result.iterations} iterations, rate {result.spread.rate:.3f}, L7 "
            f"{result.final['L7']:.4f}, L8 {result.final['L8']:.4f}, Iyy {result.final['Iyy_total']:.4f}"
        )


def wrong_knowledge(bare: Halcyonics, loaded: Halcyonics) -> None:
    print("\nRest points from exact transfers when the fixed part of the model is wrong (no noise)")
    assert loaded.load is not None
    start = loaded_start(bare, loaded.load.mass)
    exact = simulate_tests(loaded, LOADED_TESTS)
    quiet = Analyser(averages=2, accelerometer_m_s2_rtHz=0.0, floor_m_s_rtHz=0.0)
    cases = {
        "nothing wrong": (start, exact),
        "m_e 2 % high": (loaded_start(bare, 1.02 * loaded.load.mass), exact),
        "M2 5 mm out": (start.with_parameters({"M2_arm": bare.M2_arm + 0.005}), exact),
        "M3 5 mm out": (start.with_parameters({"M3_arm": bare.M3_arm + 0.005}), exact),
        "e_1 2 % high": (start.with_parameters({"e1": 1.02 * bare.e[0]}), exact),
        "all e 2 % high": (start.with_parameters({f"e{k}": 1.02 * e for k, e in enumerate(bare.e, 1)}), exact),
        "d_3 +10 % by the load": (start, simulate_tests(loaded.with_parameters({"d3": 1.1 * bare.d3}), LOADED_TESTS)),
        "0.1 Hz corner left in": (start, simulate_tests(loaded, LOADED_TESTS, replace(quiet, low_corner_Hz=0.1))),
    }
    print(f"{'':>24s}  " + "".join(f"{name:>11s}" for name in LOADED_SOURCE_FINAL))
    for label, (begin, measured) in cases.items():
        try:
            assert begin.load is not None
            # From near the truth: other rest points exist, and this is about how far this one moves.
            near = replace(begin, load=replace(loaded.load, mass=begin.load.mass))
            result = at_rest(near, LOADED_TESTS, measured)
            print(f"{label:>24s}: " + "".join(f"{result.final[name]:11.5g}" for name in LOADED_SOURCE_FINAL))
        except AvisError as error:
            print(f"{label:>24s}: {error}")


def monte_carlo(truth: Halcyonics, start: Halcyonics, tests: Sequence[TestCase], seeds: int) -> None:
    expected = None
    found: dict[str, list[np.ndarray]] = {"stop": [], "rest": [], "weighted rest": [], "joint": []}
    for seed in range(seeds):
        measured = simulate_tests(truth, tests, Analyser(), 1000 + seed)
        stop = sequential_fit(start, tests, measured)
        joint = joint_fit(stop.rig, tests, measured)
        found["stop"].append(stop.history[-1])
        found["joint"].append(joint.values)
        for label, weighting in (("rest", "equal"), ("weighted rest", "variance")):
            rest = at_rest(joint.rig, tests, measured, weighting)  # type: ignore[arg-type]
            found[label].append(rest.history[-1])
            if label == "rest":
                expected = (
                    np.sqrt(np.diag(rest.spread.sequential)),
                    np.sqrt(np.diag(joint.covariance)),
                    rest.spread.conditional,
                )
    assert expected is not None
    names = stop.names
    actual = values_of(truth, names)
    columns = ["bias", "sd"] * 4
    print(
        f"\n{seeds} noises; bias and standard deviation in % of the value "
        f"(standard error of a bias: sd/{seeds**0.5:.1f})"
    )
    print(
        f"{'':>10s} {'5 % stop':>17s} {'rest (eq. 33)':>17s} {'weighted rest':>17s} {'joint':>17s} "
        f"{'first-order sd: rest':>21s} {'joint':>8s} {'one test':>9s}"
    )
    print(f"{'':>10s} " + "".join(f"{c:>9s}" for c in columns))
    for k, name in enumerate(names):
        cells = []
        for values in found.values():
            error = 100 * (np.array(values)[:, k] - actual[k]) / abs(actual[k])
            cells.append(f"{error.mean():9.3f}{error.std(ddof=1):9.4f}")
        first = [100 * e[k] / abs(actual[k]) for e in expected]
        print(f"{name:>10s} {''.join(cells)} {first[0]:20.4f} {first[1]:8.4f} {first[2]:9.4f}")


def main(seeds: int) -> None:
    bare, loaded = bare_and_loaded()
    assert loaded.load is not None
    with threadpool_limits(1):
        table_1(bare)
        table_2(bare, loaded)
        other_masses(bare, loaded)
        wrong_knowledge(bare, loaded)
        print("\nMonte Carlo, unloaded")
        monte_carlo(bare, perturbed_start(bare, UNLOADED_TESTS, 0), UNLOADED_TESTS, seeds)
        print("\nMonte Carlo, loaded")
        monte_carlo(loaded, loaded_start(bare, loaded.load.mass), LOADED_TESTS, seeds)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50)
    main(parser.parse_args().seeds)
