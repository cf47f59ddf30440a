"""`avis gap-axis`: the effects that a model of one axis lacks, found in a measurement."""

from __future__ import annotations

from contextlib import nullcontext
from math import isnan
from pathlib import Path
from typing import Annotated, Any

from avis_ctrl.cli.console import Progress, Terminal
from avis_ctrl.cli.file_options import SAMPLE_RATE, factors, roles
from avis_ctrl.cli.options import Options

GAP_AXIS = Options("""
KIND: drive, oscillator, seismometer or levels
MEASUREMENT: a record; for a seismometer a folder with one CSV per frequency; for levels a folder of `u_*mV*.npy` and
    `y_*mV*.npy`
--columns ROLE=NAME,..: drive: force, position, reference; oscillator: u, y; seismometer: drive, coil and/or
    displacement; each also t; by name, or in CSV by number from 1; levels: none
--scale ROLE=FACTOR,..: factors to SI units
--band LOW HIGH: fitted band [Hz]; for levels, a band around one mode
--cutoff HZ: cutoff of the low-pass filter for the motion from which a drive's friction is computed; by default the
    upper end of the fitted band. Without --band, this band ends where force and motion are no longer coherent
--output KIND: quantity in the column y or position: position, velocity or acceleration
--range START END: use only this part of each record [s]
--resample HZ: new sample rate
--also RECORD: another record of the same axis (repeatable); with several records, whole records are held out
--out DIR: folder for gap.json, reports and the model that avis predict reads
--seed: ignored; accepted for older scripts
""")


def gap_axis(
    kind: Annotated[str, GAP_AXIS("KIND")],
    path: Annotated[Path, GAP_AXIS("MEASUREMENT")],
    columns: Annotated[str | None, GAP_AXIS("--columns")] = None,
    scale: Annotated[str | None, GAP_AXIS("--scale")] = None,
    sample_rate_Hz: SAMPLE_RATE = None,
    band_Hz: Annotated[tuple[float, float] | None, GAP_AXIS("--band")] = None,
    cutoff_Hz: Annotated[float | None, GAP_AXIS("--cutoff")] = None,
    output: Annotated[str, GAP_AXIS("--output")] = "position",
    range_s: Annotated[tuple[float, float] | None, GAP_AXIS("--range")] = None,
    resample_Hz: Annotated[float | None, GAP_AXIS("--resample")] = None,
    also: Annotated[list[Path] | None, GAP_AXIS("--also")] = None,
    out: Annotated[Path | None, GAP_AXIS("--out")] = None,
    seed: Annotated[int, GAP_AXIS("--seed", hidden=True)] = 1,
) -> None:
    """Find the effects that a model of one axis lacks: their size and probability, and the gap before and after.

    For example: avis gap-axis drive drive.mat --columns force=vir,position=qm,reference=qg,t=t --scale force=35.15
    """
    from avis_ctrl.gap.axis import find_axis_gap_in
    from avis_ctrl.report import rendered
    from avis_ctrl.report.gap.axis import document
    from avis_ctrl.study.files import output_folder
    from avis_ctrl.study.gap_axis import FILES, write_axis_gap

    given: dict[str, Any] = {
        "kind": kind,
        "columns": roles(columns) or None,
        "scale": factors(scale) or None,
        "sample_rate_Hz": sample_rate_Hz,
        "output": output,
        "range_s": range_s,
        "resample_Hz": resample_Hz,
        **{name: one for name, one in {"band_Hz": band_Hz, "cutoff_Hz": cutoff_Hz}.items() if one is not None},
    }
    terminal = Terminal()
    files: list[str] = []
    with output_folder(out, FILES) if out else nullcontext() as folder:
        with Progress(terminal) as progress:
            found = find_axis_gap_in(path=[path, *(also or ())], progress=progress, **given)
        if folder:
            files = write_axis_gap(folder, found, path.name, given, lambda *told: rendered(document(*told)))
    terminal.print(f"verdict: {found.verdict}")
    terminal.print(*found.sentences, soft_wrap=True, markup=False)
    values = (*found.parameters.items(), *found.ratios.items())
    terminal.print(*(f"{name} = {one}" for name, one in values), markup=False)
    for stage in found.stages:
        noise = "" if isnan(stage.chi2_per_dof) else f", chi2/dof {stage.chi2_per_dof:.4g}"
        error = f"- {stage.name}: {100 * stage.nrmse:.3g} % on held-out data{noise}"
        terminal.print(error, soft_wrap=True, markup=False)
    if folder:
        terminal.files(files, folder, *FILES[1:3])
