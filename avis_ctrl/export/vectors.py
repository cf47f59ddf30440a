"""Test vectors: inputs that take the code through its start, its limits and its fall-back, and the outputs expected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.export.protection import Processor, Protection
from avis_ctrl.export.sampled_controller import SampledController


@dataclass(frozen=True)
class SignalSettings:
    """start : part of the rows that the start takes, from drives at zero to the full gain. low_Hz, high_Hz, tones :
    sines of the inputs, whole periods of which fit between the start and the end. rest : amplitude of the tones beside
    the strongest one, relative to it. overdrive : by which the largest demand exceeds its limit, unless the converter's
    range does not allow it. range_fraction : of the converter that the inputs use at most. invalid : number of last
    samples with an input out of range. margin : by which outputs may differ beyond what one precision's rounding makes:
    compilers add in another order."""

    start: float = 0.75
    low_Hz: float = 4.0
    high_Hz: float = 100.0
    tones: int = 12
    rest: float = 0.01
    overdrive: float = 2.0
    range_fraction: float = 0.95
    invalid: int = 50
    margin: float = 10.0


def vectors(controller: SampledController, guard: Protection, settings: SignalSettings = SignalSettings()
            ) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (samples, n_y) and outputs (samples, n_u) from `init` on, computed in double precision [V].

    At each tone the sensors move together so that they drive one voltage as far as they can.
    """
    time = np.arange(round((guard.wait + 1 / guard.rise) / settings.start)) * controller.system.dt
    omega = 2 * np.pi * np.geomspace(settings.low_Hz, settings.high_Hz, settings.tones)
    response = controller.system.frequency_response(omega)
    reach = np.sum(np.abs(response / controller.limits_V[:, None]), axis=2)
    phase = np.angle(response[np.arange(omega.size), np.argmax(reach, axis=1)])
    size = np.where(np.arange(omega.size) == np.argmax(reach.max(axis=1)), 1.0, settings.rest)
    y = np.einsum("k,ktj->tj", size, np.sin(omega[:, None, None] * time[:, None] - phase[:, None]))
    linear = _run(Processor(controller, guard), y, unlimited=True)
    within = guard.input_limit_V * settings.range_fraction
    scale = min(settings.overdrive / max(float(np.max(np.abs(linear) / controller.limits_V)), 1e-30),
                float(np.min(within / np.max(np.abs(y), axis=0))))
    y = y * scale
    if np.all(np.isfinite(guard.input_limit_V)):
        y[-settings.invalid:, 0] = 2 * guard.input_limit_V[0]
    else:
        y[-settings.invalid:, 0] = np.nan
    y = y.astype(controller.dtype).astype(float)
    return y, _run(Processor(controller, guard), y)


def agreement_V(controller: SampledController, guard: Protection, y: np.ndarray, u: np.ndarray,
                settings: SignalSettings = SignalSettings()) -> float:
    """By how much outputs of another implementation may differ from u (n, n_u) with the inputs y (n, n_y) [V].

    From the difference that the controller's precision makes to the next higher one, rounded up to one digit.
    """
    other: type[np.floating] = np.longdouble if controller.arithmetic == "float64" else np.float32
    differ = settings.margin * float(np.max(np.abs(_run(Processor(controller, guard, other), y) - u)))
    digit = 10.0 ** int(np.floor(np.log10(max(differ, np.finfo(float).tiny))))
    return float(f"{np.ceil(differ / digit) * digit:.0e}")


def _run(processor: Processor, y: np.ndarray, unlimited: bool = False) -> np.ndarray:
    if unlimited:
        processor.limits_V = np.full(processor.limits_V.size, np.inf)
    return np.array([processor.step(row) for row in y])


def as_csv(controller: SampledController, y: np.ndarray, u: np.ndarray) -> str:
    """One row a sample; numbers read back exactly."""
    K = controller.system
    head = ",".join([*(f"y:{name}" for name in K.inputs), *(f"u:{name}" for name in K.outputs)])
    return "\n".join([head, *(",".join(map(repr, map(float, row))) for row in np.hstack([y, u]))]) + "\n"
