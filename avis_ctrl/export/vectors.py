"""Test vectors: inputs that take the code through its start, its limits and its fall-back, and the outputs expected.

`vectors` has the start to the full gain, an excitation in the linear range in which, in double precision, every
coefficient that matters shows if it is wrong by 0.1 %, each drive up to its limits, as far as valid inputs can take it,
and the fall-back after an input out of range. `restarts` has the fall-back to zero and the restart after inputs that
are out of range, not a number and infinite: a whole start and a restart take more rows than `vectors` has.
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
    """start : part of the rows that the start takes, from drives at zero to the full gain. limits : part of the others
    in which the drives are taken to their limits. falling : part of the others at the end, from the invalid input on.
    low_Hz, high : band of the linear excitation: a period as long as the rows, and a part of half the sample rate.
    fill : of the drives' limits that the linear excitation demands at most. overdrive : demand over limit, where a
    limit is to be reached. range_fraction : of the converter's range that valid inputs use at most. unlimited_V : valid
    inputs at most where the converter's range is not known. restart : part of the rise that is seen between the invalid
    inputs of `restarts`. linear : rows at full gain at its end, relative to those of the rise.
    margin : by which outputs may differ beyond what one precision's rounding makes: compilers add in another order. In
    double precision the expected outputs are rounded, too: twice this margin. seed : of the phases.
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


def vectors(controller: SampledController, guard: Protection, settings: SignalSettings = SignalSettings()
            ) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (samples, n_y) and outputs (samples, n_u) from `init` on, computed in double precision [V]."""
    start = guard.wait + 1 / guard.rise
    samples = round(start / settings.start)
    y = _linear(controller, guard, samples, settings)
    end = samples - max(1, round(settings.falling * (samples - start)))
    extreme = _extreme(controller, guard, round(settings.limits * (samples - start)), settings)
    y[end - len(extreme):end] = extreme
    y[end, 0] = _invalid(guard)[0]
    return _with_outputs(controller, guard, y)


def restarts(controller: SampledController, guard: Protection, settings: SignalSettings = SignalSettings()
             ) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (samples, n_y) and outputs (samples, n_u) from `init` on [V]: three times the beginning of a start and an
    invalid input of one sample, then a whole restart. The inputs reach no limit in the linear range: the outputs agree
    more closely."""
    seen = guard.wait + round(settings.restart / guard.rise)
    invalid = _invalid(guard)[1:]
    last = guard.wait + round((1 + settings.linear) / guard.rise)
    y = _linear(controller, guard, len(invalid) * seen + last, settings)
    for k, volts in enumerate(invalid):
        y[(k + 1) * seen, k % y.shape[1]] = volts
    return _with_outputs(controller, guard, y)


def agreement_V(controller: SampledController, guard: Protection, y: np.ndarray, u: np.ndarray,
                settings: SignalSettings = SignalSettings()) -> float:
    """By how much outputs of another implementation may differ from u (n, n_u) with the inputs y (n, n_y) [V].

    From the difference that the controller's precision makes to the next higher one, rounded up to two digits.
    """
    other, margin = (np.longdouble, 2 * settings.margin) if controller.arithmetic == "float64" else (
        np.float32, settings.margin)
    differ = margin * float(np.max(np.abs(_run(Processor(controller, guard, other), y) - u)))
    # Where long double is no wider than double, the difference is zero: then that of one rounding.
    differ = max(differ, margin * float(np.finfo(controller.dtype).eps) * float(np.max(np.abs(u))))
    digit = 10.0 ** int(np.floor(np.log10(max(differ, np.finfo(float).tiny))) - 1)
    return float(f"{np.ceil(differ / digit) * digit:.1e}")


def _linear(controller: SampledController, guard: Protection, samples: int, settings: SignalSettings) -> np.ndarray:
    """(samples, n_y) all inputs at once, with random phases, within the range of inputs and drives. Their power falls
    with the controller's gain: with inputs of one size at all frequencies the slow states hide the fast ones, with
    drives that move alike the inputs reach their range at the highest frequencies."""
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
    """At most (samples, n_y): for each drive those inputs within their range that move its voltage most, up, then down
    (the signs of the impulse response, backwards); less of them where that reaches the limit by far."""
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
    """(n_y,) magnitudes that valid inputs have at most."""
    limit = np.where(np.isfinite(guard.input_limit_V), guard.input_limit_V, settings.unlimited_V)
    return settings.range_fraction * limit


def _invalid(guard: Protection) -> tuple[float, ...]:
    """An invalid input of `vectors` and three of `restarts`; out of the converter's range where it is known."""
    if not np.all(np.isfinite(guard.input_limit_V)):
        return np.nan, -np.inf, np.nan, np.inf
    beyond = 2 * float(np.max(guard.input_limit_V))
    return beyond, -beyond, np.nan, np.inf


def _demand(controller: SampledController, guard: Protection, y: np.ndarray) -> float:
    """Largest demand over limit with the inputs y, without any limits."""
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
    """One row a sample; numbers read back exactly."""
    K = controller.system
    return "\n".join([_head(K), *(",".join(map(repr, map(float, row))) for row in np.hstack([y, u]))]) + "\n"


def read_csv(path: Path, controller: SampledController) -> tuple[np.ndarray, np.ndarray]:
    """y and u of a file of `as_csv`. Raises InputError."""
    K = controller.system
    try:
        head, *lines = path.read_text(encoding="utf-8").splitlines()
        rows = np.array([[float(one) for one in line.split(",")] for line in lines])
    except (OSError, ValueError) as error:
        raise InputError(f"expected test vectors; {error}", file=path) from None
    if head != _head(K) or rows.shape != (len(lines), K.ninputs + K.noutputs) or not lines:
        raise InputError(f"expected the columns {_head(K)}", file=path)
    return rows[:, :K.ninputs], rows[:, K.ninputs:]


def _head(K: StateSpace) -> str:
    return ",".join([*(f"y:{name}" for name in K.inputs), *(f"u:{name}" for name in K.outputs)])
