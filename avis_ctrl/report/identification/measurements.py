"""The measurements: records, channels, and assumptions made in reading the file."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.distortion_lines import DistortionLevels, Kind, distortion_levels
from avis_ctrl.report import words
from avis_ctrl.report.elements import Paragraph, Piece, Section, Table, section, table
from avis_ctrl.report.records import records, remarks
from avis_ctrl.study.identification import Identification

DISTORTIONS: tuple[Kind, ...] = ("even", "odd")


def measurements(found: Identification) -> Section:
    """The records and their use, channels and distortion; or the frequency responses."""
    measured = found.measured
    if isinstance(measured, FrequencyResponse):
        return section("Measurements", "measurements", _response(measured))
    tables = (_records(found, measured), _channels(found, measured), distortion(measured))
    return section("Measurements", "measurements", tables, remarks(measured))


def _records(found: Identification, campaign: Campaign) -> Table:
    if found.split is None:
        return records(campaign, {}, "")
    fitted, held = ({r.header.name for r in part.records} for part in found.split[:2])
    use = {
        name: "part fitted, part held out" if name in fitted & held else "held out" if name in held else "fitted"
        for name in fitted | held
    }
    return records(campaign, use, found.split.how)


def distortion(campaign: Campaign) -> Table | None:
    """Even and odd distortion of the multisines with detection (unexcited) lines; None if there are none."""
    rows = []
    for h in (record.header for record in campaign.records):
        if h.excitation == "multisine" and h.periods >= 2:
            with suppress(InputError):  # every line is excited: no line to detect distortion on
                levels = distortion_levels(campaign, h.name)
                rows.append((h.name, *(_largest(levels, kind) for kind in DISTORTIONS)))
    if not rows:
        return None
    return table(
        "Distortion of the multisines that have unexcited lines: r.m.s. of the even and of the odd distortion "
        "relative to that of the excited lines, after subtraction of the noise, for the output with the "
        "largest distortion. Even distortion comes from asymmetry, odd distortion from stiffening, friction "
        "or saturation.",
        ("record", "even", "odd"),
        rows,
        "lrr",
    )


def _largest(levels: DistortionLevels, kind: Kind) -> str:
    linear = levels.rms("excited")
    ratio = np.divide(levels.rms(kind), linear, out=np.zeros_like(linear), where=linear > 0)
    worst = int(np.argmax(ratio))
    return (
        f"{words.number(100 * ratio[worst], 2)} % ({levels.outputs[worst]})" if ratio[worst] > 0 else "below the noise"
    )


def _channels(found: Identification, campaign: Campaign) -> Table:
    first = campaign.records[0].header
    floor = next((r.header for r in campaign.records if r.header.floor_names), None)
    low, high = found.campaign_fit.band_Hz
    rows = [
        ("commanded, u", str(len(first.u_names)), ", ".join(first.u_names), words.unit(first.u_unit)),
        ("sensed, y", str(len(first.y_names)), ", ".join(first.y_names), words.unit(first.y_unit)),
    ]
    if floor is not None:
        rows.append(
            ("floor velocity", str(len(floor.floor_names)), ", ".join(floor.floor_names), words.unit(floor.floor_unit))
        )
    return table(
        f"The channels. The fit uses the spectral lines from {words.number(low)} to {words.number(high)} Hz.",
        ("channels", "count", "names", "unit"),
        rows,
        "lrll",
    )


def _response(measured: FrequencyResponse) -> tuple[Piece, ...]:
    f = measured.frequency_Hz
    uncertain = "covariance of the noise" if measured.noise is not None else "a variance for each entry"
    rows = [
        ("lines", f"{len(f)}, {words.number(float(f[0]))} to {words.number(float(f[-1]))} Hz"),
        ("inputs", f"{', '.join(measured.inputs)} [{words.unit(measured.input_unit)}]"),
        ("outputs", f"{', '.join(measured.outputs)} [{words.unit(measured.output_unit)}]"),
        ("uncertainty", uncertain),
        ("method", measured.method or "not stated in the file"),
    ]
    return (
        table("The measured frequency responses; the file contains no time records.", ("what", "value"), rows, "ll"),
        Paragraph("Every fourth group of neighbouring lines was held out of the fit for validation."),
    )
