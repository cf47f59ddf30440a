"""Linear prediction of the simulated loop by frequency responses, independent of the simulation's state-space steps.

The digital parts are evaluated at z = exp(j omega T), the hold and the delay exactly, the table and the chains at s = j
omega. Sampling aliases: a signal sampled at rate 1/T contains all omega + 2 pi k / T. The floor velocity is linear
between samples and the voltages are constant between updates, so both are sampled signals with known images, and

    v*(omega) = sum over k of [ G_w(omega_k) hold_1(omega_k) w* + G_u(omega_k) hold_0(omega_k) exp(-j omega_k tau) u* ]

is exact in the limit of many images. The images decay at least as fast as 1/k^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.floor_motion import DERIVATIVES
from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation.discrete import digital_controller
from avis_ctrl.simulation.sampled_loop import SampledLoop, lever_arms


@dataclass(frozen=True)
class ImageSettings:
    """images : number of pairs of images. Accelerometers are most sensitive to the jumps of force: their images decay
        only as 1/k^2, to 0.1 % after 20.
    points : largest number of frequencies at which the images are summed; between them the sum, which is smooth, is
        interpolated.
    """

    images: int = 20
    points: int = 40


SETTINGS = ImageSettings()


@dataclass(frozen=True, eq=False)
class SampledResponse:
    """The linear loop as a sampled system, at omega (n,) rad/s below half the sample rate.

    Attributes
    ----------
    velocity_floor : (n, 6, 6) payload velocity over floor velocity.
    velocity_noise : (n, 6, n_s) payload velocity over noise at the converters [1/V].
    volts_floor, volts_noise : (n, n_u, 6), (n, n_u, n_s) demanded voltages over floor velocity and over noise.
    """

    loop: SampledLoop
    omega: np.ndarray
    velocity_floor: np.ndarray
    velocity_noise: np.ndarray
    volts_floor: np.ndarray
    volts_noise: np.ndarray

    def velocity_psd(self) -> np.ndarray:
        """(n, 6) one-sided density of the payload's sampled velocity [(m/s)^2/Hz, (rad/s)^2/Hz]."""
        return self._psd(self.velocity_floor, self.velocity_noise)

    def volts_psd(self) -> np.ndarray:
        """(n, n_u) one-sided density of the demanded voltages [V^2/Hz]."""
        return self._psd(self.volts_floor, self.volts_noise)

    def _psd(self, of_floor: np.ndarray, of_noise: np.ndarray) -> np.ndarray:
        frequency = self.omega / (2 * np.pi)
        floor = np.zeros((frequency.size, len(COORDINATES)))
        for name, spectrum in self.loop.floor.items():
            # A realisation has no lines below the band of its model.
            floor[:, COORDINATES.index(name)] = np.where(
                frequency >= spectrum.low_Hz * (1 - 1e-9), spectrum.asd(frequency, "velocity") ** 2, 0.0
            )
        noise = self.loop.sensors.noise_psd(frequency, self.loop.period_s)
        return sum((np.abs(of) ** 2 @ psd[:, :, None])[..., 0] for of, psd in ((of_floor, floor), (of_noise, noise)))


@dataclass(frozen=True, eq=False)
class OpenResponse:
    """Sampled payload velocity and sensor volts over the sampled floor velocity and the computed voltages.

    velocity_floor (n, 6, 6), velocity_volts (n, 6, n_u), sensed_floor (n, n_s, 6), sensed_volts (n, n_s, n_u).
    """

    velocity_floor: np.ndarray
    velocity_volts: np.ndarray
    sensed_floor: np.ndarray
    sensed_volts: np.ndarray


def sampled_response(loop: SampledLoop, omega: np.ndarray, images: int = SETTINGS.images) -> SampledResponse:
    """Closed-loop responses of the linear loop at the frequencies omega [rad/s].

    images : number of pairs of images included, at least one.
    """
    omega = np.atleast_1d(np.asarray(omega, float))
    G = open_response(loop, omega, images)
    C = digital_controller(loop).frequency_response(omega)
    # u = C (S_w w + S_u u + n)
    volts = np.linalg.solve(np.eye(C.shape[1]) - C @ G.sensed_volts, np.concatenate([C @ G.sensed_floor, C], axis=2))
    volts_floor, volts_noise = volts[:, :, : len(COORDINATES)], volts[:, :, len(COORDINATES) :]
    return SampledResponse(
        loop,
        omega,
        G.velocity_floor + G.velocity_volts @ volts_floor,
        G.velocity_volts @ volts_noise,
        volts_floor,
        volts_noise,
    )


def open_response(loop: SampledLoop, omega: np.ndarray, images: int = SETTINGS.images) -> OpenResponse:
    """Responses of table, drives and sensors without the controller, at omega (n,) [rad/s]."""
    return OpenResponse(
        *(centre + folded for centre, folded in zip(_image(loop, omega), _folded(loop, omega, images), strict=True))
    )


def _folded(loop: SampledLoop, omega: np.ndarray, images: int) -> list[np.ndarray]:
    """Sum of all images except the centre: far above every resonance, hence smooth and interpolated from a few
    points."""
    points = omega if omega.size <= SETTINGS.points else np.linspace(omega.min(), omega.max(), SETTINGS.points)
    shifts = 2 * np.pi / loop.period_s * np.array([k for k in range(-images, images + 1) if k])
    parts = _image(loop, (shifts[:, None] + points).ravel())
    sums = [part.reshape(shifts.size, points.size, *part.shape[1:]).sum(axis=0) for part in parts]
    return sums if points is omega else [CubicSpline(points, one)(omega) for one in sums]


def _image(loop: SampledLoop, image: np.ndarray) -> list[np.ndarray]:
    """Terms of the folded sum: continuous responses at `image` = omega + 2 pi k / T, times their holds there."""
    T, eom = loop.period_s, loop.plant.mounted_body().equations_of_motion()
    s = 1j * image[:, None, None]
    sinc = np.sinc(image * T / (2 * np.pi))
    drive = _diagonal(loop.drives(), image) * (sinc * np.exp(-1j * image * (loop.loop_delay_s + T / 2)))[:, None]
    # s^2 M q + s C q + K q = (C_f + K_f / s) w + T u, and v = s q
    dynamic = s * eom.M + eom.C + eom.K / s
    acting = eom.T if loop.drive_coupling is None else eom.T @ loop.drive_coupling.frequency_response(image)
    pushed = np.concatenate(
        [(eom.C_floor + eom.K_floor / s) * (sinc**2)[:, None, None], acting * drive[:, None, :]], axis=2
    )
    velocity = np.linalg.solve(dynamic, pushed)
    _, H = loop.plant.sensor_rows()
    n = len(COORDINATES)
    # Position sensors measure relative to the chassis, which moves with the floor, linearly between samples.
    moved = H @ velocity
    if loop.gravity:
        # The apparent acceleration due to tilt, integrated to a velocity.
        moved = moved + loop.plant.tilt_rows() @ velocity / s**2
    against = np.array([kind == "displacement" for kind in loop.sensors.quantities])
    moved[:, against, :n] -= H[against] * (sinc**2)[:, None, None]
    power = np.array([DERIVATIVES[kind] - 1 for kind in loop.sensors.quantities])
    sensed = moved * s ** power[:, None] * _diagonal(loop.sensors.chains, image)[:, :, None]
    return [velocity[:, :, :n], velocity[:, :, n:], sensed[:, :, :n], sensed[:, :, n:]]


def _diagonal(systems: Sequence[StateSpace], omega: np.ndarray) -> np.ndarray:
    """(n_omega, n) responses of scalar systems; each distinct object is evaluated once."""
    known = {id(system): system.frequency_response(omega)[:, 0, 0] for system in systems}
    return np.stack([known[id(system)] for system in systems], axis=1)


def predict_transmissibility_6dof(loop: SampledLoop, omega: np.ndarray) -> np.ndarray:
    """(n_omega, 6, 6) payload velocity over floor velocity of the sampled loop, rotations as displacement of the edge.

    The floor is assumed to move only at omega [rad/s].
    """
    arms = lever_arms(loop.rig)
    return arms[:, None] * sampled_response(loop, omega).velocity_floor / arms
