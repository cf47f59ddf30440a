"""The certificate of the exported code; all of it is computed from the numbers in controller.json."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.export.bounds import StabilityNotProvedError, bounds, gain_above_in_words
from avis_ctrl.export.design_folder import DesignFolder
from avis_ctrl.export.rounding import rounding_noise
from avis_ctrl.export.sampled_controller import SampledController
from avis_ctrl.export.sampled_response import SampledAxes
from avis_ctrl.export.worst_plant import WorstPlant, mu_lower, worst_transmissibility
from avis_ctrl.lti.norms import decibels
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.simulation.discrete import spectral_radius
from avis_ctrl.simulation.sampled_loop import SampledLoop
from avis_ctrl.study.dc_gain import at_rest
from avis_ctrl.study.random_plants import random_perturbations
from avis_ctrl.study.simulation import with_delta
from avis_ctrl.summary import distinct_from_one

Progress = Callable[[str], None]


# Of the bounds (docs/export.md).
ASSUMPTIONS = (
    "beyond the eighth pair of images, the bounds of aliasing decrease as 1/n^2",
    "between the centres of the intervals, the influence of rounded coefficients is at most twice as large as there",
    "above half the sample rate, the loop gain between the computed frequencies does not exceed 1",
)


@dataclass(frozen=True)
class StabilitySettings:
    """plants : random plants of the uncertainty set, of all axes, whose loops are checked in addition to the proof for
    the kept axes. gains : between 0 and 1, at which the start must be stable. Between steps of 10 % the poles of a loop
    that is stable at both ends move little."""

    plants: int = 20
    gains: tuple[float, ...] = tuple(np.linspace(0.1, 1.0, 10))


@dataclass(frozen=True, eq=False)
class Certificate:
    """content : certificate.json. loop : the emitted controller on the nominal rig. worst : plant with the worst
    transmissibility. reasons : why `stable` or `guaranteed` is not true, in words."""

    content: dict[str, Any]
    loop: SampledLoop
    worst: WorstPlant
    reasons: tuple[str, ...]

    def one_line(self) -> str:
        """Summary for the header of the C files."""
        c = self.content
        known = {
            "mu": c["mu_upper"],
            "peak": c["worst_case_peak_transmissibility_dB"],
            "band": c["worst_case_band_transmissibility_dB"],
        }
        text = {name: _upper(value) for name, value in known.items()}
        proved = (
            "proved between frequencies under the assumptions of docs/export.md" if c["guaranteed"] else "not proved"
        )
        return (
            f"mu at most {text['mu']}, worst-case transmissibility at most {text['peak']} dB, in the band "
            f"{text['band']} dB, {'stable' if c['stable'] else 'not stable'}, {proved}"
        )


def _upper(value: float | None) -> str:
    return "unbounded" if value is None or not np.isfinite(value) else distinct_from_one(value)


def shipped_loop(folder: DesignFolder, controller: SampledController) -> SampledLoop:
    """The emitted numbers on the design's nominal rig."""
    return replace(folder.loop(folder.controller(controller.name)), digital=controller.system)


def certify(
    folder: DesignFolder,
    controller: SampledController,
    progress: Progress = lambda text: None,
    only_stable: bool = False,
    settings: StabilitySettings = StabilitySettings(),
) -> Certificate:
    """Compute the certificate of a controller's numbers, except for the execution time of a step.

    Parameters
    ----------
    only_stable : stop as soon as the loop cannot be proved stable.

    Raises
    ------
    StabilityNotProvedError : only with `only_stable`.
    ComputationError : a loop that is unstable with the nominal plant, for which nothing can be computed.
    """
    axes = SampledAxes.of(folder, controller)
    with threadpool_limits(1):
        loop = shipped_loop(folder, controller)
        progress("stability of all axes and rounding noise")
        noise = rounding_noise(controller, loop)
        # Eigenvalues first, because they take seconds and the bounds minutes.
        unstable = _unstable(_sampled_plants(folder, loop, settings))
        if only_stable and unstable:
            raise StabilityNotProvedError("; ".join(unstable))
        progress("bounds over the whole uncertainty set, from the exported numbers")
        found = bounds(axes, only_stable)
        worst = worst_transmissibility(axes, found)
        lower = mu_lower(axes, found)
        unstable += _unstable(
            [("worst case", with_delta(folder.rig, folder.plant, loop, "worst case", worst.delta, worst.omega))]
        )
    bounded = (found.mu, found.peak, found.band)
    unproved = tuple(one.covers for one in bounded if not (one.guaranteed and np.isfinite(one.upper)))
    if not found.gain_above < 1:
        unproved += (gain_above_in_words(found.gain_above),)

    content = {
        "format": "avis-certificate",
        "version": 1,
        "controller_sha256": controller.sha256,
        "mu_upper": found.mu.upper,
        "mu_lower": lower,
        "guaranteed": not unproved,
        "assumptions": list(ASSUMPTIONS),
        "stable": not unstable and bool(np.isfinite(found.peak.upper)) and found.gain_above < 1,
        "worst_case_peak_transmissibility_dB": decibels(found.peak.upper),
        "worst_case_band_transmissibility_dB": decibels(found.band.upper),
        "rounding_noise_m_per_s": float(np.linalg.norm(noise)),
        "step_time_us": None,
        "at_rest": {**at_rest(loop).as_dict(), "gain_Ns_per_m": axes.gain_at_rest()},
        "between_samples": {
            "worst_case_gain_dB": decibels(found.all_times),
            "floor_above_half_rate_dB": decibels(found.above),
        },
    }
    return Certificate(content, loop, worst, (*unstable, *unproved))


def _sampled_plants(
    folder: DesignFolder, nominal: SampledLoop, settings: StabilitySettings
) -> list[tuple[str, SampledLoop]]:
    """Loops of all axes with the emitted numbers, by name: the nominal one at several gains, and random plants."""
    K, rng = nominal.digital, np.random.default_rng((folder.design.simulation.seed, 3))
    assert K is not None
    loops = [(f"nominal, gain {g:.0%}", replace(nominal, digital=_scaled(K, g))) for g in settings.gains]
    deltas = random_perturbations(folder.plant, settings.plants, folder.design.simulation.seed)
    for k, delta in enumerate(deltas, 1):
        name, omega = f"random plant {k}", 2 * np.pi * 10 ** rng.uniform(0.0, 2.0)
        loops.append((name, with_delta(folder.rig, folder.plant, nominal, name, delta, omega)))
    return loops


def _unstable(loops: Sequence[tuple[str, SampledLoop]], most: int = 3) -> tuple[str, ...]:
    """Descriptions of at most `most` unstable loops, and the number of further ones."""
    radii = [(name, radius) for name, loop in loops if not (radius := spectral_radius(loop)) < 1]
    found = tuple(f"{name}: spectral radius {radius:.6g}" for name, radius in radii[:most])
    return (*found, f"and {len(radii) - most} more of the {len(loops)} loops") if len(radii) > most else found


def _scaled(K: StateSpace, gain: float) -> StateSpace:
    return replace(K, C=gain * K.C, D=gain * K.D)
