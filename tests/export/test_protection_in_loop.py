"""Safe start, drive limits and fall-back of the code on the nonlinear table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avis_ctrl.export.c_source import Provenance, c_files
from avis_ctrl.export.certificate import shipped_loop
from avis_ctrl.export.compiled import CompiledController
from avis_ctrl.export.protection import Processor, protection
from avis_ctrl.simulation.loop import simulate


@pytest.fixture(scope="module")
def parts(skyhook):
    controller = skyhook.sampled("skyhook_classical", "float32")
    guard = protection(controller, skyhook.rig)
    return controller, guard, shipped_loop(skyhook, controller)


def compiled(parts) -> CompiledController:
    controller, guard, _ = parts
    return CompiledController(c_files(controller, guard, Provenance(())), controller)


def test_compiled_code_moves_the_table_as_the_simulated_controller(parts, gcc):
    """The inner loop compiled by numba with the controller inside, and the same loop that calls the C code."""
    _, _, loop = parts
    code = compiled(parts)
    code.state.gain, code.state.wait = 1.0, 0  # as after the start
    inside, outside = simulate(loop, 5.0, 1, settle_s=0.0), simulate(loop, 5.0, 1, settle_s=0.0, code=code.step)
    lsb = loop.sensors.converter.lsb_V
    # A reading next to a code's edge may fall to either side of it.
    assert np.max(np.abs(inside.sensed - outside.sensed)) < lsb
    assert np.max(np.abs(inside.q_dot - outside.q_dot)) < 0.02 * np.max(np.abs(inside.q_dot))
    assert np.max(np.abs(inside.volts)) > 0


def test_start_on_a_moving_table_is_bumpless(parts, gcc):
    """Against the same code without its ramp, closed while the table swings."""
    _, guard, loop = parts
    swing = np.zeros(12)
    swing[2] = 1e-4  # a tenth of a millimetre
    soft, hard = compiled(parts), compiled(parts)
    hard.state.gain, hard.state.wait = 1.0, 0  # as after the start
    started, jumped = (simulate(loop, 8.0, 1, settle_s=0.0, initial=swing, code=code.step) for code in (soft, hard))
    assert np.all(started.demanded[: guard.wait - 1] == 0)
    steps = [np.max(np.abs(np.diff(record.demanded, axis=0, prepend=0))) for record in (started, jumped)]
    assert steps[0] < 0.1 * steps[1]
    assert soft.state.gain == 1.0
    assert np.max(np.abs(started.q_dot[-1000:, 2])) < 0.05 * np.max(np.abs(started.q_dot[:1000, 2]))


def overload(loop, code, seconds: float = 30.0):
    """A floor that swings slowly and far for two thirds of the time, then rests."""
    n = round(seconds * loop.sample_rate_Hz)
    time = np.arange(n + 1) / loop.sample_rate_Hz
    floor = np.zeros((n + 1, 6))
    floor[:, 2] = np.where(time < 2 * seconds / 3, 2e-2 * np.sin(2 * np.pi * 0.5 * time), 0.0)
    wide = replace(loop, sensors=replace(loop.sensors, converter=None))  # to reach the drives' limits, not the sensors'
    return simulate(wide, seconds, 1, settle_s=0.0, floor=floor, code=code)


@pytest.mark.slow
def test_drives_at_their_limits_release_the_table(parts):
    """Limits for seconds; afterwards the table comes to rest, and the voltages were never beyond the limits."""
    controller, guard, loop = parts
    free = replace(guard, input_limit_V=np.full(6, 1e6))
    processor = Processor(controller, free)
    processor.gain, processor.wait = 1.0, 0
    record = overload(loop, processor.step)
    limited = np.any(np.abs(record.volts) >= controller.limits_V, axis=1)
    assert np.sum(limited) > 1000
    assert np.max(np.abs(record.volts)) <= np.max(controller.limits_V)
    assert not record.diverged
    assert not np.any(limited[-5000:])
    assert np.max(np.abs(record.q_dot[-2000:, 2])) < 0.01 * np.max(np.abs(record.q_dot[:, 2]))


@pytest.mark.parametrize("fault", [np.nan, np.inf, 10.0])
def test_a_sensor_that_fails_for_a_second(parts, gcc, fault):
    """The drives go to zero, the passive table stays in place, and control comes back."""
    controller, guard, loop = parts
    code = compiled(parts)
    code.state.gain, code.state.wait = 1.0, 0  # as after the start
    sample = -1

    def faulty(y):
        nonlocal sample
        sample += 1
        if 2000 <= sample < 3000:
            y = y.copy()
            y[1] = fault
        return code.step(y)

    record = simulate(loop, 8.0, 1, settle_s=0.0, code=faulty)
    fall = round(1 / guard.fall)
    assert not record.diverged
    assert np.any(record.demanded[1900:2000] != 0)
    assert np.all(record.demanded[2000 + fall + 1 : 3000 + guard.wait - 1] == 0)
    assert np.max(np.abs(record.demanded[2000:])) <= np.max(controller.limits_V)
    assert code.state.gain == 1.0
    quiet = np.max(np.abs(record.q_dot[:2000, 2]))
    assert np.max(np.abs(record.q_dot[-1000:, 2])) < 2 * quiet
