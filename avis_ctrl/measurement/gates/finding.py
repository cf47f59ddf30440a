"""Findings of a gate on a campaign: a sentence with numbers, and plain data for its plot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from avis_ctrl.errors import InputError

Severity = Literal["ok", "note", "warning", "stop"]
SEVERITIES: tuple[str, ...] = ("ok", "note", "warning", "stop")
Response = Callable[[np.ndarray, tuple[str, ...]], np.ndarray]


@dataclass(frozen=True)
class FindingSettings:
    """most_points : maximum number of points of a line: a panel is some hundred pixels wide, with two points
        per pixel.
    most_names : channels that a sentence names; further channels are counted.
    false_alarm : probability that a gate raises an alarm on clean data of one campaign, over all its channels and
        records [1]: an alarm then deserves a look at the data.
    """

    most_points: int = 2000
    most_names: int = 4
    false_alarm: float = 0.01


SETTINGS = FindingSettings()


@dataclass(frozen=True, eq=False)
class Series:
    """A curve of a picture: x and y of equal length; style "line", "points" or "bars".

    Longer lines are reduced to the smallest and the largest point of each of `most_points` / 2 bins.
    """

    name: str
    x: np.ndarray
    y: np.ndarray
    style: str = "line"

    def __post_init__(self) -> None:
        if self.style == "line" and len(self.x) > SETTINGS.most_points:
            x, y = np.asarray(self.x), np.asarray(self.y)
            bins = np.array_split(np.arange(len(x)), SETTINGS.most_points // 2)
            keep = np.unique([k for part in bins for k in (part[np.argmin(y[part])], part[np.argmax(y[part])])])
            object.__setattr__(self, "x", x[keep])
            object.__setattr__(self, "y", y[keep])


@dataclass(frozen=True)
class Limit:
    """A straight line across a picture at `value` of the axis "x" or "y"."""

    name: str
    value: float
    axis: str = "y"


@dataclass(frozen=True, eq=False)
class Picture:
    """Plain data for a plot. Labels include the unit; scales are "linear" or "log".

    x_names : names of the positions 0, 1, 2 ... along x if these are channels; otherwise empty.
    """

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    limits: tuple[Limit, ...] = ()
    x_scale: str = "linear"
    y_scale: str = "linear"
    x_names: tuple[str, ...] = ()


def curves(names: Sequence[str], x: np.ndarray, y: np.ndarray, style: str = "line") -> tuple[Series, ...]:
    """One curve for each channel, of x (n,) and y (n, channels)."""
    return tuple(Series(name, x, column, style) for name, column in zip(names, y.T, strict=True))


def over_frequency(
    title: str, y_label: str, series: tuple[Series, ...], limits: tuple[Limit, ...], y_scale: str = "log"
) -> Picture:
    """Curves over frequency on a logarithmic axis."""
    return Picture(title, "frequency [Hz]", y_label, series, limits, "log", y_scale)


def bars(
    title: str,
    x_label: str,
    y_label: str,
    heights: Mapping[str, float],
    limits: tuple[Limit, ...] = (),
    y_scale: str = "linear",
) -> Picture:
    """A bar for each name."""
    series = Series("value", np.arange(len(heights)), np.array(list(heights.values())), "bars")
    return Picture(title, x_label, y_label, (series,), limits, y_scale=y_scale, x_names=tuple(heights))


def samples_over_time(
    record: str, channel: str, t: np.ndarray, x: np.ndarray, unit: str = "", limits: tuple[Limit, ...] = ()
) -> Picture:
    """Samples x (n,) of one channel at t (n,) s, copied: a view would keep the whole record in memory."""
    label = f"{channel} [{unit}]" if unit else channel
    return Picture(f"Record {record}, {channel}", "time [s]", label, (Series(channel, t.copy(), x.copy()),), limits)


@dataclass(frozen=True, eq=False)
class Finding:
    """One result of a gate.

    Attributes
    ----------
    gate : name of the gate.
    severity : "ok", "note" (for information), "warning" (results suffer), "stop" (results would be wrong).
    sentence : measured numbers, likely cause, next step.
    channels, records : affected channels and records; empty if all are affected.
    value, limit : the tested number and its limit.
    """

    gate: str
    severity: Severity
    sentence: str
    channels: tuple[str, ...] = ()
    records: tuple[str, ...] = ()
    value: float | None = None
    limit: float | None = None
    picture: Picture | None = None

    @property
    def tested(self) -> bool:
        """Whether the records could show what the gate looks for: a passed test has a number or a limit."""
        return self.severity != "ok" or self.value is not None or self.limit is not None

    def __post_init__(self) -> None:
        for field_ in ("value", "limit"):
            if getattr(self, field_) is not None:
                object.__setattr__(self, field_, float(getattr(self, field_)))


@dataclass(frozen=True, eq=False)
class Expectation:
    """What is known about the rig before its records are examined; every field may be absent.

    Attributes
    ----------
    y_range_V : lowest and highest value that the converter reports, unit of y.
    y_lsb_V : step of the converter, unit of y.
    drive_limits_V : largest commanded voltage of each drive, by name.
    sensor_noise_rms_V : noise of each channel, white at the sample rate, unit of y.
    y_names : channels of the rig.
    response : response(omega (n,) rad/s, inputs) -> (n, n_y, n_u) complex, from commanded volts to y, rows in the order
        of `y_names` (or of the campaign's channels if `y_names` is absent).

    Raises
    ------
    InputError : a sensor noise that is not positive.
    """

    y_range_V: tuple[float, float] | None = None
    y_lsb_V: float | None = None
    drive_limits_V: Mapping[str, float] = field(default_factory=dict)
    sensor_noise_rms_V: float | None = None
    y_names: tuple[str, ...] | None = None
    response: Response | None = None

    def __post_init__(self) -> None:
        # Zero, which a rig file of a simulated table may state, is nothing to compare with.
        if self.sensor_noise_rms_V is not None and not self.sensor_noise_rms_V > 0:
            raise InputError("expected a positive number", field="sensor_noise_rms_V", value=self.sensor_noise_rms_V)


def those(names: Sequence[str], chosen: np.ndarray) -> tuple[str, ...]:
    """The names that a mask chooses."""
    return tuple(name for name, yes in zip(names, chosen, strict=True) if yes)


def quoted(names: Sequence[str]) -> str:
    """'a', 'b' and 3 more."""
    shown, more = ", ".join(map(repr, names[: SETTINGS.most_names])), len(names) - SETTINGS.most_names
    return f"{shown} and {more} more" if more > 0 else shown


def times(ratio: float) -> str:
    """ "3.1 times", or "over 1000 times": larger numbers carry no more information."""
    return "over 1000 times" if ratio > 1000 else f"{ratio:.1f} times" if ratio < 100 else f"{ratio:.0f} times"


def percent(part: float) -> str:
    """ "0.12 %", "12 %", "230 %" or "over 1000 %"."""
    return "over 1000 %" if part > 10 else f"{100 * part:.0f} %" if part >= 0.1 else f"{100 * part:.2g} %"
