"""`avis new`: asks a few questions and writes a commented rig file or design file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from avis_ctrl.errors import InputError

app = typer.Typer(no_args_is_help=True, help="Write a commented rig file or design file to start from. What is not "
                                             "given as an option is asked for.")


def _absent(out: Path) -> Path:
    """Refused before the first question."""
    if out.exists():
        raise InputError("this file exists; choose another name or remove it", file=out)
    return out


@app.command()
def rig(
    out: Annotated[Path, typer.Argument(metavar="RIG.toml", help="file to write", callback=_absent)],
    name: Annotated[str, typer.Option(prompt="Name of the table")] = "my_table",
    mass_kg: Annotated[float, typer.Option("--mass", prompt="Mass of the payload [kg]")] = 500.0,
    size_m: Annotated[str, typer.Option("--size", prompt="Length, width, height of the payload [m]")] = "1.2, 0.9, 0.4",
    mounts: Annotated[int, typer.Option(prompt="Number of mounts, 3 or 4")] = 4,
    vertical_Hz: Annotated[float, typer.Option("--vertical", prompt="Vertical natural frequency [Hz]")] = 3.0,
    horizontal_Hz: Annotated[float, typer.Option("--horizontal", prompt="Horizontal natural frequency [Hz]")] = 2.0,
    damping: Annotated[float, typer.Option(prompt="Damping ratio")] = 0.03,
    constant_N_per_V: Annotated[float, typer.Option("--force-constant", prompt="Force of a drive [N/V]")] = 2.0,
    limit_V: Annotated[float, typer.Option("--limit", prompt="Largest drive voltage [V]")] = 10.0,
    geophone: Annotated[str, typer.Option(prompt="RESP file of the geophones (empty: a common one)")] = "",
    sample_rate_Hz: Annotated[float, typer.Option("--sample-rate", prompt="Sample rate of the controller [Hz]")
                              ] = 1000.0,
) -> None:
    """A table from its mass, size and natural frequencies."""
    from avis_ctrl.files import write_whole
    from avis_ctrl.rigs import load_rig
    from avis_ctrl.study.new_files import NewRig, rig_text

    text = rig_text(NewRig(name, mass_kg, _numbers(size_m, 3, "--size"), mounts, vertical_Hz,  # type: ignore[arg-type]
                           horizontal_Hz, damping, constant_N_per_V, limit_V,
                           Path(geophone) if geophone.strip() else None, sample_rate_Hz))
    write_whole(out, text.encode())
    modes = load_rig(out).equations_of_motion().natural_frequencies().frequencies_Hz
    print(f"{out}: modes at {', '.join(f'{f:.3g}' for f in sorted(modes))} Hz; next: replace the lines marked "
          f"\"assumed\", then avis new design DESIGN.toml --rig {out}")


@app.command()
def design(
    out: Annotated[Path, typer.Argument(metavar="DESIGN.toml", help="file to write", callback=_absent)],
    rig: Annotated[str, typer.Option(prompt="Rig file, or avis, halcyonics, halcyonics_loaded")] = "avis",
    title: Annotated[str, typer.Option(prompt="Title of the report")] = "My design",
    keep: Annotated[str, typer.Option(prompt="Coordinates under one controller (empty: chosen for the rig)")] = "",
    band_Hz: Annotated[str, typer.Option("--band", prompt="Band in which the table must isolate [Hz]")] = "1, 10",
    band_dB: Annotated[float, typer.Option("--band-limit", prompt="Transmissibility in this band, at most [dB]")
                       ] = -7.0,
    peak_dB: Annotated[float, typer.Option("--peak-limit", prompt="Transmissibility elsewhere, at most [dB]")] = 3.5,
    mass: Annotated[float, typer.Option(prompt="Mass known to within [%]")] = 10.0,
    stiffness: Annotated[float, typer.Option(prompt="Stiffness known to within [%]")] = 15.0,
    damping: Annotated[float, typer.Option(prompt="Damping known to within [%]")] = 30.0,
) -> None:
    """A design for a rig from its bounds and uncertainty."""
    from avis_ctrl.files import write_whole
    from avis_ctrl.rigs import load_rig
    from avis_ctrl.study.design_file import read_study
    from avis_ctrl.study.new_files import NewDesign, design_text, new_design

    # A design file names its rig relative to itself.
    named = os.path.relpath(rig, out.resolve().parent) if _is_file(rig) else rig
    low, high = _numbers(band_Hz, 2, "--band")
    made = new_design(NewDesign(title, tuple(keep.replace(",", " ").split()), (low, high), band_dB, peak_dB, mass,
                                stiffness, damping), load_rig(rig), named)
    write_whole(out, design_text(made).encode())
    read_study(out)
    print(f"{out}: next: avis design {out} --out {out.with_suffix('')}")


def _is_file(rig: str) -> bool:
    return rig.endswith(".toml") or "/" in rig


def _numbers(text: str, count: int, field: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError:
        values = ()
    if len(values) != count:
        raise InputError(f"expected {count} numbers with commas between them", field=field, value=text)
    return values
