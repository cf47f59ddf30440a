"""Read and write table models with effects as JSON.

A file contains the rig as the text of a rig file, sensors, drives, and effects with their values. Not stored are the
time records of effects that depend on them, and the physical bounds derived from these records. The clock of the
campaign is stored, for effects that depend on time.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from avis_ctrl.errors import InputError
from avis_ctrl.gap.effects.base import Effect
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.effects.mounts import campaign_clock
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.identification.response import ResponseModel, sensor_model
from avis_ctrl.rigs.file_errors import Section, read_json, validated
from avis_ctrl.rigs.isolator_table import INERTIA, IsolatorTable
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import rig_from
from avis_ctrl.rigs.rig_writer import rig_toml

FORMAT, VERSION = "avis-gap-model", 1
Positive = Annotated[float, Field(gt=0)]


class EffectFile(Section):
    """An effect in a file."""

    name: str
    place: str
    values: dict[str, float]


class ModelFile(Section):
    """A model in a file.

    rig : text of a rig file. rig_values : parameters of the rig that a rig file must not contain, such as an identified
        inertia that no body has. suspensions : corner [Hz] and damping ratio of geophones that differ from those
        assumed by their filters. period_s : 0 for responses to the voltage itself.
    """

    format: Literal["avis-gap-model"]
    version: Literal[1]
    rig: str
    rig_values: dict[str, float]
    loaded: bool
    suspensions: dict[str, Annotated[list[Positive], Field(min_length=2, max_length=2)]] = {}
    free: list[str]
    unit: str
    sensors: Annotated[list[str], Field(min_length=1)]
    sensitivity: list[Positive]
    actuators: Annotated[list[str], Field(min_length=1)]
    period_s: Annotated[float, Field(ge=0, le=1)]
    delay_s: Annotated[float, Field(ge=0, lt=1)]
    amplifier_corner_Hz: Positive | None
    effects: list[EffectFile]
    fixed: list[str] = []  # from files of version 0.4.0 and earlier: has no influence on the response
    campaign_s: Annotated[list[float], Field(min_length=2, max_length=2)]


def model_to_dict(model: TableModel) -> dict[str, Any]:
    """The content that `model_from_dict` reads back, every number with all its digits.

    Raises InputError for a rig that no rig file describes.
    """
    base = model.base
    text, values = _rig_text(base.rig)
    return {
        "format": FORMAT,
        "version": VERSION,
        "rig": text,
        "rig_values": values,
        "loaded": getattr(base.rig, "load", None) is not None,
        "free": list(base.names),
        "unit": base.sensors.unit,
        "sensors": list(base.sensors.names),
        "sensitivity": [float(one) for one in base.sensors.sensitivity],
        "actuators": list(base.actuators),
        "period_s": float(base.period_s),
        "delay_s": float(base.delay_s),
        "amplifier_corner_Hz": None if base.amplifier_corner_Hz is None else float(base.amplifier_corner_Hz),
        "suspensions": {name: list(own) for name, own in base.sensors.detuned.items()},
        "effects": [
            {
                "name": one.effect.name,
                "place": one.place,
                "values": {name: float(value) for name, value in one.by_name.items()},
            }
            for one in model.effects
        ],
        "campaign_s": [float(one) for one in campaign_clock(model)],
    }


def _rig_text(rig: Rig) -> tuple[str, dict[str, float]]:
    """Text of a rig file, and values that it must not contain: products of inertia, and moments of inertia that no body
    has."""
    text, loaded = rig_toml(rig), getattr(rig, "load", None) is not None
    try:
        rig_from(tomllib.loads(text), loaded)
        return text, {}
    except InputError:
        values = {name: one.value for name, one in rig.parameters().items() if name in INERTIA}
        if not values:
            raise
        round_body = dict.fromkeys(INERTIA[3:], 0.0) | dict.fromkeys(INERTIA[:3], max(values[n] for n in INERTIA[:3]))
        text = rig_toml(rig.with_parameters(round_body))
        rig_from(tomllib.loads(text), loaded)
        return text, values


def model_from_dict(content: Mapping[str, Any]) -> tuple[TableModel, tuple[float, float]]:
    """The model written by `model_to_dict`, and the first and last time of the campaign from which it was found.

    Raises
    ------
    InputError : a missing, unknown or wrong field, an effect that is not in the library, or an impossible rig.
    """
    checked = validated(ModelFile, content)
    begin, end = checked.campaign_s
    if begin >= end:
        raise InputError("expected the first time before the last one", field="campaign_s", value=checked.campaign_s)
    if len(checked.sensitivity) != len(checked.sensors):
        words = f"expected {len(checked.sensors)} values, one for each sensor"
        raise InputError(words, field="sensitivity", value=checked.sensitivity)
    for field in ("sensors", "actuators", "free"):
        names = getattr(checked, field)
        if len(set(names)) != len(names):
            raise InputError("expected different names", field=field, value=names)
    return _made(checked), (begin, end)


def read_model(path: str | Path) -> tuple[TableModel, tuple[float, float]]:
    """The model in a file, and the first and last time of the campaign from which it was found.

    Raises InputError with the file and field.
    """
    content = read_json(Path(path), FORMAT, "the model of avis gap")
    try:
        return model_from_dict(content)
    except InputError as error:
        raise error.in_file(path) from None


def _made(file: ModelFile) -> TableModel:
    try:
        rig = rig_from(tomllib.loads(file.rig), file.loaded).with_parameters(file.rig_values)
    except InputError as error:
        raise InputError(error.expected, field=f"rig: {error.field}", value=error.value) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected the text of a rig file; {' '.join(str(error).split())}", field="rig") from None
    if isinstance(rig, IsolatorTable):
        rig = rig.with_directions_by(file.free)
    sensors = sensor_model(rig, file.unit, file.sensors)
    if unknown := sorted(
        set(file.suspensions) - {name for name, own in zip(sensors.names, sensors.suspensions, strict=False) if own}
    ):
        raise InputError("expected geophones of the model", field="suspensions", value=unknown)
    own = tuple(
        (pair[0], pair[1]) if (pair := file.suspensions.get(name)) else old
        for name, old in zip(sensors.names, sensors.suspensions, strict=False)
    )
    sensors = replace(sensors, sensitivity=np.array(file.sensitivity), suspensions=own)
    base = ResponseModel(
        rig, tuple(file.free), sensors, tuple(file.actuators), file.period_s, file.delay_s, file.amplifier_corner_Hz
    )
    model = TableModel(base)
    for k, one in enumerate(file.effects, 1):
        model = model.with_effect(_effect(model, one, f"effects[{k}]"))
    _require_finite_response(model)
    return model


def _require_finite_response(model: TableModel) -> None:
    """Raise InputError for parameter values without a finite response."""
    try:
        with np.errstate(all="ignore"):
            finite = bool(np.all(np.isfinite(model.response(2 * np.pi * np.array([0.3, 3.0, 30.0])))))
    except (np.linalg.LinAlgError, ZeroDivisionError, OverflowError):
        finite = False
    if not finite:
        raise InputError(
            "expected values that leave a finite response",
            field="effects",
            value=[f"{one.label} {one.by_name}" for one in model.effects],
        )


def effect_at(model: TableModel, name: str, place: str | None, field: str) -> tuple[Effect, str]:
    """An effect by name, and the place where it acts: the given one, or for None the only possible one.

    Raises InputError with the available names or places.
    """
    known: dict[str, Effect] = {**library(), LargeMotion.name: LargeMotion()}
    if name not in known:
        near = [f"did you mean {one}?" for one in difflib.get_close_matches(name, known, n=1)]
        every = f"expected one of {', '.join(library())}; load an effect of your own with --effects FILE.py"
        raise InputError(" ".join([*near, every]), field=f"{field}.name", value=name)
    places = known[name].places(model)
    if place is None and len(places) == 1:
        place = places[0]
    if place not in places:
        raise InputError(
            f"expected one of {', '.join(places) or 'none: this rig has no place for it'}",
            field=f"{field}.place",
            value=place,
        )
    return known[name], place


def _effect(model: TableModel, one: EffectFile, field: str) -> ActiveEffect:
    effect, place = effect_at(model, one.name, one.place, field)
    parameters = effect.parameters(model, place)
    if set(one.values) != {parameter.name for parameter in parameters}:
        raise InputError(
            f"expected {', '.join(parameter.name for parameter in parameters)}",
            field=f"{field}.values",
            value=list(one.values),
        )
    return ActiveEffect(effect, place, parameters, tuple(one.values[parameter.name] for parameter in parameters))
