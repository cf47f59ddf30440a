"""Comparison of identified masses and moments of inertia with the rig file, whose values are roughly correct."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.identification.information import Information
from avis_ctrl.identification.response import INERTIAL, ResponseModel


@dataclass(frozen=True)
class FitPlausibility:
    """Criteria for identified masses and moments of inertia that are far from the rig file's.

    far : ratio of the two values, or its inverse, from which they are far apart; drawings and scales are accurate to a
        few per cent.
    alike : the identified values differ from the file's by a common factor if the largest ratio is less than this many
        times the smallest.
    known : relative standard deviation above which a parameter is not considered.
    """

    far: float = 1.5
    alike: float = 1.5
    known: float = 0.1


def far_from_file(
    start: ResponseModel, information: Information, settings: FitPlausibility = FitPlausibility()
) -> tuple[str, ...]:
    """A sentence with the likely cause if a mass or moment of inertia is far from the rig file's; otherwise empty."""
    before = dict(zip(start.names, start.values, strict=True))
    found = [
        (name, float(value / before[name]), float(value), unit)
        for name, value, unit, sigma in zip(
            information.names, information.values, information.units, information.standard_deviation, strict=True
        )
        if before[name] > 0 and value > 0 and sigma <= settings.known * value
    ]
    far = [one for one in found if one[0] in INERTIAL and not 1 / settings.far < one[1] < settings.far]
    if not far:
        return ()
    name, ratio, value, unit = far[0]
    said = f"{name} is identified as {value:.4g} {unit}, {ratio:.3g} times the rig file's {value / ratio:.4g} {unit}"
    others = [one[1] for one in found if one[0] in INERTIAL or ".k_" in one[0] or one[0].startswith("k_")]
    if len(others) > 2 and max(others) / min(others) < settings.alike:
        middle = float(np.median(others))
        return (
            f"{said}, and all masses, moments of inertia and stiffnesses that are well determined are about "
            f"{middle:.2g} times those of the file. A response to the drives depends only on their ratio to the "
            f"force constants and sensitivities: check these for a factor of {middle:.2g} or {1 / middle:.2g}",
        )
    more = f"; also far from the file: {', '.join(one[0] for one in far[1:])}" if len(far) > 1 else ""
    return (f"{said}{more}. Check the rig file, and whether these data determine the value",)
