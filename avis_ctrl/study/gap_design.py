"""Influence of named effects on the controller: the one of the re-identified model, on the updated one, and a new one.

As in `avis design`, every figure is computed from a closed loop in state space: mu and worst-case gains are bounds over
all frequencies and the whole uncertainty of the design; stability follows from the eigenvalues. The figures are valid
for the realisation of the updated model (`gap.realise`). Its difference from the fitted response is reported as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.realisation import Realised, not_realised, realise
from avis_ctrl.gap.result import Gap
from avis_ctrl.gap.table_model import TableModel
from avis_ctrl.lti.norms import decibels, hinf_norm
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.rigs.isolator_table import IsolatorTable
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.robust.mu_peak import mu_peak, worst_case_gain
from avis_ctrl.study.analysis import SETTINGS as ANALYSIS
from avis_ctrl.study.controllers import mu_optimal
from avis_ctrl.study.design_file import Design, read_study
from avis_ctrl.study.gap_plant import (
    DESCRIBED_IN,
    DesignFiles,
    delay_order,
    design_files,
    plant_of,
    six_dof_is_stable,
    wiring_of,
)
from avis_ctrl.study.gap_uncertainty import FitUncertainty, fit_uncertainty
from avis_ctrl.study.identification_design import default_design, default_keep
from avis_ctrl.study.plant import DesignPlant, Wiring, build_plant
from avis_ctrl.summary import rounded_up
from avis_ctrl.uncertainty.uncertain_rig import Uncertain

Progress = Callable[[str], None]
# As in designs/avis_z_phix.toml.
PARAMETERS_PERCENT = {"mass": 10.0, "isolator*.k_z": 15.0, "isolator*.c_z": 30.0}


@dataclass(frozen=True)
class LoopFigures:
    """Figures of a controller on a plant.

    stable : nominal stability: all poles of the closed loop are in the left half plane; if not, the figures are
        infinite.
    stable_in_six : the same with all six coordinates, the others without control (`gap_plant.six_dof_is_stable`).
    mu_upper, mu_lower : robust performance with the design's weights. peak_dB, band_dB : largest nominal
        transmissibility over all frequencies and over the design's band. worst_peak_dB, worst_band_dB : upper bounds of
        the same over the design's uncertainty.
    """

    stable: bool
    stable_in_six: bool
    mu_upper: float
    mu_lower: float
    peak_dB: float
    band_dB: float
    worst_peak_dB: float
    worst_band_dB: float
    fastest_pole_Hz: float


@dataclass(frozen=True, eq=False)
class DesignEffect:
    """Influence of the effects on a design.

    Attributes
    ----------
    before : the controller designed on the baseline, with the baseline. after : the same controller on the updated
        model; None if no named effect changes the model. new : a controller designed for the updated model, on this
        model; None if none was found.
    K_before, K_new : the controllers.
    realised : the updated model in state space, with its difference from the fitted response.
    in_files, not_in_files : labels of the effects that rig.toml and design.toml contain, and of those they do not.
    files : contents of rig.toml and design.toml by name: `avis design` runs on them.
    sentences : the outcome first. seconds : wall-clock time.
    uncertainty : of the fit, as blocks of every loop, and what has no block; None without a covariance of the fit.
    not_checked : labels of named effects against which no controller was checked, and the reasons. The loops do not
        contain these effects, so no figure here shows whether they matter.
    """

    before: LoopFigures
    after: LoopFigures | None
    new: LoopFigures | None
    K_before: StateSpace
    K_new: StateSpace | None
    realised: Realised
    in_files: tuple[str, ...]
    not_in_files: tuple[str, ...]
    files: dict[str, str]
    sentences: tuple[str, ...]
    seconds: float
    not_checked: dict[str, str] = field(default_factory=dict)
    uncertainty: FitUncertainty | None = None

    def to_json(self) -> dict[str, Any]:
        """Figures of the three loops, infinite for an unstable loop, and the sentences."""
        loops = {"before": self.before, "after": self.after, "new": self.new}
        return {
            **{name: asdict(loop) if loop else None for name, loop in loops.items()},
            "in_files": list(self.in_files),
            "not_in_files": list(self.not_in_files),
            "uncertainty": self.uncertainty.to_json() if self.uncertainty else None,
            "not_checked": dict(self.not_checked),
            "sentences": list(self.sentences),
            "seconds": self.seconds,
        }


def design_effect(
    gap: Gap, design: Path | Design | None = None, progress: Progress = lambda text: None
) -> DesignEffect:
    """Design on the baseline, evaluate on the updated model, design again.

    Parameters
    ----------
    design : a design or its file; the gap's models replace its rig. By default z and phi_x of the AVIS as in
        designs/avis_z_phix.toml.

    Raises
    ------
    InputError : a design that does not fit the rig, or whose uncertainty is that of an identification (it is valid for
        one set of parameters only); no default for this rig.
    ComputationError : no controller for the baseline.
    """
    with threadpool_limits(1):
        # The second-order terms of large rotations vanish at rest.
        before, after = (model.without(f"{LargeMotion.name}@payload") for model in (gap.baseline, gap.updated))
        signals = [f"{one.name}@{one.location}" for one in gap.effects if not one.label]
        asked, covariance = design_for(gap.baseline.rig, design), gap.covariance
        uncertainty = None
        if covariance is not None:
            progress("uncertainty: the fit's covariance as a few blocks")
            own = [gap.updated.names.index(name) for name in after.names]
            # The ranges of the default design replace a measurement, which the fit provides here.
            judged = without_ranges(asked) if design is None else asked
            wiring = wiring_of(build_plant(judged, before.effective.rig), before)
            uncertainty = fit_uncertainty(judged, after, covariance[np.ix_(own, own)], wiring)
        return compare_designs(before, after, asked, progress, signals, uncertainty)


def without_ranges(design: Design) -> Design:
    """A copy of the design without parameter ranges."""
    bare = design.uncertainty.model_copy(update={"parameters_percent": {}, "parameters_absolute": {}})
    return design.model_copy(update={"uncertainty": bare})


def compare_designs(
    baseline: TableModel,
    updated: TableModel,
    design: Design,
    progress: Progress = lambda text: None,
    signals: Sequence[str] = (),
    uncertainty: FitUncertainty | None = None,
) -> DesignEffect:
    """`design_effect` for two given models.

    signals : named effects that act on the signals and are in no model.
    uncertainty : of the fit; the loops use its design. The files contain `design`, because they cannot describe the
        blocks of a fit.
    """
    began, fit, in_files_design = time.monotonic(), uncertainty.blocks if uncertainty else (), design
    design = uncertainty.design if uncertainty else design
    progress("controller for the re-identified model: mu synthesis")
    plant, asked, rig = plant_of(design, baseline, fit=fit)
    wiring = wiring_of(plant, baseline)
    new_rig = rig
    K = mu_optimal(asked, plant, rig)[0].K
    assert K is not None
    before = figures(asked, baseline, plant, K)
    progress(f"  mu {before.mu_upper:.3f} on the re-identified model")
    after, new, K_new, when, notes = None, None, None, 0.0, []
    if updated.effects:
        after, when = _worst_moment(design, updated, wiring, K, fit)
        progress(f"  mu {after.mu_upper:.3f} on the updated model")
        progress("controller for the updated model: mu synthesis")
        new_plant, new_design, new_rig = plant_of(design, updated, wiring, when, fit)
        try:
            candidate, made = mu_optimal(new_design, new_plant, new_rig)
            K_new = candidate.K
            assert K_new is not None
            new = figures(new_design, updated, new_plant, K_new, when)
            if new.mu_upper >= 1:
                notes.append(f"Its synthesis ended as follows: {made.status}.")
            progress(f"  mu {new.mu_upper:.3f} for the new controller")
        except ComputationError as error:
            notes.append(f"No controller was found for the updated model: {error}")
    realised = realise(updated)
    files = design_files(in_files_design, updated, when)
    left_out = not_realised(updated)
    not_checked = left_out | dict.fromkeys(signals, "it acts on the measured signals and is not part of the loop")
    held = "all" if not left_out else "none" if len(left_out) == len(updated.effects) else "some"
    words = (
        *_outcome(before, after, new, design.synthesis.target_mu, held),
        *_unchecked(not_checked),
        *notes,
        *(uncertainty.sentences() if uncertainty else ()),
        *_other_ranges(in_files_design, uncertainty),
        *_remarks(realised, design, new_rig, updated, when, files),
    )
    return DesignEffect(
        before,
        after,
        new,
        K,
        K_new,
        realised,
        files.inside,
        files.outside,
        files.texts(),
        words,
        time.monotonic() - began,
        not_checked,
        uncertainty,
    )


def design_for(rig: Rig, design: Path | Design | None = None) -> Design:
    """The design that `design_effect` uses on a rig. Raises InputError as it does, before any computation."""
    if design is None:
        if not isinstance(rig, IsolatorTable):
            raise InputError(
                f"there is a default only for tables on isolators: give a design file for {rig.name}", field="design"
            )
        keep = " and ".join(default_keep(rig))
        return default_design(
            rig, f"{rig.name}: {keep} under one controller, weights chosen for the AVIS", PARAMETERS_PERCENT
        )
    asked = design if isinstance(design, Design) else read_study(design)[0]
    if asked.uncertainty.identified is not None:
        complaint = InputError(
            "it belongs to the parameters of one identification; expected a design whose ranges are "
            "set by hand (parameters_percent)",
            field="uncertainty.identified",
        )
        raise complaint.in_file(design) if isinstance(design, Path) else complaint
    return asked


def _worst_moment(
    design: Design, model: TableModel, wiring: Wiring, K: StateSpace, fit: Sequence[Uncertain] = ()
) -> tuple[LoopFigures, float]:
    """Figures of the controller on the model. If the model drifts: at the end of the campaign with the larger mu."""
    drifts = any(one.effect.name == "stiffness_drift" for one in model.effects)
    found = []
    for when in (-0.5, 0.5) if drifts else (0.0,):
        plant, asked, _ = plant_of(design, model, wiring, when, fit)
        found.append((figures(asked, model, plant, K, when), when))
    return max(found, key=lambda one: one[0].mu_upper)


def figures(design: Design, model: TableModel, plant: DesignPlant, K: StateSpace, when: float = 0.0) -> LoopFigures:
    """Figures of a controller on a plant of a model."""
    in_six = six_dof_is_stable(design, model, plant, K, when)
    fastest = float(np.max(np.abs(K.poles()), initial=0.0)) / (2 * np.pi)
    if not plant.full.closed(K).is_stable():
        return LoopFigures(False, in_six, *(float("inf"),) * 6, fastest)
    performance = plant.synthesis.closed(K)
    motion = plant.full.restricted(plant.floor_velocities, plant.velocities).closed(K)
    blocks = plant.synthesis.blocks
    mu = mu_peak(performance, plant.synthesis.all_blocks, slack=ANALYSIS.slack)
    low, high = design.transmissibility.band_Hz
    nominal = motion.select(slice(blocks.n_z, None), slice(blocks.n_w, None))
    in_band = nominal.frequency_response(2 * np.pi * np.geomspace(low, high, 400))
    worst = worst_case_gain(motion, blocks, slack=ANALYSIS.slack)
    worst_band = worst_case_gain(motion, blocks, band=(2 * np.pi * low, 2 * np.pi * high), slack=ANALYSIS.slack)
    return LoopFigures(
        True,
        in_six,
        mu.upper,
        mu.lower,
        decibels(hinf_norm(nominal).gain),
        decibels(float(np.max(np.linalg.norm(in_band, ord=2, axis=(1, 2))))),
        decibels(worst.upper),
        decibels(worst_band.upper),
        fastest,
    )


def _unchecked(not_checked: dict[str, str]) -> list[str]:
    """A sentence on the effects with which no controller was checked; empty if there are none."""
    if not not_checked:
        return []
    each = "; ".join(f"{label}: {why}" for label, why in not_checked.items())
    return [
        f"NOT checked: no controller was designed or evaluated with {', '.join(not_checked)} ({each}). Their "
        "influence on the closed loop is not known from these figures; simulate or measure the closed loop."
    ]


def _outcome(
    before: LoopFigures, after: LoopFigures | None, new: LoopFigures | None, target: float | None, held: str = "all"
) -> list[str]:
    """mu of the three loops in words; held : "all", "some" or "none" of the updated model's effects are in its loop."""
    mu, mu_after, mu_new = (
        "" if one is None else f"mu of at most {rounded_up(one.mu_upper, 3):.3g}" for one in (before, after, new)
    )
    if after is None:
        return [
            f"The controller designed on the re-identified model has {mu} there; no named effect changes the model, so "
            "nothing else was computed."
        ]
    first = f"The controller designed on the re-identified model has {mu} there and "
    if after.stable:
        verdict = f"{_verdict(before.mu_upper, after.mu_upper, held)}; {_worst_case(before, after)}"
        first += f"{mu_after} on the updated model: {verdict}."
    else:
        first += "makes the updated model unstable."
    if after.stable and before.stable_in_six and not after.stable_in_six:
        first += " With all six coordinates the updated model is unstable, which the design model hides."
    if new is None:
        return [first]
    if not new.stable:
        return [first, "The controller designed on the updated model does not stabilise it."]
    reach = "meets the specification" if new.mu_upper < 1 else "is not proved to meet the specification"
    bounds = f"worst case {new.worst_peak_dB:.1f} dB at the peak, {new.worst_band_dB:.1f} dB in the band"
    if not np.isfinite(new.worst_peak_dB):
        bounds = "stability is not proved for every table within the design's uncertainty"
    second = f"A controller designed on the updated model has {mu_new} there and {reach} ({bounds})."
    if target and after.mu_upper < new.mu_upper < 1:
        second += f" Synthesis stops near its target of {target:g}: it does not search for the lowest mu."
    return [first, second if new.stable_in_six else f"{second} With all six coordinates the loop is unstable."]


def _worst_case(before: LoopFigures, after: LoopFigures) -> str:
    if np.isfinite(before.worst_peak_dB) and not np.isfinite(after.worst_peak_dB):
        return "stability is no longer proved for every table within the design's uncertainty"
    if not np.isfinite(before.worst_peak_dB):
        return "stability was not proved on the re-identified model for every table within the design's uncertainty"
    return (
        f"worst-case transmissibility goes from {before.worst_peak_dB:.1f} to {after.worst_peak_dB:.1f} dB at its "
        f"peak and from {before.worst_band_dB:.1f} to {after.worst_band_dB:.1f} dB in the band"
    )


def _verdict(before: float, after: float, held: str) -> str:
    if before < 1 <= after:
        return "mu is no longer below 1"
    if after < 1 <= before:
        return "mu is now below 1"
    if abs(after - before) <= 0.02 * before:
        return {
            "all": "mu hardly changes",
            "some": "the effects in this loop hardly change mu",
            "none": "mu stays because this loop contains none of the named effects",
        }[held]
    kept = "below 1 with both models" if after < 1 else "below 1 with neither model"
    return f"mu is {'higher' if after > before else 'lower'}, {kept}"


def _other_ranges(design: Design, uncertainty: FitUncertainty | None) -> list[str]:
    """A sentence if the uncertainty of the files is not that of the loops; empty otherwise."""
    if uncertainty is None or (not uncertainty.blocks and uncertainty.design is design):
        return []
    ranges = ", ".join(f"{name} {size:g} %" for name, size in design.uncertainty.parameters_percent.items())
    return [
        f"design.toml cannot contain the uncertainty of the fit; its parameter ranges are {ranges or 'none'}, so "
        "`avis design` gives another mu."
    ]


def _remarks(
    realised: Realised, design: Design, plant_rig: Rig, model: TableModel, when: float, files: DesignFiles
) -> list[str]:
    """Sentences on the accuracy of the figures and on where the effects are described."""
    if not model.effects:
        return []
    error = f"at most {100 * realised.error:.2g} %" if realised.error > 1e-6 else "round-off"
    said = [
        f"The state-space form of the updated model deviates from its response by {error} "
        f"from {realised.omega[0] / 2 / np.pi:.3g} to {realised.omega[-1] / 2 / np.pi:.3g} Hz; aliasing, "
        f"up to {100 * realised.aliases:.2g} %, is neglected.",
        *realised.notes,
        "mu and transmissibility are for the design's coordinates, the others locked; stability was checked with all "
        "six.",
    ]
    left = delay_order(design, plant_rig)[1]
    if left > 0.1:
        said.append(
            f"The delay of {1e3 * plant_rig.loop_delay_s:.3g} ms needs a higher Pade order than is allowed (error "
            f"{left:.2g} at the bandwidth of the drives): do not rely on the new controller."
        )
    if any(one.effect.name == "stiffness_drift" for one in model.effects):
        said.append(f"Stiffness is taken at the {'start' if when < 0 else 'end'} of the campaign, where mu is larger.")
    by_label = {one.label: one.effect.name for one in model.effects}
    if files.inside:
        places = {label: DESCRIBED_IN.get(by_label[label]) for label in files.inside}
        where = [f"{label} ({place})" if place else label for label, place in places.items()]
        said.append(f"rig.toml and design.toml contain {', '.join(where)}, so `avis design` includes them.")
    lags = [label for label in files.outside if by_label[label] == "actuator_lag"]
    if lags:
        said.append(
            f"design.toml has one pole for all amplifiers, with the mean lag of {', '.join(lags)}: the figures here "
            "include each amplifier as it is, `avis design` on these files does not."
        )
    if others := [label for label in files.outside if label not in lags]:
        said.append(
            f"Rig and design files cannot contain {', '.join(others)}: the figures here include them, "
            "`avis design` on these files does not."
        )
    return said
