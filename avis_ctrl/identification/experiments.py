"""Predicted information of a further record, from the model alone, to find what the present data do not determine.

A record of duration T with the spectra U at the inputs adds the information

    H = 2 sum_k Re( dY_k^H inv(C_k) dY_k ),    dY_k = dG_k / dtheta U_k,

with C_k the covariance of the noise on a line (Pintelon and Schoukens 2012, section 9.11). Lines are summed by an
integral over frequency: a representative line counts as many times as the record has lines around it. The transient is
neglected, which matters for records of a few periods of the lowest mode.

A changed rig (a mass on the payload, an isolator moved) has the same parameters as the present one; the changes
themselves are taken as known exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.response import FLOOR, Matrices, ResponseModel
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import point_map

Place = tuple[float, float, float]


@dataclass(frozen=True)
class ExperimentSettings:
    """lines : logarithmic grid on which the information of a record is summed; 4 % apart over two decades, about the
    width of a mode, and fast enough to compare dozens of experiments."""

    lines: int = 120


SETTINGS = ExperimentSettings()


class Added(NamedTuple):
    """Calibrated sensor of the rig's own kind, or actuator, at a position [m] on the payload along a direction.

    force : N/V of an actuator.
    """

    name: str
    place: Place
    direction: Place
    force: float = 1.0

    @property
    def row(self) -> np.ndarray:
        """(6,) displacement along it by q; for an actuator, generalised force by volts."""
        return self.force * np.array(self.direction) @ point_map(self.place)


@dataclass(frozen=True, eq=False)
class ChangedModel(ResponseModel):
    """A model with known masses, sensors and actuators added, and parameters changed by known amounts.

    own : the model without them, whose channels come first. masses : (kg, place) each, a point mass. The parameters
    remain those of the rig without them.
    """

    own: ResponseModel = field(kw_only=True)
    masses: tuple[tuple[float, Place], ...] = ()
    more_sensors: tuple[Added, ...] = ()
    more_actuators: tuple[Added, ...] = ()

    def __post_init__(self) -> None:
        """The names of `own` were checked; others than the rig's are allowed here."""

    def matrices_of(self, rig: Rig) -> Matrices:
        own = self.own.matrices_of(rig)
        M = own.M + sum((kg * point_map(place).T @ point_map(place) for kg, place in self.masses), np.zeros((6, 6)))
        R = np.vstack([own.R, *(one.row for one in self.more_sensors)])
        return own._replace(M=M, R=R, T=np.column_stack([own.T, *(one.row for one in self.more_actuators)]))


def changed(
    model: ResponseModel,
    shifts: Mapping[str, float] | None = None,
    masses: Sequence[tuple[float, Place]] = (),
    sensors: Sequence[Added] = (),
    actuators: Sequence[Added] = (),
) -> ChangedModel:
    """The model of the changed rig, with the same free parameters.

    shifts : known changes of parameters of the rig, in their units (isolator1.p_z and so on). Raises InputError for
        names that the rig does not have, and if no rig has the values.
    """
    known = model.rig.parameters()
    if unknown := [name for name in (shifts or {}) if name not in known]:
        raise InputError(f"expected parameters of the rig {model.rig.name}", field="shifts", value=unknown)
    rig = model.rig.with_parameters({name: known[name].value + shift for name, shift in (shifts or {}).items()})
    own = len(model.sensors.names)
    # Added sensors are of the kind of the first one, with the mean sensitivity of that kind.
    alike = [motion == model.sensors.motions[0] for motion in model.sensors.motions]
    gain = float(np.mean(model.sensors.sensitivity[alike]))
    bank = replace(
        model.sensors.picked([*range(own), *([0] * len(sensors))]),
        names=(*model.sensors.names, *(one.name for one in sensors)),
        sensitivity=np.concatenate([model.sensors.sensitivity, np.full(len(sensors), gain)]),
    )
    return ChangedModel(
        rig,
        model.names,
        bank,
        (*model.actuators, *(one.name for one in actuators)),
        model.period_s,
        model.delay_s,
        model.amplifier_corner_Hz,
        model.turning,
        tuple(masses),
        tuple(sensors),
        tuple(actuators),
        own=model,
    )


class Noise(NamedTuple):
    """Covariance (n, n_y, n_y) of the noise of a record on lines omega (n,), for spectra scaled by 1/sqrt(samples)."""

    omega: np.ndarray
    covariance: np.ndarray

    def at(self, omega: np.ndarray, n_y: int) -> np.ndarray:
        """(.., n_y, n_y) on the next line at or above omega; channels beyond the measured ones have the median power,
        independent."""
        own = self.covariance[np.clip(np.searchsorted(self.omega, omega), 0, len(self.omega) - 1)]
        n_own = own.shape[1]
        middle = np.median(np.real(np.einsum("nii->ni", own)), axis=1)
        found = middle[:, None, None] * np.eye(n_y, dtype=complex)
        found[:, :n_own, :n_own] = own
        return found


def campaign_noise(blocks: Sequence[SpectralBlock]) -> Noise:
    """Noise that a fit estimated, of the record with the most lines.

    Raises InputError if there is no noise estimate of records.
    """
    records = [one for one in blocks if one.noise is not None and one.transient]
    if not records:
        raise InputError("expected records with an estimate of their noise", field="blocks", value=len(blocks))
    longest = max(records, key=lambda one: len(one.omega))
    assert longest.noise is not None
    return Noise(longest.omega, longest.noise[:, 0])


@dataclass(frozen=True)
class Drive:
    """A record: r.m.s. volts of each actuator and r.m.s. floor velocity by axis (measured), spread over a band."""

    level_V: float
    duration_s: float
    band_Hz: tuple[float, float] = (0.5, 60.0)
    floor_m_per_s: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 0 < self.band_Hz[0] < self.band_Hz[1] < np.inf:
            raise InputError("expected increasing positive frequencies", field="drive: band_Hz", value=self.band_Hz)


def predicted_information(model: ResponseModel, drive: Drive, noise: Noise) -> Information:
    """Information of a record on the model's free parameters."""
    rate = 1 / model.period_s if model.period_s else 1000.0
    low, high = drive.band_Hz[0], min(drive.band_Hz[1], 0.45 * rate)
    if low >= high:
        raise InputError(f"expected a band below {0.45 * rate:g} Hz", field="drive: band_Hz", value=drive.band_Hz)
    edges = np.geomspace(low, high, SETTINGS.lines + 1)
    omega = 2 * np.pi * np.sqrt(edges[1:] * edges[:-1])
    lines = np.diff(edges) * drive.duration_s
    # White over the band: E|U|^2 of a spectrum scaled by 1/sqrt(samples).
    spread = np.sqrt(rate / 2 / (high - low))
    columns = [drive.level_V] * len(model.actuators) + [drive.floor_m_per_s.get(axis, 0.0) for axis in FLOOR]
    U = np.broadcast_to(np.diag(columns).astype(complex) * spread, (SETTINGS.lines, len(columns), len(columns)))
    dY = model.driven(omega, U[:, :, np.array(columns) > 0]).dY if np.any(columns) else None
    H = np.zeros((len(model.names), len(model.names)))
    if dY is not None:
        L = np.linalg.inv(np.linalg.cholesky(noise.at(omega, len(model.sensors.names))))
        white = (L @ dY) * np.sqrt(2 * lines)[:, None, None]
        flat = white.reshape(len(white), -1)
        H = np.real(np.conj(flat) @ flat.T)
    return Information(model.names, model.values, model.units, H, model.scales())
