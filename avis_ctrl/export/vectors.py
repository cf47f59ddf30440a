"""Test vectors: inputs that exercise the start, limits and fall-back of the code, and the expected outputs.

`vectors` contains the start up to full gain; an excitation in the linear range in which, in double precision, an error
of 0.1 % in any coefficient that matters is visible; each drive up to its limits, as far as valid inputs can move it;
and the fall-back after an input out of range. `restarts` contains the fall-back to zero and the restart after inputs
that are out of range, not a number, and infinite: a whole start and a restart need more rows than `vectors` has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.export.protection import Processor, Protection
from avis_ctrl.export.sampled_controller import SampledController
from avis_ctrl.lti.statespace import StateSpace


@dataclass(frozen=True)
class SignalSettings:
    """start : fraction of the rows for the start, from drives at zero to full gain. limits : fraction of the remaining
    rows in which the drives are moved to their limits. falling : fraction of them at the end, from the invalid input
    on.
    low_Hz, high : band of the linear excitation, from a period as long as the rows to this fraction of half the sample
    rate. fill : largest fraction of the drives' limits that the linear excitation demands.
    overdrive : demand over limit where a limit is to be reached. range_fraction : largest fraction of the converter's
    range that valid inputs use. unlimited_V : largest valid input if the converter's range is not known. restart :
    fraction of the rise that is reached between the invalid inputs of `restarts`. linear : rows at full gain at its
    end, relative to those of the rise.
    margin : ratio of the allowed difference of outputs to that from the rounding of one precision: compilers add in
    another order. In double precision the expected outputs are rounded, too: twice this margin. seed : of the phases.
    """

    start: float = 0.75
    limits: float = 0.6
    falling: float = 0.1
    low_Hz: float = 0.5
    high: float = 0.9
    fill: float = 0.9
    overdrive: float = 2.0
    range_fraction: float = 0.95
    unlimited_V: float = 10.0
    restart: float = 0.1
    linear: float = 0.4
    margin: float = 6.0
    seed: int = 1


def vectors(
    controller: SampledController, guard: Protection, settings: SignalSettings = SignalSettings()
) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (samples, n_y) and outputs (samples, n_u) from `init` on, computed in double precision [V]."""
    start = guard.wait + 1 / guard.rise
    samples = round(start / settings.start)
    y = _linear(controller, guard, samples, settings)
    end = samples - max(1, round(settings.falling * (samples - start)))
    extreme = _extreme(controller, guard, round(settings.limits * (samples - start)), settings)
    y[end - len(extreme) : end] = extreme
    y[end, 0] = _invalid(guard)[0]
    return _with_outputs(controller, guard, y)


def restarts(
    controller: SampledController, guard: Protection, settings: SignalSettings = SignalSettings()
) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (samples, n_y) and outputs (samples, n_u) from `init` on [V]: three times the beginning of a start and an
    invalid input of one sample, then a whole restart. The inputs reach no limit in the linear range, so that the
    outputs agree more closely."""
    seen = guard.wait + round(settings.restart / guard.rise)
    invalid = _invalid(guard)[1:]
    last = guard.wait + round((1 + settings.linear) / guard.rise)
    y = _linear(controller, guard, len(invalid) * seen + last, settings)
    for k, volts in enumerate(invalid):
        y[(k + 1) * seen, k % y.shape[1]] = volts
    return _with_outputs(controller, guard, y)


def agreement_V(
    controller: SampledController,
    guard: Protection,
    y: np.ndarray,
    u: np.ndarray,
    settings: SignalSettings = SignalSettings(),
) -> float:
    """Allowed difference between the outputs of another implementation and u (n, n_u), for inputs y (n, n_y) [V].

    From the difference between the controller's precision and the next higher one, rounded up to two digits.
    """
    other, margin = (
        (np.longdouble, 2 * settings.margin) if controller.arithmetic == "float64" else (np.float32, settings.margin)
    )
    differ = margin * float(np.max(np.abs(_run(Processor(controller, guard, other), y) - u)))
    # If long double is no wider than double, the difference is zero; then that of one rounding is used.
    differ = max(differ, margin * float(np.finfo(controller.dtype).eps) * float(np.max(np.abs(u))))
    digit = 10.0 ** int(np.floor(np.log10(max(differ, np.finfo(float).tiny))) - 1)
    return float(f"{np.ceil(differ / digit) * digit:.1e}")


def _linear(controller: SampledController, guard: Protection, samples: int, settings: SignalSettings) -> np.ndarray:
    """(samples, n_y) excitation of all inputs at once, with random phases, within the range of inputs and drives. Its
    power falls with the controller's gain: with equal inputs at all frequencies the slow states would hide the fast
    ones; with equal drive voltages the inputs would reach their range at the highest frequencies."""
    K = controller.system
    frequency = np.fft.rfftfreq(samples, K.dt)
    used = (frequency >= settings.low_Hz) & (frequency <= settings.high * frequency[-1])
    gain = np.max(np.abs(K.frequency_response(2 * np.pi * frequency[used])) / controller.limits_V[:, None], axis=1)
    gain = np.maximum(gain, np.finfo(controller.dtype).eps * np.max(gain))  # an input without effect
    phase = np.random.default_rng(settings.seed).uniform(0, 2 * np.pi, gain.shape)
    spectrum = np.zeros((frequency.size, K.ninputs), complex)
    spectrum[used] = np.exp(1j * phase) / np.sqrt(gain)
    y = np.fft.irfft(spectrum, samples, axis=0)
    largest = np.array([_demand(controller, guard, y * one) for one in np.eye(K.ninputs)])
    y = y / np.maximum(largest, np.finfo(controller.dtype).eps * np.max(largest))
    y = y * (settings.fill / _demand(controller, guard, y))
    y = y * np.minimum(1.0, _range(guard, settings) / np.max(np.abs(y), axis=0))
    return y * min(1.0, settings.fill / _demand(controller, guard, y))


def _extreme(controller: SampledController, guard: Protection, samples: int, settings: SignalSettings) -> np.ndarray:
    """At most (samples, n_y): for each drive, the inputs within their range that move its voltage most, up, then down
    (signs of the time-reversed impulse response); smaller where these would exceed the limit by far."""
    K, rows = controller.system, samples // (2 * controller.system.noutputs)
    response, column = [K.D], K.B
    for _ in range(rows - 1):
        response.append(K.C @ column)
        column = K.A @ column
    backwards = np.array(response[::-1])  # (rows, n_u, n_y)
    largest = _range(guard, settings)
    reach = np.sum(np.abs(backwards) * largest, axis=(0, 2))
    size = np.minimum(1.0, settings.overdrive * controller.limits_V / np.maximum(reach, np.finfo(float).tiny))
    up = np.moveaxis(np.sign(backwards) * size[:, None] * largest, 1, 0)
    return np.concatenate([part for one in up for part in (one, -one)])


def _range(guard: Protection, settings: SignalSettings) -> np.ndarray:
    """(n_y,) largest magnitudes of valid inputs."""
    limit = np.where(np.isfinite(guard.input_limit_V), guard.input_limit_V, settings.unlimited_V)
    return settings.range_fraction * limit


def _invalid(guard: Protection) -> tuple[float, ...]:
    """One invalid input for `vectors` and three for `restarts`; out of the converter's range if it is known."""
    if not np.all(np.isfinite(guard.input_limit_V)):
        return np.nan, -np.inf, np.nan, np.inf
    beyond = 2 * float(np.max(guard.input_limit_V))
    return beyond, -beyond, np.nan, np.inf


def _demand(controller: SampledController, guard: Protection, y: np.ndarray) -> float:
    """Largest ratio of demand to limit for the inputs y, with all limits removed."""
    free = Processor(controller, replace(guard, input_limit_V=np.full(guard.input_limit_V.size, np.inf)))
    free.limits_V = np.full(free.limits_V.size, np.inf)
    return max(float(np.max(np.abs(_run(free, y)) / controller.limits_V)), float(np.finfo(float).tiny))


def _with_outputs(controller: SampledController, guard: Protection, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    y = y.astype(controller.dtype).astype(float)
    return y, expected_V(controller, guard, y)


def _run(processor: Processor, y: np.ndarray) -> np.ndarray:
    return np.array([processor.step(row) for row in y])


def expected_V(controller: SampledController, guard: Protection, y: np.ndarray) -> np.ndarray:
    """(samples, n_u) outputs for the inputs y (samples, n_y) from `init` on, computed in double precision."""
    return _run(Processor(controller, guard), y)


def as_csv(controller: SampledController, y: np.ndarray, u: np.ndarray) -> str:
    """One row per sample; the numbers read back exactly."""
    K = controller.system
    return "\n".join([_head(K), *(",".join(map(repr, map(float, row))) for row in np.hstack([y, u]))]) + "\n"


def read_csv(path: Path, controller: SampledController) -> tuple[np.ndarray, np.ndarray]:
    """y and u from a file that `as_csv` made. Raises InputError."""
    K = controller.system
    try:
        head, *lines = path.read_text(encoding="utf-8").splitlines()
        rows = np.array([[float(one) for one in line.split(",")] for line in lines])
    except (OSError, ValueError) as error:
        raise InputError(f"expected test vectors; {error}", file=path) from None
    if head != _head(K) or rows.shape != (len(lines), K.ninputs + K.noutputs) or not lines:
        raise InputError(f"expected the columns {_head(K)}", file=path)
    return rows[:, : K.ninputs], rows[:, K.ninputs :]


def _head(K: StateSpace) -> str:
    return ",".join([*(f"y:{name}" for name in K.inputs), *(f"u:{name}" for name in K.outputs)])
