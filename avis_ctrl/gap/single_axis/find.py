"""Name what a model of one axis lacks, from arrays or from files.

    find_axis_gap("drive", time=t, position=q, force=F, reference=q_ref)
    find_axis_gap("oscillator", u=u, y=y, sample_rate_Hz=610.35)
    find_axis_gap("seismometer", responses=responses, distortion=distortion)
    find_axis_gap("levels", campaign=campaign)
    find_axis_gap_in("drive", file, {"force": "vir", "position": "qm", "t": "t"}, scale={"force": 35.15})
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.single_axis.drive import DriveData
from avis_ctrl.gap.single_axis.levels import level_dependence, read_levels
from avis_ctrl.gap.single_axis.oscillator import OscillatorData
from avis_ctrl.gap.single_axis.result import AxisGap
from avis_ctrl.gap.single_axis.seismometer import SeismometerData
from avis_ctrl.gap.single_axis.stepwise import Progress
from avis_ctrl.gap.single_axis.terms import library
from avis_ctrl.gap.single_axis.verdict import gap_of
from avis_ctrl.identification.single_axis.identify import ROLES, sine_records
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.formats.reader import read_measurements

PROBLEMS: dict[str, Callable[..., Any]] = {"drive": DriveData, "oscillator": OscillatorData,
                                           "seismometer": SeismometerData}


def find_axis_gap(kind: str, *, seed: int = 1, progress: Progress | None = None, **data: Any) -> AxisGap:
    """What a model of one axis lacks, with a probability, or that nothing of the library explains it.

    Parameters
    ----------
    kind : "drive", "oscillator", "seismometer", or "levels": frequency responses at several levels, no model.
    data : drive: time (n,) s, position (n,) m, force (n,) N, reference (n,) m and cutoff_Hz where wanted. oscillator:
        u, y (n,), sample_rate_Hz, band_Hz where wanted. seismometer: responses (`Responses`), distortion (n,) where
        known. levels: campaign, periodic records at two levels.
    seed : has no influence any more; accepted for scripts that give one.

    Raises
    ------
    InputError : an unknown kind, missing or unknown data, arrays that do not fit. ComputationError : data that no model
        of this kind fits.
    """
    if kind not in (*PROBLEMS, "levels"):
        raise InputError(f"expected one of {', '.join((*PROBLEMS, 'levels'))}", field="kind", value=kind)
    begun, told = time.perf_counter(), progress or (lambda stage: None)
    make = partial(level_dependence, progress=told) if kind == "levels" else PROBLEMS[kind]
    known = signature(make).parameters
    if set(data) - set(known) or any(name not in data for name, one in known.items() if one.default is one.empty):
        said = ", ".join(name if one.default is one.empty else f"[{name}]" for name, one in known.items()
                         if name != "progress")
        raise InputError(f"expected for kind {kind} the data {said} (in brackets what may be left out)", field="data",
                         value=sorted(data))
    problem = make(**data)
    found = problem if isinstance(problem, AxisGap) else gap_of(problem, list(library(kind).values()), told)
    return replace(found, seconds=time.perf_counter() - begun)


def find_axis_gap_in(kind: str, path: str | Path, columns: Mapping[str, str] | None = None, *,
                     scale: Mapping[str, float] | None = None, sample_rate_Hz: float | None = None, seed: int = 1,
                     progress: Progress | None = None, **options: Any) -> AxisGap:
    """The same from files: a record (drive, oscillator), a folder of sine records (seismometer: drive, coil,
    displacement), or a folder of u_*.npy and y_*.npy (levels: samples x channels x realisations x periods, the level in
    mV in the name).

    Parameters
    ----------
    columns, scale, sample_rate_Hz : as in `identify_single_axis`. options : cutoff_Hz (drive), band_Hz (oscillator).

    Raises
    ------
    InputError : files, roles, columns that do not fit. ComputationError : as `find_axis_gap`.
    """
    if kind == "levels":
        if columns or scale:
            raise InputError("expected no columns and no scale: the names of the files say what they are",
                             field="columns", value=dict(columns or scale or {}))
        return find_axis_gap(kind, campaign=read_levels(path, sample_rate_Hz), transient="none", seed=seed,
                             progress=progress, **options)
    if kind not in PROBLEMS:
        raise InputError(f"expected one of {', '.join((*PROBLEMS, 'levels'))}", field="kind", value=kind)
    factors = dict(scale or {})
    campaign, driven, measured = _read(kind, path, dict(columns or {}), factors, sample_rate_Hz)
    if kind == "seismometer":
        records, refused = sine_records(campaign, driven, measured, factors)
        found = find_axis_gap(kind, seed=seed, progress=progress, **SeismometerData.of(records, measured, driven),
                              **options)
        return replace(found, sentences=(*found.sentences, *(f"Left out: {reason}." for reason in refused)))
    if len(campaign.records) != 1:
        raise InputError("expected one record", file=path, field="records", value=len(campaign.records))
    record = campaign.records[0].load()
    channel = {driven: record.u[:, 0]} | {role: record.y[:, k] for k, role in enumerate(measured)}
    channel = {role: factors.get(role, 1.0) * values for role, values in channel.items()}
    rate = campaign.sample_rate_Hz
    clock: dict[str, Any] = {"time": np.arange(len(record.u)) / rate} if kind == "drive" else {"sample_rate_Hz": rate}
    try:
        return find_axis_gap(kind, seed=seed, progress=progress, **clock, **channel, **options)
    except InputError as error:
        raise error.in_file(path) from None


def _read(kind: str, path: str | Path, columns: dict[str, str], factors: dict[str, float], rate: float | None
          ) -> tuple[Campaign, str, list[str]]:
    driven, needed, optional = ROLES[kind]
    optional = tuple(role for role in optional if role != "ground")
    known = ("t", driven, *needed, *optional)
    for role in [*columns, *factors]:
        if role not in known:
            raise InputError(f"expected one of {', '.join(known)}", field=f"role of {kind}", value=role)
    for role in (driven, *needed, *(() if needed else optional[:1])):
        if role not in columns:
            raise InputError(f"expected a column for {role}", field="columns", value=columns)
    for role, factor in factors.items():
        if role not in columns or not (np.isfinite(factor) and factor != 0):
            raise InputError("expected a finite factor, not zero, of a role that is mapped", field=f"scale of {role}",
                             value=factor)
    measured = [role for role in (*needed, *optional) if role in columns]
    mapping = {"u": [columns[driven]], "y": [columns[role] for role in measured]}
    mapping |= {"t": [columns["t"]]} if "t" in columns else {}
    hints: dict[str, Any] = {} if rate is None else {"sample_rate_Hz": rate}
    campaign = read_measurements(path, mapping, **hints)
    if not isinstance(campaign, Campaign):
        raise InputError("expected records over time, found a frequency response", file=path)
    return campaign, driven, measured
