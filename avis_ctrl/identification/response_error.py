r"""Bound on the difference between a measured frequency response and an identified rig, in a design's coordinates.

With A (volts per axis force) and D (axis velocities from sensors), both from geometry, the kept coordinates have

    G_k = D G A    and    L = inv(G_k) D (G_measured - G) A,    so that D G_measured A = G_k (I + L),

an input-multiplicative error, with rotations as displacement and force at the edge. The measured response has an error
N, with vec(N) of known covariance. The true L is therefore L_measured - inv(G_k) D N A, and

    sigma_max(L) <= sigma_max(L_measured) + q,

with q the quantile of the largest singular value of that noise. The bound is valid line by line with at least the
requested confidence. It counts the noise twice, because L_measured contains it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import sensor_rows
from avis_ctrl.lti.norms import largest_singular_value
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.response import SETTINGS as SPAN
from avis_ctrl.rigs.logical_axes import actuator_axes, sensor_axes
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True)
class FrfSpreadSettings:
    """draws : random draws for the quantiles; the 99 % quantile then depends on the 20 largest.
    confidences : probabilities of the bounds [1]: the usual ones, of which a design chooses.
    chunk : lines processed at once, to limit the memory: 26 MB for two coordinates.
    """

    draws: int = 2000
    confidences: tuple[float, ...] = (0.8, 0.9, 0.95, 0.99)
    chunk: int = 200


SETTINGS = FrfSpreadSettings()


@dataclass(frozen=True, eq=False)
class FrfSpread:
    """Relative error of a model against a measurement, at frequency_Hz (n,).

    Attributes
    ----------
    keep : coordinates.
    measured : (n,) largest singular value of L as measured, noise included.
    noise : (c, n) q, quantiles for noise alone, at each of confidences (c,).
    """

    keep: tuple[str, ...]
    frequency_Hz: np.ndarray
    measured: np.ndarray
    noise: np.ndarray
    confidences: tuple[float, ...]

    def bound(self, confidence: float = 0.95) -> np.ndarray:
        """(n,) upper bound on the largest singular value of the true L, with at least that confidence at each line: the
        next larger confidence that was computed.

        Raises InputError for a confidence above all computed ones.
        """
        able = [k for k, one in enumerate(self.confidences) if one >= confidence - 1e-9]
        if not able:
            raise InputError(
                f"expected at most {100 * max(self.confidences):g} %, the largest that the spread was computed for",
                field="confidence",
                value=confidence,
            )
        return self.measured + self.noise[min(able, key=lambda k: self.confidences[k])]

    def drowned(self, confidence: float = 0.95) -> np.ndarray:
        """(n,) bool: lines at which noise alone gives a spread of 100 % or more, with that confidence."""
        return np.asarray(self.bound(confidence) - self.measured >= 1.0)

    def usable(self, confidence: float = 0.95) -> np.ndarray:
        """(n,) the bound, reduced on lines where noise alone gives a spread of 100 % or more.

        A response hidden by noise says nothing about the model: at such lines the bound is the size of the noise. It is
        replaced by 100 %, an assumption and not a measurement, or by the measured difference minus the noise if that is
        larger. On all other lines as `bound`.
        """
        bound, drowned = self.bound(confidence), self.drowned(confidence)
        certain = np.maximum(1.0, 2 * self.measured - bound)
        return np.where(drowned, np.minimum(bound, certain), bound)

    def thinned(self, per_octave: int = 24, confidence: float = 0.95) -> FrfSpread:
        """Keep the line with the largest bound in each fraction of an octave."""
        place = np.floor(per_octave * np.log2(self.frequency_Hz / self.frequency_Hz[0]) + 1e-9).astype(int)
        bound = self.bound(confidence)
        largest = np.array([np.flatnonzero(place == one)[np.argmax(bound[place == one])] for one in np.unique(place)])
        return replace(
            self, frequency_Hz=self.frequency_Hz[largest], measured=self.measured[largest], noise=self.noise[:, largest]
        )


def kept_axes(
    rig: Rig, keep: Sequence[str], actuators: Sequence[str], sensors: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """A (n_u, n_axes) volts per newton and D (n_axes, n_s) velocities from velocities along the sensors.

    Raises
    ------
    InputError : coordinates that these actuators cannot drive or these sensors cannot distinguish.
    """
    lever = np.array([rig.edge_m if name.startswith("phi") else 1.0 for name in keep])
    return (
        actuator_axes(rig, keep, actuators).allocation * lever,
        sensor_axes(rig, keep, sensors).decoding * lever[:, None],
    )


def frf_spread(
    measured: FrequencyResponse,
    model: ResponseModel,
    keep: Sequence[str] = ("z", "phi_x"),
    confidences: Sequence[float] = SETTINGS.confidences,
) -> FrfSpread:
    """Spread of a measured frequency response about an identified model.

    Parameters
    ----------
    measured : from the model's actuators to its sensors; columns of a measured floor are ignored.
    model : at the identified parameters.
    confidences : probabilities, over repeated measurements, that a bound is valid at a line.

    If the records do not excite every drive separately, the controlled coordinates are driven by combinations that the
    records do excite; lines on which these are not known are omitted.

    Raises
    ------
    InputError : a confidence outside 0 .. 1, channels or units that are not the model's, coordinates that the channels
        cannot drive or distinguish, or that the records do not excite.
    """
    if not confidences or not all(0 < one < 1 for one in confidences):
        raise InputError("expected probabilities between 0 and 1", field="confidences", value=list(confidences))
    rows = sensor_rows(measured, model)
    drives = [k for k, name in enumerate(model.actuators) if name in measured.inputs]
    if not drives:
        raise InputError(
            f"expected a response to some of {', '.join(model.actuators)}", field="inputs", value=list(measured.inputs)
        )
    A, D = kept_axes(model.rig, keep, model.actuators, model.sensors.names)
    D = D / model.sensors.sensitivity
    columns = [measured.inputs.index(model.actuators[k]) for k in drives]
    measured, A = _pushed(measured, model, A, keep, drives, columns)
    response = model.response(measured.omega)[:, :, drives]
    G_k = D @ response @ A
    L = np.linalg.solve(G_k, D @ (measured.value[:, rows][:, :, columns] - response) @ A)
    left = np.linalg.solve(G_k, np.broadcast_to(D, (len(G_k), *D.shape)))
    noise = _noise_quantile(_covariance(measured, rows, columns, left, A), len(keep), measured.dof, confidences)
    return FrfSpread(tuple(keep), measured.frequency_Hz, largest_singular_value(L), noise, tuple(confidences))


def _pushed(
    measured: FrequencyResponse,
    model: ResponseModel,
    A: np.ndarray,
    keep: Sequence[str],
    drives: Sequence[int],
    at: Sequence[int],
) -> tuple[FrequencyResponse, np.ndarray]:
    """Lines on which the response to the kept coordinates is known, and A (n_u, k) for the measured drives, which are
    the inputs `at` of the response.

    This is A as a design has it, in the order of those drives, if the records excite it; otherwise the minimum-norm
    combination of the played voltages that gives the same forces.
    """

    def known(volts: np.ndarray) -> np.ndarray:
        V = np.zeros((len(measured.inputs), volts.shape[1]))
        V[at] = volts
        return np.all(measured.spanned(V), axis=1)

    own = A[drives]
    lines = known(own) if len(drives) == len(A) else np.zeros(len(measured.frequency_Hz), bool)
    if not np.any(lines):
        T = model.matrices.T
        played = _played(measured, at)
        own = played @ np.linalg.pinv(T[:, drives] @ played, rcond=1e-9) @ (T @ A)
        made = np.linalg.norm(T[:, drives] @ own - T @ A, axis=0) < 1e-6 * np.linalg.norm(T @ A, axis=0)
        lines = known(own)
        if not np.all(made) or not np.any(lines):
            raise InputError(
                "expected records that excite each of these coordinates separately",
                field="keep",
                value=[name for name, one in zip(keep, made, strict=True) if not one] or list(keep),
            )
    return measured.at(lines), own


def _played(measured: FrequencyResponse, at: Sequence[int]) -> np.ndarray:
    """(k, r) orthonormal combinations of the inputs `at` whose response is known, at the line where most are known."""
    if measured.gram is None:
        return np.eye(len(at))
    _, inside = measured.inverse_gram()
    line = int(np.argmax(np.real(np.trace(inside, axis1=1, axis2=2))))
    left, s, _ = np.linalg.svd(measured.gram[line][np.ix_(at, at)].real)
    return np.asarray(left[:, s > SPAN.outside**2 * s[0]])


def _covariance(
    measured: FrequencyResponse, rows: list[int], columns: list[int], left: np.ndarray, A: np.ndarray
) -> np.ndarray:
    """(n, k k, k k) covariance of vec(left N A), with the columns of the error stacked."""
    if measured.entry_variance is None:
        assert measured.gram is not None and measured.noise is not None
        inverse = measured.inverse_gram()[0][:, columns][:, :, columns]
        row = left @ measured.noise[:, rows][:, :, rows] @ np.conj(np.swapaxes(left, 1, 2))
        column = A.T @ np.swapaxes(inverse, 1, 2) @ A
        n, k = row.shape[:2]
        return np.einsum("nij,nkl->nikjl", column, row).reshape(n, k * k, k * k)
    variance = measured.entry_variance[:, rows][:, :, columns]
    # Independent entries N_rc: E[E_ai conj(E_bj)] = sum left_ar A_ci v_rc conj(left_br) A_cj.
    found = np.einsum("nar,ci,nrc,nbr,cj->niajb", left, A, variance, np.conj(left), A, optimize=True)
    n, k = left.shape[:2]
    return found.reshape(n, k * k, k * k)


def _noise_quantile(covariance: np.ndarray, k: int, dof: float, confidences: Sequence[float]) -> np.ndarray:
    """(c, n) quantiles of the largest singular value of (k, k) matrices of that covariance, estimated with `dof`."""
    rng, draws, chunk = np.random.default_rng(1), SETTINGS.draws, SETTINGS.chunk
    Z = (rng.standard_normal((draws, k * k)) + 1j * rng.standard_normal((draws, k * k))) / np.sqrt(2)
    if np.isfinite(dof):
        # The covariance was estimated: the ratio has an F instead of a chi-square distribution.
        Z /= np.sqrt(rng.gamma(dof, 1 / dof, (draws, 1)))
    values, vectors = np.linalg.eigh((covariance + np.conj(np.swapaxes(covariance, 1, 2))) / 2)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    found = []
    for start in range(0, len(root), chunk):
        # (n, draws, column, row) of the error.
        N = (Z @ np.swapaxes(root[start : start + chunk], 1, 2)).reshape(-1, draws, k, k)
        found.append(np.quantile(largest_singular_value(N), confidences, axis=1))
    return np.concatenate(found, axis=1)
