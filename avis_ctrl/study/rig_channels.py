"""Match the channels and the sample rate of a measurement to those of a rig; errors come with instructions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign
from avis_ctrl.measurement.formats.records import UNNAMED, with_header
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.rigs.rig import Rig

# Variables whose columns the readers number if they have no names: "y1", "y2", ...
USUAL = {"u": ("u", "U", "input"), "y": ("y", "Y", "output")}
WHAT = {"u": "actuators", "y": "sensors"}


@dataclass(frozen=True)
class RateSettings:
    """same : relative difference below which two sample rates are taken as the same [1]: the models then agree to this
    order."""

    same: float = 1e-6


SETTINGS = RateSettings()


def with_rig_names(
    rig: Rig, measured: Campaign | FrequencyResponse, columns: Mapping[str, Sequence[str]] | None = None
) -> Campaign | FrequencyResponse:
    """The measurement with the rig's name, if the file states none, and the rig's channels, if only numbered. A note
    names drives and sensors of the rig that the file does not have.

    Numbered channels, if as many as the rig has, are assumed to be in the order of the rig. A note of the campaign
    states this, and the gate that compares the channels with the model reports a wrong order. The function is
    idempotent.

    columns : the mapping used to read the file; columns of a variable that it names may be numbered, too.

    Raises InputError: channels that the rig does not have; the message explains how to name them and which rig the file
    names. Records of another sample rate than the rig's.
    """
    of_rig = {"u": tuple(rig.equations_of_motion().actuators), "y": tuple(rig.sensor_rows()[0])}
    if isinstance(measured, FrequencyResponse):
        had, known = {"u": measured.inputs, "y": measured.outputs}, of_rig | {"u": (*of_rig["u"], *FLOOR_NAMES)}
    else:
        had, known = {"u": measured.u_names, "y": measured.y_names}, of_rig
    changes, unknown, notes = {}, [], []
    for role, own in of_rig.items():
        stems = (*USUAL[role], *(columns or {}).get(role, ()))
        if set(had[role]) <= set(known[role]):
            if missing := [name for name in own if name not in had[role]]:
                what = "sensors" if role == "y" else "drives"
                notes.append(f"the file has no column for the rig's {what} {', '.join(missing)}")
            continue
        if len(had[role]) == len(own) and any(had[role] == numbered(stem, len(own)) for stem in stems):
            changes[role] = own
            notes.append(
                f"{role}: the file does not name its channels; assumed to be in the order of the rig "
                f"{rig.name}: {', '.join(own)} (otherwise use --columns {role}_names=...)"
            )
        else:
            unknown.append(role)
    if unknown:
        raise _refusal(rig, {role: had[role] for role in unknown}, known, of_rig, getattr(measured, "rig", UNNAMED))
    if isinstance(measured, FrequencyResponse):
        return replace(measured, inputs=changes.get("u", measured.inputs), outputs=changes.get("y", measured.outputs))
    _require_rate(rig, measured)
    if measured.rig == UNNAMED:
        measured = replace(measured, rig=rig.name)
        notes.append(f"the file does not name its rig; assumed to be {rig.name}")
    elif measured.rig != rig.name:
        notes.append(f"the records are of the rig {measured.rig}, according to their file; the model is {rig.name}")
    renamed = {f"{role}_names": names for role, names in changes.items()}
    records = tuple(with_header(record, **renamed) for record in measured.records) if renamed else measured.records
    new = tuple(note for note in notes if note not in measured.notes)
    return replace(measured, records=records, notes=(*measured.notes, *new))


def _require_rate(rig: Rig, measured: Campaign) -> None:
    """Raise InputError for records of another sample rate: in the models the drive voltage is held for one sample
    period of the rig.
    """
    found, expected = measured.sample_rate_Hz, rig.sample_rate_Hz
    ratio = found / expected
    if abs(ratio - 1) <= SETTINGS.same:
        return
    if abs(1e3 * ratio - 1) <= SETTINGS.same:
        likely = "are the time stamps in ms (column t [ms]), or is the sample rate in kHz?"
    elif abs(1e-3 * ratio - 1) <= SETTINGS.same:
        likely = "is the sample rate in mHz, or the rig file's sample_rate_Hz in kHz?"
    else:
        likely = "check the time stamps; if the rate is right, change sample_rate_Hz and loop_delay_s of the rig file"
    raise InputError(f"expected {expected:g} Hz, as in the rig file; {likely}", field="sample_rate_Hz", value=found)


def numbered(stem: str, count: int) -> tuple[str, ...]:
    """Names that a reader gives the columns of a variable."""
    return tuple(f"{stem}{k + 1}" for k in range(count))


def _refusal(
    rig: Rig,
    had: Mapping[str, Sequence[str]],
    known: Mapping[str, Sequence[str]],
    of_rig: Mapping[str, Sequence[str]],
    stated: str,
) -> InputError:
    """Error on the channels of one or both roles, with instructions."""
    strange = {role: [name for name in names if name not in known[role]] for role, names in had.items()}
    said = "; ".join(f"the {WHAT[role]} of the rig {rig.name} are {', '.join(of_rig[role])}" for role in had)
    field = " and ".join(f"{role} names" for role in had)
    value = next(iter(strange.values())) if len(had) == 1 else strange
    if stated not in (UNNAMED, rig.name):
        return InputError(f"the file is a campaign of {stated}, not of {rig.name}; {said}", field=field, value=value)
    example = ",".join(f"{role}_names={'+'.join(of_rig[role][:2])}+..." for role in had)
    counts = " and ".join(f"{len(names)} of {role}" for role, names in had.items())
    said += (
        f"; if the file's channels ({counts}) are some of these, name them in the order of the file: "
        f"--columns {example} (option of identify and convert)"
    )
    return InputError(said, field=field, value=value)
