"""Plausibility check of a rig file: can it describe a real table, and if not, which unit error would explain it?

Natural frequencies, sag, damping ratios, mass per area, radii of gyration, travel of the drives, full scale and noise
of the sensors, delay and sample rate are computed from the file (`judged`). If one of them is out of range, each
possible unit error (`unit_slips`) is corrected in turn. The error whose correction brings all properties into range,
with the fewest unusual values, is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.rigs.file_errors import dotted
from avis_ctrl.rigs.plausible_ranges import RANGES, PlausibleRanges, Range
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import EquationsOfMotion, Modes
from avis_ctrl.rigs.unit_errors import Entry, G, Place, UnitError, apart, entries, unit_errors

Content = dict[str, Any]
Build = Callable[[Content], Rig]
Judge = Callable[..., None]
ALIKE = ("constant_N_per_V", "sensitivity_Vs_per_m", "sensitivity_Vs2_per_m", "sensitivity_V_per_m")


@dataclass(frozen=True)
class SlipCost:
    """Weights that decide which unit error ("slip") is the likeliest, in squared decades beyond the usual range.

    scope : times the squared scope (`UnitError.scope`). rank : per position in the list of likely wrong units.
    off_centre : if all properties of the table are at the ends of their usual ranges. apart : if the corrected numbers
    are a decade from the others of their kind (`unit_slips.apart`). near : a second field is named if its cost is
    within this of the best. near_unit : the same for another unit of the same numbers; less than `rank`, so that the
    most usual wrong unit alone is named if nothing else decides. better : an unusual rig is taken for a slip if the
    correction reduces the cost below this fraction.
    """

    scope: float = 0.02
    rank: float = 0.05
    off_centre: float = 1.0
    apart: float = 0.1
    near: float = 0.05
    near_unit: float = 0.03
    better: float = 0.3


COST = SlipCost()


class UnusualRig(UserWarning):
    """Warning, in one line, of a value in a rig file that is possible but unusual."""


@dataclass(frozen=True)
class Property:
    """A property of the table compared with its range.

    kind : name of the range. refused, unusual : decades beyond the possible and the usual range, 0 inside. off_centre :
    see `Range`. words : with number and unit. field, value : in the file, if it is the property of a single key.
    """

    kind: str
    refused: float
    unusual: float
    off_centre: float
    words: str
    field: str = ""
    value: Any = None


Properties = Callable[[Content], list[Property]]


def plausible(
    content: Content,
    build: Build,
    ranges: PlausibleRanges = RANGES,
    written: Callable[[Content], Content] | None = None,
) -> str:
    """Compare a file's content with the ranges of real tables; return one line on unusual values, empty if none.

    Parameters
    ----------
    content : of the TOML file. build : makes the rig from it, or raises InputError. written : if `content`
        holds the answers from which a file is written: the content of this file for given answers. Messages then name
        the answers.

    Raises
    ------
    InputError : the error of `build`, with the likely unit error if there is one; values that no real table has.
    """

    def properties(content: Content) -> list[Property]:
        of_file = written(content) if written else content
        return judged(of_file, build(of_file), ranges)

    try:
        found = properties(content)
    except InputError as error:
        likely = _likely(content, properties) if _of_numbers(error.value) else []
        if not likely:
            raise
        first, words = likely[0], error.expected
        if error.field and not error.field.startswith(first.field):
            words = f"it makes {error.field} invalid ({words})"
        raise InputError(f"{words}; {_asked(likely)}", field=first.field, value=first.value) from None
    odd = sorted((one for one in found if one.unusual > 1e-9), key=lambda one: (-one.refused, -one.unusual))
    if not odd:
        return ""
    refused = odd[0].refused > 0
    worst = {one.kind: one for one in reversed(odd) if one.refused > 0 or not refused}
    words = ", ".join([one.words for one in odd if worst.get(one.kind) is one][:2])
    likely = _likely(content, properties, np.inf if refused else _cost(found))
    if not refused:
        hint = f"; {likely[0].field}: {_asked(likely)}" if likely else ""
        return f"unusual for a table: {words}{hint}"
    if likely:
        raise InputError(
            f"{words}: not possible for a real table; {_asked(likely)}", field=likely[0].field, value=likely[0].value
        )
    raise InputError(
        f"{words}: not possible for a real table, and no single wrong unit explains it; check the units of the keys",
        field=odd[0].field or "payload, isolators or drives",
        value=odd[0].value,
    )


def _of_numbers(value: Any) -> bool:
    values = value if isinstance(value, (list, tuple)) else [value]
    return bool(len(values)) and all(isinstance(one, (int, float)) and not isinstance(one, bool) for one in values)


def _asked(likely: Sequence[UnitError]) -> str:
    first, *others = likely
    also = "".join(
        f", or {'' if one.field == first.field else f'{one.field} = '}{_shown(one.meant)} ({one.words})"
        for one in others[:1]
    )
    return f"did you mean {_shown(first.meant)} ({first.words}){also}?"


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(f'{one:g}' for one in value[:3])}{', ...' if len(value) > 3 else ''}]"
    return f"{value:g}"


def _likely(content: Content, properties: Properties, now: float = np.inf) -> list[UnitError]:
    """Slips whose correction leaves nothing impossible and a cost well below `now`: the best, and one nearly as good.

    Single numbers of lists are tried only if something is impossible and no wider slip explains it.
    """
    found: list[tuple[float, UnitError]] = []
    before, _, _ = _outcome(content, properties)
    idle: set[Place] = set()
    for slip in unit_errors(content):
        if slip.one_of_list and (found or np.isfinite(now)):
            break
        if idle.issuperset(entry.place for entry in slip.entries):
            continue
        mended = slip.mended(content)
        odd, refused, cost = _outcome(mended, properties)
        if odd == before:
            # The problem does not depend on these numbers.
            idle.update(entry.place for entry in slip.entries)
        elif not refused and cost <= COST.better * now:
            cost += COST.scope * slip.scope**2 + COST.rank * slip.rank + COST.apart * apart(slip, mended)
            found.append((cost, slip))
    if not found:
        return []
    found.sort(key=lambda one: one[0])
    least, best = found[0]
    places = {entry.place for entry in best.entries}
    # Another unit of the same numbers, or other numbers.
    others = [
        slip
        for cost, slip in found[1:]
        if (cost <= least + COST.near and not places & {entry.place for entry in slip.entries})
        or (cost <= least + COST.near_unit and slip.entries == best.entries)
    ]
    return [best, *others[:1]]


def _outcome(content: Content, properties: Properties) -> tuple[tuple[str, ...], bool, float]:
    """Unusual or impossible properties of a content in words; whether it is rejected; its cost."""
    try:
        found = properties(content)
    except (InputError, ArithmeticError, np.linalg.LinAlgError) as error:
        return (str(error),), True, np.inf
    refused = tuple(one.words for one in found if one.refused)
    unusual = tuple(one.words for one in found if one.unusual > 1e-9)
    return refused or unusual, bool(refused), _cost(found)


def _cost(properties: Sequence[Property]) -> float:
    of_table = [one.off_centre for one in properties if not one.field]
    return sum(one.unusual**2 for one in properties) + COST.off_centre * float(np.mean(np.square(of_table)))


def judged(content: dict[str, Any], rig: Rig, ranges: PlausibleRanges = RANGES) -> list[Property]:
    """All properties of a rig, each compared with its range."""
    found: list[Property] = []

    def judge(kind: str, value: float, words: str, field: str = "", of: Range | None = None) -> None:
        if not np.isfinite(value) or value <= 0:
            return
        within: Range = of or getattr(ranges, kind)
        refused, unusual = within.beyond(value)
        if unusual > 1e-9:
            words = f"{words} ({_expected(within, refused > 0)})"
        found.append(Property(kind, refused, unusual, within.off_centre(value), words, field, value if field else None))

    numbers = list(entries(content))
    _single_keys(numbers, ranges, judge)
    eom, body = rig.equations_of_motion(), rig.mounted_body()
    modes = eom.natural_frequencies()
    if np.all(modes.frequencies_Hz > 0):
        judge_modes(eom, modes, judge)
        _clock(rig, float(modes.frequencies_Hz[-1]), judge)
    places = np.array([mount.position for mount in body.mounts])
    centre = places.mean(axis=0)
    radius = float(np.max(np.linalg.norm((places - centre)[:, :2], axis=1)))
    if radius > 0:
        _shape(rig, body, centre, radius, judge)
    _drives(rig, eom, radius, judge)
    _alike(numbers, body, judge)
    _signal_levels(rig, judge)
    return found


def _expected(of: Range, refused: bool) -> str:
    low, high = (of.lowest, of.highest) if refused else (of.low, of.high)
    unit = f" {of.unit}" if of.unit else ""
    return f"expected at most {high:g}{unit}" if low == 0 else f"expected {low:g} to {high:g}{unit}"


def _single_keys(numbers: Sequence[Entry], ranges: PlausibleRanges, judge: Judge) -> None:
    for entry in numbers:
        if (of := ranges.keys.get(entry.key)) is not None:
            judge(entry.key, abs(entry.value), f"{entry.value:g} {of.unit}".rstrip(), dotted(entry.place), of)


def judge_modes(eom: EquationsOfMotion, modes: Modes, judge: Judge) -> None:
    """Natural frequencies, static sag and modal damping."""
    f = modes.frequencies_Hz
    words = f"natural frequencies {f[0]:.3g} to {f[-1]:.3g} Hz"
    judge("slowest_Hz", f[0], words)
    judge("mode_Hz", f[0], words)
    judge("mode_Hz", f[-1], words)
    judge("spread", f[-1] / f[0], f"{words}, ratio {f[-1] / f[0]:.3g}")
    rises = modes.shapes[2] ** 2 * np.diag(eom.M)[2]
    vertical = f[rises > 0.2]
    if len(vertical):
        sag = G / (2 * np.pi * vertical[0]) ** 2
        judge("sag_m", sag, f"static sag {sag:.2g} m")
    damping = np.diag(modes.shapes.T @ eom.C @ modes.shapes) / (4 * np.pi * f)
    # Undamped modes are not compared, but must not hide the smallest damping of the others.
    damped = damping[damping > 0]
    for zeta in (np.min(damped, initial=np.inf), np.max(damped, initial=0.0)):
        judge("damping", zeta, f"damping ratio {zeta:.2g}")


def _shape(rig: Rig, body: Any, centre: np.ndarray, radius: float, judge: Judge) -> None:
    slab = body.mass / (np.pi * radius**2)
    judge("slab_kg_per_m2", slab, f"{slab:.3g} kg per m^2 of the area between the mounts")
    for J in np.linalg.eigvalsh(body.inertia):
        r = np.sqrt(max(J, 0.0) / body.mass)
        judge(
            "gyration",
            r / radius,
            f"radius of gyration {r:.3g} m, {r / radius:.2g} times the mounts' distance from "
            f"their centre ({radius:.3g} m)",
        )
    away = float(np.linalg.norm(body.centre_of_mass - centre))
    judge(
        "mounts_height",
        away / radius,
        f"centre of mass {away:.3g} m from the mounts' centre, {away / radius:.2g} "
        "times the radius of the circle of the mounts",
    )
    near = np.median([np.linalg.norm(mount.position - centre) for mount in body.mounts])
    for name, place in rig.points().items():
        distance = float(np.linalg.norm(place.position - centre)) / max(near, 1e-12)
        judge("outlier", distance, f"{name} is {distance:.2g} times as far from the centre as the mounts")


def _drives(rig: Rig, eom: Any, radius: float, judge: Judge) -> None:
    mass = float(eom.M[0, 0])
    force = np.abs(eom.T[:3]) @ rig.drive_limits_V()
    stiffness = np.diag(eom.K)[:3]
    driven = np.flatnonzero(force > 1e-9 * np.max(force, initial=0.0))
    if not len(driven):
        return
    k = driven[int(np.argmax(force[driven] / mass))]
    a, travel = force[k] / mass, force[k] / stiffness[k]
    together = f"all drives at their limits, {force[k]:.3g} N together,"
    judge("acceleration", a, f"{together} accelerate the payload by {a:.2g} m/s^2")
    judge("travel_m", travel, f"{together} move the payload by {travel:.2g} m")
    if radius > 0:
        judge(
            "travel_share",
            travel / radius,
            f"{together} move the payload by {travel:.2g} m, {travel / radius:.2g} "
            "times the radius of the circle of the mounts",
        )


def _alike(numbers: Sequence[Entry], body: Any, judge: Judge) -> None:
    for kind in ("stiffness", "damping"):
        values = np.array([np.diag(getattr(mount, kind)) for mount in body.mounts])
        for axis, column in zip("xyz", values.T, strict=True):
            _unequal(column, [f"{kind} of {mount.name} along {axis}" for mount in body.mounts], judge)
    for key in ALIKE:
        of_key = [entry for entry in numbers if entry.key == key]
        _unequal(np.array([entry.value for entry in of_key]), [dotted(entry.place) for entry in of_key], judge)


def _unequal(values: np.ndarray, names: list[str], judge: Judge) -> None:
    """Compare the nonzero entries with their median, if there are at least three of them."""
    there = np.abs(values) > 1e-9 * np.max(np.abs(values), initial=0.0)
    if np.count_nonzero(there) < 3:
        return
    middle = float(np.median(np.abs(values[there])))
    for value, name in zip(values[there], (n for n, t in zip(names, there, strict=True) if t), strict=True):
        share = abs(value) / middle
        judge("unequal", share, f"{name} of {value:.3g} is {share:.2g} times the median of its kind")


def _clock(rig: Rig, f: float, judge: Judge) -> None:
    judge(
        "samples_per_cycle",
        rig.sample_rate_Hz / f,
        f"{rig.sample_rate_Hz / f:.2g} samples per cycle of the fastest mode at {f:.3g} Hz",
    )
    judge(
        "delay_cycles",
        rig.loop_delay_s * f,
        f"loop delay {rig.loop_delay_s:g} s "
        f"({rig.loop_delay_s * rig.sample_rate_Hz:.3g} samples), {rig.loop_delay_s * f:.2g} cycles of the "
        "fastest mode",
    )


def _signal_levels(rig: Rig, judge: Judge) -> None:
    """Full scale of the velocity sensors, and their signal and noise relative to converter range and floor motion."""
    converter, ambient = rig.acquisition, rig.ambient
    for one in rig.sensors():
        if converter is None or one.quantity != "velocity":
            continue
        name, gain, full = one.name, one.gain, converter.adc_range_V
        judge("full_scale_m_per_s", full / gain, f"full scale {full / gain:.2g} m/s of {name}")
        if ambient is not None and (floor := ambient.floor_velocity_rms_m_per_s) > 0:
            share = floor * gain / full
            judge(
                "floor_share",
                share,
                f"the floor motion alone, {floor:.2g} m/s, uses a fraction of {share:.2g} of "
                f"the converter's range at {name}",
            )
            rounding = full * 2.0 ** (1 - converter.adc_bits) / np.sqrt(12)
            own = max(ambient.sensor_noise_rms_V, rounding) / gain
            ratio = own / floor
            judge("noise_ratio", ratio, f"noise of {name} {own:.2g} m/s, {ratio:.3g} times the floor motion")
