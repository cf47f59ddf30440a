"""The next measurement: one that separates two explanations or, failing that, shows most of what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.gap.result import RecordGap, Where
from avis_ctrl.gap.table_model import TableModel


@dataclass(frozen=True)
class NextMeasurementSettings:
    """Settings of the suggested next measurement.

    telling : residual power over noise power above which a record shows how the residual grows [1].
    another_level : minimum ratio of two different levels [1].
    within : maximum distance of an exponent of the level from zero or one for it to count as such [1].
    unsure : standard deviation from which an exponent is not reported [1]: two of them span the difference between a
        residual proportional to the drives and one independent of them.
    points : frequencies at which predictions are compared: 0.1 % apart, so that no lightly damped peak is missed.
    near : fraction of the largest difference of two predictions, above which a frequency belongs to the suggested band
        [1].
    part : fraction of the residual at a sensor, above which a band is named [1].
    """

    telling: float = 2.0
    another_level: float = 1.2
    within: float = 0.2
    unsure: float = 0.5
    points: int = 8000
    near: float = 0.5
    part: float = 0.1


SETTINGS = NextMeasurementSettings()


def between(name: str, other: str, a: TableModel, b: TableModel) -> str:
    """How to separate two explanations: measure where the predictions of their refitted models differ most."""
    for time_varying, quantity, advice in (
        (False, "amplitude", "at half of the lowest and at twice the highest level"),
        (True, "time", "over a longer time"),
    ):
        depends = [_depends(model, beside, time_varying) for model, beside in ((a, b), (b, a))]
        if any(depends):
            why = (
                f"they depend on {quantity} in different ways"
                if all(depends)
                else f"only {name if depends[0] else other} depends on {quantity}"
            )
            return f"To distinguish {name} from {other}, record the same signals {advice}: {why}."
    frequency = np.geomspace(0.1, 0.4 / max(a.period_s, 1e-4), SETTINGS.points)
    omega, n_u = 2 * np.pi * frequency, len(a.actuators)
    difference = np.abs(a.response(omega)[:, :, :n_u] - b.response(omega)[:, :, :n_u])
    k, i, j = np.unravel_index(int(np.argmax(difference)), difference.shape)
    low, high = _about(difference[:, i, j], int(k))
    band = f"{frequency[low]:.3g} to {frequency[high]:.3g} Hz"
    return (
        f"To distinguish {name} from {other}, drive {a.actuators[j]} from {band} and measure {a.sensors.names[i]}: "
        f"there their predictions differ most, by {difference.max():.2g} {a.sensors.unit}/V."
    )


def _depends(model: TableModel, other: TableModel, time_varying: bool) -> bool:
    """Whether a model has effects that the other model lacks and that depend on time, or on amplitude."""
    common = {one.label for one in other.effects}
    return any(
        one.effect.nonlinear and one.effect.time_varying == time_varying
        for one in model.effects
        if one.label not in common
    )


def _about(size: np.ndarray, k: int) -> tuple[int, int]:
    """Nearest points on either side of k with at most `near` times the size at k; the end points if there are none."""
    far = np.flatnonzero(size <= SETTINGS.near * size[k])
    return int(far[far < k].max(initial=0)), int(far[far > k].min(initial=len(size) - 1))


def of_unexplained(places: Sequence[Where], records: Sequence[RecordGap]) -> str:
    """Where to measure the unexplained residual, and how it depends on the level in these records."""
    where = _where(places)
    growth = grows(records)
    if growth is None:
        return (
            f"{where}Repeat the records at half and twice the level, and add "
            "one at rest with the floor measured: a residual in proportion to the drive is linear, one that "
            "grows faster is not, and one that stays the same is noise or comes through the floor."
        )
    power, std = growth
    rise = f"{where}The residual beyond noise varies as the level to the power {power:.2f} +- {std:.2g}"
    if abs(power) <= max(SETTINGS.within, 2 * std) and abs(power) < abs(power - 1):
        return (
            f"{rise}: it may not depend on the drives. Record the table at rest with the floor measured; "
            "look for other sources."
        )
    if abs(power - 1) <= max(SETTINGS.within, 2 * std):
        return (
            f"{rise}: it may be linear. Drive one actuator at a time: the drives and sensors for which it appears "
            "show where it acts."
        )
    law = (
        "it grows more slowly than the drive, as with friction or backlash"
        if power < 1
        else "it grows faster than the drive, as with stiffening or saturation"
    )
    return (
        f"{rise}: {law}. Repeat one record at three or more levels with `avis excite --lines odd_detection`: the "
        "lines that are not excited, against level, show its law."
    )


def grows(records: Sequence[RecordGap]) -> tuple[float, float] | None:
    """(exponent, standard deviation) of the residual beyond noise as a power of the level; None if it is not clear.

    Least squares of log residual on log level over the records, after subtraction of the noise power. The residual is
    relative to the noise, which depends on whether the floor is measured, and different signals excite different parts
    of the gap. Each kind of record therefore has its own factor; all have the same exponent. None if the levels are too
    close, too few records exceed the noise, or the standard deviation is `unsure` or more.
    """
    telling = [r for r in records if r.level_V > 0 and r.after**2 > SETTINGS.telling]
    kinds = sorted({r.kind for r in telling})
    if len(telling) < len(kinds) + 2:
        return None
    own = np.array([[r.kind == kind for kind in kinds] for r in telling], float)
    level, residual = np.log([r.level_V for r in telling]), np.log([np.sqrt(r.after**2 - 1) for r in telling])
    if max(np.ptp(level[of > 0]) for of in own.T) < np.log(SETTINGS.another_level):
        return None
    A = np.column_stack([own, level])
    x = np.linalg.lstsq(A, residual, rcond=None)[0]
    scatter = np.sum((residual - A @ x) ** 2) / (len(residual) - A.shape[1])
    std = float(np.sqrt(scatter * np.linalg.inv(A.T @ A)[-1, -1]))
    return (float(x[-1]), std) if std < SETTINGS.unsure else None


def grows_faster(records: Sequence[RecordGap]) -> bool | None:
    """Whether the residual beyond noise grows faster than the drive level; None if the records do not show it."""
    growth = grows(records)
    if growth is None:
        return None
    power, std = growth
    return True if power - 2 * std > 1 else False if power + 2 * std < 1 + SETTINGS.within else None


def _where(places: Sequence[Where]) -> str:
    """A sentence on the output and band with most of the residual; empty without places."""
    if not places:
        return ""
    outputs = {one.output for one in places}
    most = max(outputs, key=lambda name: sum(one.share for one in places if one.output == name))
    band = [one for one in places if one.output == most]
    held = sum(one.share for one in band)
    band = [one for one in band if one.share > SETTINGS.part * held]
    return (
        f"{100 * sum(one.share for one in band):.0f} % of the residual is at {most} from "
        f"{min(one.from_Hz for one in band):.3g} to {max(one.to_Hz for one in band):.3g} Hz. "
    )
