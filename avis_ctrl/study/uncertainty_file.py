"""The uncertainty file of an identification: covariance of the parameters, spread of the responses.

It contains only what depends on the measurement. The directions that a design keeps, and the filter that covers the
spread, follow from the design's coordinates, confidence and declared uncertainty.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from avis_ctrl.errors import InputError
from avis_ctrl.identification.information import Information
from avis_ctrl.identification.response_error import FrfSpread
from avis_ctrl.rigs.file_errors import Section, read_json, validated
from avis_ctrl.rigs.key_types import NotNegative, Number, Positive
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.uncertainty.identified_spread import IdentifiedSpread


@dataclass(frozen=True)
class FileSettings:
    """most_parameters, most_points : largest numbers of parameters and of frequencies that are read. An isolation table
    has a few dozen parameters; a file with many more does not describe a rig."""

    most_parameters: int = 500
    most_points: int = 20_000


SETTINGS = FileSettings()
Share = Annotated[float, Field(gt=0, lt=1)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]


class ParameterSection(Section):
    """An identified parameter; scale is the size of one relative unit."""

    name: str
    unit: str
    value: Number
    scale: Positive


class DirectionSection(Section):
    """A determined combination: relative standard deviation, and unit vector in relative parameters."""

    standard_deviation: NotNegative
    vector: list[Number]


class WeightSection(Section):
    """The filter of lowest order that covers the spread alone, for information; roots in rad/s.

    At lines where noise hides the response it covers the 100 % that designs assume there.
    """

    zeros: list[Pair]
    poles: list[Pair]
    gain: Positive
    order: Annotated[int, Field(ge=0)]
    slack_dB: NotNegative


class SpreadSection(Section):
    """Largest singular value of the relative error in the kept coordinates: measured, and quantiles of its noise."""

    keep: Annotated[list[str], Field(min_length=1)]
    frequency_Hz: Annotated[list[Positive], Field(min_length=2, max_length=SETTINGS.most_points)]
    measured: list[NotNegative]
    confidence: Annotated[list[Share], Field(min_length=1, max_length=50)]
    noise: list[list[NotNegative]]
    weight: WeightSection | None = None

    @model_validator(mode="after")
    def _shapes(self) -> SpreadSection:
        n = len(self.frequency_Hz)
        if len(self.measured) != n or [len(row) for row in self.noise] != [n] * len(self.confidence):
            raise ValueError(f"expected measured and one row of noise a confidence, at {n} frequencies each")
        if np.any(np.diff(self.frequency_Hz) <= 0):
            raise ValueError("expected increasing frequencies")
        return self

    def values(self) -> FrfSpread:
        """The spread as arrays."""
        return FrfSpread(
            tuple(self.keep),
            np.array(self.frequency_Hz),
            np.array(self.measured),
            np.array(self.noise),
            tuple(self.confidence),
        )


class UncertaintyFile(Section):
    """The content of uncertainty.json."""

    format: Literal["avis-uncertainty"]
    version: Literal[1]
    rig: str
    rig_sha256: str
    parameter: Annotated[list[ParameterSection], Field(max_length=SETTINGS.most_parameters)]
    covariance: list[list[Number]]
    direction: list[DirectionSection]
    undetermined: Annotated[int, Field(ge=0)] = 0
    spread: Annotated[list[SpreadSection], Field(min_length=1)]
    provenance: dict[str, Any] = {}

    @model_validator(mode="after")
    def _consistent(self) -> UncertaintyFile:
        n = len(self.parameter)
        if len({one.name for one in self.parameter}) != n:
            raise ValueError("expected each parameter once")
        if [len(one.vector) for one in self.direction] != [n] * len(self.direction) or len(self.direction) > n:
            raise ValueError(f"expected at most {n} directions with a number for each of the {n} parameters")
        if [len(row) for row in self.covariance] != [n] * n:
            raise ValueError(f"expected a covariance of {n} rows and columns")
        made, told = self.factor() @ self.factor().T, np.reshape(np.array(self.covariance, float), (n, n))
        size = np.sqrt(np.outer(np.diag(made), np.diag(made)))
        if np.any(np.abs(made - told) > 1e-6 * size + 1e-30):
            raise ValueError("expected a covariance that is that of the directions")
        return self

    def factor(self) -> np.ndarray:
        """S (n_p, r) with covariance S S^T, in the parameters' units."""
        V = np.reshape(np.array([one.vector for one in self.direction], float), (-1, len(self.parameter))).T
        return V * np.array([one.standard_deviation for one in self.direction]) * self.scale[:, None]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the identified parameters."""
        return tuple(one.name for one in self.parameter)

    @property
    def scale(self) -> np.ndarray:
        """(n_p,) size of one relative unit of each parameter."""
        return np.array([one.scale for one in self.parameter])

    def check_rig(self, rig: Rig) -> None:
        """Raise InputError unless the rig has the identified values and its other parameters are unchanged."""
        known = rig.parameters()
        for one in self.parameter:
            if one.name in known and abs(known[one.name].value - one.value) > 1e-9 * one.scale:
                raise InputError(
                    f"the identification found {one.value:.9g} {one.unit}; expected the rig file that was "
                    "written with it",
                    field=f"{one.name} of the rig {rig.name}",
                    value=known[one.name].value,
                )
        if rig.name != self.rig or rig_sha256(rig) != self.rig_sha256:
            raise InputError(
                f"the uncertainty was identified on {self.rig} with other parameters than this rig file "
                "has; expected the rig file that was written with it",
                field="rig",
                value=rig.name,
            )


def rig_sha256(rig: Rig) -> str:
    """Hash of the rig's parameters to ten digits: writing and reading a file does not change it."""
    text = ";".join(f"{name}={one.value:.10g}" for name, one in sorted(rig.parameters().items()))
    return hashlib.sha256(text.encode()).hexdigest()


def read_uncertainty(path: str | Path) -> UncertaintyFile:
    """Read and check an uncertainty file.

    Raises InputError: one line naming file, field, value and what was expected.
    """
    path = Path(path)
    content = read_json(path, "avis-uncertainty", "the uncertainty.json of an identification")
    try:
        return validated(UncertaintyFile, content, path)
    except InputError as error:
        # An inconsistent value is a whole section, too long for one line.
        value = None if isinstance(error.value, (dict, list)) else error.value
        raise InputError(error.expected, file=path, field=error.field or None, value=value) from None


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


def _spread_section(spread: FrfSpread) -> SpreadSection:
    filter = IdentifiedSpread(2 * np.pi * spread.frequency_Hz, spread.usable(0.95))
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
