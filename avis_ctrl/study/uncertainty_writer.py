"""uncertainty.json from an identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from avis_ctrl.identification.information import Information
from avis_ctrl.identification.spread import FrfSpread
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.study.uncertainty_file import (
    DirectionSection,
    ParameterSection,
    SpreadSection,
    UncertaintyFile,
    WeightSection,
    rig_sha256,
)
from avis_ctrl.uncertainty.identified_spread import IdentifiedSpread


def uncertainty_content(
    rig: Rig, information: Information, spreads: Sequence[FrfSpread], provenance: Mapping[str, Any] | None = None
) -> UncertaintyFile:
    """The content of the file.

    Parameters
    ----------
    rig : identified. information : of the fit; the covariance also keeps parameters that are not the rig's.
    spreads : for the sets of coordinates that designs may keep.
    """
    sigma, V = information.directions
    kept = np.flatnonzero(information.determined)
    values = information.values
    parameters = [
        ParameterSection(name=name, unit=unit, value=float(value), scale=float(scale))
        for name, unit, value, scale in zip(
            information.names, information.units, values, information.scale, strict=True
        )
    ]
    directions = [DirectionSection(standard_deviation=float(sigma[k]), vector=V[:, k].tolist()) for k in kept]
    return UncertaintyFile(
        format="avis-uncertainty",
        version=1,
        rig=rig.name,
        rig_sha256=rig_sha256(rig),
        parameter=parameters,
        covariance=information.covariance.tolist(),
        direction=directions,
        undetermined=len(values) - len(kept),
        spread=[_spread_section(one.thinned()) for one in spreads],
        provenance=dict(provenance or {}),
    )


def _spread_section(spread: FrfSpread, confidence: float = 0.95) -> SpreadSection:
    filter = IdentifiedSpread(2 * np.pi * spread.frequency_Hz, spread.usable(confidence))
    shape = filter.shape
    weight = WeightSection(
        zeros=[[z.real, z.imag] for z in shape.zeros().tolist()],
        poles=[[p.real, p.imag] for p in shape.poles().tolist()],
        gain=shape.gain,
        order=shape.order,
        slack_dB=max(filter.slack_dB, 0.0),
    )
    return SpreadSection(
        keep=list(spread.keep),
        frequency_Hz=spread.frequency_Hz.tolist(),
        measured=spread.measured.tolist(),
        confidence=list(spread.confidences),
        noise=spread.noise.tolist(),
        weight=weight,
    )


def uncertainty_json(content: UncertaintyFile) -> str:
    """The text of the file."""
    return content.model_dump_json(indent=1) + "\n"
