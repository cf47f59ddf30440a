"""Find the effects that a single-axis model lacks, from arrays or from files.

find_axis_gap("drive", records=[Signals("a", force, position)], rate=1000.0)
find_axis_gap("seismometer", responses=responses, distortion=distortion)
find_axis_gap("levels", campaign=campaign)
find_axis_gap_in("drive", file, {"force": "vir", "position": "qm", "t": "t"}, scale={"force": 35.15})
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

from avis_ctrl.errors import InputError
from avis_ctrl.gap.axis.analysis import analyse
from avis_ctrl.gap.axis.level_dependence import levels, read_levels
from avis_ctrl.gap.axis.mass import drive, oscillator, position_of
from avis_ctrl.gap.axis.model import Effect, Problem
from avis_ctrl.gap.axis.records import Signals
from avis_ctrl.gap.axis.result import AxisGap
from avis_ctrl.gap.axis.search import Progress
from avis_ctrl.gap.axis.seismometer import of_sines, seismometer
from avis_ctrl.identification.single_axis.identify import read_columns, roles_of, sine_records
from avis_ctrl.measurement.campaign import Campaign

PROBLEMS: dict[str, Callable[..., Problem]] = {
    "drive": drive,
    "oscillator": oscillator,
    "seismometer": seismometer,
    "levels": levels,
}
# Units assumed for the numbers of each role.
UNITS = {"force": "N", "position": "m", "drive": "N", "coil": "V", "displacement": "m"}


def find_axis_gap(kind: str, *, own: Sequence[Effect] = (), progress: Progress | None = None, **data: Any) -> AxisGap:
    """Name the effects that a single-axis model lacks, with probabilities, or report that the library explains nothing.

    Parameters
    ----------
    kind : "drive", "oscillator", "seismometer", or "levels" (a mode at several levels). data : arguments of
    `mass.drive`, `mass.oscillator`, `seismometer.seismometer`, `level_dependence.levels`. own : user-defined effects in
    addition to the library.

    Raises
    ------
    InputError : an unknown kind; an own effect with missing texts, or with the name and place of another one; missing
    or unknown data; arrays that do not fit. ComputationError : no model of this kind fits the data.
    """
    _require_kind(kind)
    known = {name: one for name, one in signature(PROBLEMS[kind]).parameters.items() if name != "settings"}
    if set(data) - set(known) or any(name not in data for name, one in known.items() if one.default is one.empty):
        expected = ", ".join(name if one.default is one.empty else f"[{name}]" for name, one in known.items())
        raise InputError(
            f"kind {kind} needs the data {expected} (those in brackets are optional)", field="data", value=sorted(data)
        )
    begun, report = time.perf_counter(), progress or (lambda text: None)
    report("reading and windows")
    problem = PROBLEMS[kind](**data)
    taken = {one.label for one in problem.effects}
    for one in own:
        if not (one.name and one.location and one.title and one.parameters) or one.label in taken:
            raise InputError(
                "expected an effect with name, location, title and parameters, and a name and place that no other has",
                field="own",
                value=one.label,
            )
        taken.add(one.label)
    found = analyse(replace(problem, effects=[*own, *problem.effects]), report)
    return replace(found, seconds=time.perf_counter() - begun)


@dataclass(frozen=True)
class Reading:
    """Conversion of file columns into signals.

    columns, scale : by role. sample_rate_Hz : for files without time. output : quantity of y or position in the file,
    "position", "velocity" or "acceleration". range_s : part of each record that is used. resample_Hz : new sample rate.
    """

    columns: Mapping[str, str]
    scale: Mapping[str, float]
    sample_rate_Hz: float | None = None
    output: str = "position"
    range_s: tuple[float, float] | None = None
    resample_Hz: float | None = None


def find_axis_gap_in(
    kind: str,
    path: str | Path | Sequence[str | Path],
    columns: Mapping[str, str] | None = None,
    *,
    scale: Mapping[str, float] | None = None,
    sample_rate_Hz: float | None = None,
    output: str = "position",
    range_s: tuple[float, float] | None = None,
    resample_Hz: float | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> AxisGap:
    """`find_axis_gap` from files: records (drive, oscillator; of several records, whole ones are held out), a folder of
    sine records (seismometer: drive, coil, displacement), or a folder of u_*.npy and y_*.npy (levels: samples x
    channels x realisations x periods, with the level in mV in the file name).

    Parameters
    ----------
    columns, scale, sample_rate_Hz, output, range_s, resample_Hz : see `Reading`; columns by name, or by number from 1.
    options : cutoff_Hz (drive), band_Hz (drive, oscillator, levels).

    Raises
    ------
    InputError : files, roles or columns that do not fit. ComputationError : as in `find_axis_gap`.
    """
    paths = [path] if isinstance(path, (str, Path)) else list(path)
    _require_kind(kind)
    if kind == "levels":
        if columns or scale:
            raise InputError(
                "expected no columns and no scale: the names of the files say what they are",
                field="columns",
                value=dict(columns or scale or {}),
            )
        campaign = read_levels(paths[0], sample_rate_Hz)
        return find_axis_gap(kind, campaign=campaign, transient="none", progress=progress, **options)
    reading = Reading(dict(columns or {}), dict(scale or {}), sample_rate_Hz, output, range_s, resample_Hz)
    if kind == "seismometer":
        driven, measured = _roles(kind, reading)
        campaign = _campaign(paths[0], reading, driven, measured)
        records, refused = sine_records(campaign, driven, measured, dict(reading.scale))
        found = find_axis_gap(kind, progress=progress, **of_sines(records, measured, driven), **options)
        said = (*(f"Left out: {reason}." for reason in refused), *assumed(reading))
        return replace(found, sentences=(*found.sentences, *said))
    several, rate = signals_in(kind, paths, reading, options.get("band_Hz"))
    try:
        found = find_axis_gap(kind, records=several, rate=rate, progress=progress, **options)
    except InputError as error:
        raise error.in_file(str(paths[0])) from None
    sentences = (*found.sentences, *assumed(reading, rate))
    return replace(found, sentences=sentences, model={**found.model, "reading": asdict(reading)})


def _require_kind(kind: str) -> None:
    if kind not in PROBLEMS:
        raise InputError(f"expected one of {', '.join(PROBLEMS)}", field="kind", value=kind)


def signals_in(
    kind: str, paths: Sequence[str | Path], reading: Reading, band_Hz: tuple[float, float] | None = None
) -> tuple[list[Signals], float]:
    """Records of a drive or an oscillator, scaled, cut and resampled, and their sample rate [Hz].

    Raises
    ------
    InputError : files, roles, columns or options that do not fit.
    """
    driven, measured = _roles(kind, reading)
    found, rates = [], set()
    for path in paths:
        campaign = _campaign(path, reading, driven, measured)
        rates.add(campaign.sample_rate_Hz)
        if len(rates) > 1:
            raise InputError(
                "expected records of one sample rate", file=path, field="sample_rate_Hz", value=sorted(rates)
            )
        rate = campaign.sample_rate_Hz
        for source in campaign.records:
            record = source.load()
            name = source.header.name if len(campaign.records) > 1 else Path(path).stem
            u, y = record.u[:, 0] * reading.scale.get(driven, 1.0), record.y[:, 0] * reading.scale.get(measured[0], 1.0)
            if reading.range_s is not None:
                a, b = (round(t * rate) for t in reading.range_s)
                if not 0 <= a < b <= len(u):
                    raise InputError(
                        f"expected a range inside the record's {len(u) / rate:.5g} s",
                        file=path,
                        field="range",
                        value=reading.range_s,
                    )
                u, y = u[a:b], y[a:b]
            if reading.resample_Hz is not None:
                u, y = (_resampled(x, rate, reading.resample_Hz) for x in (u, y))
            new = reading.resample_Hz or rate
            low = 0.5 * band_Hz[0] if band_Hz and band_Hz[0] > 0 else 20 * new / max(len(u), 1)
            found.append(Signals(name, u, position_of(y, new, reading.output, low)))
    return found, float(reading.resample_Hz or rates.pop())


def _resampled(x: np.ndarray, rate: float, wanted: float) -> np.ndarray:
    ratio = Fraction(wanted / rate).limit_denominator(1000)
    if not (np.isfinite(wanted) and wanted > 0) or ratio == 0 or abs(float(ratio) * rate / wanted - 1) > 1e-6:
        raise InputError(
            f"expected a sample rate that is a ratio of whole numbers to {rate:g} Hz", field="resample", value=wanted
        )
    return signal.resample_poly(x, ratio.numerator, ratio.denominator, padtype="line")


def assumed(reading: Reading, rate: float | None = None) -> tuple[str, ...]:
    """Sentence on the units that were assumed for the columns."""
    units = [
        f"{role} = {name}{f' times {reading.scale[role]:g}' if role in reading.scale else ''}"
        + (f" in {UNITS[role]}" if role in UNITS else "")
        for role, name in reading.columns.items()
        if role != "t"
    ]
    bare = [role for role in reading.columns if role in UNITS and role not in reading.scale]
    hint = f"; not scaled: where the file has other units, --scale {bare[0]}=FACTOR" if bare else ""
    clock = (
        ""
        if rate is None or "t" in reading.columns
        else (f" The sample rate of {rate:g} Hz is taken as given: with another one every time and mass is wrong.")
    )
    return (f"Assumed units: {', '.join(units)}{hint}.{clock}",)


def _roles(kind: str, reading: Reading) -> tuple[str, list[str]]:
    return roles_of(kind, reading.columns, reading.scale, without=("ground",))


def _campaign(path: str | Path, reading: Reading, driven: str, measured: Sequence[str]) -> Campaign:
    campaign = read_columns(path, reading.columns, driven, measured, reading.sample_rate_Hz)
    stated, given = campaign.sample_rate_Hz, reading.sample_rate_Hz
    if given is not None and abs(stated / given - 1) > 1e-3:
        raise InputError(
            f"expected the sample rate of the file's times, {stated:.6g} Hz",
            file=path,
            field="sample_rate_Hz",
            value=given,
        )
    return campaign
