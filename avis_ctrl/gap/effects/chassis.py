"""What the mounts stand on: a chassis that recoils."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np

from avis_ctrl.errors import AvisError
from avis_ctrl.gap.data import thinned
from avis_ctrl.gap.effects.base import Effect, EffectParameter, Seed, register, told_from_none
from avis_ctrl.gap.effects.impedance import recoils
from avis_ctrl.gap.effects.mounts import has_mounts
from avis_ctrl.gap.effects.sensors import receptance
from avis_ctrl.gap.refit import likelihood
from avis_ctrl.gap.score import Score
from avis_ctrl.gap.score_algebra import reduction
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.identification.maximum_likelihood import LikelihoodFit
from avis_ctrl.identification.spectra import SpectralBlock
from avis_ctrl.rigs.rigid_body import point_map

if TYPE_CHECKING:
    from avis_ctrl.gap.operators import Operators

WAYS = ("x", "y", "z", "rx", "ry", "rz")
# Below this the suspension's own modes are in the way of the first look.
LOWEST_Hz = 7.0
# Where a way of moving is looked for that the score finds nothing in [Hz].
STIFF_Hz = 90.0
# Starts of which the most promising are followed: mass over the payload's, frequencies alike along all ways, and
# radii of gyration and heights [m] of a frame of a table's size.
TRIAL_MASS, TRIAL_Hz = 2.0, tuple(np.geomspace(10.0, 90.0, 7).tolist())
SHAPE = (0.45, 0.45, 0.45, -0.4, -0.1)
# Lines of a record, iterations, and how many are followed, only where the gap is more than this times the noise.
TRIAL_LINES, TRIAL_ITERATIONS, TRIED, PLAIN = 50, 4, 3, 1.3


@register
class BaseCompliance(Effect):
    """The chassis, a rigid body on something soft: it recoils from mounts and motors, and filters the floor.

    c = B (f_mounts + (s C_b + K_b) w), B = inv(s^2 M_c + s C_b + K_b), each along its own axis (translation), or with
    rotation too, the mass at its own height and the springs of the base at theirs.
    """

    name = "base_compliance"
    title = "the chassis stands on something soft and recoils"
    looks_like = "one more resonance in every channel, and less floor motion above it"
    confusable = ("payload_flexible_mode", "attached_oscillator", "mount_surge")
    holds_states = True

    def places(self, model: TableModel) -> tuple[str, ...]:
        return ("chassis/translation", "chassis/rocking") if has_mounts(model) else ()

    def parameters(self, model: TableModel, place: str) -> tuple[EffectParameter, ...]:
        m = model.rig.mounted_body().mass

        def frequency(way: str) -> EffectParameter:
            about = f"along {way}" if len(way) == 1 else f"about {way[1]}"
            return EffectParameter(f"{way}_Hz", "Hz", f"of the chassis on its base, {about}", 0.0, 1.0, 300.0, 10.0,
                                   False, (20.0,), True)
        found = (EffectParameter("mass_kg", "kg", "of the chassis", 0.0, 0.05 * m, 400 * m, m, False, (2 * m,)),
                 EffectParameter("damping", "1", "damping ratio", 0.0, 1e-3, 1.0, 0.05, False, (0.06,), True),
                 *(frequency(way) for way in WAYS[:3]))
        if place.endswith("translation"):
            return found
        return (*found, *(frequency(way) for way in WAYS[3:]),
                *(EffectParameter(f"gyration_{axis}_m", "m", f"radius of gyration about {axis}", 0.0, 0.03, 5.0, 0.3,
                                  False, (0.5,), True) for axis in "xyz"),
                EffectParameter("centre_z_m", "m", "height of its mass over the table's centre", 0.0, -3.0, 1.0, 0.3,
                                False, (-0.5,), True),
                EffectParameter("base_z_m", "m", "height of its springs over its mass", 0.0, -2.0, 2.0, 0.3, False,
                                (0.0,), True))

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """Short fits to few lines: from where each way of moving resonates best by itself, and from the most promising
        of like frequencies along all ways, where one step of all parameters together is expected to lead furthest."""
        blocks = [thinned(part.block, TRIAL_LINES, seed=2) for part in score.parts]
        few = Score(score.model, blocks).chi2
        scale = score.chi2 / max(few, 1.0)
        own = self._by_ways(score, place)
        trials = [] if score.chi2 < PLAIN * score.dof else self._alike(score.model, place, blocks)
        found = []
        for values in [*(one.values for one in own), *trials[:TRIED]]:
            begin = score.model.with_effect(ActiveEffect(self, place, self.parameters(score.model, place), values))
            if (made := _short_fit(begin, blocks)) is not None:
                reached = cast(TableModel, made.model).effects[-1].values
                # On few lines the rig's parameters take their part of the noise, too.
                found.append(Seed(reached, score.chi2 - scale * made.chi2, len(made.model.names),
                                  len(own) + len(TRIAL_Hz), few - made.chi2))
        found = [one for one in found if one.chi2 > 0] or own
        return sorted(found, key=lambda seed: -seed.chi2)

    def _alike(self, model: TableModel, place: str, blocks: Sequence[SpectralBlock]) -> list[tuple[float, ...]]:
        """Starts of one frequency along all ways, the most promising first."""
        parameters, found = self.parameters(model, place), []
        payload = model.rig.mounted_body().mass
        shape = () if place.endswith("translation") else SHAPE
        for f in TRIAL_Hz:
            values = (TRIAL_MASS * payload, 0.05, *[f] * (6 if shape else 3), *shape)
            try:
                left = Score(model.with_effect(ActiveEffect(self, place, parameters, values)), blocks).chi2
            except (AvisError, np.linalg.LinAlgError):
                continue
            found.append((left, values))
        return [values for _, values in sorted(found)]

    def _by_ways(self, score: Score, place: str) -> list[Seed]:
        """Where each way of moving resonates best by itself; masses follow from all of them together."""
        ways = WAYS[:3] if place.endswith("translation") else WAYS
        zeta, grid = 0.06, np.geomspace(LOWEST_Hz, STIFF_Hz, 26)
        rows, labels = [], []
        for f in grid:
            key = ("recoil", float(f))
            if key not in score.kept:
                score.kept[key] = recoils(score, partial(receptance, frequency_Hz=f, damping=zeta))
            rows.append(score.kept[key][:len(ways)])
            labels += [(way, float(f)) for way in ways]
        A = np.concatenate(rows)
        gram, fall = A @ A.T, A @ score.e
        best = _greedy(gram, fall, labels)
        moving = [way for way in best if len(way) == 1]
        if not moving:
            return []
        chosen = [labels.index((way, f)) for way, f in best.items()]
        took = reduction(gram[np.ix_(chosen, chosen)], fall[chosen])
        inverse = dict(zip(best, took.coefficients, strict=True))
        # The way that was found first tells the mass best; one that would need another mass is no recoil.
        leader = inverse[moving[0]]
        if leader <= 0:
            return []
        best = {way: f for way, f in best.items() if len(way) > 1 or leader / 3 < inverse[way] < 3 * leader}
        mass = self.parameters(score.model, place)[0]
        m = float(np.clip(1 / leader, 2 * mass.low, mass.high / 2))
        at = {way: best.get(way, STIFF_Hz) for way in ways}
        values = [m, zeta, *(at[way] for way in ways[:3])]
        if len(ways) > 3:
            radii = [np.sqrt(1 / (inverse[way] * m)) if inverse.get(way, 0.0) > 0 else 0.6 for way in ways[3:]]
            values += [*(at[way] for way in ways[3:]), *np.clip(radii, 0.1, 3.0).tolist(), -0.3, 0.0]
        return [Seed(tuple(float(v) for v in values), took.chi2, 2 * len(best))]

    def implausible(self, values: Mapping[str, float], std: Mapping[str, float]) -> str:
        return "" if told_from_none(values, std, ["mass_kg"]) else (
            "a chassis so heavy that the data do not tell it from one that stands still")

    def change(self, ops: Operators, place: str, values: Mapping[str, float]) -> None:
        mass, damping, stiffness = of_chassis(values)
        s = ops.s[:, None, None]
        tied = stiffness + s * damping
        if "rx_Hz" in values:
            B = np.linalg.inv(s ** 2 * mass + tied)
            H = B @ tied[:, :, :3]
        else:
            B, H, along = np.zeros((len(s), 6, 6), complex), np.zeros((len(s), 6, 3), complex), range(3)
            held = tied[:, along, along]
            D = s[:, :, 0] ** 2 * mass[along, along] + held
            B[:, along, along], H[:, along, along] = 1 / D, held / D
        ops.recoil, ops.follow = B, H


def of_chassis(values: Mapping[str, float]) -> np.ndarray:
    """(3, 6, 6) mass, damping and stiffness of a chassis on its base, in the payload's coordinates about the table's
    centre; nothing in those in which it does not move."""
    ways = [way for way in WAYS if f"{way}_Hz" in values]
    n = len(ways)
    radii = [1.0 if len(way) == 1 else values[f"gyration_{way[1]}_m"] for way in ways]
    inertia = values["mass_kg"] * np.square(radii)
    w = 2 * np.pi * np.array([values[f"{way}_Hz"] for way in ways])
    found = np.zeros((3, 6, 6))
    if n == 3:
        found[:, range(3), range(3)] = inertia, 2 * values["damping"] * inertia * w, inertia * w ** 2
        return found
    centre = np.array([0.0, 0.0, values["centre_z_m"]])
    G, below = point_map(centre), point_map(centre + np.array([0.0, 0.0, values["base_z_m"]]))
    each = (inertia, 2 * values["damping"] * inertia * w, inertia * w ** 2)
    for which, place, one in zip(found, (G, below, below), each, strict=True):
        which += place.T @ np.diag(one[:3]) @ place
        which[3:, 3:] += np.diag(one[3:])
    return found


def _short_fit(model: TableModel, blocks: Sequence[SpectralBlock]) -> LikelihoodFit | None:
    try:
        return likelihood(model, blocks, TRIAL_ITERATIONS)
    except (AvisError, np.linalg.LinAlgError, FloatingPointError):
        return None


def _greedy(gram: np.ndarray, fall: np.ndarray, labels: list[tuple[str, float]]) -> dict[str, float]:
    """Ways of moving and their frequencies, one after the other, each the best beside those before it.

    A way that adds little, or would need a negative mass, is taken as stiff.
    """
    best: dict[str, float] = {}
    took = 0.0
    while True:
        rows = [labels.index((way, f)) for way, f in best.items()]
        trials = []
        for k, (way, _) in enumerate(labels):
            if way not in best:
                own = [*rows, k]
                one = reduction(gram[np.ix_(own, own)], fall[own])
                if np.all(one.coefficients > 0):
                    trials.append((one.chi2, k))
        if not trials or max(trials)[0] < 1.05 * took:
            return best
        took, k = max(trials)
        best[labels[k][0]] = labels[k][1]
