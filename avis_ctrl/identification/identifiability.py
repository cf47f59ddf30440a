"""Combinations of a rig's parameters that the data determine, and those that they do not, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.identification.identifiability_text import (
    combination_text,
    group_sentence,
    scaling_sentence,
    unit_text,
    weak_direction_sentence,
    weak_sentence,
)
from avis_ctrl.identification.information import SETTINGS as INFORMATION
from avis_ctrl.identification.information import Combination, Information
from avis_ctrl.identification.response import ResponseModel, size_of
from avis_ctrl.identification.structural_identifiability import Structure, structural_null_space, structure_of


@dataclass(frozen=True)
class IdentifiabilitySettings:
    """weak : relative standard deviation above which a combination is called weak [1]: scales and data sheets are as
    good."""

    weak: float = 0.05


SETTINGS = IdentifiabilitySettings()


@dataclass(frozen=True, eq=False)
class IdentifiabilityReport:
    """Interpretation of an information matrix.

    Attributes
    ----------
    rank, condition : how many combinations are determined, conditioning of those.
    combinations : as many as the structure allows; their standard deviation may still be infinite if the data are too
        poor. unseen : directions that no such data show, in the parameters' units. sentences : all of it in words.
    """

    information: Information
    rank: int
    condition: float
    structure: Structure
    combinations: tuple[Combination, ...]
    unseen: tuple[Mapping[str, float], ...]
    sentences: tuple[str, ...]


def identifiability_report(
    information: Information,
    model: ResponseModel | None = None,
    floor: bool = False,
    priors: Mapping[str, float] | None = None,
) -> IdentifiabilityReport:
    """Rank, combinations and sentences.

    Parameters
    ----------
    model : separates what no data could show (exactly) from what these data show too poorly. Without it, everything
        that the information leaves undetermined is taken as the former, with the precision of round-off.
    floor : whether a record with measured floor is part of the data.
    priors : standard deviations of parameters that are part of the information.

    Raises
    ------
    InputError : a model of other parameters.
    """
    if model is not None and model.names != information.names:
        raise InputError(
            f"expected a model with the free parameters {', '.join(information.names)}",
            field="model",
            value=model.names,
        )
    values, units, names = information.values, information.units, information.names
    if model is None:
        null, own = information.null_space, information.null_space
        structure = structure_of(null, values, units, names, 1e-3)
    else:
        own = _orthonormal(structural_null_space(model, floor) * (model.scales() / information.scale)[:, None])
        null = _left_dark(information, own)
        # The structure uses relative units of the values.
        structure = structure_of(
            _orthonormal(null * (information.scale / size_of(values))[:, None]), values, units, names
        )
    of_groups = [[_combination(information, structure, row) for row in group.seen] for group in structure.groups]
    alone = [_combination(information, structure, row) for row in np.eye(len(names))[list(structure.singles)]]
    places = [min(group.members) for group in structure.groups for _ in group.seen]
    found = [one for own in of_groups for one in own] + alone
    order = np.argsort([*places, *structure.singles], kind="stable")
    combinations = tuple(found[k] for k in order)
    unseen = tuple(_by_name(row, names) for group in structure.groups for row in group.unseen)
    said = _sentences(information, structure, combinations, of_groups, alone)
    if model is not None and own.shape[1] > null.shape[1]:
        said = (*said, _prior_sentence(own.shape[1] - null.shape[1], priors or {}))
    return IdentifiabilityReport(
        information, information.rank, information.condition, structure, combinations, unseen, said
    )


def _orthonormal(basis: np.ndarray) -> np.ndarray:
    return np.linalg.qr(basis)[0] if basis.size else basis


def _left_dark(information: Information, null: np.ndarray) -> np.ndarray:
    """Directions of a null space of the equations on which priors give no information either."""
    if not null.shape[1]:
        return null
    inside = null.T @ information.relative @ null
    values, vectors = np.linalg.eigh((inside + inside.T) / 2)
    floor = 4 * len(null) * np.finfo(float).eps * np.max(np.linalg.eigvalsh(information.relative))
    return null @ vectors[:, values <= max(1 / INFORMATION.undetermined**2, floor)]


def _combination(information: Information, structure: Structure, row: np.ndarray) -> Combination:
    """The sum row @ theta, multiplied by powers of the pins that make it invariant to the scalings."""
    values, units, names = information.values, information.units, information.names
    inside = np.flatnonzero(row)
    value, gradient = float(row @ values), np.array(row, float)
    powers: dict[int, float] = {}
    if structure.scalings:
        exponents = np.array([one.exponents for one in structure.scalings])
        pins = [one.pin for one in structure.scalings]
        of_pins = np.linalg.solve(exponents[:, pins], exponents[:, inside[0]])
        powers = {pin: -power for pin, power in zip(pins, np.round(of_pins, 9), strict=True) if power}
        total = value
        for pin, power in powers.items():
            total *= values[pin] ** power
        gradient = gradient * (total / value) if value else gradient
        for pin, power in powers.items():
            gradient[pin] += power * total / values[pin]
        value = total
    sigma = information.of(gradient)[1]
    text = combination_text([(names[j], row[j]) for j in inside], [(names[j], p) for j, p in powers.items()])
    unit = unit_text(_common([units[j] for j in inside]), [(units[j], p) for j, p in powers.items()])
    return Combination(_by_name(gradient, names), value, sigma, unit, text)


def _common(units: Sequence[str]) -> str:
    return units[0] if len(set(units)) == 1 else "mixed units"


def _by_name(row: np.ndarray, names: Sequence[str]) -> dict[str, float]:
    return {name: float(weight) for name, weight in zip(names, row, strict=True) if weight}


def _sentences(
    information: Information,
    structure: Structure,
    combinations: Sequence[Combination],
    of_groups: Sequence[Sequence[Combination]],
    singles: Sequence[Combination],
) -> tuple[str, ...]:
    names, count = information.names, len(information.names)
    alone = [name for name, known in zip(names, information.known, strict=True) if known]
    said = [
        f"The data determine {information.rank} combinations of the {count} parameters; the relative standard "
        f"deviations of the most and the least precise one differ by a factor of "
        f"{np.sqrt(information.condition):.3g}."
        if information.rank
        else f"The data determine none of the combinations of the {count} parameters."
    ]
    if len(alone) == count:
        said.append("Every parameter is determined individually.")
    elif alone:
        said.append(f"Determined individually ({len(alone)}): {', '.join(alone)}.")
    said += [scaling_sentence(one, information) for one in structure.scalings]
    if structure.scalings:
        shared = [one.words for one in singles if one.words not in names]
        if shared:
            said.append(f"Determined as such ratios and products ({len(shared)}): {', '.join(shared)}.")
    for group, seen in zip(structure.groups, of_groups, strict=True):
        said.append(group_sentence([names[j] for j in group.members], seen))
    poor = [one for one in combinations if not one.determined]
    if poor:
        said.append(
            f"Identifiable by the equations, but not determined by these data (standard deviation above the "
            f"value itself): {', '.join(one.words for one in poor)}."
        )
    weak = sorted(
        (one for one in combinations if one.determined and one.relative > SETTINGS.weak), key=lambda one: -one.relative
    )
    said += [weak_sentence(one) for one in weak]
    sigma, V = information.directions
    last = information.rank - 1
    if last >= 0 and sigma[last] > SETTINGS.weak:
        said.append(weak_direction_sentence(names, V[:, last], float(sigma[last])))
    return tuple(said)


def _prior_sentence(count: int, priors: Mapping[str, float]) -> str:
    named = f" on {', '.join(priors)}" if 0 < len(priors) <= 6 else ""
    return (
        f"{count} of the combinations are determined by the priors{named} alone: these data contain no information "
        "on them, and more data of the same kind would not, either."
    )
