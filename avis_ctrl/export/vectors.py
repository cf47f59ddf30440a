"""Test vectors: inputs that take the code through its start, its limits and its fall-back, and the outputs expected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.export.protection import Processor, Protection
from avis_ctrl.export.sampled_controller import SampledController


@dataclass(frozen=True)
class SignalSettings:
    """samples : rows of the file, as the contract says. low_Hz, high_Hz, tones : sines of the inputs, over the band in
    which tables are controlled. overdrive : by which the largest demand exceeds its limit. range_fraction : of the
    converter that the inputs use at most, so that only the last samples leave its range. invalid : number of last
    samples with an input out of range."""

    samples: int = 2000
    low_Hz: float = 0.5
    high_Hz: float = 50.0
    tones: int = 12
    overdrive: float = 3.0
    range_fraction: float = 0.5
    invalid: int = 50


def vectors(controller: SampledController, guard: Protection, settings: SignalSettings = SignalSettings()
            ) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (samples, n_y) and outputs (samples, n_u) from `init` on, computed in double precision [V]."""
    rng = np.random.default_rng(1)
    time = np.arange(settings.samples) * controller.system.dt
    frequency = np.geomspace(settings.low_Hz, settings.high_Hz, settings.tones)
    n_y = controller.system.ninputs
    phase = rng.uniform(0, 2 * np.pi, (settings.tones, n_y))
    y = np.sum(np.sin(2 * np.pi * frequency[:, None, None] * time[:, None] + phase[:, None]) / settings.tones, axis=0)
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


def _run(processor: Processor, y: np.ndarray, unlimited: bool = False) -> np.ndarray:
    if unlimited:
        processor.limits_V = np.full(processor.limits_V.size, np.inf)
    return np.array([processor.step(row) for row in y])


def as_csv(controller: SampledController, y: np.ndarray, u: np.ndarray) -> str:
    """One row a sample; numbers read back exactly."""
    K = controller.system
    head = ",".join([*(f"y:{name}" for name in K.inputs), *(f"u:{name}" for name in K.outputs)])
    return "\n".join([head, *(",".join(map(repr, map(float, row))) for row in np.hstack([y, u]))]) + "\n"
