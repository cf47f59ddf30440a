"""Commercial geophones read from SEED RESP text files, and a check of each file against its name.

A file of the IRIS Nominal Response Library is named RESP.<network>.<station>.<location>.<channel>.<model>.<...>.
The model is followed by coil [ohm], shunt [ohm] (or NONE), corner [Hz] and gain [V s/m]. Models without a shunt have
only corner and gain; the GS-11D has its corner first. An underscore represents the decimal point.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avis_ctrl.errors import InputError

VELOCITY_UNIT, VOLT_UNIT = "M/S", "V"


@dataclass(frozen=True)
class CatalogueEntry:
    """Data of one RESP file, from its content and from its name.

    `corner_Hz`, `damping` and `gain_Vs_per_m` are from poles and stage gains. The fields that start with `named_`, the
    coil and the shunt are from the file's name (None: not given there).
    """

    file: str
    model: str
    corner_Hz: float
    damping: float
    gain_Vs_per_m: float
    overall_sensitivity: float
    normalisation: float
    normalisation_Hz: float
    coil_ohm: float | None
    shunt_ohm: float | None
    named_corner_Hz: float
    named_gain_Vs_per_m: float


def check_against_name(entry: CatalogueEntry, tolerance: float = 0.02) -> list[str]:
    """Contradictions between a file and its name or within the file, in words with both numbers; empty if none.

    Compared, each to the relative tolerance: corner (from the poles) and gain with the name, product of the stage gains
    with the overall sensitivity, normalisation factor with the poles' response at its frequency.
    """
    s = 2j * np.pi * entry.normalisation_Hz
    w = 2 * np.pi * entry.corner_Hz
    response = abs(s**2 / (s**2 + 2 * entry.damping * w * s + w**2))
    pairs = [
        ("corner from the poles", entry.corner_Hz, "the name's", entry.named_corner_Hz, "Hz"),
        ("gain", entry.gain_Vs_per_m, "the name's", entry.named_gain_Vs_per_m, "V s/m"),
        ("gain of stage 1", entry.gain_Vs_per_m, "the overall sensitivity", entry.overall_sensitivity, "V s/m"),
        ("normalisation factor", entry.normalisation, "what the poles imply", 1 / response, ""),
    ]
    return [
        f"{what} is {value:.4g} {unit}".rstrip() + f", {against} {other:.4g} {unit}".rstrip()
        for what, value, against, other, unit in pairs
        if abs(value - other) > tolerance * abs(other)
    ]


def read_response(path: str | Path) -> CatalogueEntry:
    """Read the RESP file of a second-order velocity sensor.

    Raises
    ------
    InputError : unreadable or truncated, a wrong unit or transfer-function type, poles or zeros that are missing,
        not finite, unstable or not a conjugate pair, a name that cannot be parsed.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"a readable ASCII file ({error})", file=path) from error
    try:
        return _parse(text, path.name)
    except InputError as error:
        raise error.in_file(path) from None


def _parse(text: str, name: str) -> CatalogueEntry:
    stage = _poles_and_zeros_stage(text)
    if (kind := _word(stage, "B053F03", "transfer function type")) != "A":
        raise InputError("type A (Laplace, rad/s)", field="B053F03", value=kind)
    for code, unit in (("B053F05", VELOCITY_UNIT), ("B053F06", VOLT_UNIT)):
        if (found := _word(stage, code, "unit")) != unit:
            raise InputError(f"unit {unit}", field=code, value=found)
    zeros = _roots(stage, "B053F10-13", int(_number(stage, "B053F09")), "zeros")
    poles = _roots(stage, "B053F15-18", int(_number(stage, "B053F14")), "poles")
    if zeros.size != 2 or np.any(zeros != 0):
        raise InputError("two zeros at s = 0", field="B053F10-13 (zeros)", value=zeros.tolist())
    if poles.size != 2 or np.any(poles.real >= 0) or abs(np.sum(poles.imag)) > 1e-6 * abs(poles[0]):
        raise InputError("two stable poles, real or a conjugate pair", field="B053F15-18 (poles)", value=poles.tolist())
    w = float(np.sqrt(abs(np.prod(poles))))
    gains = _stage_gains(text)
    analogue = float(np.prod([value for stage_number, value in gains.items() if stage_number > 0]))
    named = _from_name(name)
    return CatalogueEntry(
        file=name,
        model=name.split(".")[5],
        corner_Hz=w / (2 * np.pi),
        damping=float(-np.sum(poles.real) / (2 * w)),
        gain_Vs_per_m=analogue,
        overall_sensitivity=gains[0],
        normalisation=_number(stage, "B053F07"),
        normalisation_Hz=_number(stage, "B053F08"),
        coil_ohm=named["coil"],
        shunt_ohm=named["shunt"],
        named_corner_Hz=_given(named, "corner"),
        named_gain_Vs_per_m=_given(named, "gain"),
    )


def _poles_and_zeros_stage(text: str) -> str:
    """Text from blockette 53 of the first stage on; InputError if it is missing."""
    start = text.find("B053F03")
    if start < 0:
        raise InputError("a poles-and-zeros stage (is the file truncated?)", field="B053F03")
    return text[start:]


def _word(text: str, code: str, what: str) -> str:
    found = re.search(rf"^{re.escape(code)}\s+[^:\n]*:\s*(\S+)", text, re.MULTILINE)
    if not found:
        raise InputError(f"a {what} (is the file truncated?)", field=code)
    return found[1]


def _number(text: str, code: str) -> float:
    return _float(_word(text, code, "number"), code)


def _float(word: str, field: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError("a finite number", field=field, value=word)
    return value


def _roots(text: str, code: str, count: int, what: str) -> np.ndarray:
    rows = re.findall(rf"^{re.escape(code)}\s+\d+\s+(\S+)\s+(\S+)", text, re.MULTILINE)
    if len(rows) != count:
        raise InputError(f"{count} {what}, the file holds {len(rows)}", field=f"{code} ({what})")
    return np.array([complex(_float(re_, code), _float(im, code)) for re_, im in rows])


def _stage_gains(text: str) -> dict[int, float]:
    """Gain by stage number; stage 0 is the overall sensitivity."""
    rows = re.findall(r"^B058F03\s+[^:\n]*:\s*(\S+)\s*\nB058F04\s+[^:\n]*:\s*(\S+)", text, re.MULTILINE)
    gains = {int(_float(stage, "B058F03")): _float(value, "B058F04") for stage, value in rows}
    for stage, what in ((1, "the gain of stage 1"), (0, "the overall sensitivity")):
        if stage not in gains:
            raise InputError(f"{what} (is the file truncated?)", field="B058F04")
        if gains[stage] <= 0:
            raise InputError("a positive gain", field="B058F04", value=gains[stage])
    return gains


def _from_name(name: str) -> dict[str, float | None]:
    """Coil, shunt, corner and gain as stated in the file's name; None for missing values."""
    parts = name.split(".")
    if len(parts) not in (8, 10):
        raise InputError(
            "a name RESP.network.station.location.channel.model[.coil.shunt].corner.gain", field="name", value=name
        )
    if len(parts) == 8:
        order = ["corner", "gain"]
    elif parts[5].startswith("GS11"):
        order = ["corner", "coil", "shunt", "gain"]
    else:
        order = ["coil", "shunt", "corner", "gain"]
    named: dict[str, float | None] = {"coil": None, "shunt": None}
    for what, word in zip(order, parts[6:], strict=True):
        # A letter after the corner distinguishes elements of one model (HG-6 4.5A, 4.5B).
        number = re.sub(r"[A-Z]$", "", word).replace("_", ".")
        named[what] = None if word == "NONE" else _float(number, f"name ({what})")
    return named


def _given(named: dict[str, float | None], what: str) -> float:
    value = named[what]
    if value is None or value <= 0:
        raise InputError("a positive number in the file's name", field=f"name ({what})", value=value)
    return value
