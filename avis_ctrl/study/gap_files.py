"""Files of `avis gap`: the result, both models, their rig files, and predictions of other campaigns."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.checks import places
from avis_ctrl.errors import InputError
from avis_ctrl.files import write_together
from avis_ctrl.gap import line_response
from avis_ctrl.gap.model_files import model_to_dict, read_model
from avis_ctrl.gap.result import Gap
from avis_ctrl.gap.signals.declipping import channel_limits
from avis_ctrl.gap.simulation import simulate
from avis_ctrl.gap.table_model import ActiveEffect, TableModel, inseparable_parameters
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.predictor import model_inputs, predict
from avis_ctrl.measurement.campaign import Campaign, Record
from avis_ctrl.measurement.formats.hdf5_writing import replacing
from avis_ctrl.rigs.file_errors import read_json
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.study.file_names import (
    BASELINE_FILE,
    BASELINE_RIG,
    DESIGN_FILE,
    DESIGN_FOLDER,
    GAP_FILE,
    GAP_FILES,
    GAP_REPORTS,
    RIG_FILE,
    UPDATED_FILE,
    UPDATED_RIG,
)
from avis_ctrl.study.files import as_json
from avis_ctrl.study.identification_output import identified_rig

# Named effects that act on the signals only and cannot be predicted from u and floor.
UNPREDICTABLE = {
    "mains_hum": "the hum's phase in another campaign is not known",
    "ground_motion": "floor motion that is not measured cannot be predicted",
}


def write_gap(
    folder: Path,
    gap: Gap,
    html: bytes | None = None,
    pdf: bytes | None = None,
    content: Mapping[str, Any] | None = None,
    design: Mapping[str, str] | None = None,
) -> list[Path]:
    """Write all files or none; gap.json is last, so its presence shows that the others are complete.

    content : of gap.json; by default the gap's own without provenance.
    design : contents of the files in the folder design, by name; those of an earlier `avis gap` are removed.

    Raises ComputationError if the disk cannot store the files.
    """
    texts: dict[str, str | bytes | None] = {
        BASELINE_RIG: _toml(gap.baseline, "the rig's own structure, its parameters re-identified", None),
        UPDATED_RIG: _toml(gap.updated, "the rig with the named effects, all parameters refitted", gap.covariance),
        BASELINE_FILE: json.dumps(model_to_dict(gap.baseline), indent=1, allow_nan=False),
        UPDATED_FILE: json.dumps(model_to_dict(gap.updated), indent=1, allow_nan=False),
        **{f"{DESIGN_FOLDER}/{name}": text for name, text in (design or {}).items()},
        GAP_REPORTS[0]: html,
        GAP_REPORTS[1]: pdf,
        GAP_FILE: as_json(dict(content or gap.to_json())),
    }
    contents = {
        name: text.encode() if isinstance(text, str) else text for name, text in texts.items() if text is not None
    }
    return write_together(folder, contents, [*(folder / name for name in GAP_FILES), *_earlier_design(folder)])


def _earlier_design(folder: Path) -> list[Path]:
    """Design files that an earlier `avis gap` wrote, by its gap.json: those of the user remain."""
    with contextlib.suppress(InputError):
        if read_gap(folder).get("design"):
            return [folder / DESIGN_FOLDER / name for name in (RIG_FILE, DESIGN_FILE)]
    return []


def _toml(model: TableModel, what: str, covariance: np.ndarray | None) -> str:
    """The rig file of a model, with comments on the effects that it cannot describe."""
    rig, left = rig_with_effects(model)
    names, known = model.base.names, rig.parameters()
    comments = {}
    if covariance is not None and covariance.shape == (len(model.names),) * 2:
        shared = {name: group for group in inseparable_parameters(_rig_alone(model)) for name in group}
        for k, name in enumerate(names):
            if name in shared:
                others = " and ".join(other for other in shared[name] if other != name)
                comments[name] = f"{name.rpartition('.')[2]} known only together with {others}"
            elif name in known:
                sigma = float(np.sqrt(max(covariance[k, k], 0.0)))
                comments[name] = f"{name.rpartition('.')[2]} +- {sigma:.2g} {known[name].unit}"
    header = [f"{rig.name}, {what} by avis gap"]
    if comments:
        header.append(
            "standard deviations (1 sigma) beside the values: of the fit, with all values that are not fitted taken as "
            "exact"
        )
    header += [
        f"not in this file, because a rig file cannot describe it: {one.effect.title} ({one.effect.name}, "
        f"{one.place}: " + ", ".join(_as_reported(model, one)) + ")"
        for one in left
    ]
    if any(one.effect.name == "stiffness_drift" for one in left):
        header.append(
            "the stiffness in this file is that in the middle of its drift; the change is relative to "
            "that at the beginning"
        )
    return rig_toml(rig, comments, "\n".join(header))


def _rig_alone(model: TableModel) -> TableModel:
    """The model with only those parameters free that have no tolerance: a tolerance would make them separable."""
    free = tuple(name for name in default_parameters(model.rig) if name in model.base.names)
    return replace(model, base=replace(model.base, names=free))


def _as_reported(model: TableModel, one: ActiveEffect) -> list[str]:
    """Parameters of an effect as in gap.json and in the report."""
    n = len(one.names)
    found = one.effect.reported(model, one.place, one.by_name, np.zeros((n, n)))
    return [
        f"{name} = {value.value:.6g}{'' if value.unit in ('', '1') else ' ' + value.unit}"
        for name, value in found.items()
    ]


def rig_with_effects(model: TableModel) -> tuple[Rig, list[ActiveEffect]]:
    """The rig of a model including those effects that a rig file can describe, and the other effects."""
    rig, left = identified_rig(model.effective), []
    for one in model.effects:
        changes = one.effect.rig_changes(model, one.place, one.by_name)
        if not changes:
            taken = _in_rig(rig, one)
            rig = taken or rig
            if taken is None:
                left.append(one)
    return rig, left


def _in_rig(rig: Rig, one: ActiveEffect) -> Rig | None:
    """The rig with an effect that changes a number of its file; None for any other effect."""
    values = one.by_name
    if one.effect.name == "actuator_gain":
        name = rig.force_constant(one.place)
        return rig.with_parameters({name: rig.parameters()[name].value * values["gain"]})
    if one.effect.name == "sensor_gain" and rig.gain_per_sensor:
        gain = next(sensor.gain for sensor in rig.sensors() if sensor.name == one.place)
        return rig.with_sensor_gains({one.place: gain * values["gain"]})
    if one.effect.name == "loop_delay":
        return rig.with_loop_delay(rig.loop_delay_s + values["extra_delay_s"])
    return None


def read_gap(folder: Path) -> dict[str, Any]:
    """gap.json of a folder.

    Raises InputError if the folder contains no result of avis gap, or an incomplete one.
    """
    path = folder / GAP_FILE
    found = read_json(path, "avis-gap", "the folder of avis gap")
    for key in ("effects", "traces"):
        effects = found.setdefault(key, []) if key == "traces" else found.get(key)
        if not isinstance(effects, list) or not all(
            isinstance(one, dict) and isinstance(one.get("name"), str) for one in effects
        ):
            raise InputError("expected a list of named effects", file=path, field=key)
    return found


def gap_rig(folder: Path) -> Rig:
    """The rig of the re-identified (baseline) model. Raises InputError as `read_model`."""
    return read_model(folder / BASELINE_FILE)[0].rig


def write_gap_predictions(
    folder: Path, campaign: Campaign, out: Path, progress: Callable[[str], None] = lambda text: None
) -> None:
    """Write /records/NN/y_baseline and y_updated, simulated from the u and floor of a campaign, in the unit of its y.

    Records start at rest. y is clipped at the converter's range and not rounded; y_updated is also clipped where a
    converter was found to clip earlier. The attribute `not_predicted` states what cannot be predicted.

    Raises
    ------
    InputError : a folder or campaign that does not fit, a path that cannot be written.
    ComputationError : an effect with which the motion diverges; a disk that cannot store the file.
    """
    found = read_gap(folder)
    effects = [*found["effects"], *found["traces"]]
    models = {"y_baseline": read_model(folder / BASELINE_FILE), "y_updated": read_model(folder / UPDATED_FILE)}
    for model, _ in models.values():
        _require_fit(model, campaign)
    with replacing(out) as file:
        file.attrs.update({"format": "avis-prediction", "version": 1, "rig": models["y_baseline"][0].rig.name})
        file.attrs["not_predicted"] = "; ".join(_not_predicted(effects, campaign))
        # Model by model: records of equal length use the same response of the model.
        for name, (model, clock) in models.items():
            low, high = converter_limits(model, campaign, effects if name == "y_updated" else [])
            for source in campaign.records:
                h = source.header
                progress(f"{name}, record {h.name}: {h.duration_s:.4g} s")
                try:
                    y = _predicted(model, source.load(), clock)
                except InputError as error:
                    raise InputError(
                        error.expected, field=f"record {h.name}: {error.field}", value=error.value
                    ) from None
                y = y[:, [model.sensors.names.index(channel) for channel in h.y_names]]
                group = file.require_group(f"records/{h.name}")
                data = group.create_dataset(name, data=np.clip(y, low, high))
                data.attrs.update({"names": np.array(h.y_names, dtype=object).astype("S"), "unit": h.y_unit})
                group.attrs["sample_rate_Hz"] = h.sample_rate_Hz


def _predicted(model: TableModel, record: Record, clock: tuple[float, float]) -> np.ndarray:
    """(samples, n_y), sensors in the model's order."""
    if len(record.u) > line_response.SETTINGS.most_samples and not model.effects:
        limit = model.rig.limits_of(record.header.u_names)
        return predict(model.base, replace(record, u=np.clip(record.u, -limit, limit)), large_motion=False)
    u, floor = model_inputs(model.base, record)
    h = record.header
    return simulate(model, u, floor, h.sample_rate_Hz, start_s=h.start_s, campaign_s=clock).y


def _require_fit(model: TableModel, campaign: Campaign) -> None:
    if campaign.y_unit != model.sensors.unit:
        raise InputError(
            f"expected {model.sensors.unit}, as in the campaign that the model was found from",
            field="unit of y",
            value=campaign.y_unit,
        )
    places(campaign.y_names, model.sensors.names, "the model's sensors are", "y names")


def _not_predicted(effects: Sequence[Mapping[str, Any]], campaign: Campaign) -> list[str]:
    said = [f"{one['name']}: {UNPREDICTABLE[one['name']]}" for one in effects if one["name"] in UNPREDICTABLE]
    still = [record.header.name for record in campaign.records if not record.header.floor_names]
    if still:
        said.append(f"floor of records {', '.join(still)}: not measured, taken as still")
    return said


def converter_limits(
    model: TableModel, campaign: Campaign, effects: Sequence[Mapping[str, Any]]
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limits (n_y,), in the campaign's order: range of the converter, or where it was found to clip.

    effects : named effects and traces (very small effects), as in gap.json.
    """
    found = []
    for one in effects:
        if one["name"] == "sensor_quantisation":
            given = {key: of.get("value") for key, of in one.get("parameters", {}).items()}
            values = {key: value for key, value in given.items() if isinstance(value, (int, float))}
            found.append((one.get("location"), values))
    return channel_limits(model.rig.converter if campaign.y_unit == "V" else None, campaign.y_names, found)
