"""Analysis of a controller, the same for all controllers: bounds, transmissibility, site response.

Every figure is computed from the closed loop with the final controller and never taken from its synthesis.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import ComputationError
from avis_ctrl.lti.norms import hinf_norm
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.floor_motion import band_rms, third_octave_midbands, third_octave_rms
from avis_ctrl.rigs.vibration_criteria import rating
from avis_ctrl.robust.mu_gain import perturbed, worst_gain
from avis_ctrl.robust.mu_peak import MuPeak, mu_peak, worst_case_gain
from avis_ctrl.robust.slycot_adapter import hinf_norm_slicot
from avis_ctrl.study.design_file import Design
from avis_ctrl.study.design_result import Bound, Candidate, ControllerResult, SiteResponse, Transmissibility
from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.uncertainty.blocks import BlockStructure


@dataclass(frozen=True)
class AnalysisSettings:
    """Settings of the analysis.

    slack : relative excess [1] of upper bounds over the largest value found (0.5 %, 0.04 dB); tighter bounds only cost
        time.
    passive_slack : replaces `slack` for the worst-case gains of the passive table if there are many blocks: its narrow
        peaks need many frequency intervals. passive_stability_slack : the same for its robust stability, where mu is
        flat over frequency.
    few_points : number of frequencies of the upper bound of the worst-case gain if no curve is drawn, in addition to
        the frequencies of the highest gains.
    axis_points : number of frequencies of the lower bound of an axis, in a band of two or three octaves.
    plot_Hz, plot_points : range and number of the frequencies of curves: the modes of a table and a decade on either
        side, about 90 to a decade, so that a resonance is drawn as a curve.
    samples : number of perturbations for the range of sampled transmissibilities: enough for the picture, the bounds do
        not depend on it.
    peak_factor : level relative to the r.m.s. [1] that a Gaussian signal of 10 Hz bandwidth exceeds once in ten
        minutes: sqrt(2 ln(f T)), Rice 1944.
    """

    slack: float = 5e-3
    passive_slack: float = 2e-2
    passive_stability_slack: float = 5e-2
    few_points: int = 0
    axis_points: int = 24
    plot_Hz: tuple[float, float] = (0.1, 200.0)
    plot_points: int = 300
    samples: int = 60
    peak_factor: float = float(np.sqrt(2 * np.log(600.0 * 10.0)))


SETTINGS = AnalysisSettings()


def analyse(design: Design, plant: DesignPlant, candidate: Candidate, samples: np.ndarray) -> ControllerResult:
    """Analyse one controller on the design's plant.

    Parameters
    ----------
    samples : (n_samples, n_w, n_z) perturbations, constant over frequency, for the range of sampled transmissibilities.

    Raises ComputationError: the closed loop of the nominal plant is unstable, or a bound cannot be computed.
    """
    K = candidate.K
    full = plant.full.closed(K)
    if not full.is_stable():
        fastest_growing = max(full.poles(), key=lambda pole: pole.real)
        raise ComputationError(
            "the closed loop is unstable with the nominal plant, so its mu has no bounds",
            measured=f"a closed-loop pole at {abs(fastest_growing.imag) / (2 * np.pi):.3g} Hz that grows with a time "
            f"constant of {1 / max(fastest_growing.real, 1e-12):.3g} s",
        )
    performance = plant.synthesis.closed(K)
    motion = plant.full.restricted([*plant.floor_velocities], [*plant.velocities]).closed(K)
    blocks, all_blocks = plant.synthesis.blocks, plant.synthesis.all_blocks
    n_w, n_z = blocks.n_w, blocks.n_z
    low, high = design.transmissibility.band_Hz
    nominal = performance.select(slice(n_z, None), slice(n_w, None))
    fastest = float(np.max(np.abs(K.poles()), initial=0.0)) / (2 * np.pi) if K is not None else 0.0
    loose = K is None and blocks.many
    slack = SETTINGS.passive_stability_slack if loose else SETTINGS.slack
    robust = mu_peak(performance.select(slice(n_z), slice(n_w)), blocks, slack=slack)
    slack = SETTINGS.passive_slack if loose else SETTINGS.slack
    band, few = (2 * np.pi * low, 2 * np.pi * high), SETTINGS.few_points
    worst_peak = worst_case_gain(motion, blocks, slack=slack, robust=robust)
    worst_band = worst_case_gain(motion, blocks, band=band, slack=slack, robust=robust, points=few)
    omega = 2 * np.pi * np.geomspace(*SETTINGS.plot_Hz, SETTINGS.plot_points)
    return ControllerResult(
        **vars(candidate),
        stable=full.is_stable(),
        gamma=hinf_norm(nominal).gain,
        mu=bound(plant, blocks, mu_peak(performance, all_blocks, slack=SETTINGS.slack)),
        stability=bound(plant, blocks, robust),
        worst_peak=bound(plant, blocks, worst_peak),
        worst_band=bound(plant, blocks, worst_band),
        transmissibility=transmissibility(motion, blocks, samples, omega),
        compliance=_compliance(plant, full, omega),
        site=site_response(plant, full, K is not None, design.floor.band_Hz),
        peak_transmissibility=hinf_norm(motion.select(slice(n_z, None), slice(n_w, None))).gain,
        fastest_pole_Hz=fastest,
        gamma_slicot=_by_slicot(nominal),
    )


def worst_of_axis(
    design: Design, plant: DesignPlant, axis: int, K: StateSpace | None, stability: Bound | None = None
) -> float:
    """Bound on the worst-case velocity of an axis in the band, for unit floor velocity in any direction.

    axis : index among the axes of the design.
    stability : robust stability of the loop with K. If given, the result is an upper bound over the whole uncertainty
        set, valid between frequencies. Otherwise it is a lower bound, attained by a plant.
    """
    part = plant.full.restricted([*plant.floor_velocities], [*plant.velocities])
    blocks = plant.synthesis.blocks
    motion = part.closed(K).select([*range(blocks.n_z), blocks.n_z + axis], None)
    band = design.transmissibility.band_Hz[0] * 2 * np.pi, design.transmissibility.band_Hz[1] * 2 * np.pi
    if stability is not None:
        return worst_case_gain(
            motion, blocks, band=band, slack=SETTINGS.slack, robust=stability, points=SETTINGS.few_points
        ).upper
    omega = np.geomspace(*band, SETTINGS.axis_points)
    return float(np.max(worst_gain(motion.frequency_response(omega), blocks).gain))


def _by_slicot(system: StateSpace) -> float | None:
    """H-infinity norm by SLICOT, an independent code; None if it fails."""
    try:
        return hinf_norm_slicot(system)
    except ComputationError:
        return None


def bound(plant: DesignPlant, blocks: BlockStructure, found: MuPeak) -> Bound:
    """A mu or worst-case result, with its perturbation in words."""
    return Bound(**vars(found), words=describe(plant, blocks, found.delta) if found.delta is not None else ())


def describe(plant: DesignPlant, blocks: BlockStructure, delta: np.ndarray) -> tuple[str, ...]:
    """A perturbation in words: parameters by value, channels ("chains") by size and phase; equal ones are grouped."""
    part = delta[: blocks.n_w, : blocks.n_z]
    real = {p.name: p for p in plant.rig.parameters}
    told: list[tuple[str, str]] = []
    for value, block in zip(blocks.values(part), blocks.blocks, strict=True):
        if block.name in real:
            parameter = real[block.name]
            words = parameter.words(float(np.real(value)), plant.rig.nominal, plant.rig.units).removeprefix(block.name)
        else:
            number = complex(np.asarray(value).ravel()[0]) if np.size(value) == 1 else None
            size = abs(number) if number is not None else float(np.linalg.norm(np.asarray(value), 2))
            phase = f" at {np.degrees(np.angle(number)):+.0f} deg" if number is not None else ""
            words = f": {100 * size:.0f} % of its bound{phase}"
        told.append((block.name, words))
    return _by_family(told)


def _by_family(told: list[tuple[str, str]]) -> tuple[str, ...]:
    """Merge (name, words) pairs whose names differ only in their number, if the words are the same for all of them."""
    families: dict[str, list[tuple[str, str]]] = {}
    for name, words in told:
        families.setdefault(re.sub(r"\d+", "*", name), []).append((name, words))
    lines: list[str] = []
    for family, members in families.items():
        alike = len(members) > 1 and len({words for _, words in members}) == 1
        lines += [f"every {family}{members[0][1]}"] if alike else [name + words for name, words in members]
    return tuple(lines)


def transmissibility(
    motion: StateSpace, blocks: BlockStructure, samples: np.ndarray, omega: np.ndarray
) -> Transmissibility:
    """Nominal and sampled transmissibility of a closed loop with inputs (w_delta, floor)."""
    response = motion.frequency_response(omega)
    nominal = response[:, blocks.n_z :, blocks.n_w :]
    sampled = [np.linalg.norm(perturbed(response, delta[None]), ord=2, axis=(1, 2)) for delta in samples]
    sigma = np.linalg.norm(nominal, ord=2, axis=(1, 2))
    band = np.array([sigma, *sampled])
    return Transmissibility(omega, nominal, sigma, band.min(axis=0), band.max(axis=0))


def _compliance(plant: DesignPlant, full: StateSpace, omega: np.ndarray) -> np.ndarray:
    forces, moved = [f"force_{a}" for a in plant.axes], [f"{a}_rel" for a in plant.axes]
    return np.linalg.norm(full.select(moved, forces).frequency_response(omega), ord=2, axis=(1, 2))


def site_response(plant: DesignPlant, full: StateSpace, controlled: bool, band_Hz: Sequence[float]) -> SiteResponse:
    """Spectra of payload velocity and drive voltages caused by the site's floor motion and the sensor noise."""
    frequency = np.geomspace(plant.floor.low_Hz, 250.0, 2000)
    omega = 2 * np.pi * frequency
    floor = plant.floor.asd(frequency, "velocity")
    outputs = [*plant.velocities, *plant.volts]
    from_floor = full.select(outputs, plant.floor_velocities).frequency_response(omega)
    from_noise = full.select(outputs, list(plant.noises)).frequency_response(omega)
    # Floor motions in different directions and the noises of the sensors are uncorrelated.
    by_floor = np.linalg.norm(from_floor, axis=2) * floor[:, None]
    # The weight covers the 1/f noise and is constant at low frequency: rescale to the actual noise.
    real = np.stack([weight.asked(omega) / weight.magnitude(omega) for weight in plant.noises.values()], axis=1)
    by_noise = np.linalg.norm(from_noise * real[:, None, :], axis=2) * plant.floor_density
    if not controlled:
        # No voltages, and no sensor noise in the motion: exactly zero, without round-off.
        by_floor[:, len(plant.axes) :], by_noise[:] = 0.0, 0.0
    density = np.hypot(by_floor, by_noise)

    def rms(asd: np.ndarray, low: float = frequency[0], high: float = frequency[-1]) -> float:
        return band_rms(frequency, asd, low, high) if np.any(asd) else 0.0

    n = len(plant.axes)
    bands = third_octave_midbands(1.0, 80.0)
    payload = np.stack([third_octave_rms(frequency, density[:, k], bands) for k in range(n)], axis=1)
    on_floor = third_octave_rms(frequency, floor, bands)
    volts = {name: rms(density[:, n + k]) for k, name in enumerate(plant.actuators)}
    return SiteResponse(
        {axis: rms(density[:, k], *band_Hz) for k, axis in enumerate(plant.axes)},
        {axis: rms(by_noise[:, k], *band_Hz) for k, axis in enumerate(plant.axes)},
        bands,
        on_floor,
        payload,
        rating(bands, payload.max(axis=1)),
        rating(bands, on_floor),
        volts,
        {name: SETTINGS.peak_factor * value for name, value in volts.items()},
    )
