"""Uncertainty of a design from an identification: bounded parameter directions, and a filter that covers the spread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.identification.directions import Directions, directions_that_matter
from avis_ctrl.identification.response_error import FrfSpread
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.study.uncertainty_file import UncertaintyFile
from avis_ctrl.uncertainty.identified_spread import IdentifiedSpread, covering_spread
from avis_ctrl.uncertainty.uncertain_rig import UncertainDirection
from avis_ctrl.uncertainty.weights import NeglectedDynamics

# Names of the uncertainty blocks.
RESPONSE, DIRECTION = "identified response", "identified direction {}"


@dataclass(frozen=True)
class ComparisonSettings:
    """band_Hz, points : range and number of the frequencies at which directions are compared: the range of
    transmissibility, independent of the measured band."""

    band_Hz: tuple[float, float] = (0.1, 100.0)
    points: int = 200


SETTINGS = ComparisonSettings()


@dataclass(frozen=True, eq=False)
class InDesign:
    """Uncertainty of a design from an identification.

    directions : bounded, for the rig's LFT. found : the directions with their effects and the residual.
    spread : measured, with its confidence. weight : covers the spread, the residual of the directions, and the declared
        uncertainty of the drives.
    The spread is used as in `FrfSpread.usable`: 100 % is assumed at lines where noise hides the response.
    """

    directions: tuple[UncertainDirection, ...]
    found: Directions
    spread: FrfSpread
    confidence: float
    weight: IdentifiedSpread

    @property
    def assumption(self) -> str:
        """What is assumed at lines where noise hides the response; empty if there are none."""
        drowned, f = self.spread.drowned(self.confidence), self.spread.frequency_Hz
        if not np.any(drowned):
            return ""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], drowned, [False]])))
        where = ", ".join(
            f"{f[first]:.3g} Hz" if last == first + 1 else f"{f[first]:.3g} to {f[last - 1]:.3g} Hz"
            for first, last in edges.reshape(-1, 2)
        )
        largest = 100 * float(np.max(self.spread.bound(self.confidence)[drowned]))
        return (
            f"Measurement noise hides the response at {where}: there noise alone causes a spread of 100 % or more "
            f"(bound up to {largest:.0f} %), so that the data contain no information on the model. The uncertainty "
            "is assumed to be 100 % there, or more only where the measurement proves it. To measure it, record "
            "longer or at a higher level."
        )


def in_design(
    content: UncertaintyFile,
    rig: Rig,
    keep: Sequence[str],
    confidence: float = 0.95,
    declared: NeglectedDynamics | None = None,
    factor: float = 1.0,
) -> InDesign:
    """The bounded directions and the covering filter of an identification, for the coordinates of a design.

    Parameters
    ----------
    declared, factor : the design's own relative uncertainty of its drives, and a factor that makes it valid for all
        coordinates together.

    Raises InputError: a rig other than the identified one, coordinates or a confidence that the file does not contain.
    """
    content.check_rig(rig)
    spread = next((one for one in content.spread if sorted(one.keep) == sorted(keep)), None)
    if spread is None:
        known = "; ".join(", ".join(one.keep) for one in content.spread)
        raise InputError(
            f"the uncertainty file is valid for {known}; identify again with --design FILE, a design file "
            "that keeps the coordinates wanted here",
            field="keep",
            value=list(keep),
        )
    values, own = spread.values(), [name in rig.parameters() for name in content.names]
    names = [name for name, here in zip(content.names, own, strict=True) if here]
    # Sensors and delay are not parameters of the rig's equations: the measured spread covers their errors.
    judged = 2 * np.pi * np.geomspace(*SETTINGS.band_Hz, SETTINGS.points)
    found = directions_that_matter(rig, names, content.factor()[own], keep, judged, confidence)
    directions = tuple(
        UncertainDirection(
            DIRECTION.format(k), tuple((name, float(change)) for name, change in zip(names, row, strict=True) if change)
        )
        for k, row in enumerate(found.changes, 1)
    )
    omega = 2 * np.pi * values.frequency_Hz
    left = np.interp(np.log(omega), np.log(found.omega), found.rest)
    # A spread of exactly zero has no logarithm; 1e-9 is negligible.
    data = np.maximum(values.usable(confidence) + left, 1e-9)
    return InDesign(directions, found, values, confidence, covering_spread(omega, data, declared, factor))
