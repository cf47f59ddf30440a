"""First versions of a rig file and a design file from a few answers, with a comment on every assumption."""

from __future__ import annotations

import tomllib
import warnings
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from avis_ctrl.checks import require_positive
from avis_ctrl.errors import InputError
from avis_ctrl.rigs.geophone_catalogue import check_against_name, read_response
from avis_ctrl.rigs.instruments import Tolerances
from avis_ctrl.rigs.key_types import LIMITS
from avis_ctrl.rigs.plausibility import UnusualRig, plausible
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rig_file import rig_from
from avis_ctrl.study.design_file import Design, design_from_table
from avis_ctrl.study.identification_design import default_band, default_design, design_toml


@dataclass(frozen=True)
class NewRig:
    """A box on equal mounts near its lower corners, with a vertical and a horizontal drive and sensor at each mount.

    Attributes
    ----------
    name : of the rig. mass_kg : of the payload. size_m : length, width, height along x, y, z.
    mounts : 3 (two near one side, one at the middle of the opposite side) or 4, their centroid below the centre of
        mass.
    vertical_Hz, horizontal_Hz : natural frequencies of the payload on its mounts, without rotation. The vertical mode
        has no rotation; horizontal modes include rocking, because the mounts are below the centre of mass.
    damping : damping ratio of all mounts. constant_N_per_V, limit_V : of a drive.
    sensors : "geophone" or "accelerometer" (a seismic one of 10 V/g).
    geophone : RESP file of the sensor; None for a 4.5 Hz geophone of 28.8 V s/m.
    sample_rate_Hz : of the controller.
    """

    name: str = "my_table"
    mass_kg: float = 500.0
    size_m: tuple[float, ...] = (1.2, 0.9, 0.4)
    mounts: int = 4
    vertical_Hz: float = 3.0
    horizontal_Hz: float = 2.0
    damping: float = 0.03
    constant_N_per_V: float = 2.0
    limit_V: float = 10.0
    sensors: str = "geophone"
    geophone: Path | None = None
    sample_rate_Hz: float = 1000.0


def rig_text(new: NewRig) -> str:
    """The text of the rig file.

    Raises InputError: not 3 or 4 mounts, a size, mass or frequency that is not positive, an invalid name, other
    sensors, a RESP file that cannot be read or contradicts itself.
    """
    if new.sensors not in ("geophone", "accelerometer"):
        raise InputError("expected geophone or accelerometer", field="sensors", value=new.sensors)
    if new.sensors == "accelerometer" and new.geophone is not None:
        raise InputError("expected no RESP file of a geophone for accelerometers", field="geophone", value=new.geophone)
    if new.mounts not in (3, 4):
        raise InputError("expected 3 or 4; add further mounts to the file afterwards", field="mounts", value=new.mounts)
    for one in fields(new):
        if one.type == "float":
            require_positive(getattr(new, one.name), one.name)
    if len(new.size_m) != 3 or not all(0 < side <= LIMITS.farthest_m for side in new.size_m):
        raise InputError(
            f"expected three positive lengths in metres, at most {LIMITS.farthest_m:g}",
            field="size_m",
            value=list(new.size_m),
        )
    if not new.name.strip() or not new.name.isprintable() or set(new.name) & set('"\\'):
        raise InputError("expected a name without quotes", field="name", value=new.name)
    x, y, z = new.size_m
    inertia = new.mass_kg / 12 * np.array([y**2 + z**2, x**2 + z**2, x**2 + y**2])
    own = new.mass_kg / new.mounts
    k = [own * (2 * np.pi * f) ** 2 for f in (new.horizontal_Hz, new.horizontal_Hz, new.vertical_Hz)]
    c = [2 * new.damping * np.sqrt(own * stiffness) for stiffness in k]
    places = _places(new)
    text = (
        f'# {new.name}: a first rig file. Values marked "assumed" are usual ones, or those of a homogeneous box on\n'
        "# equal mounts: replace them by your own numbers. docs/rig_file.md explains every key. avis identify\n"
        "# measures most of them.\n"
        f'name = "{new.name}"\n\n[payload]\nmass_kg = {new.mass_kg:g}\n'
        f"inertia_kgm2 = {_row(inertia)}             # assumed: homogeneous box, about the centre of mass\n"
        "centre_of_mass_m = [0.0, 0.0, 0.0]   # assumed: in the geometric centre\n"
    )
    for place in places:
        text += (
            f"\n[[isolator]]\nposition_m = {_row(place)}      # assumed: 10 % of the size from the edge\n"
            f"stiffness_N_per_m = {_row(k)}   # from {new.horizontal_Hz:g} Hz along x and y, "
            f"{new.vertical_Hz:g} Hz along z\ndamping_Ns_per_m = {_row(c)}    # damping ratio {new.damping:g}\n"
        )
    text += f"\n[actuators]\nlimit_V = {new.limit_V:g}{_if_default(new, 'limit_V')}\n"
    for n, (place, axis) in enumerate(zip(places, _horizontal(new), strict=True), 1):
        for letter, direction in (("z", (0, 0, 1)), axis):
            text += (
                f'\n[[drive]]\nname = "A{letter}{n}"\nposition_m = {_row(place)}      # assumed: at the mount\n'
                f"direction = {_row(direction)}      # assumed\nconstant_N_per_V = {new.constant_N_per_V:g}"
                f"{_if_default(new, 'constant_N_per_V')}\n"
            )
    sensor = _ACCELEROMETER if new.sensors == "accelerometer" else _geophone(new.geophone)
    for n, (place, axis) in enumerate(zip(places, _horizontal(new), strict=True), 1):
        for letter, direction in (("z", (0, 0, 1)), axis):
            text += (
                f'\n[[{new.sensors}]]\nname = "S{letter}{n}"\nposition_m = {_row(place)}      # assumed: at the mount\n'
                f"direction = {_row(direction)}      # assumed\n{sensor}"
            )
    return text + (
        f"\n[acquisition]\nsample_rate_Hz = {new.sample_rate_Hz:g}\nadc_bits = 16                        # assumed\n"
        "adc_range_V = 10.0                   # assumed\n"
        f"loop_delay_s = {1 / new.sample_rate_Hz:g}                 # assumed: one sample\n"
        "\n[ambient]\nfloor_velocity_rms_m_per_s = 2e-6    # assumed: a quiet laboratory\n"
        "sensor_noise_rms_V = 0.001           # assumed\n"
        "\n# How accurately the values above are known: standard deviations for avis identify and avis gap.\n"
        "[tolerances]\n"
        + "".join(f"{f'{one.name} = {one.default:g}':36} # assumed\n" for one in fields(Tolerances))
        + "\n# If there is an analogue anti-alias filter (Butterworth) before the converter:\n"
        f"# [electronics]\n# anti_alias_order = 4\n# anti_alias_corner_Hz = {new.sample_rate_Hz / 4:g}\n"
    )


def _if_default(new: NewRig, name: str) -> str:
    """A mark of a value that is the default of `NewRig`."""
    default = next(one.default for one in fields(NewRig) if one.name == name)
    return "      # assumed, unless you entered it" if getattr(new, name) == default else ""


def rig_of(new: NewRig) -> Rig:
    """The table of a new rig file. Warns of unusual answers.

    Raises InputError: answers that no real table has; the message names the likely unit error. See also `rig_text`.
    """
    answers = {name: list(value) if isinstance(value, tuple) else value for name, value in vars(new).items()}
    if unusual := plausible(answers, rig_from, written=_content):
        warnings.warn(UnusualRig(unusual), stacklevel=2)
    return rig_from(_content(answers))


def _content(answers: dict[str, Any]) -> dict[str, Any]:
    return tomllib.loads(rig_text(NewRig(**answers)))


def _row(values: object) -> str:
    return f"[{', '.join(str(float(f'{value:.6g}')) for value in np.asarray(values, float))}]"


def _places(new: NewRig) -> list[tuple[float, float, float]]:
    """Mounts under the lower corners, a tenth of the length inside.

    If there are three mounts, the pair is nearer to the middle, so that a vertical motion does not tilt the payload.
    """
    x, y, z = 0.4 * new.size_m[0], 0.4 * new.size_m[1], -0.5 * new.size_m[2]
    if new.mounts == 3:
        return [(-x, -y / 2, z), (x, -y / 2, z), (0.0, y, z)]
    return [(-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z)]


def _horizontal(new: NewRig) -> list[tuple[str, tuple[int, int, int]]]:
    """Horizontal direction of the drive and sensor at each mount; together they cover x, y and the rotation about z."""
    along_x, along_y = ("x", (1, 0, 0)), ("y", (0, 1, 0))
    return [along_y, along_y, along_x] if new.mounts == 3 else [along_y, along_x, along_y, along_x]


# Sensitivity, corner and noise as in data sheets of seismic accelerometers of 10 V/g.
_ACCELEROMETER = (
    "sensitivity_Vs2_per_m = 1.02          # assumed: 10 V/g\nlow_corner_Hz = 0.1                   # assumed\n"
    "noise_m_per_s2_rtHz = 5e-7            # assumed\npreamplifier_gain = 100.0            # assumed\n"
)


def _geophone(path: Path | None) -> str:
    if path is None:
        source, gain, corner, damping = "assumed: a common 4.5 Hz geophone", 28.8, 4.5, 0.56
    else:
        entry = read_response(path)
        if wrong := check_against_name(entry):
            raise InputError(f"the file contradicts itself: {'; '.join(wrong)}", file=path)
        source, gain, corner, damping = f"from {entry.file}", entry.gain_Vs_per_m, entry.corner_Hz, entry.damping
    return (
        f"sensitivity_Vs_per_m = {gain:.6g}          # {source}\nsuspension_Hz = {corner:.6g}      # {source}\n"
        f"suspension_damping = {damping:.6g}      # {source}\ncompensated_Hz = {min(0.5, corner):g}   # assumed: by "
        "an analogue filter\ncompensated_damping = 0.7            # assumed\n"
        "preamplifier_gain = 100.0            # assumed\n"
    )


@dataclass(frozen=True)
class NewDesign:
    """Answers for a new design.

    keep : coordinates under one controller; empty for those of the default design. band_Hz : band in which the
        transmissibility stays below band_dB [dB]; `default_band` if empty. peak_dB : limit at all other frequencies.
        The ranges of mass, and of stiffness and damping of every mount, are in per cent of the rig file's values.
    """

    title: str
    keep: tuple[str, ...] = ()
    band_Hz: tuple[float, ...] = ()
    band_dB: float = -7.0
    peak_dB: float = 3.5
    mass_percent: float = 10.0
    stiffness_percent: float = 15.0
    damping_percent: float = 30.0


def new_design(new: NewDesign, rig: Rig, rig_name: str) -> Design:
    """The design, validated.

    Raises InputError: a coordinate that the drives cannot move or the sensors cannot measure; an invalid band or range.
    """
    known = rig.parameters()
    spreads = {"mass": new.mass_percent, "isolator*.k_*": new.stiffness_percent, "isolator*.c_*": new.damping_percent}
    spreads = {
        name: value
        for name, value in spreads.items()
        if name in known or (any(one.startswith(name.partition("*")[0]) for one in known) and "*" in name)
    }
    start = default_design(rig, new.title, spreads)
    shape = start.model_dump(exclude_none=True)
    shape["rig"] = rig_name
    shape["keep"] = list(new.keep) or shape["keep"]
    band = list(new.band_Hz or default_band(rig))
    shape["transmissibility"] |= {"band_Hz": band, "band_dB": new.band_dB, "peak_dB": new.peak_dB}
    limits = {"worst_case_peak_transmissibility_dB": new.peak_dB, "worst_case_band_transmissibility_dB": new.band_dB}
    for one in shape["requirement"]:
        if one["quantity"] in limits:
            one["at_most"] = limits[one["quantity"]]
    return design_from_table(shape)


# Comments above the sections of a new design file.
_REMARKS = {
    "[loop]": "Assumed: corner of the current amplifiers.",
    "[uncertainty.parameters_percent]": "Half-width of each parameter's range; the bounds hold for all such plants.\n"
    "# After avis identify, use its uncertainty.json instead.",
    "[uncertainty.actuator_chains]": "Assumed: neglected dynamics of each drive, 100 % at the crossover frequency.",
    "[transmissibility]": "Upper bounds from floor to payload: peak_dB at every frequency, band_dB inside band_Hz.",
    "[control_effort]": "Assumed: floor velocity at which the drives may reach their voltage limit.\n"
    "# The controller rolls off above bandwidth_Hz.",
    "[synthesis]": "The D-K iteration ends as soon as mu is below target_mu, or after max_iterations.",
    "[simulation]": "Check on the nonlinear table: duration of each run, and number of random plants of the set.",
    "[[requirement]]": "Rows of the verdict. All quantities: docs/design_file.md.",
}


def design_text(design: Design) -> str:
    """The text of the design file, with a comment above each section."""
    lines, told = (
        [
            '# A first design file: change what is marked "Assumed" to suit your table. docs/design_file.md '
            "explains every key."
        ],
        set(),
    )
    for line in design_toml(design).splitlines():
        if line in _REMARKS and line not in told:
            lines.append(f"# {_REMARKS[line]}")
            told.add(line)
        lines.append(line)
    return "\n".join(lines) + "\n"
