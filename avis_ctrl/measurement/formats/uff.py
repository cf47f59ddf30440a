"""Universal files (UFF, data set 58 and 58b): time responses as a campaign, frequency responses with their coherence.

The name of a channel is its entity name, such as "Sz1", or "node 3 +Z" without one. Units come from the axis label or,
without a label, from the specific data type and the factors of data set 164. Every function in a file is one channel of
one record: the second function of a channel belongs to the second record, and so on.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign, RecordSource
from avis_ctrl.measurement.formats.common import ALLOWED, INPUT_NAME, Unit, reading, require_small, unit_of
from avis_ctrl.measurement.formats.records import Hints, Mapped, Part, campaign_from, mapped, pick, record_from
from avis_ctrl.measurement.formats.response import stated_response
from avis_ctrl.measurement.formats.time_axis import agreed_rate, rounded, sample_rate_from
from avis_ctrl.measurement.formats.uff_functions import Axis, Function, Point, functions
from avis_ctrl.measurement.frequency_response import FrequencyResponse

TIME, RESPONSE, COHERENCE, MULTIPLE_COHERENCE = 1, 4, 6, 26
WORDS = {
    0: "unknown",
    2: "auto spectrum",
    3: "cross spectrum",
    5: "transmissibility",
    7: "auto correlation",
    8: "cross correlation",
    9: "power spectral density",
    10: "energy spectral density",
    12: "spectrum",
}
# Specific data type -> SI unit; displacement, velocity and acceleration are scaled by the unit of length.
LENGTHS, FORCE = {8: "m", 11: "m/s", 12: "m/s^2"}, 13
HERTZ = {"": 1.0, "Hz": 1.0, "kHz": 1e3, "rad/s": 1 / (2 * np.pi)}
SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3}
AVERAGES = (r"(\d+)\s*averages?\b", r"\baverages?\s*[:=]?\s*(\d+)")

Entry = tuple[Point, Point]


def read(path: Path, columns: Mapped | None, rig: str | None, hints: Hints) -> Campaign | FrequencyResponse:
    """A universal file: a campaign if it contains time responses, otherwise its frequency responses.

    columns : roles u, y, floor to names of channels. Without it, excitation forces, references of other functions and
    the names u*, A1, Ax1, ... are inputs.
    """
    with reading(path, "the universal file"):
        require_small(path)
        found = functions(path)
        kinds = sorted({function.kind for function in found})
        if TIME in kinds:
            return _campaign(path, found, columns, rig, hints)
        if RESPONSE in kinds:
            return _response(found, hints)
        held = ", ".join(f"{kind} ({WORDS.get(kind, 'other')})" for kind in kinds) or "no data set 58"
        message = f"expected functions of type 1 (time response) or 4 (frequency response); the file has {held}"
        raise InputError(message, field="function type")


def channel_names(points: Sequence[Point]) -> dict[Point, str]:
    """Name of each channel; an entity name that several channels have is completed with node and direction."""
    names = {point: point.channel() for point in points}
    shared = [name for name in names.values() if list(names.values()).count(name) > 1]
    return {
        point: f"{name} {point._replace(name='').channel()}" if name in shared else name
        for point, name in names.items()
    }


def axis_unit(axis: Axis, point: Point, function: Function, role: str, hint: str | None) -> Unit:
    """SI unit of an axis and the factor to it, from the caller's hint, the label, or the data type.

    Raises
    ------
    InputError : no unit stated, an unknown unit, a label that contradicts data set 164.
    """
    field = f"{function.place}, channel {point.channel()}: unit"
    if hint is not None:
        return unit_of(hint, f"{role}_unit", ALLOWED[role])
    by_type = None
    if abs(point.direction) < 4:  # units of rotations are not supported
        if axis.kind in LENGTHS:
            by_type = Unit(LENGTHS[axis.kind], 1 / function.length)
        elif axis.kind == FORCE:
            by_type = Unit("N", 1 / function.force)
    if axis.unit:
        labelled = unit_of(axis.unit, field, ALLOWED[role])
        if by_type is None or by_type.factor == 1.0:  # not scaled by data set 164
            return labelled
        if labelled.si != by_type.si or abs(labelled.factor / by_type.factor - 1) > 1e-6:
            message = f"by data set 164 it is {by_type.factor:g} {by_type.si}; state the right one with {role}_unit"
            raise InputError(message, field=field, value=axis.unit)
        return labelled
    if by_type is None or by_type.si not in ALLOWED[role]:
        allowed = ", ".join(ALLOWED[role])
        message = f"not stated (no label, specific data type {axis.kind}); pass {role}_unit, one of {allowed}"
        raise InputError(message, field=field)
    return by_type


def _abscissa(function: Function, units: Mapping[str, float]) -> np.ndarray:
    unit = function.axes[0].unit
    if unit not in units:
        field = f"{function.place}: abscissa unit"
        raise InputError(f"expected one of {', '.join(filter(None, units))}", field=field, value=unit)
    return function.abscissa * units[unit]


def _clock(function: Function) -> tuple[float, float, str]:
    """Sample rate [Hz], first time [s] and a note."""
    time = _abscissa(function, SECONDS)
    if len(time) < 2:
        raise InputError("expected at least two samples", field=function.place, value=len(time))
    if not function.even:
        return sample_rate_from(time, field=f"{function.place}: abscissa")
    step = (time[-1] - time[0]) / (len(time) - 1)
    # The increment is printed as E13.5: its uncertainty is half a unit of the sixth digit.
    mantissa = step / 10.0 ** np.floor(np.log10(step))
    rate = rounded(1 / step, 0.5e-5 / mantissa)
    note = f"sample rate {1 / step:.9g} Hz, from an increment with six digits; taken as {rate:.9g} Hz"
    return rate, float(time[0]), note if abs(rate * step - 1) > 1e-9 else ""


def _inputs(first: Mapping[str, Function]) -> list[str]:
    """Channels that the file identifies as inputs, from the first function of each."""
    references = {
        function.reference for function in first.values() if function.reference.node > 0 or function.reference.name
    }
    return [
        name
        for name, function in first.items()
        if function.axes[1].kind == FORCE or function.response in references or re.fullmatch(INPUT_NAME, name, re.I)
    ]


def _campaign(path: Path, found: Sequence[Function], columns: Mapped | None, rig: str | None, hints: Hints) -> Campaign:
    responses = [function for function in found if function.kind == TIME]
    names = channel_names([function.response for function in responses])
    takes: dict[str, list[Function]] = defaultdict(list)
    for function in responses:
        takes[names[function.response]].append(function)
    roles = _roles(takes, columns, hints)
    count = max(map(len, takes.values()))
    others = sorted({function.kind for function in found} - {TIME})
    records, notes = [], [f"functions of type {other} beside the time responses were not read" for other in others]
    for k in range(count):
        chosen = {}
        for role, wanted in roles.items():
            for name in wanted:
                if len(takes[name]) <= k:
                    message = f"missing in record {k:02d}; other channels have {count} records"
                    raise InputError(message, field=f"channel {name}")
            chosen[role] = {name: takes[name][k] for name in wanted}
        record, assumed = _record(f"{k:02d}", chosen, hints)
        records.append(record)
        notes += assumed
    return campaign_from(records, notes, rig or "", path)


def _roles(takes: Mapping[str, list[Function]], columns: Mapped | None, hints: Hints) -> dict[str, list[str]]:
    available = list(takes)
    roles = {role: mapped(columns, role) or [] for role in ("u", "y", "floor")}
    for role, wanted in roles.items():
        pick(wanted, available, role)
    if columns is None:
        roles["u"] = _inputs({name: some[0] for name, some in takes.items()})
        roles["floor"] = list(FLOOR_NAMES) if set(FLOOR_NAMES) <= set(available) else []
        roles["y"] = [name for name in available if name not in roles["u"] and name not in roles["floor"]]
    if not roles["u"] and hints.excitation not in ("rest", "floor"):
        message = (
            f"no channel is recognised as an input; the file has {', '.join(available)}; assign the channels with "
            "columns (such as u=A1, y=S1), or state excitation rest or floor"
        )
        raise InputError(message, field="u")
    if not roles["y"]:
        raise InputError(f"expected at least one output; the file has {', '.join(available)}", field="y")
    return roles if roles["floor"] else {role: roles[role] for role in ("u", "y")}


def _record(name: str, chosen: Mapping[str, Mapping[str, Function]], hints: Hints) -> tuple[RecordSource, list[str]]:
    """A record from the function of each channel, by role and name."""
    every = [function for some in chosen.values() for function in some.values()]
    (rate, start, note), first, samples = _clock(every[0]), every[0].response.channel(), len(every[0].value)
    for function in every[1:]:
        field = f"record {name}, channel {function.response.channel()}"
        if len(function.value) != samples:
            raise InputError(f"expected {samples} samples, as {first} has", field=field, value=len(function.value))
        if not np.allclose(function.abscissa, every[0].abscissa, rtol=0, atol=0.1 / rate):
            raise InputError(f"expected the times of {first}", field=field)
    parts = {}
    for role, by_name in chosen.items():
        some = by_name.values()
        hint = {"u": hints.u_unit, "y": hints.y_unit}.get(role)
        if any(np.iscomplexobj(function.value) for function in some):
            raise InputError("expected real samples of a time response", field=f"record {name}: {role}")
        units = [axis_unit(function.axes[1], function.response, function, role, hint) for function in some]
        array = np.zeros((samples, len(some)))
        for column, function, unit in zip(array.T, some, units, strict=True):
            column[:] = function.value * unit.factor
        parts[role] = Part(list(by_name), [unit.si for unit in units], array)
    # The units have already been applied.
    hints = replace(hints, u_unit=None, y_unit=None)
    if hints.sample_rate_Hz is not None:
        rate, note = agreed_rate(hints.sample_rate_Hz, rate, f"record {name}: sample_rate_Hz"), ""
    record, notes = record_from(name, parts, rate, start, hints)
    notes += [f"record {name}: {note}"] if note else []
    notes += [
        f"record {name}: channel {function.response.name} is measured along "
        f"{function.response._replace(name='').channel().split()[-1]}; its sign is kept"
        for function in every
        if function.response.direction < 0 and function.response.name
    ]
    return record, notes


def _response(found: Sequence[Function], hints: Hints) -> FrequencyResponse:
    entries, coherences = _entries(found, (RESPONSE,)), _entries(found, (COHERENCE, MULTIPLE_COHERENCE))
    outputs = list(dict.fromkeys(entry[0] for entry in entries))
    inputs = list(dict.fromkeys(entry[1] for entry in entries))
    output_names, input_names = channel_names(outputs), channel_names(inputs)
    missing = [f"{output_names[y]} from {input_names[u]}" for y in outputs for u in inputs if (y, u) not in entries]
    if missing:
        message = f"expected every output for every input; {len(missing)} are missing, the first is {missing[0]}"
        raise InputError(message, field="frequency responses")
    first = next(iter(entries.values()))
    frequency = _abscissa(first, HERTZ)
    value = np.zeros((len(frequency), len(outputs), len(inputs)), complex)
    coherence = np.zeros(value.shape)
    complete, units = True, set()
    for (y, u), function in entries.items():
        at = (slice(None), outputs.index(y), inputs.index(u))
        factor, si = _ratio_unit(function, hints)
        value[at] = _on(function, frequency) * factor
        units.add(si)
        beside = coherences.get((y, u))
        if beside is None and len(inputs) == 1:  # multiple coherence has no reference
            beside = next((some for (point, _), some in coherences.items() if point == y), None)
        complete &= beside is not None
        if beside is not None:
            coherence[at] = np.real(_on(beside, frequency))
    if len(units) > 1:
        raise InputError("expected one unit of all frequency responses", field="units", value=sorted(units))
    output_unit, input_unit = units.pop()
    fields = {
        "frequency_Hz": frequency,
        "value": value,
        "coherence": coherence if complete else None,
        "averages": _averages(found),
        "inputs": [input_names[u] for u in inputs],
        "outputs": [output_names[y] for y in outputs],
        "input_unit": input_unit,
        "output_unit": output_unit,
    }
    return stated_response(fields, replace(hints, u_unit=None, y_unit=None))  # the units have already been applied


def _entries(found: Sequence[Function], kinds: Sequence[int]) -> dict[Entry, Function]:
    """Functions of the given types by response and reference."""
    entries: dict[Entry, Function] = {}
    for function in found:
        if function.kind in kinds:
            entry = (function.response, function.reference)
            if entry in entries:
                pair = f"{entry[0].channel()} from {entry[1].channel()}"
                raise InputError("expected each pair of response and reference once", field=function.place, value=pair)
            entries[entry] = function
    return entries


def _on(function: Function, frequency: np.ndarray) -> np.ndarray:
    """Values of the function, if it has the frequencies of the first frequency response."""
    own = _abscissa(function, HERTZ)
    if own.shape != frequency.shape or not np.allclose(own, frequency, rtol=1e-5, atol=1e-9):
        message = f"expected the {len(frequency)} frequencies of the first frequency response"
        field = f"{function.place}, {function.response.channel()} from {function.reference.channel()}"
        raise InputError(message, field=field, value=f"{len(own)} from {own[0]:g} to {own[-1]:g} Hz")
    return function.value


def _ratio_unit(function: Function, hints: Hints) -> tuple[float, tuple[str, str]]:
    """Factor to SI and (output unit, input unit) of a frequency response; one label may contain both ("m/s^2/V")."""
    _, over, under = function.axes
    if not under.unit and under.kind == 0 and over.unit.count("/"):
        left, _, right = over.unit.rpartition("/")
        if right.strip("() ") in ("V", "mV", "N", "mN", "kN", "lbf"):
            over, under = over._replace(unit=left), under._replace(unit=right)
    output = axis_unit(over, function.response, function, "y", hints.y_unit)
    input_ = axis_unit(under, function.reference, function, "u", hints.u_unit)
    return output.factor / input_.factor, (output.si, input_.si)


def _averages(found: Sequence[Function]) -> float | None:
    """Number of averages, if all ID lines that state it agree."""
    lines = [line for function in found for line in function.lines]
    matches = [re.search(pattern, line, re.IGNORECASE) for line in lines for pattern in AVERAGES]
    counts = {int(match[1]) for match in matches if match}
    return float(counts.pop()) if len(counts) == 1 else None
