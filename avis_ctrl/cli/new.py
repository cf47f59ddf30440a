"""`avis new`: prompts for a few values, checks each at once, and writes a commented rig file or design file."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from avis_ctrl.errors import InputError

app = typer.Typer(
    no_args_is_help=True,
    help="Write a commented rig file or design file to start from. It asks for most values that are not given.",
)


def _absent(out: Path) -> Path:
    """Raise InputError for an existing file, before the first prompt."""
    if out.exists():
        raise InputError("this file exists; choose another name or remove it", file=out)
    return out


def _asked(check: Callable[[typer.Context, str, Any], None], flag: str, question: str, prompted: bool = True) -> Any:
    """An option that is prompted for if it is not given; an invalid answer is prompted for again."""

    def checked(ctx: typer.Context, param: typer.CallbackParam, value: Any) -> Any:
        try:
            check(ctx, str(param.name), value)
        except InputError as error:
            error = _with_options(ctx, error)
            if ctx.get_parameter_source(str(param.name)) is None:  # typed at the prompt: its source is set later
                raise typer.BadParameter(str(error)) from None
            raise error from None
        return value

    # [kg] in a help text would be markup.
    return typer.Option(
        flag, prompt=question if prompted else False, help=question.replace("[", r"\["), callback=checked
    )


def _with_options(ctx: typer.Context, error: InputError) -> InputError:
    """The error with the name of the option instead of that of the field."""
    option = next((one.opts[0] for one in ctx.command.params if one.name == error.field), error.field)
    return InputError(error.expected, file=error.file, field=option, value=error.value)


def _check_rig(ctx: typer.Context, name: str, value: Any) -> None:
    from avis_ctrl.study.new_files import NewRig, rig_of, rig_text

    new = replace(NewRig(), **_rig_fields({name: value}))
    try:
        rig_text(new)
    except InputError:
        rig_of(new)  # raises the same error with the likely wrong unit
        raise


def _rig_fields(given: dict[str, Any]) -> dict[str, Any]:
    """Answers as fields of NewRig."""
    fields = dict(given)
    if "size_m" in fields:
        fields["size_m"] = _numbers(fields["size_m"], 3, "--size")
    if "geophone" in fields:
        fields["geophone"] = Path(fields["geophone"]) if fields["geophone"].strip() else None
    return fields


_of_rig = partial(_asked, _check_rig)


@app.command()
def rig(
    ctx: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="RIG.toml", help="file to write", callback=_absent)],
    name: Annotated[str, _of_rig("--name", "Name of the table")] = "my_table",
    mass_kg: Annotated[float, _of_rig("--mass", "Mass of the payload [kg]")] = 500.0,
    size_m: Annotated[str, _of_rig("--size", "Length, width, height of the payload [m]")] = "1.2, 0.9, 0.4",
    mounts: Annotated[int, _of_rig("--mounts", "Number of mounts, 3 or 4")] = 4,
    vertical_Hz: Annotated[float, _of_rig("--vertical", "Vertical natural frequency [Hz]")] = 3.0,
    horizontal_Hz: Annotated[
        float, _of_rig("--horizontal", "Horizontal natural frequency, without rocking [Hz]")
    ] = 2.0,
    damping: Annotated[float, _of_rig("--damping", "Damping ratio, 0.03 for 3 %")] = 0.03,
    constant_N_per_V: Annotated[float, _of_rig("--force-constant", "Force of a drive [N/V]")] = 2.0,
    limit_V: Annotated[float, _of_rig("--limit", "Largest drive voltage [V]")] = 10.0,
    sensors: Annotated[str, _of_rig("--sensors", "Sensors: geophone or accelerometer")] = "geophone",
    geophone: Annotated[str, _of_rig("--geophone", "RESP file of the geophones (by default a common one)", False)] = "",
    sample_rate_Hz: Annotated[float, _of_rig("--sample-rate", "Sample rate of the controller [Hz]")] = 1000.0,
) -> None:
    """Write a rig file for a table of given mass, size and natural frequencies."""
    from avis_ctrl.files import write_whole
    from avis_ctrl.study.new_files import NewRig, rig_of, rig_text

    new = NewRig(**_rig_fields({one.name: ctx.params[one.name] for one in dataclasses.fields(NewRig)}))
    try:
        modes = rig_of(new).equations_of_motion().natural_frequencies().frequencies_Hz
    except InputError as error:
        raise _with_options(ctx, error) from None
    write_whole(out, rig_text(new).encode())
    print(
        f"{out}: natural frequencies {', '.join(f'{f:.3g}' for f in sorted(modes))} Hz. The mounts stand below the "
        "centre of mass, so horizontal motion is coupled with rocking.\n"
        f'Next: replace the values marked "assumed" in the file, then run avis new design DESIGN.toml --rig {out}'
    )


def _check_design(ctx: typer.Context, name: str, value: Any) -> None:
    """Check one answer with defaults for the others, so that an error refers to this answer."""
    from avis_ctrl.rigs import load_rig
    from avis_ctrl.study.new_files import NewDesign, new_design

    if name == "rig":
        load_rig(value)
        return
    if "rig" not in ctx.params:  # not yet known; everything is checked together at the end
        return
    fields = _design_fields({name: value})
    if name == "peak_dB":  # prompted for before the limit in the band, which must be lower
        fields["band_dB"] = min(NewDesign.band_dB, value - 1.0)
    elif name == "band_dB":
        fields["peak_dB"] = ctx.params.get("peak_dB", NewDesign.peak_dB)
    new_design(NewDesign(**fields), load_rig(ctx.params["rig"]), "rig.toml")
    if name.endswith("_percent"):
        _doubt(name, value)


@dataclass(frozen=True)
class PercentSettings:
    """fraction : a percentage below this [%] is probably meant as a fraction: stiffness and damping are never known so
    well, and a weighed mass hardly.
    """

    fraction: float = 0.5


PERCENT = PercentSettings()


def _doubt(field: str, value: float) -> None:
    """State on the standard error that a percentage looks like a fraction."""
    if value < PERCENT.fraction:
        what = field.removesuffix("_percent")
        meant = f"for a fraction of {value:g} give {100 * value:g}"
        print(f"avis: {what} known to within {value:g} %: unusually small; {meant}", file=sys.stderr)


def _design_fields(given: dict[str, Any]) -> dict[str, Any]:
    """Answers as fields of NewDesign."""
    fields = {"title": "My design", **given}
    if "keep" in fields:
        fields["keep"] = tuple(fields["keep"].replace(",", " ").split())
    if "band_Hz" in fields:
        fields["band_Hz"] = _numbers(fields["band_Hz"], 2, "--band") if fields["band_Hz"].strip() else ()
    return fields


_of_design = partial(_asked, _check_design)


@app.command()
def design(
    ctx: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="DESIGN.toml", help="file to write", callback=_absent)],
    rig: Annotated[str, _of_design("--rig", "Rig file, or avis, halcyonics, halcyonics_loaded")] = "avis",
    title: Annotated[str, _of_design("--title", "Title of the report")] = "My design",
    keep: Annotated[
        str, _of_design("--keep", "Coordinates under one controller, such as z, phi_x (empty: chosen for the rig)")
    ] = "",
    band_Hz: Annotated[
        str,
        _of_design("--band", "Band in which the table must isolate [Hz] (empty: scaled with the natural frequencies)"),
    ] = "",
    peak_dB: Annotated[float, _of_design("--peak-limit", "Transmissibility at any frequency, at most [dB]")] = 3.5,
    band_dB: Annotated[float, _of_design("--band-limit", "Transmissibility in the band, at most [dB]")] = -7.0,
    mass_percent: Annotated[float, _of_design("--mass", "Mass known to within [%]")] = 10.0,
    stiffness_percent: Annotated[float, _of_design("--stiffness", "Stiffness known to within [%]")] = 15.0,
    damping_percent: Annotated[float, _of_design("--damping", "Damping known to within [%]")] = 30.0,
) -> None:
    """Write a design file for a rig from bounds on its transmissibility and parameter uncertainty."""
    from avis_ctrl.files import write_whole
    from avis_ctrl.rigs import load_rig
    from avis_ctrl.study.design_file import read_study
    from avis_ctrl.study.new_files import NewDesign, design_text, new_design

    # In a design file, the path of the rig file is relative to the design file.
    named = os.path.relpath(rig, out.resolve().parent) if rig.endswith(".toml") or "/" in rig else rig
    given = _design_fields({one.name: ctx.params[one.name] for one in dataclasses.fields(NewDesign)})
    made = new_design(NewDesign(**given), load_rig(rig), named)
    write_whole(out, design_text(made).encode())
    read_study(out)
    low, high = made.transmissibility.band_Hz
    print(
        f"{out}: written. Isolation is required from {low:g} to {high:g} Hz.\n"
        f'Next: replace the values marked "Assumed", then run avis design {out} --out {out.with_suffix("")}'
    )


def _numbers(text: str, count: int, field: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.replace(",", " ").replace("x", " ").split())
    except ValueError:
        values = ()
    if len(values) != count:
        raise InputError(f"expected {count} numbers separated by commas", field=field, value=text)
    return values
