"""Identification of a single-axis model from files.

identify_single_axis("seismometer", folder, {"drive": "FuncGen", "coil": "Current", "displacement": "Laser",
                     "t": "Seconds"}, scale={"coil": 0.9425e-6, ...})
identify_single_axis("drive", file, {"force": "vir", "position": "qm", "reference": "qg", "t": "t"},
                     scale={"force": 35.15})
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import AvisError, ComputationError, InputError
from avis_ctrl.identification.single_axis.decay import fit_decay
from avis_ctrl.identification.single_axis.drive import fit_drive
from avis_ctrl.identification.single_axis.fit import SingleAxisFit
from avis_ctrl.identification.single_axis.oscillator import fit_oscillator
from avis_ctrl.identification.single_axis.seismometer import Responses, fit_seismometer
from avis_ctrl.identification.single_axis.sine import SineRecord, fit_sine
from avis_ctrl.measurement.campaign import Campaign, RecordSource
from avis_ctrl.measurement.formats.reader import read_measurements

# kind -> (role of the input, other required roles, optional roles)
ROLES: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "seismometer": ("drive", (), ("coil", "displacement", "ground")),
    "decay": ("", ("y",), ()),
    "drive": ("force", ("position",), ("reference",)),
    "oscillator": ("u", ("y",), ()),
}


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and not np.isnan(value)


# What is expected of an option, in words, and whether a value is that.
Kind = tuple[str, Callable[[Any], bool]]
TRUTH: Kind = ("true or false", lambda value: isinstance(value, bool))
WORD: Kind = ("a word", lambda value: isinstance(value, str))
NUMBER: Kind = ("a number", _number)
WHOLE: Kind = ("a whole number", lambda value: isinstance(value, int) and _number(value))
PAIR: Kind = (
    "two numbers, low and high",
    lambda value: isinstance(value, (tuple, list)) and len(value) == 2 and all(map(_number, value)),
)
OPTIONS: dict[str, dict[str, Kind]] = {
    "seismometer": {"delay": TRUTH},
    "drive": {"cutoff_Hz": NUMBER, "coulomb": WORD, "offset": TRUTH},
    "oscillator": {"band_Hz": PAIR},
    "decay": {"corner_Hz": NUMBER, "damping": NUMBER, "start_s": NUMBER, "end_s": NUMBER, "drift": WHOLE},
}


def identify_single_axis(
    kind: str,
    path: str | Path,
    columns: Mapping[str, str],
    *,
    scale: Mapping[str, float] | None = None,
    sample_rate_Hz: float | None = None,
    **options: Any,
) -> SingleAxisFit:
    """Read measurements of one axis and fit a model to them.

    Parameters
    ----------
    kind : "seismometer" (stepped sine: a directory with one CSV per frequency, or a campaign), "decay" (one record),
        "drive" or "oscillator" (one record).
    columns : role to name of a column or variable, and "t" to that of the time if there is one. Roles: seismometer:
        drive, and coil, displacement or both; for a shaken ground its velocity is the drive, and the coil is mapped as
        "ground". decay: y. drive: force, position, and reference for instruments. oscillator: u, y.
    scale : role to the factor that converts the file's numbers to SI; 1 by default.
    sample_rate_Hz : for files without time.
    options : of `fit_seismometer`, `fit_decay`, `fit_drive`,
        `fit_oscillator`.

    Raises
    ------
    InputError : an unknown kind, role, option or column; an unreadable file. ComputationError : as in the fits.

    Examples
    --------
    A decay of 1 Hz and damping ratio 0.02:

    >>> t = np.arange(0.0, 20.0, 0.01)
    >>> y = np.exp(-0.02 * 2 * np.pi * t) * np.cos(2 * np.pi * np.sqrt(1 - 0.02**2) * t)
    >>> y += 0.01 * np.random.default_rng(1).normal(size=t.size)
    >>> np.savetxt("decay.csv", np.c_[t, y], header="t,y", delimiter=",", comments="")
    >>> print(ac.single_axis("decay", "decay.csv", {"t": "t", "y": "y"}, corner_Hz=1.1, damping=0.05).lines()[0])
    corner_Hz = 0.999986 +- 0.000031 Hz
    """
    if kind not in ROLES:
        raise InputError(f"expected one of {', '.join(ROLES)}", field="kind", value=kind)
    for name, value in options.items():
        _check_option(kind, name, value)
    scale = dict(scale or {})
    driven, measured = roles_of(kind, columns, scale)
    campaign = read_columns(path, columns, driven, measured, sample_rate_Hz)
    if kind == "seismometer":
        responses, refused = stepped_sine(campaign, driven, measured, scale)
        fit = fit_seismometer(responses, **options)
        return replace(fit, notes=(*fit.notes, *(f"left out: {reason}" for reason in refused)))
    if len(campaign.records) != 1:
        raise InputError("expected one record", file=path, field="records", value=len(campaign.records))
    time, channel = _channels(campaign.records[0], driven, measured, scale)
    if kind == "drive":
        return fit_drive(time, channel["position"], channel["force"], reference=channel.get("reference"), **options)
    if kind == "decay":
        return fit_decay(time, channel["y"], **options)
    rate = campaign.sample_rate_Hz
    return fit_oscillator(channel["u"], channel["y"], rate, **{"band_Hz": (0.005 * rate, 0.4 * rate)} | options)


def sine_records(
    campaign: Campaign, driven: str, measured: Sequence[str], scale: Mapping[str, float] | None = None
) -> tuple[list[SineRecord], list[str]]:
    """The sine of each record, in order of frequency, and the reasons why the others were refused.

    driven, measured : roles, in the order of the campaign's u and y.
    """
    found, refused = [], []
    for source in campaign.records:
        time, channel = _channels(source, driven, measured, dict(scale or {}))
        try:
            record = fit_sine(source.header.name, time, channel, driven)
        except AvisError as error:
            refused.append(str(error))
            continue
        reasons = [reason for name in record.channels if (reason := record.refusal(name))]
        refused += reasons
        if not reasons:
            found.append(record)
    return sorted(found, key=lambda record: record.frequency_Hz), refused


def stepped_sine(
    campaign: Campaign, driven: str, measured: Sequence[str], scale: Mapping[str, float] | None = None
) -> tuple[Responses, list[str]]:
    """Responses to the drive from sine records, and the reasons why the others were omitted.

    Raises
    ------
    ComputationError : fewer than four usable frequencies.
    """
    records, refused = sine_records(campaign, driven, measured, scale)
    records = distinct(records)
    if len(records) < 4:
        raise ComputationError(
            "too few sine records",
            measured=f"{len(records)} usable of {len(campaign.records)}",
            cause=refused[0] if refused else "repeated frequencies",
            next_step="map the columns, and give at least four frequencies about the corner",
        )
    return responses_of(records, driven, measured), refused


def distinct(records: Sequence[SineRecord]) -> list[SineRecord]:
    """Records in order of frequency, without repeated frequencies."""
    return [
        record
        for k, record in enumerate(records)
        if k == 0 or record.frequency_Hz > 1.001 * records[k - 1].frequency_Hz
    ]


def responses_of(records: Sequence[SineRecord], driven: str, measured: Sequence[str]) -> Responses:
    """Responses to the drive with their variances."""
    pairs = {role: [record.ratio(role, driven) for record in records] for role in measured}
    return Responses(
        np.array([record.frequency_Hz for record in records]),
        {role: np.array([H for H, _ in pair]) for role, pair in pairs.items()},
        {role: np.array([v for _, v in pair]) for role, pair in pairs.items()},
    )


def _check_option(kind: str, name: str, value: Any) -> None:
    if name not in OPTIONS[kind]:
        raise InputError(f"expected one of {', '.join(sorted(OPTIONS[kind]))}", field=f"option of {kind}", value=name)
    wanted, fits = OPTIONS[kind][name]
    if not fits(value):
        raise InputError(f"expected {wanted}", field=name, value=value)


def roles_of(
    kind: str, columns: Mapping[str, str], scale: Mapping[str, float], without: Sequence[str] = ()
) -> tuple[str, list[str]]:
    """Role of the input (empty if there is none) and roles of the outputs that are mapped; `without` some of the
    optional ones.

    Raises
    ------
    InputError : unknown or missing roles, a factor that is zero, not finite, or of a role that is not mapped.
    """
    driven, needed, optional = ROLES[kind]
    optional = tuple(role for role in optional if role not in without)
    known = {"t", *needed, *optional, *([driven] if driven else [])}
    for role in [*columns, *scale]:
        if role not in known:
            raise InputError(f"expected one of {', '.join(sorted(known))}", field=f"role of {kind}", value=role)
    for role in [*([driven] if driven else []), *needed]:
        if role not in columns:
            raise InputError(f"expected a column for {role}", field="columns", value=dict(columns))
    for role, factor in scale.items():
        if role not in columns or not (np.isfinite(factor) and factor != 0):
            raise InputError(
                "expected a finite factor, not zero, of a role that is mapped", field=f"scale of {role}", value=factor
            )
    measured = [role for role in (*needed, *optional) if role in columns]
    if not measured:
        raise InputError(f"expected a column for {' or '.join(optional)}", field="columns", value=dict(columns))
    return driven, measured


def read_columns(
    path: str | Path, columns: Mapping[str, str], driven: str, measured: Sequence[str], sample_rate_Hz: float | None
) -> Campaign:
    """Records of a file, with the columns of these roles. Raises InputError."""
    mapping = {"y": [columns[role] for role in measured]}
    hints: dict[str, Any] = {} if sample_rate_Hz is None else {"sample_rate_Hz": sample_rate_Hz}
    if driven:
        mapping["u"] = [columns[driven]]
    else:
        hints["excitation"] = "rest"  # released and left alone
    if "t" in columns:
        mapping["t"] = [columns["t"]]
    found = read_measurements(path, mapping, **hints)
    if not isinstance(found, Campaign):
        raise InputError("expected records over time, found a frequency response", file=path)
    return found


def _channels(
    source: RecordSource, driven: str, measured: Sequence[str], scale: Mapping[str, float]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    record = source.load()
    found = {driven: record.u[:, 0]} if driven else {}
    found |= {role: record.y[:, k] for k, role in enumerate(measured)}
    time = np.arange(source.header.samples) / source.header.sample_rate_Hz
    with np.errstate(over="ignore"):  # refused below
        found = {role: scale.get(role, 1.0) * values for role, values in found.items()}
    for role, values in found.items():
        if not np.all(np.isfinite(values)):  # the record's own samples are finite
            field = f"scale of {role}"
            raise InputError("expected a factor that keeps all samples finite", field=field, value=scale[role])
    return time, found
