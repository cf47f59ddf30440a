"""Search for the effects that the model of a rig lacks: gates (checks of the records), analysis, design, provenance."""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.gap.analysis import analyse
from avis_ctrl.gap.effects.user_effects import OwnEffects, try_out
from avis_ctrl.gap.preparation import check_band
from avis_ctrl.gap.result import Gap
from avis_ctrl.gap.settings import SETTINGS
from avis_ctrl.gap.signal_effects import predicted
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.gap.tuning_values import tuning_values
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.measurement.campaign import Campaign, digest
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.gates import Finding
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.study.gap_design import DesignEffect, design_effect
from avis_ctrl.study.gap_files import converter_limits
from avis_ctrl.study.identification import amplifier_corner, amplifier_words
from avis_ctrl.study.provenance import provenance
from avis_ctrl.study.record_checks import check_campaign
from avis_ctrl.study.rig_channels import with_rig_names
from avis_ctrl.study.workers import each

Progress = Callable[[str], None]
# Gates whose stops are ignored: `gap` itself recognises and names these faults, or corrects them.
NAMED_HERE = (
    "clipping",
    "hum",
    "signal to noise",
    "coherence",
    "repeatability",
    "level dependence",
    "periodicity",
    "spikes",
    "missing samples",
    "sample clock",
)


@dataclass(frozen=True)
class RecordSettings:
    """samples : minimum number of samples of a record; with fewer, neither the gates nor a held-out third give any
    information.
    """

    samples: int = 300


RECORDS = RecordSettings()


@dataclass(frozen=True)
class GapOptions:
    """User options.

    band_Hz : of the comparison; the excited band if None. gates : check the records first. despite_gates : continue if
        a gate reports a stop.
    amplifier_corner_Hz : known corner of the amplifiers' lag; see `amplifier_corner`.
    design : synthesise controllers on both models, according to design_file, or by default for z and phi_x.
    own_effects : effects from the user's own file, in addition to the library.
    """

    seed: int = 1
    band_Hz: tuple[float, float] | None = None
    gates: bool = True
    despite_gates: bool = False
    amplifier_corner_Hz: float | None = None
    design: bool = False
    design_file: Path | None = None
    own_effects: OwnEffects | None = None

    def __post_init__(self) -> None:
        """Raises InputError for an invalid band, or a corner that is not positive."""
        if self.band_Hz is not None and not 0 <= self.band_Hz[0] < self.band_Hz[1] < np.inf:
            raise InputError("expected 0 <= LOW < HIGH", field="band_Hz", value=self.band_Hz)
        corner = self.amplifier_corner_Hz
        if corner is not None and not 0 < corner < np.inf:
            raise InputError("expected a positive frequency", field="amplifier_corner_Hz", value=corner)


@dataclass(frozen=True, eq=False)
class GapFinding:
    """Complete result of `avis gap`. design is None if not requested, or if it failed (reason in design_note)."""

    gap: Gap
    measured: Campaign
    findings: tuple[Finding, ...]
    provenance: Mapping[str, Any]
    design: DesignEffect | None = None
    design_note: str = ""

    def to_json(self) -> dict[str, Any]:
        """Content of gap.json: the contract's keys, error by noise alone, sentences of the report, mu, provenance."""
        return {
            **self.gap.to_json(),
            "noise_nrmse": self.gap.noise_nrmse,
            "sentences": list(self.gap.sentences),
            "design": self.design.to_json() if self.design else None,
            "design_note": self.design_note or None,
            "provenance": dict(self.provenance),
        }


def find_gap(
    measured: Campaign | FrequencyResponse,
    rig: Rig,
    options: GapOptions | None = None,
    progress: Progress = lambda text: None,
) -> GapFinding:
    """Find where a rig and a campaign disagree, and name the missing effects.

    Raises
    ------
    InputError : frequency responses instead of records, channels of another rig, a gate that reports a stop, records
        without excitation or without information on the noise, an effect of the user that fails.
    ComputationError : a fit that does not converge.
    """
    options, began = options or GapOptions(), time.monotonic()
    if not isinstance(measured, Campaign):
        raise InputError(
            "expected records in time: frequency responses do not distinguish faults of a signal from "
            "those of the table",
            field="measurement",
        )
    named = with_rig_names(rig, measured)
    assert isinstance(named, Campaign)  # with_rig_names keeps the type
    measured = named
    _require_records(measured)
    if options.band_Hz is not None:
        check_band(measured, options.band_Hz, SETTINGS)
    if options.own_effects is not None:
        try_out(
            options.own_effects,
            TableModel(ResponseModel.of(rig, (), measured.y_unit, measured.y_names, measured.u_names)),
        )
    with threadpool_limits(1):
        findings = _gates(measured, rig, options, progress) if options.gates else ()
        corner = amplifier_corner(rig, options.amplifier_corner_Hz)
        known = (amplifier_words(corner, options.amplifier_corner_Hz, fitted=True),) if corner else ()
        for words in known:
            progress(words)
        gap = analyse(measured, rig, options.seed, options.band_Hz, corner, None, progress, each)
        seconds = time.monotonic() - began
        stops = tuple(f"gate {one.gate}: {one.sentence}" for one in findings if one.severity == "stop")
        gap = replace(gap, seconds=seconds, sentences=(*gap.sentences, *known, *stops))
        design, note, design_sha256 = _design(gap, options, progress)
    return GapFinding(
        gap, measured, findings, gap_provenance(measured, rig, options, seconds, design_sha256), design, note
    )


def _require_records(measured: Campaign) -> None:
    """Preconditions of the gates. Raises InputError."""
    if measured.records[0].header.u_unit != "V":
        raise InputError("expected commanded voltages in V", field="unit of u", value=measured.records[0].header.u_unit)
    for record in measured.records:
        if record.header.samples < RECORDS.samples:
            raise InputError(
                f"expected at least {RECORDS.samples} samples",
                field=f"record {record.header.name}: samples",
                value=record.header.samples,
            )


def _gates(measured: Campaign, rig: Rig, options: GapOptions, progress: Progress) -> tuple[Finding, ...]:
    progress("gates")
    model = ResponseModel.of(rig, (), measured.y_unit, measured.y_names, measured.u_names)
    return check_campaign(measured, model, options.despite_gates, progress, NAMED_HERE)


def _design(gap: Gap, options: GapOptions, progress: Progress) -> tuple[DesignEffect | None, str, str | None]:
    """The comparison of controllers, or the reason why there is none; and the SHA-256 of the design file."""
    path, sha256 = options.design_file, None
    if not options.design:
        return None, "", None
    if path is None:
        progress("no design file given: controllers with the weights of the shipped AVIS design")
    else:
        with contextlib.suppress(OSError):  # the same error of `design_effect` names the file
            sha256 = hashlib.sha256(path.read_bytes()).hexdigest()  # before the synthesis, which takes minutes
    try:
        return design_effect(gap, path, progress), "", sha256
    except AvisError as error:
        return None, f"no comparison of controllers: {error}", sha256


def predict(found: GapFinding, campaign: Campaign) -> list[tuple[np.ndarray, np.ndarray]]:
    """Predict (y_baseline, y_updated), each (samples, n_y), of every record of another campaign from u and floor.

    The signals are clipped at the converter's range, y_updated also where a converter was found to clip earlier.
    """
    gap, both = found.gap, []
    effects = [one.to_json() for one in (*gap.effects, *gap.traces)]
    for model, known in ((gap.baseline, []), (gap.updated, effects)):
        low, high = converter_limits(model, campaign, known)
        order = [model.sensors.names.index(name) for name in campaign.y_names]
        both.append({name: np.clip(y[:, order], low, high) for name, y in predicted(campaign, model).items()})
    return [(both[0][record.header.name], both[1][record.header.name]) for record in campaign.records]


def gap_provenance(
    measured: Campaign, rig: Rig, options: GapOptions, seconds: float, design_sha256: str | None = None
) -> dict[str, Any]:
    """Provenance of a gap search; design_sha256 : of the design file, None if none was used."""
    data, own, further = digest(measured), options.own_effects, dict[str, str]()
    if own is not None:
        further |= {"own_effects": f"{own.path.name}: {', '.join(own.names)}", "own_effects_sha256": own.sha256}
    if design_sha256 is not None:
        further["design_sha256"] = design_sha256
    return provenance(
        rig,
        repr(options) + data,
        options.seed,
        seconds,
        ("numpy", "scipy", "numba", "h5py"),
        measurement=measured.source,
        **further,
        measurement_sha256=data,
        settings=tuning_values(),
    )
