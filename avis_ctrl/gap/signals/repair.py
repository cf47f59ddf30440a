"""Replace clipped samples of y by the value that a model expects there, and limit u to what the drives can follow.

A clipped sample shows only that the true value is beyond the limit. Its expectation given the model is the prediction
if that is beyond the limit, too; otherwise it is close to the limit. This is the E step of expectation maximisation for
censored data (Dempster, Laird and Rubin 1977, section 4.2), with noise small compared with the excess. Fit, predict and
repair again until the parameters converge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.gap.signals.converter import ConverterFinding, nominal_converter
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True, eq=False)
class Repaired:
    """A campaign in memory.

    clipped : fraction of each channel's samples of y, over all records, that are at its limits.
    """

    campaign: Campaign
    clipped: dict[str, float]


def channel_limits(
    rig: Rig, names: tuple[str, ...], findings: tuple[ConverterFinding, ...] = ()
) -> dict[str, tuple[float, float]]:
    """Lowest and highest value [V] that each channel can show: as found, otherwise as in the rig file."""
    limits = dict.fromkeys(names, nominal_converter(rig).limits_V)
    for one in findings:
        if one.kind == "clipping" and one.channel in limits:
            low, high = limits[one.channel]
            of = one.parameters
            limits[one.channel] = (
                of["clip_low_V"].value if "clip_low_V" in of else low,
                of["clip_high_V"].value if "clip_high_V" in of else high,
            )
    return limits


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
    limits = channel_limits(rig, names, findings)
    low, high = (np.array([limits[name][k] for name in names]) for k in (0, 1))
    margin = nominal_converter(rig).lsb_V / 2
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
