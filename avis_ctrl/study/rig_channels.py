"""A measurement in the words of the rig: its name and channels where the file states none, and what to do if wrong."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import FLOOR_NAMES, Campaign
from avis_ctrl.measurement.formats.flat import UNNAMED, with_header
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.rigs.rig import Rig

# What readers call the channels of a matrix without names: "y1", "y2", ...
NUMBERED = {"u": re.compile(r"(u|U|input)\d+"), "y": re.compile(r"(y|Y|output)\d+")}


def in_words_of(rig: Rig, measured: Campaign | FrequencyResponse) -> Campaign | FrequencyResponse:
    """The measurement with the rig's name where the file states none, and the rig's channels where they are numbered.

    Channels that are only numbered, as many as the rig has, are taken in the rig's own order; a note of the campaign
    says so, and the gate that compares the channels with the model speaks where that is wrong. Doing it twice does no
    more than once.

    Raises
    ------
    InputError : channels that the rig does not have; says how to name them, and of which rig the file says it is.
    """
    response = isinstance(measured, FrequencyResponse)
    had = {"u": measured.inputs, "y": measured.outputs} if isinstance(measured, FrequencyResponse) else {
        "u": measured.u_names, "y": measured.y_names}
    of_rig = {"u": rig.equations_of_motion().actuators, "y": rig.sensor_rows()[0]}
    changes: dict[str, Any] = {}
    notes = []
    for role, own in of_rig.items():
        known = (*own, *FLOOR_NAMES) if response and role == "u" else own
        names = had[role]
        if all(name in known for name in names):
            continue
        if len(names) == len(own) and all(NUMBERED[role].fullmatch(name) for name in names):
            changes[role] = own
            notes.append(f"{role}: the file names no channels; taken in the order of the rig {rig.name}: "
                         f"{', '.join(own)} (otherwise --columns {role}_names=...)")
            continue
        raise _unknown(rig, role, names, own, "" if isinstance(measured, FrequencyResponse) else measured.rig)
    if isinstance(measured, FrequencyResponse):
        return replace(measured, inputs=changes.get("u", measured.inputs), outputs=changes.get("y", measured.outputs))
    if measured.rig == UNNAMED:
        measured = replace(measured, rig=rig.name)
        notes.append(f"the file names no rig; taken as {rig.name}")
    if not changes and not notes:
        return measured
    renamed = {f"{role}_names": names for role, names in changes.items()}
    records = tuple(with_header(record, **renamed) for record in measured.records)
    return replace(measured, records=records, notes=(*measured.notes, *notes))


def _unknown(rig: Rig, role: str, names: Sequence[str], own: Sequence[str], stated: str) -> InputError:
    what = {"u": "actuators", "y": "sensors"}[role]
    unknown = [name for name in names if name not in own]
    said = f"the {what} of the rig {rig.name} are {', '.join(own)}"
    if stated not in ("", UNNAMED, rig.name):
        said += f"; the file says it is a campaign of {stated}"
    example = "+".join((*own[:2], "...") if len(own) > 2 else own)
    said += (f"; if the file's {len(names)} channels are among these, name them in its order: "
             f"--columns {role}_names={example}")
    return InputError(said, field=f"{role} names", value=unknown)
