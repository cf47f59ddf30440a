"""The C code, compiled with gcc and called from Python."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.export.sampled_controller import SampledController
from avis_ctrl.files import write_together

# All warnings that the contract requires.
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Werror")
# No fused multiply-add: product and sum are rounded separately, as the certificate's error model assumes.
BUILD = ("-O2", "-ffp-contract=off", "-fPIC", "-shared")


@dataclass(frozen=True)
class TimingSettings:
    """runs : number of clock readings; the median suppresses interrupts. steps : between two readings, long compared
    with the clock's resolution."""

    runs: int = 31
    steps: int = 2000


def compiler() -> str | None:
    """Path of gcc; None if it is not installed."""
    return shutil.which("gcc")


def _library(files: Mapping[str, str], *flags: str) -> ctypes.CDLL:
    """The shared library of all C sources among the files, by name."""
    gcc = compiler()
    if gcc is None:
        raise ComputationError(
            "the C code was not compiled",
            cause="gcc is not installed",
            next_step="install gcc, or compile the files on the target",
        )
    with tempfile.TemporaryDirectory() as folder:
        write_together(Path(folder), {name: text.encode() for name, text in files.items()})
        sources, library = [name for name in files if name.endswith(".c")], str(Path(folder) / "controller.so")
        done = subprocess.run([gcc, *flags, *sources, "-o", library], cwd=folder, capture_output=True, text=True)
        if done.returncode:
            raise ComputationError("the C code does not compile", measured=done.stderr.strip().splitlines()[0])
        return ctypes.CDLL(library)  # stays loaded when its file is gone


class CompiledController:
    """The shared library of a controller's C files, with its own state.

    Raises
    ------
    ComputationError : no compiler, or source that does not compile.
    """

    def __init__(self, files: Mapping[str, str], controller: SampledController, flags: Sequence[str] = BUILD):
        self._library = _library(files, *STRICT, *flags)
        real = ctypes.c_float if controller.arithmetic == "float32" else ctypes.c_double

        class State(ctypes.Structure):
            _fields_ = (
                ("x", real * max(controller.system.nstates, 1)),
                ("excess", real * controller.system.noutputs),
                ("gain", real),
                ("wait", ctypes.c_uint32),
            )

        self._step, self._init = self._library.avis_controller_step, self._library.avis_controller_init
        self._step.restype = self._init.restype = None
        self.dtype, self.state = controller.dtype, State()
        self._y = np.zeros(controller.system.ninputs, controller.dtype)
        self._u = np.zeros(controller.system.noutputs, controller.dtype)
        self._arguments: tuple[Any, ...] = (
            ctypes.byref(self.state),
            self._y.ctypes.data_as(ctypes.c_void_p),
            self._u.ctypes.data_as(ctypes.c_void_p),
        )
        self.reset()

    def reset(self) -> None:
        """`avis_controller_init`."""
        self._init(self._arguments[0])

    def step(self, y: np.ndarray) -> np.ndarray:
        """Drive volts (n_u,) for sensor volts (n_y,)."""
        self._y[:] = y
        self._step(*self._arguments)
        return self._u.astype(float)


_TIMER = """\
#include <time.h>
#include "avis_controller.h"
void time_steps(unsigned runs, unsigned steps, const real_t *y, double *seconds)
{
    avis_controller_t c;
    real_t u[AVIS_CONTROLLER_OUTPUTS];
    avis_controller_init(&c);
    for (unsigned k = 0; k < runs; k++) {
        struct timespec a, b;
        clock_gettime(CLOCK_MONOTONIC, &a);
        for (unsigned j = 0; j < steps; j++) {
            avis_controller_step(&c, y + (j % 16u) * AVIS_CONTROLLER_INPUTS, u);
        }
        clock_gettime(CLOCK_MONOTONIC, &b);
        seconds[k] = ((double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec)) / (double)steps;
    }
}
"""


def step_time_us(
    files: Mapping[str, str], controller: SampledController, settings: TimingSettings = TimingSettings()
) -> float | None:
    """Median time of one step on this machine [us], -O2; None without gcc."""
    if compiler() is None:
        return None
    loaded = _library({**files, "timer.c": _TIMER}, "-std=gnu99", *BUILD)
    y = np.random.default_rng(0).normal(0, 1e-2, (16, controller.system.ninputs)).astype(controller.dtype)
    seconds = np.zeros(settings.runs)
    loaded.time_steps(
        ctypes.c_uint(settings.runs),
        ctypes.c_uint(settings.steps),
        y.ctypes.data_as(ctypes.c_void_p),
        seconds.ctypes.data_as(ctypes.c_void_p),
    )
    return float(1e6 * np.median(seconds))
