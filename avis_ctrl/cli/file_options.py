"""Options of the commands that read a measurement file of any format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from avis_ctrl.cli.options import Options
from avis_ctrl.errors import InputError

if TYPE_CHECKING:  # imports are deferred so that `avis --help` responds at once
    from avis_ctrl.measurement.campaign import Campaign
    from avis_ctrl.measurement.frequency_response import FrequencyResponse
    from avis_ctrl.rigs.rig import Rig

# Options of `convert`, `identify` and `gap` for information that a file may lack.
FILE = Options("""
--period SECONDS: period of a multisine, if the file does not state it
--excitation KIND: multisine, noise, rest, floor or sine, if the file does not state it
--sample-rate HZ: sample rate, if the file has no time column
--unit-y UNIT: unit of y in the file: V, mV, m/s, mm/s, m/s^2, g, m, ...; V by default
""")
PERIOD = Annotated[float | None, FILE("--period")]
EXCITATION = Annotated[str | None, FILE("--excitation")]
SAMPLE_RATE = Annotated[float | None, FILE("--sample-rate")]
UNIT_Y = Annotated[str | None, FILE("--unit-y")]


def known_hints(
    period_s: float | None, excitation: str | None, sample_rate_Hz: float | None, y_unit: str | None
) -> dict[str, Any]:
    """The hints that were given, by name."""
    given = {"period_s": period_s, "excitation": excitation, "sample_rate_Hz": sample_rate_Hz, "y_unit": y_unit}
    return {name: value for name, value in given.items() if value is not None}


def read_measured(path: Path, rig: Rig, columns: str | None = None, **hints: Any) -> Campaign | FrequencyResponse:
    """The measurement in a file, with the channel names of the rig. columns : value of --columns."""
    from avis_ctrl.measurement.formats import parse_columns, read_measurements
    from avis_ctrl.study.rig_channels import with_rig_names

    mapping = parse_columns(columns) if columns else None
    try:
        measured = read_measurements(path, mapping, **hints)
    except InputError as error:
        if error.field not in ("u", "y"):  # columns that no usual name assigns
            raise
        names = f"drives {', '.join(rig.equations_of_motion().actuators)}; sensors {', '.join(rig.sensor_rows()[0])}"
        raise InputError(
            f"{error.expected}; the rig {rig.name} has {names}", file=error.file, field=error.field, value=error.value
        ) from None
    try:
        return with_rig_names(rig, measured, mapping)
    except InputError as error:
        raise error.in_file(path) from None


def read_campaign(path: Path, rig: Rig, columns: str | None = None, **hints: Any) -> Campaign:
    """`read_measured`; raises InputError for frequency responses."""
    from avis_ctrl.measurement.campaign import Campaign

    measured = read_measured(path, rig, columns, **hints)
    if not isinstance(measured, Campaign):
        raise InputError("expected records, found frequency responses", file=path)
    return measured


def roles(text: str | None, option: str = "--columns") -> dict[str, str]:
    """ROLE=NAME,.. by role; empty without a text."""
    found = {}
    for part in text.split(",") if text else ():
        role, equals, name = (word.strip() for word in part.partition("="))
        if not (role and equals and name):
            raise InputError("expected ROLE=NAME", field=option, value=part)
        found[role] = name
    return found


def factors(text: str | None) -> dict[str, float]:
    """ROLE=FACTOR,.. of --scale by role; empty without a text."""
    found = {}
    for role, number in roles(text, "--scale").items():
        try:
            found[role] = float(number)
        except ValueError:
            raise InputError("expected ROLE=NUMBER", field="--scale", value=f"{role}={number}") from None
    return found
