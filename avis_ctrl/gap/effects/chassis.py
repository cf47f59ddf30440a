"""What the mounts stand on: a chassis that recoils."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import cast

import numpy as np

from avis_ctrl.errors import AvisError
from avis_ctrl.gap.effects.base import Effect, EffectParameter, Table, register, told_from_none
from avis_ctrl.gap.effects.impedance import recoils
from avis_ctrl.gap.effects.mounts import has_mounts
from avis_ctrl.gap.effects.sensors import receptance
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.score import Score, reduction
from avis_ctrl.gap.starting_values import Seed
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.identification.maximum_likelihood import LikelihoodFit, fit
from avis_ctrl.identification.noise import relative_noise
from avis_ctrl.identification.response import ResponseModel
from avis_ctrl.identification.spectra import thinned
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs.rigid_body import point_map

WAYS = ("x", "y", "z", "rx", "ry", "rz")
# Below this the suspension's own modes are in the way of the first look.
LOWEST_Hz = 7.0
# Where a way of moving is looked for that the score finds nothing in [Hz].
STIFF_Hz = 90.0
# Starts of which the most promising are followed: mass over the payload's, frequencies alike along all ways, and
# radii of gyration and heights [m] of a frame of a table's size.
TRIAL_MASS, TRIAL_Hz = 2.0, tuple(np.geomspace(6.0, 90.0, 13).tolist())
SHAPE = (0.45, 0.45, 0.45, -0.4, -0.1)
# Lines of a record; what follows only where the gap is more than this times the noise.
TRIAL_LINES, PLAIN = 50, 1.3
# Of the starts that one step makes most promising so many are fitted with so many iterations, and then the best of
# these; by shares of the response, where the step is a good guide and four iterations lead half way, in one go.
TRIED, TRIED_BY_SHARES = ((7, 4), (3, 8)), ((3, 12),)
# Where the gap is more than this times the noise, starts are followed by weights that ask at first for these shares of
# the response, with so many iterations by the next ones; where that leads to no end at this times the noise, what each
# way by itself tells is followed by the noise's own, too.
STEEP, SHARES, LATER_ITERATIONS, AN_END = 100.0, (0.3, 0.03), 8, 2.0
# A start by a share of the response, or a step along one way, is taken where it leaves less than this of the gap; and
# ways are looked at one by one where all together leave less than that, of so many starts.
PROMISING, FOLLOWED, BOTH = 0.8, 0.25, 2
# By a share of the response nothing is left where it is less than this of the gap.
NOTHING = 0.01
# Where a chassis leaves more than so many times the noise, its ways are looked at again by so many lines of a record,
# which tell minima apart that few do not.
NOT_YET, MORE_LINES = 1.1, 150
# Where else the frequency of one way is looked for, over the median of all ways, and how often.
ELSEWHERE, ROUNDS = (0.65, 0.8, 1.0, 1.25, 1.55), 6
# Ways of which a frame's low mass makes two modes, so that one may stand for the other.
TOGETHER = (("x", "ry"), ("y", "rx"), ("z",), ("rz",))


@register
class BaseCompliance(Effect):
    """The chassis, a rigid body on something soft: it recoils from mounts and motors, and filters the floor.

    c = B (f_mounts + (s C_b + K_b) w), B = inv(s^2 M_c + s C_b + K_b), each along its own axis (translation), or with
    rotation too, the mass at its own height and the springs of the base at theirs.
    """

    name = "base_compliance"
    title = "the chassis stands on something soft and recoils"
    looks_like = "one more resonance in every channel, and less floor motion above it"
    holds_states = True
    resonant = True

    def places(self, model: Table) -> tuple[str, ...]:
        return ("chassis/translation", "chassis/rocking") if has_mounts(model) else ()

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
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
        of like frequencies along all ways, where one step of all parameters together is expected to lead furthest. The
        best is followed, each way of moving sought elsewhere beside the others.

        Six resonances of a per cent of damping, each some widths away from where it is sought: by the noise's own
        weights every line between them is a wall. By weights relative to the response, as of one who looks at a Bode
        plot, they are slopes; from there the weights go to those of the noise.
        """
        blocks = [thinned(part.block, TRIAL_LINES, seed=2) for part in score.parts]
        own = self._by_ways(score, place)
        few = Score(score.model, blocks).chi2
        wide, steep = (score.chi2 > times * score.dof for times in (PLAIN, STEEP))
        starts = [one.values for one in own]
        shares = [[_with_share(block, share) for block in blocks] for share in (SHARES if steep else ())]
        reached = self._followed(score.model, place, starts, [*shares, blocks], wide)
        if steep and starts and (reached is None or reached.chi2 > AN_END * reached.dof):
            straight = self._followed(score.model, place, starts, [blocks], False)
            reached = min((one for one in (reached, straight) if one is not None), key=_chi2, default=None)
        if reached is None:
            return own
        if wide and reached.chi2 - reached.dof < FOLLOWED * (few - reached.dof):
            more = [thinned(part.block, MORE_LINES, seed=2) for part in score.parts]
            made = _short_fit(cast(TableModel, reached.model), more, LATER_ITERATIONS)
            if made is not None:
                few = Score(score.model, more).chi2
                near = made.chi2 - made.dof < FOLLOWED * (few - made.dof)
                reached = self._way_by_way(made, place, more, made.dof, NOT_YET * made.dof) if near else made
        # On few lines the rig's parameters take their part of the noise, too.
        found = Seed(_effect(reached).values, score.chi2 - score.chi2 / max(few, 1.0) * reached.chi2,
                     len(reached.model.names), len(own) + len(TRIAL_Hz), few - reached.chi2)
        return [found] if found.chi2 > 0 else own

    def _followed(self, model: TableModel, place: str, starts: Sequence[tuple[float, ...]],
                  weights: Sequence[Sequence[SpectralBlock]], wide: bool) -> LikelihoodFit | None:
        """The best of what starts lead to by the first weights, followed by the others. wide : with those of one
        frequency, and way by way."""
        first, *later = weights
        start = Score(model, first)
        # What a share of the response adds to the noise is none: all that is left counts.
        noise = 0 if later else start.dof
        gap = start.chi2 - noise
        alike = [values for left, values in (self._alike(model, place, first) if wide else [])
                 if left - noise < PROMISING * gap or not later]
        trials = [self._standing(model, place, values) for values in [*starts, *alike]]
        made: list[LikelihoodFit] = []
        for most, iterations in TRIED_BY_SHARES if later else TRIED:
            fits = [_short_fit(one, first, iterations) for one in trials[:most]]
            made = sorted((one for one in fits if one is not None), key=_chi2)
            trials = [cast(TableModel, one.model) for one in made]
        enough = NOTHING * gap if later else NOT_YET * noise
        for one in made[:BOTH] if wide else []:
            if one.chi2 - noise < FOLLOWED * gap and made[0].chi2 > enough:
                made = sorted([*made, self._way_by_way(one, place, first, noise, enough)], key=_chi2)
        reached = made[0] if made else None
        for then in later:
            reached = reached and _short_fit(cast(TableModel, reached.model), then, LATER_ITERATIONS)
        return reached

    def _alike(self, model: TableModel, place: str, blocks: Sequence[SpectralBlock]
               ) -> list[tuple[float, tuple[float, ...]]]:
        """Starts of one frequency along all ways, the most promising first, and the chi-square expected of each."""
        payload = model.rig.mounted_body().mass
        shape = () if place.endswith("translation") else SHAPE
        starts = [(TRIAL_MASS * payload, 0.05, *[f] * (6 if shape else 3), *shape) for f in TRIAL_Hz]
        expected = [(self._expected(model, place, values, blocks), values) for values in starts]
        return sorted(one for one in expected if one[0] < np.inf)

    def _way_by_way(self, reached: LikelihoodFit, place: str, blocks: Sequence[SpectralBlock],
                    noise: float, enough: float) -> LikelihoodFit:
        """A fit with the frequencies of ways that go together sought elsewhere, as long as that brings it nearer to
        `noise`, the chi-square of an exact model, and until it is `enough`. With ten parameters of the others, which
        may stand for them, nothing leads there downhill."""
        for _ in range(ROUNDS):
            if reached.chi2 < enough:
                return reached
            now = _effect(reached)
            rest = cast(TableModel, reached.model).without(now.label)
            left, values = min((self._expected(rest, place, moved, blocks), moved) for moved in _elsewhere(now))
            if left - noise > PROMISING * (reached.chi2 - noise):
                return reached
            made = _short_fit(self._standing(rest, place, values), blocks, LATER_ITERATIONS)
            if made is None or made.chi2 - noise > PROMISING * (reached.chi2 - noise):
                return reached
            reached = made
        return reached

    def _expected(self, model: TableModel, place: str, values: tuple[float, ...], blocks: Sequence[SpectralBlock]
                  ) -> float:
        """Chi-square that one step of all parameters from a start is expected to leave; infinite without a step."""
        try:
            return Score(self._standing(model, place, values), blocks).chi2
        except (AvisError, np.linalg.LinAlgError):
            return np.inf

    def _standing(self, model: TableModel, place: str, values: tuple[float, ...]) -> TableModel:
        return model.with_effect(ActiveEffect(self, place, self.parameters(model, place), values))

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


def _with_share(block: SpectralBlock, share: float) -> SpectralBlock:
    """The block with noise of this share of its response beside its own."""
    relative, = relative_noise([block], share)
    assert block.noise is not None and relative.noise is not None
    return block.with_noise(block.noise + relative.noise, block.dof)


def _elsewhere(one: ActiveEffect) -> Iterator[tuple[float, ...]]:
    """Values of a chassis with the frequencies of ways that go together at others, around the median of all ways."""
    names = [parameter.name for parameter in one.parameters]
    free = [way for way in WAYS if f"{way}_Hz" in names]
    middle = np.median([one.by_name[f"{way}_Hz"] for way in free])
    for ways in [[way for way in together if way in free] for together in TOGETHER]:
        # One of two may be right as it is.
        for factors in product((None, *ELSEWHERE), repeat=len(ways)):
            moved = list(one.values)
            for way, factor in zip(ways, factors, strict=True):
                if factor is None:
                    continue
                k = names.index(f"{way}_Hz")
                moved[k] = float(min(factor * middle, 0.9 * one.parameters[k].high))
                if len(way) > 1:
                    moved[names.index(f"gyration_{way[1]}_m")] = SHAPE[0]
            if any(factors):
                yield tuple(moved)


def _effect(found: LikelihoodFit) -> ActiveEffect:
    return cast(TableModel, found.model).effects[-1]


def _chi2(one: LikelihoodFit) -> float:
    return one.chi2


def _short_fit(model: TableModel, blocks: Sequence[SpectralBlock], iterations: int) -> LikelihoodFit | None:
    try:
        return fit(cast(ResponseModel, model), blocks, model.priors, max_iterations=iterations)
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
