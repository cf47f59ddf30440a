"""`avis gap-axis`: what a model of one axis lacks, named from a measurement."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

from avis_ctrl.cli.file_options import SAMPLE_RATE
from avis_ctrl.errors import InputError


def gap_axis(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="drive, oscillator, seismometer or levels")],
    path: Annotated[Path, typer.Argument(metavar="MEASUREMENT", help="a record; for a seismometer a folder with one "
                                         "CSV per frequency; for levels a folder of u_*mV*.npy and y_*mV*.npy")],
    columns: Annotated[str | None, typer.Option("--columns", metavar="ROLE=NAME,..", help="drive: force, position, "
                                                "reference; oscillator: u, y; seismometer: drive, coil and/or "
                                                "displacement; each also t; levels: none")] = None,
    scale: Annotated[str | None, typer.Option("--scale", metavar="ROLE=FACTOR,..", help="factors to SI units")] = None,
    sample_rate_Hz: SAMPLE_RATE = None,
    band_Hz: Annotated[tuple[float, float] | None, typer.Option("--band", metavar="LOW HIGH", help="Hz; for an "
                                                                "oscillator or for levels")] = None,
    cutoff_Hz: Annotated[float | None, typer.Option("--cutoff", metavar="HZ", help="low-pass of a drive's data; by "
                                                    "default as far as force and motion are coherent")] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="folder for gap.json")] = None,
    seed: Annotated[int, typer.Option("--seed", hidden=True, help="has no influence any more")] = 1,
) -> None:
    """Name the effect that a model of one axis lacks, with its size, its probability, and the gap before and after.

    For example: avis gap-axis drive drive.mat --columns force=vir,position=qm,reference=qg,t=t --scale force=35.15
    """
    from rich.console import Console

    from avis_ctrl.cli.console import Progress
    from avis_ctrl.files import write_whole
    from avis_ctrl.gap.single_axis import find_axis_gap_in
    from avis_ctrl.study.files import output_folder

    roles = dict(_pair(part, "--columns") for part in columns.split(",")) if columns else None
    factors = {role: _number(text) for role, text in (_pair(part, "--scale") for part in scale.split(","))} \
        if scale else None
    options: dict[str, Any] = {} if band_Hz is None else {"band_Hz": band_Hz}
    options |= {} if cutoff_Hz is None else {"cutoff_Hz": cutoff_Hz}
    console = Console(highlight=False)
    with output_folder(out, ("gap.json",)) if out else nullcontext() as folder:
        with Progress(console) as progress:
            found = find_axis_gap_in(kind, path, roles, scale=factors, sample_rate_Hz=sample_rate_Hz,
                                     progress=progress, **options)
        if folder:
            write_whole(folder / "gap.json", json.dumps(found.to_json(), indent=2, allow_nan=False).encode())
    console.print(f"verdict: {found.verdict}")
    for sentence in found.sentences:
        console.print(sentence, soft_wrap=True, markup=False)
    for one in (*found.base_parameters, *found.ratios()):
        console.print(f"{one.name} = {one.value:.6g}{f' +- {one.std:.2g}' if one.std >= 0 else ''} {one.unit}".rstrip())
    for stage in (*found.stages, *found.references):
        noise = "" if stage.chi2_per_dof is None else f", chi2/dof {stage.chi2_per_dof:.4g}"
        console.print(f"- {stage.stage}: {100 * stage.nrmse:.3g} % on held-out data{noise}", soft_wrap=True,
                      markup=False)
    if folder:
        console.print(f"{folder / 'gap.json'}")


def _pair(text: str, option: str) -> tuple[str, str]:
    role, equals, name = (part.strip() for part in text.partition("="))
    if not (role and equals and name):
        raise InputError("expected ROLE=NAME", field=option, value=text)
    return role, name


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError("expected ROLE=NUMBER", field="--scale", value=text) from None
