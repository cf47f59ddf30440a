"""Measured transfer functions X/V of the sequential fit: simulated as an analyser gives them, or from a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.rigs.halcyonics import Halcyonics
from avis_ctrl.rigs.rigid_body import point_map
from benchmarks.sequential.published import TestCase, place_of

_DERIVATIVE = {"m": 0, "m/s": 1, "m/s^2": 2}


@dataclass(frozen=True, eq=False)
class MeasuredTests:
    """One complex transfer function per test.

    Attributes
    ----------
    omega : (n,) rad/s, increasing, positive.
    transfers : X/V [m/V], (n,) complex, by the test's number; for a drive with signs, of the whole combination.
    variance : E|error|^2 [m^2/V^2], (n,), by the test's number, or None where it is not known. The errors of
        different lines and of different tests count as independent.
    """

    omega: np.ndarray
    transfers: Mapping[int, np.ndarray]
    variance: Mapping[int, np.ndarray] | None = None

    def __post_init__(self) -> None:
        omega = np.asarray(self.omega, float)
        if (
            omega.ndim != 1
            or omega.size < 1
            or not np.all(np.isfinite(omega))
            or omega[0] <= 0
            or np.any(np.diff(omega) <= 0)
        ):
            raise InputError(
                "expected positive, increasing frequencies in rad/s", field="omega", value=omega.tolist()[:5]
            )
        object.__setattr__(self, "omega", omega)
        for field in ("transfers", "variance"):
            given = getattr(self, field)
            if given is not None:
                kind = complex if field == "transfers" else float
                arrays = {number: np.asarray(array, kind) for number, array in given.items()}
                for number, array in arrays.items():
                    self._check(f"{field} of test {number}", array, field == "variance")
                object.__setattr__(self, field, arrays)
        if self.variance is not None and (missing := set(self.transfers) - set(self.variance)):
            raise InputError("expected a variance for each test, or for none", field="variance", value=sorted(missing))

    def _check(self, field: str, array: np.ndarray, positive: bool) -> None:
        if array.shape != self.omega.shape or not np.all(np.isfinite(array)):
            raise InputError(
                f"expected {self.omega.size} finite numbers, one for each frequency", field=field, value=array.shape
            )
        if positive and np.any(array <= 0):
            raise InputError("expected positive variances", field=field, value=float(array.min()))

    @property
    def frequency_Hz(self) -> np.ndarray:
        return self.omega / (2 * np.pi)

    def between(self, low_Hz: float, high_Hz: float) -> MeasuredTests:
        """The lines of a band, ends included. InputError where it holds none."""
        slack = 1e-9
        keep = (self.frequency_Hz >= low_Hz * (1 - slack)) & (self.frequency_Hz <= high_Hz * (1 + slack))
        if not np.any(keep):
            raise InputError(
                f"expected lines in the band; they go from {self.frequency_Hz[0]:.4g} to "
                f"{self.frequency_Hz[-1]:.4g} Hz",
                field="band_Hz",
                value=(low_Hz, high_Hz),
            )
        variance = None if self.variance is None else {k: v[keep] for k, v in self.variance.items()}
        return MeasuredTests(self.omega[keep], {k: t[keep] for k, t in self.transfers.items()}, variance)


@dataclass(frozen=True)
class Analyser:
    """An FFT analyser driving with random voltage, and what disturbs it. None of it is printed in the source.

    Attributes
    ----------
    averages : n of the H1 estimate; at least 2, so that the coherence says something.
    resolution_Hz, low_Hz, high_Hz : the frequency lines.
    drive_V_rtHz : density of the random voltage. 0.01 is 0.1 V r.m.s. in 100 Hz.
    accelerometer_m_s2_rtHz : noise of accelerometer and conditioner; as displacement it rises as 1/omega^2.
    floor_m_s_rtHz : floor velocity along x, y and z each, independent; it reaches the plate through K and D.
    low_corner_Hz : second-order high-pass of accelerometer and integrating conditioner (two equal first-order
        corners) that nobody corrects; 0: none.

    Windows and leakage are not simulated: lines are independent.
    """

    averages: int = 50
    resolution_Hz: float = 0.25
    low_Hz: float = 1.0
    high_Hz: float = 40.0
    drive_V_rtHz: float = 0.01
    accelerometer_m_s2_rtHz: float = 2e-5
    floor_m_s_rtHz: float = 1e-6
    low_corner_Hz: float = 0.0

    def __post_init__(self) -> None:
        if self.averages < 2:
            raise InputError("expected at least 2 averages", field="averages", value=self.averages)
        for field in ("resolution_Hz", "low_Hz", "drive_V_rtHz"):
            if not (np.isfinite(getattr(self, field)) and getattr(self, field) > 0):
                raise InputError("expected a positive number", field=field, value=getattr(self, field))
        for field in ("accelerometer_m_s2_rtHz", "floor_m_s_rtHz", "low_corner_Hz"):
            if not (np.isfinite(getattr(self, field)) and getattr(self, field) >= 0):
                raise InputError("expected a number, not negative", field=field, value=getattr(self, field))
        if not self.low_Hz < self.high_Hz < np.inf:
            raise InputError(f"expected more than low_Hz = {self.low_Hz:g}", field="high_Hz", value=self.high_Hz)

    @property
    def omega(self) -> np.ndarray:
        """(n,) rad/s of the lines."""
        first, last = np.ceil(self.low_Hz / self.resolution_Hz), np.floor(self.high_Hz / self.resolution_Hz)
        return 2 * np.pi * self.resolution_Hz * np.arange(first, last + 1)


def voltage_transfers(rig: Halcyonics, rows: np.ndarray, patterns: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """X/V [m/V], (k, n) complex: eq. 32 times e_r for k pairs of measured displacement and drive at once.

    rows : (k, 6) from the plate's motion w to the displacement, see `row_of`; patterns : (k, 8) voltages A.
    """
    eom = rig.equations_of_motion()
    w = omega[:, None, None]
    W = np.linalg.solve(-(w**2) * eom.M + 1j * w * eom.C + eom.K, eom.T @ patterns.T)
    return np.einsum("kj,njk->kn", rows, W)


def row_of(rig: Halcyonics, test: TestCase) -> np.ndarray:
    """(6,) from the plate's motion w to the test's displacement, eq. 31."""
    return point_map(place_of(rig, test))["xyz".index(test.direction)]


def simulate_tests(
    rig: Halcyonics,
    tests: Sequence[TestCase],
    noise: Analyser | None = None,
    seed: int | np.random.Generator = 0,
    omega: np.ndarray | None = None,
) -> MeasuredTests:
    """Transfer functions as an analyser would measure them on this rig.

    Each drive case of each test is a run of its own (the source subtracts two runs). A run draws, for each line and
    average, the voltage V and the disturbance N and returns H1 = S_xv/S_vv of X = H V + N, with its variance as
    the analyser knows it, from the same averages: (S_xx - |S_xv|^2/S_vv) / ((n - 1) S_vv), that is
    |H1|^2 (1 - coherence)/(coherence (n - 1)).

    Parameters
    ----------
    noise : None for the exact transfer functions, without variance.
    omega : rad/s, instead of the analyser's lines.
    """
    rng = np.random.default_rng(seed)
    lines = (noise or Analyser()).omega if omega is None else np.asarray(omega, float)
    transfers, variance = {}, {}
    for test in tests:
        row = row_of(rig, test)
        total, spread = np.zeros(lines.size, complex), np.zeros(lines.size)
        for sign, pattern in test.drive_cases:
            H = voltage_transfers(rig, row[None], pattern[None], lines)[0]
            if noise is not None:
                disturbance = np.sqrt(disturbance_density(rig, row, lines, noise))
                H, v = _averaged(H * _high_pass(lines, noise.low_corner_Hz), disturbance, noise, rng)
                spread += v
            total += sign * H
        transfers[test.number], variance[test.number] = total, spread
    return MeasuredTests(lines, transfers, None if noise is None else variance)


def disturbance_density(rig: Halcyonics, row: np.ndarray, omega: np.ndarray, noise: Analyser) -> np.ndarray:
    """(n,) power spectral density [m^2/Hz] of what a measured displacement, row (6,), holds beside the drive."""
    eom = rig.equations_of_motion()
    w = omega[:, None, None]
    G = -(w**2) * eom.M + 1j * w * eom.C + eom.K
    carried = np.linalg.solve(G, (1j * w * eom.C_floor + eom.K_floor)[:, :, :3])
    through = np.einsum("j,njk->nk", row, carried)
    floor = np.sum(np.abs(through) ** 2, axis=1) * (noise.floor_m_s_rtHz / omega) ** 2
    return floor + (noise.accelerometer_m_s2_rtHz / omega**2) ** 2


def _high_pass(omega: np.ndarray, corner_Hz: float) -> np.ndarray:
    return (1j * omega / (1j * omega + 2 * np.pi * corner_Hz)) ** 2


def _averaged(
    H: np.ndarray, disturbance: np.ndarray, noise: Analyser, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """H1 estimate and the variance read off it, (n,) each."""
    shape = (noise.averages, H.size)

    def circular() -> np.ndarray:
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / np.sqrt(2)

    V, N = noise.drive_V_rtHz * circular(), disturbance * circular()
    X = H * V + N
    S_vv, S_xv = np.sum(np.abs(V) ** 2, axis=0), np.sum(X * V.conj(), axis=0)
    unexplained = np.sum(np.abs(X) ** 2, axis=0) - np.abs(S_xv) ** 2 / S_vv
    # Rounding only: without any disturbance the difference of equal numbers may fall below zero.
    return S_xv / S_vv, np.maximum(unexplained, 1e-30 * S_vv) / ((noise.averages - 1) * S_vv)


def transfers_from_response(
    response: FrequencyResponse,
    tests: Sequence[TestCase],
    outputs: Mapping[tuple[str, str], str] | None = None,
    actuators: Sequence[str] = ("A1", "A2", "A3", "A4", "A5", "A6", "A7", "A8"),
    delay_s: float = 0.0,
) -> MeasuredTests:
    """The tests' transfer functions out of one measured frequency response matrix.

    Parameters
    ----------
    response : inputs are actuators in V, outputs displacements ("m"), velocities ("m/s") or accelerations
        ("m/s^2") of points; sensors must already be taken out.
    outputs : name of the output that measures (point, direction), such as ("M3", "z"): "acc3z". By default
        "z_3" and so on, as the source writes them.
    actuators : names of A1..A8 among the inputs.
    delay_s : delay from commanded to acting voltage, taken out.

    The variance of a combination follows from the covariance of one experiment; the correlation between tests that
    share an experiment is dropped. Raises InputError for a missing channel or another unit.
    """
    if response.input_unit != "V" or response.output_unit not in _DERIVATIVE:
        raise InputError(
            f"expected inputs in V and outputs in one of {', '.join(_DERIVATIVE)}",
            field="input_unit, output_unit",
            value=(response.input_unit, response.output_unit),
        )
    omega = response.omega
    if omega[0] <= 0:
        response = response.at(omega > 0)
        omega = response.omega
    to_displacement = np.exp(1j * omega * delay_s) / (1j * omega) ** _DERIVATIVE[response.output_unit]
    inverse = None if response.gram is None else np.linalg.inv(response.gram)
    if len(actuators) != 8:
        raise InputError("expected the names of A1..A8", field="actuators", value=list(actuators))
    transfers, variance = {}, {}
    for test in tests:
        name = (outputs or {}).get((test.point, test.direction), test.displacement)
        row = _index(response.outputs, name, f"output for {test.displacement} of test {test.number}")
        pattern = np.zeros(len(response.inputs))
        for k in np.flatnonzero(test.pattern).tolist():
            pattern[_index(response.inputs, actuators[k], f"input of test {test.number}")] = test.pattern[k]
        transfers[test.number] = to_displacement * (response.value[:, row] @ pattern)
        if inverse is None or response.noise is None:
            spread = response.variance()[:, row] @ pattern**2
        else:
            spread = np.real(np.einsum("j,nkj,k->n", pattern, inverse, pattern) * response.noise[:, row, row])
        variance[test.number] = np.abs(to_displacement) ** 2 * spread
    return MeasuredTests(omega, transfers, variance)


def _index(names: Sequence[str], name: str, field: str) -> int:
    if name not in names:
        raise InputError(f"expected one of {list(names)}", field=field, value=name)
    return list(names).index(name)
