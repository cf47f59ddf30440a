"""A measured frequency response matrix with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Frequency response matrix G of many inputs and outputs, estimated from Y = G U + noise.

    With the noise of one experiment of covariance C and the inputs' Gram matrix S = sum U U^H over what the estimate
    averaged, column j of the estimate's error correlates with column k as inv(S)_kj C (Pintelon and Schoukens,
    System Identification, 2nd ed., 2012, section 2.7): covariance of vec(G) = inv(S)^T kron C.

    Attributes
    ----------
    frequency_Hz : (n,) increasing.
    value : (n, n_y, n_u) complex, unit of y per unit of u.
    noise : (n, n_y, n_y) complex Hermitian covariance C of the total error (noise and, where it was separated,
        nonlinear distortion), E[e e^H].
    gram : (n, n_u, n_u) complex Hermitian, S above.
    dof : complex degrees of freedom of the noise covariance estimate; infinite where the covariance is given.
    measurement_noise : the part of `noise` that does not repeat from period to period, where separated.
    distortion : the part of `noise` that repeats: stochastic nonlinear distortion, where separated; may be indefinite
        by chance where there is none.
    coherence : (n, n_y) multiple coherence where it was computed.
    entry_variance : (n, n_y, n_u) E|error|^2 of each entry, for files that know no more (coherence, or variances);
        entries then count as independent, and `noise` and `gram` are None.
    shared : of how many neighbouring lines the errors go together, because their estimates rest on the same data: the
        sum of their correlation over all distances; 1 for independent lines.
    method : how it was estimated, in words.
    """

    frequency_Hz: np.ndarray
    value: np.ndarray
    noise: np.ndarray | None
    gram: np.ndarray | None
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    input_unit: str = "V"
    output_unit: str = "V"
    dof: float = np.inf
    measurement_noise: np.ndarray | None = None
    distortion: np.ndarray | None = None
    coherence: np.ndarray | None = None
    entry_variance: np.ndarray | None = None
    method: str = ""
    shared: float = 1.0

    def __post_init__(self) -> None:
        n, n_y, n_u = len(self.frequency_Hz), len(self.outputs), len(self.inputs)
        shapes = {"value": (n, n_y, n_u), "noise": (n, n_y, n_y), "gram": (n, n_u, n_u),
                  "measurement_noise": (n, n_y, n_y), "distortion": (n, n_y, n_y), "coherence": (n, n_y),
                  "entry_variance": (n, n_y, n_u)}
        for field, shape in shapes.items():
            array = getattr(self, field)
            if array is None:
                continue
            array = np.asarray(array)
            if array.shape != shape or not np.all(np.isfinite(array)):
                raise InputError(f"expected finite numbers of shape {shape}", field=field, value=array.shape)
            object.__setattr__(self, field, array)
        if (self.noise is None or self.gram is None) == (self.entry_variance is None):
            raise InputError("expected the noise covariance with the inputs' Gram matrix, or variances of the entries",
                             field="noise, gram, entry_variance")
        frequency = np.asarray(self.frequency_Hz, float)
        if not np.all(np.diff(frequency) > 0):
            raise InputError("expected increasing frequencies", field="frequency_Hz")
        object.__setattr__(self, "frequency_Hz", frequency)

    @property
    def omega(self) -> np.ndarray:
        """(n,) rad/s."""
        return 2 * np.pi * self.frequency_Hz

    def variance(self, part: str = "noise") -> np.ndarray:
        """(n, n_y, n_u) variance E|error|^2 of each entry from `noise`, `measurement_noise` or `distortion`."""
        if part == "noise" and self.entry_variance is not None:
            return self.entry_variance
        covariance = getattr(self, part)
        if covariance is None or self.gram is None:
            raise InputError("this estimate did not separate noise and distortion", field=part)
        inverse = np.linalg.inv(self.gram)
        rows = np.real(np.einsum("nii->ni", covariance))
        columns = np.real(np.einsum("njj->nj", inverse))
        return rows[:, :, None] * columns[:, None, :]

    @property
    def standard_deviation(self) -> np.ndarray:
        """(n, n_y, n_u) square root of E|error|^2 of each entry."""
        return np.sqrt(np.maximum(self.variance(), 0.0))

    def between(self, low_Hz: float, high_Hz: float) -> FrequencyResponse:
        """The lines of a band, ends included."""
        return self.at((self.frequency_Hz >= low_Hz) & (self.frequency_Hz <= high_Hz))

    def at(self, keep: np.ndarray) -> FrequencyResponse:
        """Some of the lines, by mask or index."""
        def cut(array: np.ndarray | None) -> np.ndarray | None:
            return None if array is None else array[keep]
        return FrequencyResponse(self.frequency_Hz[keep], self.value[keep], cut(self.noise), cut(self.gram),
                                 self.inputs, self.outputs, self.input_unit, self.output_unit, self.dof,
                                 cut(self.measurement_noise), cut(self.distortion), cut(self.coherence),
                                 cut(self.entry_variance), self.method, self.shared)
