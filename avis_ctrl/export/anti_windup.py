"""Choice of the anti-windup by simulation of the nonlinear table; each law is compared with no anti-windup.

No anti-windup is best for every controller. The part of the demand beyond the limits may be one that the table should
not get anyway; a law that reacts to it then prolongs the recovery. The circle criterion, by which these laws could
guarantee an L2 gain, is not satisfied even without anti-windup: at the upper crossover an eigenvalue of I - L has a
phase beyond 90 degrees. Therefore the laws are compared: the floor moves as at the site, but so far that the linear
loop would demand several times the drives' range, then it rests. A law qualifies only if the table recovers no more
slowly than without it, at every level of the floor. Of these laws, the one with the smallest geometric mean of all
figures is exported; if none is better than no anti-windup, none is exported. Random motion averages over the instants
at which it may end; after a single sine the recovery depends on that instant more than on the law.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import gmean

from avis_ctrl.rigs.rigid_body import COORDINATES
from avis_ctrl.simulation.loop import floor_velocity, simulate
from avis_ctrl.simulation.sampled_loop import NO_ANTI_WINDUP, AntiWindup, SampledLoop, lever_arms


@dataclass(frozen=True)
class AntiWindupSettings:
    """levels : largest voltage that the linear loop would demand, in units of the drive's limit: from hardly limited to
    always limited. records : number of random floor motions at each level. motion_s, fade_s : duration of the motion,
    several periods of the slowest floor motion, and of its fade-out. rest_s : the rest that is evaluated, in which a
    damped table settles. late_s : start and end of the part of it in which the largest velocity is evaluated: what
    still rings after the first swing. corners_Hz, gains : of the lags tried; around the table's resonances, which the
    controller damps, and above the corners of the slow states that wind up. alike : recoveries that differ by less than
    this fraction count as equal; other floor records change them by a tenth. seed : of the floor.
    """

    levels: tuple[float, ...] = (1.5, 3.0, 6.0, 12.0)
    records: int = 4
    motion_s: float = 20.0
    fade_s: float = 0.5
    rest_s: float = 5.0
    late_s: tuple[float, float] = (1.0, 3.0)
    corners_Hz: tuple[float, ...] = (0.3, 1.0, 3.0)
    gains: tuple[float, ...] = (0.3, 1.0)
    alike: float = 0.01
    seed: int = 1


@dataclass(frozen=True)
class Choice:
    """law : the exported law. corner_Hz, gain : of its lag, None without one. levels : of the floor. without, chosen :
    (levels, 2) r.m.s. velocity of the kept axes in the rest, and largest velocity in its late part, each r.m.s. over
    the records [m/s]; rotations at the edge."""

    law: AntiWindup
    corner_Hz: float | None
    gain: float | None
    levels: tuple[float, ...]
    without: np.ndarray
    chosen: np.ndarray

    def as_dict(self) -> dict[str, Any]:
        """Entry of certificate.json."""

        def row(figures: np.ndarray) -> dict[str, list[float]]:
            return {"rms_m_per_s": figures[:, 0].tolist(), "late_peak_m_per_s": figures[:, 1].tolist()}

        return {
            "chosen": "none" if self.corner_Hz is None else "lag of the excess",
            "corner_Hz": self.corner_Hz,
            "gain": self.gain,
            "demand_over_limit": list(self.levels),
            "recovery": row(self.chosen),
            "recovery_without": row(self.without),
        }


def choose_anti_windup(
    loop: SampledLoop, axes: tuple[str, ...], settings: AntiWindupSettings = AntiWindupSettings()
) -> Choice:
    """Choose the anti-windup for the loop of the exported controller by the velocity of `axes`.

    Converter and noise are omitted: beyond the converter's range the code switches the drives off, so that they do not
    reach their limits.
    """
    sensors = replace(
        loop.sensors, converter=None, noise_rms_V=np.zeros(1), flicker_rms_V=np.zeros(1), offset_V=np.zeros(1)
    )
    loop = replace(loop, sensors=sensors)
    floors = _floors(loop, settings)

    def recovery(law: AntiWindup, level: int) -> np.ndarray:
        return _recovery(replace(loop, anti_windup=law), axes, settings.levels[level] * floors, settings)

    levels = range(len(settings.levels))
    without = np.array([recovery(NO_ANTI_WINDUP, k) for k in levels])
    best = Choice(NO_ANTI_WINDUP, None, None, settings.levels, without, without)
    for corner in settings.corners_Hz:
        for gain in settings.gains:
            law, found = AntiWindup.of(corner, gain, loop.period_s), []
            for k in levels:
                found.append(recovery(law, k))
                if np.any(found[-1] > (1 + settings.alike) * without[k]):
                    break
            else:
                if gmean(found, None) < min(gmean(best.chosen, None), (1 - settings.alike) * gmean(without, None)):
                    best = Choice(law, corner, gain, settings.levels, without, np.array(found))
    return best


def _floors(loop: SampledLoop, settings: AntiWindupSettings) -> np.ndarray:
    """(records, n + 1, 6) floor velocities that end in rest; the linear loop just demands a drive's limit."""
    n = round((settings.motion_s + settings.rest_s) * loop.sample_rate_Hz)
    time = np.arange(n + 1) * loop.period_s
    fade = np.clip((settings.motion_s - time) / settings.fade_s, 0.0, 1.0)[:, None]
    floors = []
    for record in range(settings.records):
        floor = fade * floor_velocity(loop, n, np.random.default_rng((settings.seed, record)))
        demanded = simulate(
            replace(loop, limit_V=1e12), n * loop.period_s, settle_s=0.0, nonlinear=False, floor=floor
        ).demanded
        most = np.max(np.abs(demanded) / loop.limits_V)
        floors.append(floor / most if most > 0 else floor)
    return np.array(floors)


def _recovery(loop: SampledLoop, axes: tuple[str, ...], floors: np.ndarray, settings: AntiWindupSettings) -> np.ndarray:
    """(2,) r.m.s. velocity in the rest, and largest velocity in its late part, r.m.s. over the records; inf if
    unstable."""
    kept = [COORDINATES.index(name) for name in axes]
    start, *late = (round((settings.motion_s + t) * loop.sample_rate_Hz) for t in (0.0, *settings.late_s))
    found = []
    for floor in floors:
        record = simulate(loop, (len(floor) - 1) * loop.period_s, settle_s=0.0, floor=floor)
        if record.diverged:
            return np.full(2, np.inf)
        speed = np.linalg.norm(record.q_dot[:, kept] * lever_arms(loop.rig)[kept], axis=1)
        found.append((np.sqrt(np.mean(speed[start:] ** 2)), np.max(speed[late[0] : late[1]])))
    return np.sqrt(np.mean(np.square(found), axis=0))
