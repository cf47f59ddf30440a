"""Files of an identification: rig.toml, result.json, and predictions of other campaigns."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from avis_ctrl.errors import InputError
from avis_ctrl.files import write_together
from avis_ctrl.identification.large_motion import AS_SIMULATED, Turning
from avis_ctrl.identification.predictor import Predictor, model_inputs
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign, ranges
from avis_ctrl.measurement.formats.hdf5_writing import replacing
from avis_ctrl.rigs.file_errors import Section, read_json, validated
from avis_ctrl.rigs.isolator_table import IsolatorTable
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import load_rig, rig_from
from avis_ctrl.rigs.rig_writer import rig_toml
from avis_ctrl.study.file_names import IDENTIFICATION_FILES, REPORT_FILES, RESULT_FILE, RIG_FILE
from avis_ctrl.study.files import as_json, values_of
from avis_ctrl.study.identification import Identification


@dataclass(frozen=True)
class PredictionSettings:
    """piece : number of samples that are predicted and written at once, for memory: 1 MB a channel."""

    piece: int = 1 << 17


SETTINGS = PredictionSettings()


def identified_rig(model: ResponseModel) -> Rig:
    """The rig of a fit, including sensor sensitivities and loop delay.

    Raises InputError if a rig file cannot describe the result.
    """
    rig = model.rig
    sensitive = [name for name in model.names if name.startswith("sensor.")]
    if not sensitive and "loop_delay_s" not in model.names:
        return rig
    if not isinstance(rig, IsolatorTable):
        raise InputError(
            "a rig file of this kind has one sensitivity and one delay for all; leave them out",
            field="parameters",
            value=sensitive or ["loop_delay_s"],
        )
    rig = rig.with_sensor_gains(dict(zip(model.sensors.names, model.sensors.sensitivity.tolist(), strict=True)))
    return replace(rig, acquisition=replace(rig.acquisition, loop_delay_s=model.delay_s))


def require_readable(found: Identification) -> None:
    """Raise InputError if the identified values are not a valid rig, such as an inertia that no body has.

    A value that the fit took as known is wrong in this case.
    """
    try:
        rig_from(tomllib.loads(identified_toml(found)), getattr(found.rig, "load", None) is not None)
    except InputError as error:
        raise InputError(
            f"the identified values are not a valid rig: {error}; a value that was taken as known is wrong",
            field="rig.toml",
        ) from None


def identified_toml(found: Identification) -> str:
    """The rig file of an identification, with the standard deviation beside each identified value."""
    information = found.information
    known, start = found.rig.parameters(), found.start.parameters()
    comments = {}
    for name, sigma in zip(information.names, information.standard_deviation, strict=True):
        if name in known:
            spread = f"+- {sigma:.2g} {known[name].unit}"
            together = f"known only in combination (start {start[name].value:.4g})"
            comments[name] = f"{name.rpartition('.')[2]} {spread if np.isfinite(sigma) else together}"
    p = found.provenance
    header = [
        f"{found.rig.name}, identified by avis_ctrl {p['avis_ctrl']} on {p['date']}",
        f"from {p['measurement'] or 'a measurement'}, SHA-256 {p['measurement_sha256'][:16]}",
        f"{information.rank} of {len(information.names)} combinations of parameters are determined; standard "
        "deviations (1 sigma) beside the values",
        "the report and result.json list the combinations",
        found.caution,
    ]
    return rig_toml(identified_rig(found.campaign_fit.fit.model), comments, "\n".join(header))


def result_dict(found: Identification) -> dict[str, Any]:
    """Content of result.json for `as_json`: the numerical results."""
    fit, information = found.campaign_fit.fit, found.information
    noise_chi2 = found.campaign_fit.first.chi2_per_dof if found.campaign_fit.measured else None
    start = found.start.parameters()
    rows = {
        name: {"value": value, "std": sigma, "unit": unit, "start": start[name].value if name in start else None}
        for name, value, sigma, unit in zip(
            information.names, information.values, information.standard_deviation, information.units, strict=True
        )
    }
    return {
        "format": "avis-identification",
        "version": 1,
        "rig": found.rig.name,
        "loaded": getattr(found.rig, "load", None) is not None,
        "parameters": rows,
        "covariance": {"names": information.names, "matrix": information.covariance},
        "rank": information.rank,
        "condition": information.condition,
        "identifiability": found.identifiability.sentences,
        "fit": {
            "chi2_per_dof_of_measured_noise": noise_chi2,
            "dof": fit.dof,
            "held_at_bounds": fit.held,
            "band_Hz": found.campaign_fit.band_Hz,
            "converged": fit.converged,
            "starts_chi2": fit.starts,
            "notes": found.campaign_fit.notes,
        },
        "advice": found.advice,
        "validation": found.validation.as_dict(),
        "gates": [
            values_of(finding, "gate", "severity", "sentence", "channels", "records") for finding in found.findings
        ],
        "unit_of_y": found.model.sensors.unit,
        "amplifier_corner_Hz": found.model.amplifier_corner_Hz,
        "turning": found.model.turning._asdict(),
        "tolerances": [{**one.to_json(), "unit": one.unit} for one in found.campaign_fit.tolerances],
        "suspensions": found.model.sensors.detuned,
        "provenance": found.provenance,
        "seconds": found.seconds,
    }


def write_identification(
    found: Identification,
    folder: Path,
    html: bytes | None = None,
    pdf: bytes | None = None,
    more: dict[str, str] | None = None,
) -> list[Path]:
    """Write all files or none; result.json is last, so its presence shows that the others are complete."""
    texts = {
        RIG_FILE: identified_toml(found).encode(),
        **{name: text.encode() for name, text in (more or {}).items()},
        **dict(zip(REPORT_FILES, (html, pdf), strict=True)),
        RESULT_FILE: as_json(result_dict(found)),
    }
    return write_together(
        folder,
        {name: content for name, content in texts.items() if content is not None},
        [folder / name for name in IDENTIFICATION_FILES],
    )


class ResultFile(Section, extra="ignore"):
    """What predictions need of result.json; the defaults are for files of earlier versions.

    turning : how motor and sensor axes turn with the payload. suspensions : corner [Hz] and damping ratio of geophones
        that differ from those assumed by their filters.
    """

    loaded: bool = False
    amplifier_corner_Hz: float | None = None
    turning: Turning = AS_SIMULATED
    suspensions: dict[str, Annotated[list[float], Field(min_length=2, max_length=2)]] = {}


def read_identified(folder: Path) -> tuple[Rig, ResultFile]:
    """Rig of an identification's folder, and what else predictions need.

    Raises InputError if the folder contains no identification, or an incomplete one.
    """
    path = folder / RESULT_FILE
    content = read_json(path, "avis-identification", "the folder of avis identify or avis gap")
    found = validated(ResultFile, content, path)
    return load_rig(folder / RIG_FILE, found.loaded, check=False), found


def write_predictions(
    folder: Path, campaign: Campaign, out: Path, progress: Callable[[str], None] = lambda text: None
) -> None:
    """Write /records/NN/y, simulated from the u and floor of a campaign, in the unit of its y.

    The simulation includes the second-order terms of the table's rotations.

    Raises
    ------
    InputError : a folder or campaign that does not fit, a path that cannot be written.
    ComputationError : the disk cannot store the file.
    """
    rig, known = read_identified(folder)
    model = ResponseModel.of(
        rig, (), campaign.y_unit, campaign.y_names, campaign.u_names, True, known.amplifier_corner_Hz
    )
    sensors, own = model.sensors, known.suspensions
    suspensions = tuple(
        (own[name][0], own[name][1]) if name in own else old
        for name, old in zip(sensors.names, sensors.suspensions, strict=False)  # ideal sensors have none
    )
    model = replace(model, turning=known.turning, sensors=replace(sensors, suspensions=suspensions))
    limits = rig.converter.limits_V if campaign.y_unit == "V" and rig.converter else None
    with replacing(out) as file:
        file.attrs.update({"format": "avis-prediction", "version": 1, "rig": rig.name})
        for record in campaign.records:
            h = record.header
            progress(f"record {h.name}: {h.duration_s:.4g} s")
            if abs(h.sample_rate_Hz * model.period_s - 1) > 1e-6:
                raise InputError(
                    f"expected the rig's own {1 / model.period_s:g} Hz",
                    value=h.sample_rate_Hz,
                    field=f"record {h.name}: sample_rate_Hz",
                )
            group = file.create_group(f"records/{h.name}")
            data = group.create_dataset("y", (h.samples, len(h.y_names)), np.float64)
            data.attrs.update({"names": np.array(h.y_names, dtype=object).astype("S"), "unit": h.y_unit})
            group.attrs["sample_rate_Hz"] = h.sample_rate_Hz
            predictor = Predictor(model, large_motion=True)
            for start, stop in ranges(h.samples, SETTINGS.piece):
                # Includes the next sample: the floor is interpolated linearly to it within this piece.
                u, floor = model_inputs(model, record.load(start, min(stop + 1, h.samples)))
                y = predictor.read(u[: stop - start], floor)
                data[start:stop] = y if limits is None else np.clip(y, *limits)
