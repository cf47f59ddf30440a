"""Types of the numbers and names in rig files and other files: limits, units, what a wrong entry is told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from avis_ctrl.rigs.floor_spectrum import shipped_spectra


@dataclass(frozen=True)
class RigLimits:
    """farthest_m : maximum distance of a point from the origin along each axis [m]. No table is larger, and for distant
        points the inertia is lost in the round-off of m r^2.
    largest : maximum size of any number [SI unit of its key]: no value of a table comes near it, and products of such
        numbers are finite.
    position_std_m : maximum standard deviation of a position [m]: far more than that of any measurement; a larger
        number was meant in millimetres.
    """

    farthest_m: float = 100.0
    largest: float = 1e12
    position_std_m: float = 0.1


LIMITS = RigLimits()
Number = Annotated[float, Field(ge=-LIMITS.largest, le=LIMITS.largest, strict=True)]
Positive = Annotated[float, Field(gt=0, le=LIMITS.largest, strict=True)]
NotNegative = Annotated[float, Field(ge=0, le=LIMITS.largest, strict=True)]
Whole = Annotated[int, Field(strict=True)]


def _not_far(length: float) -> float:
    if abs(length) > LIMITS.farthest_m:
        raise ValueError(f"expected a length in metres, at most {LIMITS.farthest_m:g}")
    return length


def _not_in_millimetres(length: float) -> float:
    if length > LIMITS.position_std_m:
        raise ValueError(
            f"expected a standard deviation in metres, at most {LIMITS.position_std_m:g}; {length:g} mm is "
            f"{1e-3 * length:g}"
        )
    return length


LengthStd = Annotated[float, Field(ge=0, strict=True), AfterValidator(_not_in_millimetres)]
Length = Annotated[float, Field(strict=True), AfterValidator(_not_far)]
PositiveLength = Annotated[float, Field(gt=0, strict=True), AfterValidator(_not_far)]
_THREE = Field(min_length=3, max_length=3, strict=False)  # lists of a file, tuples in a rig
Vector = Annotated[tuple[Number, ...], _THREE]
Point = Annotated[tuple[Length, ...], _THREE]
PositiveVector = Annotated[tuple[Positive, ...], _THREE]
DampingVector = Annotated[tuple[NotNegative, ...], _THREE]
Axis = Literal["x", "y", "z"]


def unit_vector(direction: tuple[float, ...]) -> tuple[float, ...]:
    """The direction scaled to unit length, unchanged if it has that length. Raises ValueError for a zero vector."""
    length = float(np.linalg.norm(direction))
    if not length > 0:
        raise ValueError("expected a vector that is not zero")
    return direction if abs(length - 1.0) <= 1e-12 else tuple(part / length for part in direction)


Direction = Annotated[tuple[Number, ...], _THREE, AfterValidator(unit_vector)]
# Channel names become signal names of models: letters, digits, _ and -, a letter first.
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]*$")]
Percent = Annotated[float, Field(ge=0, le=100, strict=True)]


def _rising(band: list[float]) -> list[float]:
    if band[0] >= band[1]:
        raise ValueError("expected the lower limit first, then the upper one")
    return band


def _shipped(spectrum: str) -> str:
    if spectrum not in shipped_spectra():
        raise ValueError(f"expected one of {', '.join(shipped_spectra())}")
    return spectrum


# Also for other files: a frequency band [Hz], and the name of a shipped spectrum of floor motion.
Band = Annotated[list[Positive], Field(min_length=2, max_length=2), AfterValidator(_rising)]
Spectrum = Annotated[str, AfterValidator(_shipped)]
