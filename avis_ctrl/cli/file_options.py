"""Options of the commands that read a measurement file of any format."""

from __future__ import annotations

from typing import Annotated, Any

import typer

# Options of `convert`, `identify` and `gap` for information that a file may lack.
PERIOD = Annotated[float | None, typer.Option("--period", metavar="SECONDS", help="period of a multisine, if the file "
                                              "does not state it")]
EXCITATION = Annotated[str | None, typer.Option("--excitation", metavar="KIND", help="multisine, noise, rest, floor or "
                                                "sine, if the file does not state it")]
SAMPLE_RATE = Annotated[float | None, typer.Option("--sample-rate", metavar="HZ", help="sample rate, if the file has "
                                                   "no time column")]
UNIT_Y = Annotated[str | None, typer.Option("--unit-y", metavar="UNIT", help="unit of y in the file: V, mV, m/s, mm/s, "
                                            "m/s^2, g, m, ...; V by default")]


def known_hints(period_s: float | None, excitation: str | None, sample_rate_Hz: float | None,
                y_unit: str | None) -> dict[str, Any]:
    """The hints that were given, by name."""
    given = {"period_s": period_s, "excitation": excitation, "sample_rate_Hz": sample_rate_Hz, "y_unit": y_unit}
    return {name: value for name, value in given.items() if value is not None}
