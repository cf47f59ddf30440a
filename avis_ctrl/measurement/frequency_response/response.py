"""A measured frequency response matrix with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from avis_ctrl.errors import InputError


@dataclass(frozen=True)
class SpanSettings:
    """gram : smallest eigenvalue, relative to the largest, of a direction that counts as spanned (Gram matrix of inputs
        of unit size) [1]: smaller ones may be round-off.
    outside : fraction of a combination of inputs that may lie outside the spanned directions [1]: gains are known to
        1 % at best, so that a smaller part does not matter.
    """

    gram: float = 1e-13
    outside: float = 1e-4


SETTINGS = SpanSettings()


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Frequency response matrix G with several inputs and outputs, estimated from Y = G U + noise.

    Let C be the noise covariance of one experiment, and S = sum U U^H the Gram matrix of the inputs over the averaged
    data. The covariance of the errors in columns j and k of the estimate is inv(S)_kj C (Pintelon and Schoukens, System
    Identification, 2nd ed., 2012, section 2.7): covariance of vec(G) = inv(S)^T kron C.

    Attributes
    ----------
    frequency_Hz : (n,) increasing.
    value : (n, n_y, n_u) complex, unit of y per unit of u.
    noise : (n, n_y, n_y) complex Hermitian covariance C of the total error (noise and, where it was separated,
        nonlinear distortion), E[e e^H].
    gram : (n, n_u, n_u) complex Hermitian, S above; singular if the inputs do not span all directions. G is unknown
        along the other directions (`spanned`, `along`).
    dof : complex degrees of freedom of the noise covariance estimate; infinite if the covariance is given.
    measurement_noise : the part of `noise` that does not repeat from period to period, where separated.
    distortion : the part of `noise` that repeats: stochastic nonlinear distortion, where separated; if there is none,
        the estimate may be indefinite because of its random error.
    entry_variance : (n, n_y, n_u) E|error|^2 of each entry, for files with only coherence or variances; the entries
        then count as independent, and `noise` and `gram` are None.
    shared : number of neighbouring lines with correlated errors, because their estimates use the same data: the sum of
        the correlation over all distances; 1 for independent lines.
    method : description of the estimator.
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
    entry_variance: np.ndarray | None = None
    method: str = ""
    shared: float = 1.0

    def __post_init__(self) -> None:
        n, n_y, n_u = len(self.frequency_Hz), len(self.outputs), len(self.inputs)
        shapes = {
            "value": (n, n_y, n_u),
            "noise": (n, n_y, n_y),
            "gram": (n, n_u, n_u),
            "measurement_noise": (n, n_y, n_y),
            "distortion": (n, n_y, n_y),
            "entry_variance": (n, n_y, n_u),
        }
        for field, shape in shapes.items():
            array = getattr(self, field)
            if array is None:
                continue
            array = np.asarray(array)
            if array.shape != shape or not np.all(np.isfinite(array)):
                raise InputError(f"expected finite numbers of shape {shape}", field=field, value=array.shape)
            object.__setattr__(self, field, array)
        if (self.noise is None or self.gram is None) == (self.entry_variance is None):
            message = "expected the noise covariance with the inputs' Gram matrix, or variances of the entries"
            raise InputError(message, field="noise, gram, entry_variance")
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
        inverse, _ = self.inverse_gram()
        rows = np.real(np.einsum("nii->ni", covariance))
        columns = np.real(np.einsum("njj->nj", inverse))
        return rows[:, :, None] * np.where(self.spanned(np.eye(len(self.inputs))), columns, np.inf)[:, None, :]

    def inverse_gram(self) -> tuple[np.ndarray, np.ndarray]:
        """Pseudo-inverse of the Gram matrix, and the projector (n, n_u, n_u) onto its range for inputs of unit size.

        The columns are scaled to unit size, because units differ by orders of magnitude.
        """
        assert self.gram is not None
        size = np.sqrt(np.real(np.einsum("nii->ni", self.gram)))
        size = np.where(size > 0, size, 1.0)
        values, vectors = np.linalg.eigh(self.gram / (size[:, :, None] * size[:, None, :]))
        known = values > SETTINGS.gram * values[:, -1:]
        inverse = np.where(known, 1 / np.where(known, values, 1.0), 0.0)
        adjoint = np.swapaxes(vectors.conj(), 1, 2)
        return (
            (vectors * inverse[:, None, :]) @ adjoint / (size[:, :, None] * size[:, None, :]),
            (vectors * known[:, None, :]) @ adjoint,
        )

    def spanned(self, V: np.ndarray) -> np.ndarray:
        """(n, k) bool: whether the response to inputs played in the proportions of V (n_u, k) is known on each line."""
        V = np.asarray(V, float)
        if self.gram is None:
            return np.ones((len(self.frequency_Hz), V.shape[1]), bool)
        size = np.sqrt(np.real(np.einsum("nii->ni", self.gram)))
        # Combinations are scaled to inputs of unit size; a combination with a silent input is not spanned.
        scaled = V[None] / np.where(size > 0, size, np.finfo(float).tiny ** 0.25)[:, :, None]
        left = scaled - self.inverse_gram()[1] @ scaled
        return np.asarray(np.linalg.norm(left, axis=1) < SETTINGS.outside * np.linalg.norm(scaled, axis=1))

    def along(self, V: np.ndarray, names: tuple[str, ...], unit: str) -> FrequencyResponse:
        """Response to inputs in the proportions of V (n_u, k), with new names and unit, on the lines where it is known.

        Raises InputError if it is known on no line, or if the columns of V are linearly dependent.
        """
        keep = np.all(self.spanned(V), axis=1)
        if not np.any(keep):
            raise InputError(f"expected records exciting {', '.join(names)}", field="inputs", value=list(self.inputs))
        one = self.at(keep)
        if one.entry_variance is not None:
            return replace(
                one,
                value=one.value @ V,
                entry_variance=one.entry_variance @ np.abs(V) ** 2,
                inputs=names,
                input_unit=unit,
            )
        inverse = V.T @ one.inverse_gram()[0] @ V
        size = np.sqrt(np.real(np.einsum("nii->ni", inverse)))
        scale = size[:, :, None] * size[:, None, :]
        try:
            gram = np.linalg.inv(inverse / scale) / scale
        except np.linalg.LinAlgError:
            raise InputError("expected linearly independent columns", field="inputs", value=list(names)) from None
        return replace(one, value=one.value @ V, gram=gram, inputs=names, input_unit=unit)

    @property
    def standard_deviation(self) -> np.ndarray:
        """(n, n_y, n_u) square root of E|error|^2 of each entry."""
        return np.sqrt(np.maximum(self.variance(), 0.0))

    def between(self, low_Hz: float, high_Hz: float) -> FrequencyResponse:
        """Lines inside a band, ends included."""
        return self.at((self.frequency_Hz >= low_Hz) & (self.frequency_Hz <= high_Hz))

    def at(self, keep: np.ndarray) -> FrequencyResponse:
        """Selected lines, by mask or index."""
        by_line = {
            field.name: array[keep]
            for field in fields(self)
            if isinstance(array := getattr(self, field.name), np.ndarray)
        }
        return replace(self, **by_line)
