"""Effects on the signals alone: detected in the records themselves, not by fits of the table.

They are not classes of the library (`effects.library`) and have no score.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import AvisError
from avis_ctrl.gap.effects.mounts import campaign_clock
from avis_ctrl.gap.result import NamedEffect
from avis_ctrl.gap.run import Mapper, sequential_map
from avis_ctrl.gap.settings import GapSettings
from avis_ctrl.gap.signals.converter import ConverterFinding, inspect_converter
from avis_ctrl.gap.signals.hum import HumFinding, subtract
from avis_ctrl.gap.signals.noise_level import FloorLevel, NoiseLevels, noise_levels
from avis_ctrl.gap.signals.record_residual import RecordResidual, record_residuals
from avis_ctrl.gap.simulation import simulate
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.identification.predictor import model_inputs
from avis_ctrl.measurement.campaign import Campaign, Record, RecordSource
from avis_ctrl.rigs.rig import Rig


@dataclass(frozen=True, eq=False)
class SignalFaults:
    """Faults found in the signals themselves. drifting_delay : whether the delay of y after u changes too much within
    the records for any model of the table (gate "sample clock")."""

    converter: tuple[ConverterFinding, ...] = ()
    hum: HumFinding | None = None
    drifting_delay: bool = False
    noise: NoiseLevels | None = None

    @property
    def resolution_V(self) -> dict[str, float]:
        """Steps of the channels whose converter is coarser than stated, by name [V]."""
        return {one.channel: one.parameters["resolution_V"].value for one in self.converter if one.kind == "resolution"}

    @property
    def raised(self) -> tuple[str, ...]:
        """Sensors with noise above ambient that no converter fault explains; the library has no name for it."""
        if self.noise is None:
            return ()
        known = {one.channel for one in self.converter}
        return tuple(name for name in self.noise.raised if name not in known)


def converter_faults(campaign: Campaign, rig: Rig) -> tuple[ConverterFinding, ...]:
    """Converters that are coarser, or clip lower, than stated in the rig file; none if y is not in V."""
    return inspect_converter(campaign, rig) if campaign.y_unit == "V" and rig.acquisition is not None else ()


def predicted(campaign: Campaign, model: TableModel, each: Mapper = sequential_map) -> dict[str, np.ndarray]:
    """(samples, n_y) sensor signals predicted by the model in every record, from rest. A drift goes on as in the
    campaign from which the model was found."""
    clock = campaign_clock(model)

    def read(record: RecordSource) -> np.ndarray:
        h = record.header
        return simulate(
            model, *model_inputs(model.base, record.load()), h.sample_rate_Hz, start_s=h.start_s, campaign_s=clock
        ).y

    return dict(zip((record.header.name for record in campaign.records), each(read, campaign.records), strict=True))


def time_residuals(campaign: Campaign, model: TableModel, each: Mapper = sequential_map) -> tuple[RecordResidual, ...]:
    """Residual of the model in every record, in time."""
    return record_residuals(campaign, predicted(campaign, model, each))


def levels(
    residual: tuple[RecordResidual, ...],
    model: TableModel,
    hum: HumFinding | None,
    converter: tuple[ConverterFinding, ...],
) -> NoiseLevels | None:
    """Noise of floor and sensors; None if the records or the rig file do not allow an estimate."""
    n_u, steps = len(model.actuators), SignalFaults(converter).resolution_V
    try:
        return noise_levels(residual, lambda omega: model.response(omega)[:, :, n_u:], model.rig, hum, steps)
    except AvisError:
        return None


def without_hum(campaign: Campaign, hum: HumFinding, residual: tuple[RecordResidual, ...]) -> Campaign:
    """The campaign with the sines of the hum subtracted from every record."""
    of, records = {one.header.name: one for one in residual}, []
    for source in campaign.records:
        record = source.load()
        h = record.header
        y = subtract(hum, of[h.name].e, record.y, h.sample_rate_Hz, h.y_names)
        records.append(Record(h, record.u, y, record.floor))
    return replace(campaign, records=tuple(records))


def named(faults: SignalFaults, settings: GapSettings) -> list[NamedEffect]:
    """Effects found in the signals, with the names of the contract."""
    fault = {"resolution": "is coarser than the rig file states", "clipping": "clips below its nominal range"}
    rows: list[tuple[str, str, str, ConverterFinding | HumFinding | FloorLevel]] = [
        ("sensor_quantisation", one.channel, f"the converter of {one.channel} {fault[one.kind]}", one)
        for one in faults.converter
    ]
    if hum := faults.hum:
        where = f"mains hum of {hum.nominal_Hz:g} Hz and harmonics in {', '.join(hum.channels)}"
        rows.append(("mains_hum", "geophones", where, hum))
    if faults.noise and (floor := faults.noise.ground_motion):
        rows.append(("ground_motion", "floor", "the unmeasured floor motion is larger than the rig file states", floor))
    return [
        NamedEffect(
            name, place, title, one.parameters, min(one.confidence, settings.most_sure), confirmation=one.sentence
        )
        for name, place, title, one in rows
    ]
