"""The chassis under the mounts: it recoils."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from operator import attrgetter

import numpy as np

from avis_ctrl.errors import AvisError
from avis_ctrl.gap.effects.base import EffectParameter, Table, Values, differs_from_zero, register
from avis_ctrl.gap.effects.impedance import recoils
from avis_ctrl.gap.effects.mounts import OfMounts
from avis_ctrl.gap.effects.sensors import receptance
from avis_ctrl.gap.operators import Operators
from avis_ctrl.gap.score import Score, reduction
from avis_ctrl.gap.starting_values import Seed
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.identification.maximum_likelihood import LikelihoodFit, fit
from avis_ctrl.identification.noise import relative_noise
from avis_ctrl.identification.spectra import thinned
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.rigs.rigid_body import point_map

COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
# Coordinates that the low centre of mass of a frame couples, so that one can compensate for the other.
TOGETHER = (("x", "ry"), ("y", "rx"), ("z",), ("rz",))


@dataclass(frozen=True)
class ChassisSettings:
    """Settings of the search for the starting values of a chassis.

    A coordinate is one of x, y, z, rx, ry, rz of the chassis. The gap is chi-square minus its degrees of freedom.
    Weights relative to the response mean noise of a given fraction of the response, added to the measured noise.

    own_Hz : lowest and highest resonance frequency [Hz] of a single coordinate, and number of frequencies searched;
        below the lowest, the suspension modes dominate.
    stiff_Hz : frequency of a coordinate in which no resonance was found [Hz]: near the end of the band.
    first_damping : damping ratio of that search [1]: large enough that the grid misses no resonance.
    least_gain : reduction of chi-square with one more coordinate over that without it, below which that coordinate
        counts as stiff [1].
    mass_ratio : ratio of the masses of two coordinates, up to which both can belong to one chassis [1].
    alike_Hz : lowest and highest frequency [Hz] of initial points with one frequency for all coordinates, and their
        number.
    alike_mass : mass at these points over that of the payload [1].
    alike_shape : radii of gyration about x, y, z, height of the mass, and height of the springs above the mass [m] at
        these points: for a frame as large as a table.
    lines, more_lines : lines of a record for short fits, and for the last one: more lines separate minima that few
        lines do not.
    wide : chi-square per degree of freedom above which initial points with one frequency are tried, and coordinates are
        refined one by one.
    steep : chi-square per degree of freedom above which fits start with weights relative to the response.
    fractions : of the response, for these weights, in this order; the last fit uses the measured noise.
    tried : (number of starts, iterations of each fit) of successive rounds; each round continues the best fits of the
        previous one.
    tried_by_fractions : the same with weights relative to the response, which need only one round: the first-order
        prediction is accurate there.
    later_iterations : iterations of a fit that continues an earlier one.
    converged : chi-square per degree of freedom up to which the fits with relative weights have reached the minimum.
    promising : fraction of the gap that may remain after a start or a step for it to be continued.
    followed : fraction of the gap up to which a fit is refined one coordinate after the other.
    followed_fits : number of fits refined in this coordinate, the best first.
    negligible : fraction of the gap below which relative weights have nothing more to explain.
    explained : chi-square per degree of freedom below which the measured noise explains the residual.
    elsewhere : other frequencies of a coordinate, over the median of all coordinates [1].
    rounds : maximum number of coordinates that are changed one after the other.
    followed_groups : groups of coupled coordinates from which a fit of all parameters is repeated, the most promising
        first.
    """

    own_Hz: tuple[float, float, int] = (7.0, 90.0, 26)
    stiff_Hz: float = 90.0
    first_damping: float = 0.06
    least_gain: float = 1.05
    mass_ratio: float = 3.0
    alike_Hz: tuple[float, float, int] = (6.0, 90.0, 13)
    alike_mass: float = 2.0
    alike_shape: tuple[float, ...] = (0.45, 0.45, 0.45, -0.4, -0.1)
    lines: int = 50
    more_lines: int = 150
    wide: float = 1.3
    steep: float = 100.0
    fractions: tuple[float, ...] = (0.3, 0.03)
    tried: tuple[tuple[int, int], ...] = ((7, 4), (3, 8))
    tried_by_fractions: tuple[tuple[int, int], ...] = ((3, 12),)
    later_iterations: int = 8
    converged: float = 2.0
    promising: float = 0.8
    followed: float = 0.25
    followed_fits: int = 2
    negligible: float = 0.01
    explained: float = 1.1
    elsewhere: tuple[float, ...] = (0.65, 0.8, 1.0, 1.25, 1.55)
    rounds: int = 6
    followed_groups: int = 2


SETTINGS = ChassisSettings()


@register
class BaseCompliance(OfMounts):
    """The chassis, a rigid body on a soft base: it recoils from mounts and motors, and filters the floor motion.

    c = B (f_mounts + (s C_b + K_b) w), B = inv(s^2 M_c + s C_b + K_b). translation : each axis by itself. rocking :
    with rotations; the mass and the springs of the base have their own heights.
    """

    name = "base_compliance"
    title = "the chassis stands on something soft and recoils"
    looks_like = "one more resonance in every channel, and less floor motion above it"
    at = ("chassis/translation", "chassis/rocking")
    holds_states = True
    resonant = True

    def parameters(self, model: Table, place: str) -> tuple[EffectParameter, ...]:
        m = model.rig.mounted_body().mass

        def frequency(coordinate: str) -> EffectParameter:
            about = f"along {coordinate}" if len(coordinate) == 1 else f"about {coordinate[1]}"
            return EffectParameter(
                f"{coordinate}_Hz",
                "Hz",
                f"of the chassis on its base, {about}",
                0.0,
                1.0,
                300.0,
                10.0,
                False,
                (20.0,),
                True,
            )

        found = (
            EffectParameter("mass_kg", "kg", "of the chassis", 0.0, 0.05 * m, 400 * m, m, False, (2 * m,)),
            EffectParameter("damping", "1", "damping ratio", 0.0, 1e-3, 1.0, 0.05, False, (0.06,), True),
            *(frequency(coordinate) for coordinate in COORDINATES[:3]),
        )
        if place.endswith("translation"):
            return found
        return (
            *found,
            *(frequency(coordinate) for coordinate in COORDINATES[3:]),
            *(
                EffectParameter(
                    f"gyration_{axis}_m",
                    "m",
                    f"radius of gyration about {axis}",
                    0.0,
                    0.03,
                    5.0,
                    0.3,
                    False,
                    (0.5,),
                    True,
                )
                for axis in "xyz"
            ),
            EffectParameter(
                "centre_z_m",
                "m",
                "height of its mass over the table's centre",
                0.0,
                -3.0,
                1.0,
                0.3,
                False,
                (-0.5,),
                True,
            ),
            EffectParameter(
                "base_z_m", "m", "height of its springs over its mass", 0.0, -2.0, 2.0, 0.3, False, (0.0,), True
            ),
        )

    def seeds(self, score: Score, place: str) -> list[Seed]:
        """The result of short fits to few lines, then the best resonance of each coordinate by itself.

        The short fits start from these resonances, and from points with one frequency for all coordinates, the best by
        the score test with all parameters. The best fit is then refined with other frequencies of one coordinate after
        the other. All these fits keep the tolerances fixed. If the tolerances imitate the chassis, only a fit of all
        parameters finds it, and it must start from the single resonances.

        With six resonances of 1 % damping, each off by several half-widths, a fit weighted by the measured noise stops
        in a local minimum. Weights relative to the response, as in a Bode plot, widen the minimum; the last fit uses
        the measured noise.
        """
        blocks = [thinned(part.block, SETTINGS.lines, seed=2) for part in score.parts]
        own = self._by_coordinate(score, place)
        few = Score(score.model, blocks).chi2
        wide, steep = (score.chi2 > times * score.dof for times in (SETTINGS.wide, SETTINGS.steep))
        starts = [one.values for one in own]
        relative = [
            [_with_relative_noise(block, fraction) for block in blocks]
            for fraction in (SETTINGS.fractions if steep else ())
        ]
        reached = self._followed(score.model, place, starts, [*relative, blocks], wide)
        if steep and starts and (reached is None or reached.chi2 > SETTINGS.converged * reached.dof):
            straight = self._followed(score.model, place, starts, [blocks], False)
            reached = min((one for one in (reached, straight) if one is not None), key=attrgetter("chi2"), default=None)
        if reached is None:
            return own
        if wide and reached.chi2 - reached.dof < SETTINGS.followed * (few - reached.dof):
            more = [thinned(part.block, SETTINGS.more_lines, seed=2) for part in score.parts]
            made = _short_fit(reached.model, more, SETTINGS.later_iterations)
            if made is not None:
                few = Score(score.model, more).chi2
                near = made.chi2 - made.dof < SETTINGS.followed * (few - made.dof)
                reached = self._one_by_one(made, place, more, made.dof, SETTINGS.explained * made.dof) if near else made
        # The rig's parameters fit part of the noise with and without the chassis, so only those of the chassis count.
        # The frequency of each coordinate was chosen from a grid: any combination could have been the best.
        values = _effect(reached).values
        found = Seed(
            values,
            score.chi2 - score.chi2 / max(few, 1.0) * reached.chi2,
            len(values),
            SETTINGS.own_Hz[2] ** len(_coordinates(place)),
            few - reached.chi2,
        )
        return [found, *own] if found.chi2 > 0 else own

    def extended_models(self, score: Score, one: ActiveEffect) -> list[tuple[str, tuple[float, ...]]]:
        """The same law with other frequencies of coupled coordinates."""
        blocks = [thinned(part.block, SETTINGS.lines, seed=2) for part in score.parts]
        rest = score.model.without(one.label)
        here = Score(self._standing(rest, one.place, one.values), blocks)
        if here.chi2 < SETTINGS.explained * here.dof:
            return []
        found = self._best_elsewhere(rest, one, blocks)[: SETTINGS.followed_groups]
        return [(one.place, values) for chi2, values in found if chi2 < np.inf]

    def _followed(
        self,
        model: TableModel,
        place: str,
        starts: Sequence[tuple[float, ...]],
        weights: Sequence[Sequence[SpectralBlock]],
        wide: bool,
    ) -> LikelihoodFit[TableModel] | None:
        """The best fit from these starts with the first weights, continued with the later ones; None if all fail.
        wide : also start from one frequency for all coordinates, and refine one coordinate after the other."""
        first, *later = weights
        start = Score(model, first)
        # Relative weights are not noise: all of chi-square counts as the gap.
        noise = 0 if later else start.dof
        gap = start.chi2 - noise
        alike = [
            values
            for chi2, values in (self._alike(model, place, first) if wide else [])
            if chi2 - noise < SETTINGS.promising * gap or not later
        ]
        trials = [self._standing(model, place, values) for values in [*starts, *alike]]
        made: list[LikelihoodFit[TableModel]] = []
        for most, iterations in SETTINGS.tried_by_fractions if later else SETTINGS.tried:
            fits = [_short_fit(one, first, iterations) for one in trials[:most]]
            made = sorted((one for one in fits if one is not None), key=attrgetter("chi2"))
            trials = [one.model for one in made]
        enough = SETTINGS.negligible * gap if later else SETTINGS.explained * noise
        for one in made[: SETTINGS.followed_fits] if wide else []:
            if one.chi2 - noise < SETTINGS.followed * gap and made[0].chi2 > enough:
                made = sorted([*made, self._one_by_one(one, place, first, noise, enough)], key=attrgetter("chi2"))
        reached = made[0] if made else None
        for then in later:
            reached = reached and _short_fit(reached.model, then, SETTINGS.later_iterations)
        return reached

    def _alike(
        self, model: TableModel, place: str, blocks: Sequence[SpectralBlock]
    ) -> list[tuple[float, tuple[float, ...]]]:
        """(expected chi-square, values) of starts with one frequency for all coordinates, the best first."""
        payload = model.rig.mounted_body().mass
        coordinates = _coordinates(place)
        shape = SETTINGS.alike_shape if len(coordinates) > 3 else ()
        starts = [
            (SETTINGS.alike_mass * payload, 0.05, *[f] * len(coordinates), *shape)
            for f in np.geomspace(*SETTINGS.alike_Hz).tolist()
        ]
        expected = [(self._expected(model, place, values, blocks), values) for values in starts]
        return sorted(one for one in expected if one[0] < np.inf)

    def _one_by_one(
        self,
        reached: LikelihoodFit[TableModel],
        place: str,
        blocks: Sequence[SpectralBlock],
        noise: float,
        enough: float,
    ) -> LikelihoodFit[TableModel]:
        """Refine a fit with other frequencies of coupled coordinates while chi-square comes closer to `noise`, its
        value for an exact model, and until it is below `enough`."""
        for _ in range(SETTINGS.rounds):
            if reached.chi2 < enough:
                return reached
            now = _effect(reached)
            rest = reached.model.without(now.label)
            chi2, values = self._best_elsewhere(rest, now, blocks)[0]
            if chi2 - noise > SETTINGS.promising * (reached.chi2 - noise):
                return reached
            made = _short_fit(self._standing(rest, place, values), blocks, SETTINGS.later_iterations)
            if made is None or made.chi2 - noise > SETTINGS.promising * (reached.chi2 - noise):
                return reached
            reached = made
        return reached

    def _best_elsewhere(
        self, rest: TableModel, one: ActiveEffect, blocks: Sequence[SpectralBlock]
    ) -> list[tuple[float, tuple[float, ...]]]:
        """(expected chi-square, values) of the best start with other frequencies in each group of coupled coordinates,
        the best first. The parameters of the other coordinates can compensate for a wrong frequency, which makes a
        local minimum that no descent can escape."""
        return sorted(
            min((self._expected(rest, one.place, moved, blocks), moved) for moved in group) for group in _elsewhere(one)
        )

    def _expected(
        self, model: TableModel, place: str, values: tuple[float, ...], blocks: Sequence[SpectralBlock]
    ) -> float:
        """Chi-square expected after one step of all parameters from a start; infinite if the step fails."""
        try:
            return Score(self._standing(model, place, values), blocks).chi2
        except (AvisError, np.linalg.LinAlgError):
            return np.inf

    def _standing(self, model: TableModel, place: str, values: tuple[float, ...]) -> TableModel:
        return model.with_effect(ActiveEffect(self, place, self.parameters(model, place), values))

    def _by_coordinate(self, score: Score, place: str) -> list[Seed]:
        """Seeds from the best resonance of each coordinate by itself; the masses are estimated together."""
        coordinates = _coordinates(place)
        zeta, grid = SETTINGS.first_damping, np.geomspace(*SETTINGS.own_Hz)
        rows, labels = [], []
        for f in grid:
            key = ("recoil", float(f))
            if key not in score.kept:
                score.kept[key] = recoils(score, partial(receptance, frequency_Hz=f, damping=zeta))
            rows.append(score.kept[key][: len(coordinates)])
            labels += [(coordinate, float(f)) for coordinate in coordinates]
        A = np.concatenate(rows)
        gram, product = A @ A.T, A @ score.e
        best = _greedy(gram, product, labels)
        moving = [coordinate for coordinate in best if len(coordinate) == 1]
        if not moving:
            return []
        chosen = [labels.index((coordinate, f)) for coordinate, f in best.items()]
        took = reduction(gram[np.ix_(chosen, chosen)], product[chosen])
        inverse = dict(zip(best, took.coefficients, strict=True))
        # The first coordinate found determines the mass best; one with a different mass is not a recoil of the chassis.
        leader = inverse[moving[0]]
        if leader <= 0:
            return []
        ratio = SETTINGS.mass_ratio
        best = {
            coordinate: f
            for coordinate, f in best.items()
            if len(coordinate) > 1 or leader / ratio < inverse[coordinate] < ratio * leader
        }
        mass = self.parameters(score.model, place)[0]
        m = float(np.clip(1 / leader, 2 * mass.low, mass.high / 2))
        at = {coordinate: best.get(coordinate, SETTINGS.stiff_Hz) for coordinate in coordinates}
        values = [m, zeta, *(at[coordinate] for coordinate in coordinates[:3])]
        if len(coordinates) > 3:
            radii = [
                np.sqrt(1 / (inverse[coordinate] * m)) if inverse.get(coordinate, 0.0) > 0 else 0.6
                for coordinate in coordinates[3:]
            ]
            values += [
                *(at[coordinate] for coordinate in coordinates[3:]),
                *np.clip(radii, 0.1, 3.0).tolist(),
                -0.3,
                0.0,
            ]
        return [Seed(tuple(float(v) for v in values), took.chi2, 2 * len(best))]

    def implausible(self, values: Values, std: Values) -> str:
        return (
            ""
            if differs_from_zero(values, std, ["mass_kg"])
            else ("a chassis so heavy that the data do not distinguish it from a fixed one")
        )

    def change(self, ops: Operators, place: str, values: Values) -> None:
        mass, damping, stiffness = of_chassis(values)
        s = ops.s[:, None, None]
        tied = stiffness + s * damping
        if "rx_Hz" in values:
            B = np.linalg.inv(s**2 * mass + tied)
            H = B @ tied[:, :, :3]
        else:
            B, H, along = np.zeros((len(s), 6, 6), complex), np.zeros((len(s), 6, 3), complex), range(3)
            held = tied[:, along, along]
            D = s[:, :, 0] ** 2 * mass[along, along] + held
            B[:, along, along], H[:, along, along] = 1 / D, held / D
        ops.recoil, ops.follow = B, H


def _coordinates(place: str) -> tuple[str, ...]:
    """Coordinates in which a chassis moves."""
    return COORDINATES[:3] if place.endswith("translation") else COORDINATES


def of_chassis(values: Values) -> np.ndarray:
    """(3, 6, 6) mass, damping and stiffness of a chassis on its base, in the payload's coordinates about the table's
    centre; zero in the coordinates in which it does not move."""
    radii = [1.0, 1.0, 1.0, *(values.get(f"gyration_{axis}_m", 0.0) for axis in "xyz")]
    inertia = values["mass_kg"] * np.square(radii)
    w = 2 * np.pi * np.array([values.get(f"{coordinate}_Hz", 0.0) for coordinate in COORDINATES])
    found = np.zeros((3, 6, 6))
    centre = np.array([0.0, 0.0, values.get("centre_z_m", 0.0)])
    G, below = point_map(centre), point_map(centre + np.array([0.0, 0.0, values.get("base_z_m", 0.0)]))
    each = (inertia, 2 * values["damping"] * inertia * w, inertia * w**2)
    for which, place, one in zip(found, (G, below, below), each, strict=True):
        which += place.T @ np.diag(one[:3]) @ place
        which[3:, 3:] += np.diag(one[3:])
    return found


def _with_relative_noise(block: SpectralBlock, fraction: float) -> SpectralBlock:
    """The block with noise of this fraction of its response added to its noise."""
    (relative,) = relative_noise([block], fraction)
    assert block.noise is not None and relative.noise is not None
    return block.with_noise(block.noise + relative.noise, block.dof)


def _elsewhere(one: ActiveEffect) -> list[list[tuple[float, ...]]]:
    """Values of a chassis with other frequencies, relative to the median of all coordinates; one list for each group of
    coupled coordinates."""
    names = [parameter.name for parameter in one.parameters]
    free = [coordinate for coordinate in COORDINATES if f"{coordinate}_Hz" in names]
    middle = np.median([one.by_name[f"{coordinate}_Hz"] for coordinate in free])

    def moved(coordinates: Sequence[str], factors: Sequence[float | None]) -> tuple[float, ...]:
        values = list(one.values)
        for coordinate, factor in zip(coordinates, factors, strict=True):
            if factor is None:
                continue
            k = names.index(f"{coordinate}_Hz")
            values[k] = float(min(factor * middle, 0.9 * one.parameters[k].high))
            if len(coordinate) > 1:
                values[names.index(f"gyration_{coordinate[1]}_m")] = SETTINGS.alike_shape[0]
        return tuple(values)

    groups = [[coordinate for coordinate in together if coordinate in free] for together in TOGETHER]
    # The frequency of one of two coordinates may be right.
    return [
        [
            moved(coordinates, factors)
            for factors in product((None, *SETTINGS.elsewhere), repeat=len(coordinates))
            if any(factors)
        ]
        for coordinates in groups
        if coordinates
    ]


def _effect(found: LikelihoodFit[TableModel]) -> ActiveEffect:
    return found.model.effects[-1]


def _short_fit(model: TableModel, blocks: Sequence[SpectralBlock], iterations: int) -> LikelihoodFit[TableModel] | None:
    try:
        return fit(model, blocks, model.priors, max_iterations=iterations)
    except (AvisError, np.linalg.LinAlgError, FloatingPointError):
        return None


def _greedy(gram: np.ndarray, product: np.ndarray, labels: list[tuple[str, float]]) -> dict[str, float]:
    """Greedy selection of coordinates and their frequencies; each adds the largest reduction to the previous ones.

    A coordinate that adds little, or would need a negative mass, counts as stiff.
    """
    best: dict[str, float] = {}
    took = 0.0
    while True:
        rows = [labels.index((coordinate, f)) for coordinate, f in best.items()]
        trials = []
        for k, (coordinate, _) in enumerate(labels):
            if coordinate not in best:
                own = [*rows, k]
                one = reduction(gram[np.ix_(own, own)], product[own])
                if np.all(one.coefficients > 0):
                    trials.append((one.chi2, k))
        if not trials or max(trials)[0] < SETTINGS.least_gain * took:
            return best
        took, k = max(trials)
        best[labels[k][0]] = labels[k][1]
