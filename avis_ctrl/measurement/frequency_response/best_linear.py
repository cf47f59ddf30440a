"""Best linear approximation of a nonlinear rig from random-phase multisines, with noise and distortion separated.

Robust method for several inputs (Pintelon and Schoukens, System Identification, 2nd ed., 2012, sections 4.3 and 7.3):
the scatter between the periods of a record gives the noise; the scatter between phase realisations gives noise and
stochastic nonlinear distortion together. For experiments e with mean periods Y_e and U_e,

    G = (sum Y_e U_e^H) inv(S),   S = sum U_e U_e^H,   C = sum (Y_e - G U_e)(Y_e - G U_e)^H / (n_e - n_u).

For M realisations of n_u experiments with invertible U, G is the mean of the M responses Y_r inv(U_r), weighted by
power, and C is their scatter with n_u (M - 1) degrees of freedom. The experiments need not form such groups, and the
grouping need not be known. Within one group of orthogonal multisines the distortion can look linear. Only different
groups reveal it: a campaign with one group cannot separate noise and distortion.

The distortion is averaged over the inputs: the covariance inv(S)^T kron C cannot represent a distortion that differs
from input to input. A measured U is allowed: its noise and that of Y are combined as [I, -G] cov [I, -G]^H.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.measurement.campaign import Campaign, RecordSource
from avis_ctrl.measurement.frequency_response.periodic import (
    SETTINGS,
    PeriodMean,
    average,
    periodic_records,
    settled_after,
)
from avis_ctrl.measurement.frequency_response.response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.spectra import Band, Channels, channels, checked_band, lines

Transient = Literal["auto", "drop", "remove", "none"]


@dataclass(frozen=True, eq=False)
class _Experiments:
    """Mean periods of all experiments: U (n_e, n, n_u), Y (n_e, n, n_y); covariance (n, n_z, n_z) of their noise."""

    U: np.ndarray
    Y: np.ndarray
    covariance: np.ndarray | None
    dof: int


def best_linear_approximation(
    campaign: Campaign, *, band_Hz: Band | None = None, level_V: float | None = None, transient: Transient = "auto"
) -> FrequencyResponse:
    """The response, where all excited lines have the same inputs.

    Parameters and errors as in `best_linear_approximations`.

    Raises
    ------
    InputError : different inputs on different lines.
    """
    found = best_linear_approximations(campaign, band_Hz=band_Hz, level_V=level_V, transient=transient)
    if len(found) > 1:
        sets = "; ".join(f"{', '.join(r.inputs)} on {r.frequency_Hz.size} lines" for r in found)
        message = (
            f"different lines excite different inputs ({sets}): use best_linear_approximations, which gives one "
            "response for each set"
        )
        raise InputError(message, field="records")
    return found[0]


def best_linear_approximations(
    campaign: Campaign, *, band_Hz: Band | None = None, level_V: float | None = None, transient: Transient = "auto"
) -> tuple[FrequencyResponse, ...]:
    """G from the drives on the excited lines, with total, noise and distortion covariances.

    One response for each set of inputs that are excited on the same lines (several sets for zippered multisines). The
    floor motion is not periodic and counts as noise. C is averaged over the smallest number of excited lines with
    2 n_y + 4 degrees of freedom.

    Parameters
    ----------
    band_Hz : frequency band; all lines by default.
    level_V : r.m.s. level of the records to use, if the campaign has several levels.
    transient : "drop": drop the periods that have not settled (at least two are kept); "remove": remove the transient
        by local polynomials or rational functions through the lines between harmonics; "none"; "auto": drop if at least
        half of the periods remain and are settled, otherwise remove. If a mode is narrower than about two lines of the
        record, part of its transient remains and is included in C.

    Raises
    ------
    InputError : no periodic records, several levels or periods, neither repeated periods nor several realisations.
    ComputationError : experiments that cannot separate the inputs.
    """
    records = periodic_records(campaign, level_V)
    used = channels(records, False)
    n, rate = records[0].header.period_samples or 0, campaign.sample_rate_Hz
    keep = lines(n, rate, checked_band(band_Hz, rate))
    if keep.stop <= keep.start:
        raise InputError(f"expected a band with harmonics of {rate / n:g} Hz", field="band_Hz", value=band_Hz)
    dropped, remove = chosen_treatment(records, used, keep, transient)
    means = [average(record, used, keep, dropped, remove) for record in records]
    data = _experiments(means, len(used.inputs))
    frequency = np.arange(keep.start, keep.stop) * rate / n
    treatment = f"{dropped} periods dropped" + (", transient removed" if remove else "")
    words = f"best linear approximation, {len(data.U)} experiments of {means[0].periods} periods, {treatment}"
    return tuple(_response(data, frequency, line, active, used, words) for active, line in _excited_sets(data, used))


def chosen_treatment(
    records: Sequence[RecordSource], used: Channels, keep: slice, transient: Transient
) -> tuple[int, bool]:
    """Number of periods to drop, and whether to remove a transient from the others."""
    if transient not in ("auto", "drop", "remove", "none"):
        raise InputError("expected auto, drop, remove or none", field="transient", value=transient)
    count = min(record.header.periods for record in records)
    found, settled = settled_after(records, used, keep) if transient in ("auto", "drop") else (0, False)
    if transient != "auto":
        return found, transient == "remove"
    # For a slow transient, dropping would discard most of the data. Removal then uses all periods: after some periods
    # are dropped, the residual transient is hidden by the noise of a single record, but not in the mean of many.
    if settled and found <= count // 2:
        return found, False
    return 0, count >= 2


def _experiments(means: Sequence[PeriodMean], n_u: int) -> _Experiments:
    """Mean periods; records with equal inputs count as repetitions of one experiment, not as realisations."""
    groups: list[list[PeriodMean]] = []
    for mean in means:
        for group in groups:
            first = group[0].Z[:, :n_u]
            if np.linalg.norm(mean.Z[:, :n_u] - first) ** 2 < SETTINGS.repeated * np.linalg.norm(first) ** 2:
                group.append(mean)
                break
        else:
            groups.append([mean])
    Z = np.stack([np.mean([m.Z for m in group], axis=0) for group in groups])
    parts = [(m, len(group)) for group in groups for m in group if m.covariance is not None]
    covariance, dof = None, sum(m.dof for m, _ in parts)
    if parts and len(parts) == len(means):
        # Pooled by degrees of freedom; the mean of r records has 1/r of their covariance.
        each = np.zeros_like(np.asarray(parts[0][0].covariance))
        for m, _ in parts:
            each += m.dof / dof * np.asarray(m.covariance)
        covariance = each * np.mean([1 / len(group) for group in groups])
    return _Experiments(Z[:, :, :n_u], Z[:, :, n_u:], covariance, dof if covariance is not None else 0)


def _excited_sets(data: _Experiments, used: Channels) -> list[tuple[list[int], np.ndarray]]:
    """(inputs, lines) of each set of inputs that are excited together, ordered by first line."""
    power = np.mean(np.abs(data.U) ** 2, axis=0)
    noise = np.zeros_like(power)
    if data.covariance is not None:
        n_u = power.shape[1]
        # Smoothed over lines: a few periods give a poor noise estimate for a single line.
        raw = np.real(np.einsum("nii->ni", data.covariance))[:, :n_u]
        noise = _running_mean(raw, min(10, (len(raw) - 1) // 2))
    on = (power > SETTINGS.excited_power * power.max(axis=0)) & (power > SETTINGS.excited_over_noise * noise)
    if not np.any(on):
        if np.any(power > 0):
            message = (
                "expected inputs that repeat in each period; these differ from period to period by as much as their "
                "size: check the period"
            )
            raise InputError(message, field="period_s")
        raise InputError("expected at least one excited line in the band", field="inputs", value=used.inputs)
    sets: dict[tuple[int, ...], list[int]] = {}
    for line in np.flatnonzero(on.any(axis=1)):
        sets.setdefault(tuple(np.flatnonzero(on[line]).tolist()), []).append(int(line))
    return [(list(active), np.array(where)) for active, where in sets.items()]


def _response(
    data: _Experiments, frequency_Hz: np.ndarray, line: np.ndarray, active: list[int], used: Channels, words: str
) -> FrequencyResponse:
    names = tuple(used.inputs[j] for j in active)
    U, Y = np.moveaxis(data.U[:, line][:, :, active], 0, 1), np.moveaxis(data.Y[:, line], 0, 1)
    gram = np.swapaxes(U, 1, 2) @ U.conj()
    _check_rank(gram, names, len(data.U), frequency_Hz[line])
    G = np.swapaxes(np.linalg.pinv(U) @ Y, 1, 2)  # least squares of Y = U G^T
    dof, n_y = len(data.U) - len(active), Y.shape[2]
    noise = None
    if data.covariance is not None:
        columns = [*active, *range(len(used.inputs), data.covariance.shape[1])]
        both = np.concatenate([-G, np.broadcast_to(np.eye(n_y), (line.size, n_y, n_y))], axis=2)
        noise = both @ data.covariance[line][:, columns][:, :, columns] @ np.swapaxes(both.conj(), 1, 2)
    if dof == 0 and noise is None:
        message = f"expected repeated periods or more than {len(active)} experiments, to estimate the noise"
        raise InputError(message, field="records", value=len(data.U))
    per_line = dof or data.dof
    half = _smoothing(per_line, n_y, line.size)
    C = noise = None if noise is None else _running_mean(noise, half)
    distortion = None
    said = "; noise only, distortion not separated"
    if dof:
        E = Y - U @ np.swapaxes(G, 1, 2)
        C = _running_mean(np.swapaxes(E, 1, 2) @ E.conj() / dof, half)
        distortion = None if noise is None else C - noise
        said = "; noise and distortion together" if noise is None else ""
    return FrequencyResponse(
        frequency_Hz[line],
        G,
        C,
        gram,
        **used.labels(names),
        dof=float(per_line * (2 * half + 1)),
        measurement_noise=noise,
        distortion=distortion,
        method=f"{words}, C over {2 * half + 1} lines{said}",
    )


def _check_rank(gram: np.ndarray, names: tuple[str, ...], experiments: int, frequency_Hz: np.ndarray) -> None:
    size = np.sqrt(np.real(np.einsum("nii->ni", gram)))
    values, vectors = np.linalg.eigh(gram / (size[:, :, None] * size[:, None, :]))
    bad = np.flatnonzero(values[:, 0] < SETTINGS.dependent)
    if bad.size:
        which = [n for n, part in zip(names, np.abs(vectors[bad[0], :, 0]), strict=True) if part > 0.03]
        raise ComputationError(
            f"the responses to {', '.join(which)} cannot be distinguished",
            measured=f"{experiments} different experiments on {bad.size} of {frequency_Hz.size} lines from "
            f"{frequency_Hz[bad[0]]:.6g} Hz",
            cause=f"{len(names)} inputs need as many experiments with independent phases on each line",
            next_step="measure further realisations, choose fewer inputs, or use local_polynomial, which takes "
            "neighbouring lines together",
        )


def _smoothing(dof: int, n_y: int, count: int) -> int:
    """Number of lines on each side over which C is averaged."""
    half = 0
    while (2 * half + 1) * dof < 2 * n_y + 4 and 2 * half + 3 <= count:
        half += 1
    return half


def _running_mean(x: np.ndarray, half: int) -> np.ndarray:
    """Means over 2 half + 1 entries along the first axis; at the ends the window is shifted inwards."""
    width = 2 * half + 1
    start = np.clip(np.arange(len(x)) - half, 0, len(x) - width)
    return sum((x[start + k] for k in range(width)), np.zeros_like(x)) / width
