"""The C code: compiled, run and compared with linear systems simulated by scipy."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from avis_ctrl.export.c_source import HEADER, SOURCE, Provenance, c_files, constants_of
from avis_ctrl.export.compiled import STRICT, CompiledController, step_time_us
from avis_ctrl.export.protection import Processor, protection
from avis_ctrl.export.vectors import agreement_V, expected_V, restarts, vectors
from avis_ctrl.simulation.discrete import digital_controller
from avis_ctrl.simulation.sampled_loop import AntiWindup

ARITHMETIC = ("float64", "float32")


def exported(folder, arithmetic, title="a design", converter=True):
    """Controller, protection and C files; with the converter's range of the rig or without."""
    controller = folder.sampled("skyhook_classical", arithmetic)
    guard = protection(controller, folder.rig)
    if not converter:
        guard = replace(guard, input_limit_V=np.full(6, np.inf))
    return controller, guard, c_files(controller, guard, Provenance((title,)))


@pytest.mark.parametrize(("arithmetic", "tolerance"), [("float64", 1e-12), ("float32", 2e-5)])
def test_code_is_the_simulated_controller(skyhook, gcc, rng, arithmetic, tolerance):
    """After the start, and away from the limits: scipy's simulation of the controller that `simulate` runs."""
    controller, _, files = exported(skyhook, arithmetic)
    K = digital_controller(skyhook.loop(skyhook.controller("skyhook_classical")))
    code = CompiledController(files, controller)
    code.state.gain, code.state.wait = 1.0, 0  # as after the start
    y = rng.normal(0, 0.02, (4000, K.ninputs)).astype(controller.dtype).astype(float)
    expected = scipy.signal.dlsim((K.A, K.B, K.C, K.D, K.dt), y)[1]
    u = np.array([code.step(row) for row in y])
    largest = np.max(np.abs(expected))
    assert 0 < largest < np.min(controller.limits_V)
    assert np.max(np.abs(u - expected)) < tolerance * largest


def reached(controller, guard) -> np.ndarray:
    """(n_u,) largest demand over limit that inputs within their range cause in 20 samples, by the impulse response."""
    K = controller.system
    _, response = scipy.signal.dimpulse((K.A, K.B, K.C, K.D, K.dt), n=20)
    return np.sum(np.abs(response), axis=(0, 1)) * min(guard.input_limit_V[0], 10.0) / controller.limits_V


@pytest.mark.parametrize("arithmetic", ARITHMETIC)
@pytest.mark.parametrize("converter", [True, False])
def test_test_vectors_start_reach_the_limits_and_fall_back(skyhook, gcc, arithmetic, converter):
    controller, guard, files = exported(skyhook, arithmetic, converter=converter)
    code = CompiledController(files, controller)
    y, u = vectors(controller, guard)
    assert len(y) == 2000
    assert np.all(u[: guard.wait - 1] == 0) and np.any(u[guard.wait] != 0)
    able = reached(controller, guard) > 1.3
    assert np.any(able)
    for limit in (controller.limits_V, -controller.limits_V):
        assert np.all(np.any(u == limit, axis=0)[able])
    invalid = ~np.all(np.abs(y) < guard.input_limit_V, axis=1)
    assert np.count_nonzero(invalid) == 1 and np.argmax(invalid) > 1900
    differ = np.max(np.abs(np.array([code.step(row) for row in y]) - u))
    assert differ <= agreement_V(controller, guard, y, u) < (1e-11 if arithmetic == "float64" else 5e-4)


@pytest.mark.parametrize("arithmetic", ARITHMETIC)
@pytest.mark.parametrize("converter", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_restart_vectors_fall_back_and_restart(skyhook, gcc, arithmetic, converter):
    """After each invalid input the drives are at zero, and then move again; at last at full gain."""
    controller, guard, files = exported(skyhook, arithmetic, converter=converter)
    code = CompiledController(files, controller)
    y, u = restarts(controller, guard)
    rows = np.flatnonzero(~np.all(np.abs(y) < guard.input_limit_V, axis=1))
    assert [np.count_nonzero(test(y)) for test in (np.isnan, np.isinf)] == ([1, 1] if converter else [1, 2])
    assert len(y) == 3700 and rows.tolist() == [600, 1200, 1800]  # docs/contracts/export.md, which counts from 1
    for row, end in zip(rows, [*rows[1:], len(y)], strict=True):
        assert np.any(u[row - 1] != 0) and np.all(u[row + 20 : row + guard.wait] == 0) and np.any(u[end - 1] != 0)
    assert np.max(np.abs(u) / controller.limits_V) < 1
    got = []
    for row in y:
        got.append(code.step(row))
    assert code.state.gain == 1.0
    tolerance = agreement_V(controller, guard, y, u)
    assert np.max(np.abs(got - u)) <= tolerance < (1e-12 if arithmetic == "float64" else 1e-4)


def mutated(controller):
    """Every coefficient in turn times 1.001, and by how much that changes the frequency response, relative to the
    largest gain to the same drive at the same frequency."""
    K = controller.system
    z = np.exp(2j * np.pi * np.geomspace(0.01, 490, 100) * K.dt)
    inverse = np.linalg.inv(z[:, None, None] * np.eye(K.nstates) - K.A)
    right, left = np.abs(inverse @ K.B), np.abs(K.C @ inverse)
    largest = np.max(np.abs(K.C @ inverse @ K.B + K.D), axis=2)
    for name, matrix in controller.matrices().items():
        for i, j in zip(*np.nonzero(matrix), strict=True):
            if name == "A":
                change = left[:, :, i] * np.max(right[:, j], axis=1)[:, None] / largest
            elif name == "B":
                change = left[:, :, i] / largest
            else:
                change = (np.max(right[:, j], axis=1) if name == "C" else 1.0) / largest[:, i]
            changed = matrix.copy()
            changed[i, j] *= 1.001
            yield np.max(change) * 1e-3 * abs(matrix[i, j]), replace(controller, system=replace(K, **{name: changed}))


@pytest.mark.slow
@pytest.mark.parametrize(("arithmetic", "negligible", "found"), [("float64", 1e-10, 1.0), ("float32", 1e-4, 0.75)])
def test_a_coefficient_that_is_off_by_a_thousandth_is_seen(skyhook, arithmetic, negligible, found):
    """The arithmetic of the code with one coefficient changed, against both files; coefficients of which a thousandth
    changes the response by less than `negligible` may pass. Rounding hides some in single precision."""
    controller, guard, _ = exported(skyhook, arithmetic)
    tests = [
        (y, u, agreement_V(controller, guard, y, u))
        for y, u in (vectors(controller, guard), restarts(controller, guard))
    ]
    seen = []
    for size, changed in mutated(controller):
        if size > negligible:
            seen.append(any(np.max(np.abs(expected_V(changed, guard, y) - u)) > allowed for y, u, allowed in tests))
    assert len(seen) > 50
    assert np.mean(seen) >= found


@pytest.mark.parametrize("rate", [50, 100, 2000])
def test_test_vectors_outlast_the_start_at_any_rate(skyhook, rate):
    """The start takes 1.5 s; before the invalid input almost a quarter of the rows is at full gain."""
    controller, _, _ = exported(skyhook, "float64")
    other = replace(controller, system=replace(controller.system, dt=1 / rate))
    guard = protection(other, skyhook.rig)
    y, _ = vectors(other, guard)
    processor, gains = Processor(other, guard), []
    for row in y:
        processor.step(row)
        gains.append(processor.gain)
    assert len(y) == 2 * rate
    assert np.count_nonzero(np.array(gains) == 1) > 0.22 * len(y)


@pytest.mark.parametrize("arithmetic", ARITHMETIC)
def test_clean_under_warnings_and_sanitizers(skyhook, gcc, tmp_path, arithmetic):
    """Any input, infinities and NaN among them, with every warning an error and both sanitizers watching."""
    _, _, files = exported(skyhook, arithmetic)
    main = """
        #include <math.h>
        #include <stdlib.h>
        #include "avis_controller.h"
        int main(void) {
            avis_controller_t c;
            real_t y[AVIS_CONTROLLER_INPUTS], u[AVIS_CONTROLLER_OUTPUTS];
            avis_controller_init(&c);
            for (long k = 0; k < 60000; k++) {
                for (int i = 0; i < AVIS_CONTROLLER_INPUTS; i++) {
                    y[i] = (real_t)(rand() % 2001 - 1000) / (real_t)(k < 20000 ? 50000 : 50);
                }
                if (k % 7001 == 5) y[0] = (real_t)NAN;
                if (k % 9001 == 5) y[1] = (real_t)-INFINITY;
                if (k % 9001 == 9) y[1] = (real_t)1e30;
                avis_controller_step(&c, y, u);
                for (int i = 0; i < AVIS_CONTROLLER_OUTPUTS; i++) {
                    if (!(u[i] <= 10 && u[i] >= -10)) return 1;
                }
            }
            for (int i = 0; i < AVIS_CONTROLLER_STATES; i++) if (!isfinite(c.x[i])) return 2;
            return 0;
        }"""
    for name, text in {**files, "main.c": main}.items():
        (tmp_path / name).write_text(text)
    program = tmp_path / "program"
    built = subprocess.run(
        [
            gcc,
            *STRICT,
            "-g",
            "-O1",
            "-fsanitize=address,undefined",
            "-fno-sanitize-recover=all",
            "-c",
            SOURCE,
            "-o",
            "controller.o",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    assert built.stderr == ""
    subprocess.run(
        [gcc, "-std=c99", "-fsanitize=address,undefined", "main.c", "controller.o", "-o", program, "-lm"],
        cwd=tmp_path,
        check=True,
        capture_output=True,
    )
    done = subprocess.run([program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_no_heap_and_no_globals(skyhook, gcc, tmp_path):
    """The object file defines two functions and read-only data, and calls nothing."""
    _, _, files = exported(skyhook, "float32")
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    subprocess.run([gcc, "-std=c99", "-O0", "-fno-stack-protector", "-c", SOURCE], cwd=tmp_path, check=True)
    listed = subprocess.run(["nm", "avis_controller.o"], cwd=tmp_path, capture_output=True, text=True, check=True)
    kinds = {line.split()[-1]: line.split()[-2] for line in listed.stdout.splitlines()}
    assert {name for name, kind in kinds.items() if kind == "T"} == {"avis_controller_init", "avis_controller_step"}
    assert set(kinds.values()) <= {"T", "t", "r"}


@pytest.mark.parametrize("arithmetic", ARITHMETIC)
def test_source_holds_the_numbers_of_the_controller(skyhook, arithmetic):
    controller, _, files = exported(skyhook, arithmetic)
    held = constants_of(files[SOURCE], controller.dtype)
    for name, matrix in controller.matrices().items():
        assert np.array_equal(held[name], matrix), name
    single = arithmetic == "float32"
    assert (f"typedef {'float' if single else 'double'} real_t;") in files[HEADER]
    # No double constant in single precision.
    body = files[SOURCE].split('#include "avis_controller.h"')[1]
    assert bool(re.search(r"\d\.\d+(e[-+]\d+)?[,}; ]", body)) is not single


@pytest.mark.parametrize("title", ["*/ int evil; /*", "ends with \\", "two\nlines", "??/", "Umlaut ä \x00"])
def test_a_hostile_title_stays_a_comment(skyhook, gcc, title):
    controller, _, files = exported(skyhook, "float32", title)
    comment, rest = files[HEADER].split("*/", 1)
    assert "evil" not in rest
    assert all(" " <= one <= "~" or one == "\n" for one in comment)
    CompiledController(files, controller)


def test_start_is_bumpless(skyhook, gcc):
    """A constant sensor offset is there from the first sample: voltages begin at zero and never step."""
    controller, guard, files = exported(skyhook, "float64")
    code = CompiledController(files, controller)
    y = np.full(controller.system.ninputs, 0.1)
    u = np.array([code.step(y) for _ in range(6000)])
    linear = scipy.signal.dlsim((*controller.matrices().values(), controller.system.dt), np.tile(y, (6000, 1)))[1]
    assert np.all(u[: guard.wait - 1] == 0)
    jump_without = np.max(np.abs(linear[0]))
    assert np.max(np.abs(np.diff(u, axis=0))) < 0.02 * jump_without
    after = guard.wait + round(1 / guard.rise) + 1
    assert np.max(np.abs(u[after:] - linear[after:])) < 1e-9 * np.max(np.abs(linear))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 20.0, -20.0])
def test_an_invalid_input_brings_the_drives_to_zero_and_back(skyhook, gcc, rng, bad):
    controller, guard, files = exported(skyhook, "float32")
    code = CompiledController(files, controller)
    code.state.gain, code.state.wait = 1.0, 0  # as after the start
    y = rng.normal(0, 0.02, (8000, controller.system.ninputs))
    for row in y[:1000]:
        before = code.step(row)
    y[1000:1500, 2] = bad
    u = np.array([code.step(row) for row in y[1000:]])
    fall = round(1 / guard.fall)
    assert np.any(before != 0)
    assert np.all(np.isfinite(u))
    assert np.all(u[fall + 1 : 500 + guard.wait - 1] == 0)
    assert np.all(np.any(u[500 + guard.wait : 1000 + guard.wait] != 0, axis=0))
    assert code.state.gain == 1.0


@pytest.mark.parametrize("arithmetic", ARITHMETIC)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_infinite_input_does_not_stay_in_the_states(skyhook, gcc, rng, arithmetic, bad):
    """Where the converter's range is not known, nothing else bounds it: the sample counts as zero."""
    controller, _, _ = exported(skyhook, arithmetic)
    guard = replace(protection(controller, skyhook.rig), input_limit_V=np.full(6, np.inf))
    code = CompiledController(c_files(controller, guard, Provenance(())), controller)
    code.state.gain, code.state.wait = 1.0, 0  # as after the start
    y = rng.normal(0, 0.02, (2500, 6)).astype(controller.dtype).astype(float)
    y[200, 1] = bad
    u = np.array([code.step(row) for row in y])
    K, y[200, 1] = controller.system, 0.0
    linear = scipy.signal.dlsim((K.A, K.B, K.C, K.D, K.dt), y)[1]
    assert np.all(u[200 + round(1 / guard.fall) : 200 + guard.wait] == 0)
    assert np.max(np.abs(u[1800:] - linear[1800:])) < (1e-12 if arithmetic == "float64" else 2e-5)


@pytest.mark.parametrize("rate", [333.0, 1000.0, 4096.0])
def test_the_gain_has_no_rounding_error(skyhook, gcc, rate):
    """In single precision the sum of many steps of 0.001 would be off by 1e-5: multiples of 2^-23 add exactly."""
    controller, _, _ = exported(skyhook, "float32")
    controller = replace(controller, system=replace(controller.system, dt=1 / rate))
    guard = protection(controller, skyhook.rig)
    code = CompiledController(c_files(controller, guard, Provenance(())), controller)
    found = []
    for _ in range(guard.wait + round(1.1 * rate)):
        code.step(np.zeros(6))
        found.append(code.state.gain)
    rising = np.arange(1, len(found) - guard.wait + 2)
    assert np.array_equal(found[guard.wait - 1 :], np.minimum(rising * guard.rise, 1.0))
    assert np.count_nonzero(np.array(found) < 1) - guard.wait + 2 == pytest.approx(rate, abs=1)


@pytest.mark.parametrize("arithmetic", ARITHMETIC)
def test_a_step_is_timed(skyhook, gcc, arithmetic):
    controller, _, files = exported(skyhook, arithmetic)
    assert 0 < step_time_us(files, controller) < 1e6 / controller.sample_rate_Hz


def test_without_a_compiler_there_is_no_time_and_a_clear_error(skyhook, monkeypatch):
    from avis_ctrl.errors import ComputationError

    monkeypatch.setenv("PATH", "")
    controller, _, files = exported(skyhook, "float32")
    assert step_time_us(files, controller) is None
    with pytest.raises(ComputationError, match="gcc is not installed"):
        CompiledController(files, controller)


def test_realisation_is_the_same_controller_in_schur_form(skyhook):
    """python-control evaluates both transfer matrices."""
    K = digital_controller(skyhook.loop(skyhook.controller("skyhook_classical")))
    form = skyhook.sampled("skyhook_classical").system
    omega = np.geomspace(1e-3, 0.99 * np.pi / K.dt, 60)
    a, b = K.to_control()(np.exp(1j * omega * K.dt)), form.to_control()(np.exp(1j * omega * K.dt))
    assert np.max(np.abs(a - b) / np.max(np.abs(a), axis=(0, 1))) < 1e-9
    assert np.all(np.tril(form.A, -2) == 0)


@pytest.mark.parametrize(("arithmetic", "tolerance"), [("float64", 1e-10), ("float32", 3e-3)])
def test_anti_windup_takes_off_what_passed_its_lag(skyhook, gcc, arithmetic, tolerance):
    """Voltages of the code far beyond the limits: the linear controller and the lag of the excess, both by scipy."""
    controller, _, _ = exported(skyhook, arithmetic)
    law = AntiWindup.of(1.0, 0.5, controller.system.dt)
    guard = replace(protection(controller, skyhook.rig, law), input_limit_V=np.full(6, np.inf))
    code = CompiledController(c_files(controller, guard, Provenance(())), controller)
    code.state.gain, code.state.wait = 1.0, 0  # as after the start
    K, time = controller.system, np.arange(3000) * controller.system.dt
    y = np.sin(2 * np.pi * np.outer(time, [0.7, 1.1, 1.3, 1.7, 1.9, 2.3])) * (time[:, None] < 2)
    y = 30 * y / np.max(np.abs(scipy.signal.dlsim((K.A, K.B, K.C, K.D, K.dt), y)[1]))  # drives have 10 V
    y = y.astype(controller.dtype).astype(float)
    demand = scipy.signal.dlsim((K.A, K.B, K.C, K.D, K.dt), y)[1]
    u = np.array([code.step(row) for row in y])
    limited = np.abs(u) == controller.limits_V
    assert 0.1 < np.mean(limited[:2000]) < 1
    # What was taken off is known where nothing was cut off; there u + b = demand.
    keep, feed = np.exp(-2 * np.pi * K.dt), 0.5 * (1 - np.exp(-2 * np.pi * K.dt))
    wanted = np.zeros_like(u)
    for drive in range(u.shape[1]):
        # b+ = keep b + feed (demand - b - u)
        b = scipy.signal.lfilter([0.0, feed], [1.0, feed - keep], demand[:, drive] - u[:, drive])
        wanted[:, drive] = demand[:, drive] - b
    assert np.max(np.abs(np.clip(wanted, -controller.limits_V, controller.limits_V) - u)) < tolerance
    assert np.max(np.abs(wanted - demand)) > 1


def test_processor_takes_a_sample(skyhook):
    controller, guard, _ = exported(skyhook, "float32")
    assert Processor(controller, guard).step(np.zeros(6)).shape == (8,)
