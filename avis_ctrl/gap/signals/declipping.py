"""Replace clipped samples of y by the value that a model expects there, and limit u to what the drives can follow.

A clipped sample shows only that the true value is beyond the limit. Its expectation given the model is the prediction
if that is beyond the limit, too; otherwise it is close to the limit. This is the E step of expectation maximisation for
censored data (Dempster, Laird and Rubin 1977, section 4.2), with noise small compared with the excess. Fit, predict and
repair again until the parameters converge.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.signals.converter import ConverterFinding, nominal_converter
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.rigs.converter import Converter
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True, eq=False)
class Repaired:
    """A campaign in memory.

    clipped : fraction of each channel's samples of y, over all records, that are at its limits.
    """

    campaign: Campaign
    clipped: dict[str, float]


def channel_limits(
    converter: Converter | None, names: Sequence[str], found: Iterable[tuple[str | None, Mapping[str, float]]]
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value (n_y,) [V] that each channel can show: range of the converter, or where it clips.

    found : channel, and values by name of a converter's fault; "clip_low_V" and "clip_high_V" count.
    """
    low, high = (np.full(len(names), one) for one in (converter.limits_V if converter else (-np.inf, np.inf)))
    for channel, values in found:
        if channel in names:
            k = names.index(channel)
            low[k] = max(low[k], values.get("clip_low_V", -np.inf))
            high[k] = min(high[k], values.get("clip_high_V", np.inf))
    return low, high


def repair(
    campaign: Campaign,
    rig: Rig,
    predicted: Mapping[str, np.ndarray] | None = None,
    findings: tuple[ConverterFinding, ...] = (),
) -> Repaired:
    """Every record in memory, with clipped samples replaced if a prediction (samples, n_y) of the record is given.

    Samples within half a nominal step of a limit count as clipped. u is limited to the rig's drive limit: larger
    commands are nominal behaviour. Without predictions, nothing else is changed.

    Raises
    ------
    InputError : y not in V.
    """
    if campaign.y_unit != "V":
        raise InputError("expected V: the converter clips in its own unit", field="unit of y", value=campaign.y_unit)
    names = campaign.y_names
    converter = nominal_converter(rig)
    found = [(one.channel, {key: p.value for key, p in one.parameters.items()}) for one in findings]
    low, high = channel_limits(converter, names, found)
    margin = converter.lsb_V / 2
    at, samples = np.zeros(len(names)), 0
    records = []
    for source in campaign.records:
        record = source.load()
        top, bottom = record.y >= high - margin, record.y <= low + margin
        y = record.y
        at += np.count_nonzero(top | bottom, axis=0)
        samples += len(y)
        if predicted is not None and record.header.name in predicted:
            model = predicted[record.header.name]
            y = np.where((top & (model > y)) | (bottom & (model < y)), model, y)
        limits_V = rig.limits_of(record.header.u_names)
        records.append(replace(record, u=np.clip(record.u, -limits_V, limits_V), y=y))
    return Repaired(replace(campaign, records=tuple(records)), dict(zip(names, (at / samples).tolist(), strict=True)))
