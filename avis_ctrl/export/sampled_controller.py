"""The controller as a processor runs it, in numbers: x+ = A x + B y, u = C x + D y."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.file_errors import read_json
from avis_ctrl.study.files import as_json

Arithmetic = Literal["float32", "float64"]
FORMAT = "avis-sampled-controller"


@dataclass(frozen=True, eq=False)
class SampledController:
    """Controller from sensor volts to drive volts at the rig's sample rate, including every axis.

    Attributes
    ----------
    system : A (n, n), B (n, n_y), C (n_u, n), D (n_u, n_y), discrete; inputs and outputs have the names of the rig's
        sensors and drives. With float32 arithmetic all numbers are float32 values.
    limits_V : (n_u,) largest magnitude of each drive voltage.
    delay_samples : delay from the sample to the resulting voltage.
    """

    name: str
    system: StateSpace
    arithmetic: Arithmetic
    limits_V: np.ndarray
    delay_samples: float

    @property
    def dtype(self) -> type[np.floating]:
        """Type of the numbers on the processor."""
        return np.float32 if self.arithmetic == "float32" else np.float64

    @property
    def sample_rate_Hz(self) -> float:
        """Sample rate [Hz]."""
        return 1.0 / self.system.dt

    def matrices(self) -> dict[str, np.ndarray]:
        """A, B, C and D by name."""
        return {name: getattr(self.system, name) for name in "ABCD"}

    def rounded(self, arithmetic: Arithmetic) -> SampledController:
        """The same controller with its numbers rounded to those that the processor can store."""
        to = np.float32 if arithmetic == "float32" else np.float64
        A, B, C, D = (matrix.astype(to).astype(float) for matrix in self.matrices().values())
        return replace(self, system=replace(self.system, A=A, B=B, C=C, D=D), arithmetic=arithmetic)

    def as_bytes(self) -> bytes:
        """The content of controller.json; floats are printed so that they read back exactly."""
        K = self.system
        return as_json(
            {
                "format": FORMAT,
                "version": 1,
                "name": self.name,
                "sample_rate_Hz": self.sample_rate_Hz,
                "arithmetic": self.arithmetic,
                **self.matrices(),
                "inputs": K.inputs,
                "outputs": K.outputs,
                "input_units": ["V"] * K.ninputs,
                "output_units": ["V"] * K.noutputs,
                "limits_V": self.limits_V,
                "delay_samples": self.delay_samples,
            }
        )

    @property
    def sha256(self) -> str:
        """Hash of controller.json."""
        return hashlib.sha256(self.as_bytes()).hexdigest()


def read_controller(path: Path) -> SampledController:
    """Read a controller from a file.

    Raises
    ------
    InputError : no such file, another format, numbers that form no controller or are not float32 as the file states.
    """
    content = read_json(path, FORMAT, "a file of avis export")
    try:
        return controller_from(content)
    except InputError as error:
        raise error.in_file(path) from None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"expected a sampled controller; {error!r}", file=path) from None


def controller_from(content: dict[str, Any]) -> SampledController:
    """The controller from a file's content."""
    if content["arithmetic"] not in ("float32", "float64"):
        raise InputError("expected float32 or float64", field="arithmetic", value=content["arithmetic"])
    rate, limits = float(content["sample_rate_Hz"]), np.array(content["limits_V"], float)
    if not (np.isfinite(rate) and rate > 0):
        raise InputError("expected a positive rate", field="sample_rate_Hz", value=rate)
    A, B, C, D = (np.array(content[name], float) for name in "ABCD")
    system = StateSpace(A, B, C, D, 1.0 / rate, tuple(content["inputs"]), tuple(content["outputs"]))
    if limits.shape != (system.noutputs,) or not (np.all(np.isfinite(limits)) and np.all(limits > 0)):
        raise InputError(f"expected {system.noutputs} positive limits", field="limits_V", value=limits.tolist())
    found = SampledController(
        str(content["name"]), system, content["arithmetic"], limits, float(content["delay_samples"])
    )
    held = found.rounded(found.arithmetic)
    for name, matrix in found.matrices().items():
        if not np.array_equal(matrix, held.matrices()[name]):
            raise InputError("expected float32 values, as the arithmetic says", field=name)
    return found


def parse_controller(text: bytes) -> SampledController:
    """The controller from the bytes that `as_bytes` returns."""
    return controller_from(json.loads(text))
