"""Reported parameters against those that the truth was built with."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import pi

from scipy.stats import norm

from benchmarks.blind.judge import PLACED, Judged

QUANTILE = float(norm.ppf(0.975))

# A unit at the end of a parameter's name, in SI. Per cent is one hundredth: of a departure, and of nothing else.
UNITS = {
    "Hz": 1.0,
    "kHz": 1e3,
    "rad_per_s": 1 / (2 * pi),
    "s": 1.0,
    "ms": 1e-3,
    "us": 1e-6,
    "m": 1.0,
    "mm": 1e-3,
    "um": 1e-6,
    "N": 1.0,
    "mN": 1e-3,
    "V": 1.0,
    "mV": 1e-3,
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": pi / 180,
    "percent": 0.01,
    "kg": 1.0,
    "g": 1e-3,
    "N_per_m": 1.0,
    "kN_per_m": 1e3,
}

NOMINAL_DELAY_S = 1e-3


@dataclass(frozen=True)
class Equivalent:
    """reported = scale * hidden + offset, for an effect whose truth and report use other words.

    beside : a parameter that truth and report must both have, of a law that is richer than the usual one.
    """

    effect: str
    hidden: str
    reported: str
    scale: float = 1.0
    offset: float = 0.0
    beside: str = ""


# Words of the truth (tests/truth) for parameters of the library (avis_ctrl/gap/effects).
EQUIVALENTS: tuple[Equivalent, ...] = (
    # The truth's delay_s is what comes on top of the nominal one of the rig file, 1 ms; the report gives the sum too.
    Equivalent("loop_delay", "delay_s", "extra_delay_s"),
    Equivalent("loop_delay", "delay_s", "delay_s", offset=NOMINAL_DELAY_S),
    *(Equivalent("product_of_inertia", "product_kgm2", f"{place}_kgm2") for place in ("Jxy", "Jxz", "Jyz")),
    *(Equivalent("com_offset", f"{axis}_m", f"offset_{axis}_m") for axis in "xyz"),
    # Mounts and contacts of the truth scatter by up to 10 and 20 % about these, their means.
    Equivalent("cubic_stiffness", "k3_beside_k5_N_per_m3", "k3_N_per_m3", beside="k5_N_per_m5"),
    Equivalent("cubic_stiffness", "cubic_N_per_m3", "k3_N_per_m3"),
    Equivalent("contact_friction", "coulomb_N", "force_N"),
    Equivalent("stiffness_drift", "change", "relative_change"),
    *(
        Equivalent(effect, "damping_ratio", "damping")
        for effect in ("payload_flexible_mode", "attached_oscillator", "base_compliance")
    ),
)


@dataclass(frozen=True)
class Error:
    """A reported parameter whose truth is known: error and standard deviation in the reported unit."""

    effect: str
    parameter: str
    error: float
    std: float

    @property
    def inside(self) -> bool:
        """Within its own 95 % interval."""
        return abs(self.error) <= QUANTILE * self.std

    @property
    def deviations(self) -> float:
        return abs(self.error) / self.std if self.std else (0.0 if self.error == 0 else float("inf"))


def unit_of(name: str) -> tuple[str, float | None]:
    """Stem and factor to SI of a parameter's name; the name itself and None where it ends in no unit."""
    for unit in sorted(UNITS, key=len, reverse=True):
        if stem := re.fullmatch(rf"(.+)_{unit}", name):
            return stem[1], UNITS[unit]
    return name, None


def true_value(
    effect: str, reported: str, hidden: dict, table: Sequence[Equivalent] = EQUIVALENTS, beside: Collection[str] = ()
) -> tuple[str, float] | None:
    """The truth of a reported parameter and the name it has there; None where there is none.

    By the table, under the same name, or under its name with another unit. beside : all that is reported.
    """
    for one in table:  # first, since a word can mean something else in the truth
        known = not one.beside or (one.beside in beside and one.beside in hidden)
        if (one.effect, one.reported) == (effect, reported) and known and is_number(hidden.get(one.hidden)):
            return one.hidden, one.scale * hidden[one.hidden] + one.offset
    if is_number(hidden.get(reported)):
        return reported, float(hidden[reported])
    stem, unit = unit_of(reported)
    for name, value in hidden.items():
        other, factor = unit_of(name)
        if unit is not None and factor is not None and other == stem and is_number(value):
            return name, float(value) * factor / unit
    return None


def is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def parameter_errors(
    cases: Sequence[Judged], table: Sequence[Equivalent] = EQUIVALENTS
) -> tuple[list[Error], list[str]]:
    """Errors that can be compared, and "effect.parameter" of each reported one that cannot.

    Counted are effects named rightly: by their own name and, where the place is a choice, at the right place. A
    parameter of the truth counts once, however many reported ones follow from it.
    """
    errors, unknown = [], []
    for case in cases:
        for pair in case.pairs:
            if not pair.exact or (pair.hidden.name in PLACED and not pair.place):
                continue
            seen = set()
            for name, estimate in pair.named.parameters.items():
                truth = true_value(pair.named.name, name, pair.hidden.parameters, table, pair.named.parameters)
                if truth is None or estimate.std is None:
                    unknown.append(f"{pair.named.name}.{name}")
                elif truth[0] not in seen:
                    seen.add(truth[0])
                    errors.append(Error(pair.named.name, name, estimate.value - truth[1], estimate.std))
    return errors, unknown
