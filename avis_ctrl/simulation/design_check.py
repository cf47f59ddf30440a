"""Simulation check of a design: many plants under one controller, with a pass or fail for each."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.simulation.discrete import spectral_radius
from avis_ctrl.simulation.loop import SimulationRecord, simulate
from avis_ctrl.simulation.sampled_loop import SampledLoop
from avis_ctrl.simulation.spectrum_check import SpectrumAgreement, check_spectrum_agreement


@dataclass(frozen=True, eq=False)
class PlantCheck:
    """Result for one plant, one line of the report.

    Attributes
    ----------
    diverged : the nonlinear simulation went beyond the stops.
    spectral_radius : of the linear sampled loop; reveals an instability too slow for the simulated time.
    spectrum : agreement with the linear prediction; None if the run diverged or the linear loop is unstable.
    peak_V, limit_V : largest demanded voltage of the drive that comes closest to its limit, and that limit.
    rms_V : of the demanded voltages, maximum over the drives.
    clipped_dac, clipped_adc : number of samples beyond the limits.
    payload_rms : r.m.s. velocity by controlled axis [m/s], rotations at the edge; at all frequencies of the
        record.
    """

    name: str
    diverged: bool
    spectral_radius: float
    spectrum: SpectrumAgreement | None
    peak_V: float
    rms_V: float
    limit_V: float
    clipped_dac: int
    clipped_adc: int
    payload_rms: dict[str, float]

    @property
    def stable(self) -> bool:
        """Whether the linear loop is stable and the simulation did not diverge."""
        return not self.diverged and self.spectral_radius < 1.0

    @property
    def within_limits(self) -> bool:
        """No voltage exceeds its limit, at the drives or at the converter."""
        return self.clipped_dac == 0 and self.clipped_adc == 0

    @property
    def agrees(self) -> bool:
        """Whether the spectrum agrees with its prediction."""
        return self.spectrum is not None and self.spectrum.agrees

    @property
    def passed(self) -> bool:
        """Whether the plant passes all checks."""
        return self.stable and self.agrees and self.within_limits

    def as_dict(self) -> dict[str, Any]:
        """Values for a file."""
        names = ("name", "passed", "stable", "diverged", "spectral_radius", "within_limits")
        volts = ("peak_V", "rms_V", "limit_V", "clipped_dac", "clipped_adc")
        return {name: getattr(self, name) for name in (*names, *volts, "payload_rms")} | {
            "spectrum_agrees": self.agrees,
            "spectrum": self.spectrum.as_dict() if self.spectrum else None,
        }


@dataclass(frozen=True, eq=False)
class SimulationCheck:
    """Results for all plants; `first` is the full record of the first plant, for time plots."""

    plants: tuple[PlantCheck, ...]
    duration_s: float
    seed: int
    false_alarm: float
    first: SimulationRecord

    @property
    def passed(self) -> bool:
        """Whether the plant passes all checks."""
        return all(plant.passed for plant in self.plants)

    def as_dict(self) -> dict[str, Any]:
        """JSON-serialisable summary, without time series and line spectra."""
        return {
            "passed": self.passed,
            "duration_s": self.duration_s,
            "seed": self.seed,
            "false_alarm": self.false_alarm,
            "plants": [plant.as_dict() for plant in self.plants],
        }


def check_designs(
    loops: Sequence[SampledLoop], duration_s: float = 60.0, seed: int = 1, false_alarm: float = 0.01
) -> SimulationCheck:
    """Simulate each loop with its own floor motion and noise, and judge it.

    Parameters
    ----------
    loops : nominal first, then the worst case and the random plants; their names head the lines.
    seed : loop k draws from (seed, k).
    false_alarm : probability that by noise alone any band of any plant disagrees.

    Raises
    ------
    InputError : no loops; errors of `simulate` and `check_spectrum_agreement`.
    """
    if not loops:
        raise InputError("at least one loop", field="loops", value=[])
    first = simulate(loops[0], duration_s, (seed, 0))
    records = itertools.chain([first], (simulate(loop, duration_s, (seed, k)) for k, loop in enumerate(loops[1:], 1)))
    plants = tuple(judge(record, false_alarm=false_alarm / len(loops)) for record in records)
    return SimulationCheck(plants, duration_s, seed, false_alarm, first)


def judge(
    record: SimulationRecord, band_Hz: tuple[float, float] = (1.0, 80.0), false_alarm: float = 0.01
) -> PlantCheck:
    """Check of one simulation record."""
    loop = record.loop
    radius = spectral_radius(loop)
    # Without a stable linear loop there is no stationary spectrum to predict.
    steady = not record.diverged and radius < 1.0
    spectrum = check_spectrum_agreement(record, band_Hz, false_alarm=false_alarm) if steady else None
    peaks = np.max(np.abs(record.demanded), axis=0)
    nearest = int(np.argmax(peaks * (loop.limits_V.max() / loop.limits_V)))
    return PlantCheck(
        loop.name,
        record.diverged,
        radius,
        spectrum,
        float(peaks[nearest]),
        float(np.max(np.sqrt(np.mean(record.demanded**2, axis=0)))),
        float(loop.limits_V[nearest]),
        record.clipped_dac,
        record.clipped_adc,
        {axis: float(np.sqrt(np.mean(record.velocity(axis) ** 2))) for axis in loop.axes},
    )
