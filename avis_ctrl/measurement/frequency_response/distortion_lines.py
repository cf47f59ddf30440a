"""Even and odd distortion of a single record, from the lines that its multisine does not excite (fast method).

A periodic odd multisine excites only some of the odd harmonics. Even nonlinearities respond on even harmonics and odd
nonlinearities on odd harmonics; the odd harmonics that are not excited are the detection lines (Pintelon and Schoukens,
System Identification, 2nd ed., 2012, section 4.3.2). The noise is estimated from the lines between harmonics or from
repeated periods.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.frequency_response.best_linear import Transient, chosen_treatment
from avis_ctrl.measurement.frequency_response.periodic import SETTINGS, average
from avis_ctrl.measurement.frequency_response.spectra import channels, checked_band, lines

Kind = Literal["excited", "odd", "even"]


@dataclass(frozen=True, eq=False)
class DistortionLevels:
    """Powers of the outputs of one record, line by line.

    frequency_Hz : (n,) harmonics; kind : (n,) "excited", "odd" (detection) or "even"; power : (n, n_y) mean square of
    the line's sine, squared unit of y; noise : (n, n_y) expected power there of the noise alone.
    """

    frequency_Hz: np.ndarray
    kind: np.ndarray
    power: np.ndarray
    noise: np.ndarray
    outputs: tuple[str, ...]
    output_unit: str

    def rms(self, kind: Kind) -> np.ndarray:
        """(n_y,) r.m.s. of one kind of lines, noise subtracted; 0 where noise hides it.

        The odd distortion is scaled from the detection lines to all odd lines, because excited lines contain it too.
        """
        here = self.kind == kind
        if not np.any(here):
            return np.zeros(len(self.outputs))
        share = np.sum(self.kind != "even") / np.sum(here) if kind == "odd" else 1.0
        return np.sqrt(np.maximum(share * np.sum(self.power[here] - self.noise[here], axis=0), 0.0))


def distortion_levels(campaign: Campaign, record: str, *, transient: Transient = "auto") -> DistortionLevels:
    """Even and odd distortion of one record of an odd multisine with detection lines.

    Only harmonics from the lowest to the highest excited one are evaluated. Components that the generator itself
    produces on these lines count as distortion of the rig; the commanded u has none.

    Raises
    ------
    InputError : a record that is not periodic, excites even lines, or excites all odd lines; fewer than two periods.
    """
    source = campaign.named(record)
    header = source.header
    field = f"record {header.name}"
    if not header.period_samples or header.periods < 2:
        raise header.error("period_s", "expected a periodic record of at least two periods")
    n, rate = header.period_samples, header.sample_rate_Hz
    used = channels((source,), False)
    keep = lines(n, rate, checked_band(None, rate))
    drop, remove = chosen_treatment((source,), used, keep, transient)
    mean = average(source, used, keep, drop, remove)
    n_u, harmonic = len(used.inputs), np.arange(keep.start, keep.stop)
    size = np.abs(mean.Z[:, :n_u])
    on = np.any((size > SETTINGS.excited_amplitude * size.max(axis=0, initial=0)) & (size > 0), axis=1)
    if not np.any(on):
        raise InputError("expected an excited line in the band", field=field)
    if np.any(harmonic[on] % 2 == 0):
        first_Hz = harmonic[on & (harmonic % 2 == 0)][0] * rate / n
        raise InputError(
            f"expected an odd multisine; it excites even harmonics, the first at {first_Hz:g} Hz", field=field
        )
    between = (harmonic >= harmonic[on][0]) & (harmonic <= harmonic[on][-1])
    kind = np.where(on, "excited", np.where(harmonic % 2 == 1, "odd", "even"))
    if not np.any(between & (kind == "odd")):
        raise InputError("expected odd harmonics that are not excited, to detect odd distortion", field=field)
    if mean.covariance is None:
        raise InputError("expected at least two settled periods, to estimate the noise", field=field)
    # Z is divided by sqrt(n): a line of amplitude a has |Z|^2 = a^2 n / 4 and mean square a^2 / 2.
    power = 2 / n * np.abs(mean.Z[between, n_u:]) ** 2
    noise = 2 / n * np.real(np.einsum("nii->ni", mean.covariance))[between, n_u:]
    return DistortionLevels(harmonic[between] * rate / n, kind[between], power, noise, used.outputs, used.output_unit)
