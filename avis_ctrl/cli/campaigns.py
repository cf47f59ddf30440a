"""`avis excite`, `avis simulate-campaign`, `avis convert`: excitation signals, simulated campaigns, file formats."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from avis_ctrl.cli.console import Progress, Terminal
from avis_ctrl.cli.file_options import EXCITATION, PERIOD, SAMPLE_RATE, UNIT_Y, known_hints
from avis_ctrl.cli.options import Options
from avis_ctrl.errors import InputError


@dataclass(frozen=True)
class LevelSettings:
    """share : fraction of the largest level at which nothing clips [1]: a rig may respond more strongly than its file
    predicts, but not twice as strongly.
    """

    share: float = 0.5


SETTINGS = LevelSettings()
RIG = Annotated[str, typer.Option("--rig", metavar="RIG", help="avis, halcyonics, halcyonics_loaded or a rig.toml")]


EXCITE = Options("""
--out FILE: signals.h5, .csv or .mat
--kind: multisine or noise
--band LOW HIGH: Hz
--period: period of a multisine, or length of a noise record [s]
--periods: number of periods of a multisine; the first one contains the transient
--rms: r.m.s. voltage of each drive [V]; by default half of the largest level at which neither the drives nor the
    converter clip, computed for the rig file
--lines: full, odd or odd_detection (odd lines, one in each group not excited)
--scheme: orthogonal (one record per drive, all drives on all lines) or zippered (one record, each drive has its own
    lines)
--seed: seed of all random draws
""")


def excite(
    rig: RIG,
    out: Annotated[Path, EXCITE("--out")],
    kind: Annotated[str, EXCITE("--kind")] = "multisine",
    band_Hz: Annotated[tuple[float, float], EXCITE("--band")] = (0.5, 60.0),
    period_s: Annotated[float, EXCITE("--period")] = 10.0,
    periods: Annotated[int, EXCITE("--periods")] = 6,
    rms_V: Annotated[float | None, EXCITE("--rms")] = None,
    lines: Annotated[str, EXCITE("--lines")] = "full",
    scheme: Annotated[str, EXCITE("--scheme")] = "orthogonal",
    seed: Annotated[int, EXCITE("--seed")] = 1,
) -> None:
    """Generate excitation signals for the rig: multisines of low crest factor, or noise, within its voltage limit."""
    from avis_ctrl.measurement.excitation.design import MultisineSettings, NoiseSettings, multisine, noise
    from avis_ctrl.measurement.excitation.files import require_suffix, write_signals
    from avis_ctrl.rigs import load_rig
    from avis_ctrl.simulation.campaign_data import largest_level, open_loop
    from avis_ctrl.study.files import require_output
    from avis_ctrl.study.plan_file import plan_from_table

    require_suffix(out)
    require_output(out)
    terminal = Terminal()
    table = load_rig(rig)
    names, limit_V = table.equations_of_motion().actuators, float(table.drive_limits_V().min())
    with Progress(terminal) as progress:
        progress(f"{kind} for {len(names)} drives, {band_Hz[0]:g} to {band_Hz[1]:g} Hz")
        if kind == "multisine":
            words: dict[str, Any] = {"lines": lines, "scheme": scheme}  # the settings refuse unknown ones
            signals = multisine(
                MultisineSettings(names, table.sample_rate_Hz, period_s, band_Hz, limit_V, rms_V, **words, seed=seed)
            )
        elif kind == "noise":
            signals = noise(NoiseSettings(names, table.sample_rate_Hz, period_s, band_Hz, limit_V, rms_V, seed=seed))
        else:
            raise InputError("expected multisine or noise", field="--kind", value=kind)
        if rms_V is None:
            progress("level: a noise-free simulation of the rig, to find the level at which the sensors clip")
            plan = plan_from_table({"title": "level", "duration_s": period_s, "record": [{"excitation": "rest"}]})
            most = largest_level(open_loop(table, plan), signals, signals.u.shape[1] * (periods if periods < 4 else 4))
            signals = signals.scaled_to(SETTINGS.share * most)
        write_signals(signals, out, periods if kind == "multisine" else 1, table.name)
    quantities = (signals.rms_V, signals.peak_V, signals.crest, signals.crest_before)
    terminal.table(
        ("record", "r.m.s. [V]", "peak [V]", "crest factor", "before optimisation"),
        [(str(k), *(f"{values[k].max():.3g}" for values in quantities)) for k in range(len(signals.u))],
        title="largest value over the drives",
    )
    terminal.print(f"{out}: {len(signals.u)} records to play; limit {limit_V:g} V")


SIMULATE_CAMPAIGN = Options("""
--out CAMPAIGN.h5: file to write
--plan PLAN.toml: records, levels, floor; by default multisines at three levels, noise, rest and a shaken floor
--write-plan FILE: write the plan used, as a starting point; without --out nothing is simulated
--truth FILE: also write the rig that was simulated, with its perturbed values
--perturbed: default plan; stiffness, mass and inertia differ from the rig file by up to 5 %, damping by up to 20 %, and
    values with a tolerance in the rig file by random amounts (normal, the tolerance is the standard deviation)
--orthogonal: default plan with orthogonal multisines
--duration: length of each record of the default plan in seconds
--effects FILE.py: Python file with effects of your own that the plan names (docs/own_effect.md)
--seed: seed of excitation, floor, noise and perturbation; for another campaign of the same table, use the file written
    by --truth as --rig
""")


def simulate_campaign(
    rig: RIG,
    out: Annotated[Path | None, SIMULATE_CAMPAIGN("--out")] = None,
    plan: Annotated[Path | None, SIMULATE_CAMPAIGN("--plan")] = None,
    write_plan: Annotated[Path | None, SIMULATE_CAMPAIGN("--write-plan")] = None,
    truth: Annotated[Path | None, SIMULATE_CAMPAIGN("--truth")] = None,
    perturbed: Annotated[bool, SIMULATE_CAMPAIGN("--perturbed")] = False,
    orthogonal: Annotated[bool, SIMULATE_CAMPAIGN("--orthogonal")] = False,
    duration_s: Annotated[float, SIMULATE_CAMPAIGN("--duration")] = 60.0,
    effects: Annotated[Path | None, SIMULATE_CAMPAIGN("--effects")] = None,
    seed: Annotated[int, SIMULATE_CAMPAIGN("--seed")] = 1,
) -> None:
    """Simulate a measurement campaign with the nonlinear model, to plan an identification."""
    from avis_ctrl.files import write_whole
    from avis_ctrl.measurement.formats.hdf5 import write_campaign
    from avis_ctrl.rigs import load_rig
    from avis_ctrl.study.files import require_hdf5_output, require_output
    from avis_ctrl.study.hidden_effects import campaign_with_effects
    from avis_ctrl.study.plan_file import default_plan, plan_toml, read_plan

    if out is not None:
        require_hdf5_output(out, plan, rig, effects)
    for written in (write_plan, truth):
        if written is not None:
            require_output(written, plan, rig, effects)
    if plan and (perturbed or orthogonal):
        raise InputError(
            "these belong to the default plan; in a plan, write perturb_percent under [truth] and scheme "
            "under [multisine]",
            field="--perturbed, --orthogonal",
        )
    if effects is not None:
        from avis_ctrl.gap.effects.user_effects import load_effects

        load_effects(effects)
    terminal = Terminal()
    table = load_rig(rig)
    chosen = (
        read_plan(plan)
        if plan
        else default_plan(table, "orthogonal" if orthogonal else "zippered", perturbed=perturbed, duration_s=duration_s)
    )
    if out is None:
        if write_plan is None or truth is not None:
            raise InputError("expected a file for the campaign", field="--out")
        write_whole(write_plan, plan_toml(chosen).encode())
        terminal.print(f"{write_plan}: plan of a campaign, to edit; simulate it with --plan {write_plan} --out FILE.h5")
        return
    with Progress(terminal) as progress:
        try:
            simulated = campaign_with_effects(
                table, chosen, seed, lambda k, total, name: progress(f"record {name}, {k} of {total}")
            )
        except InputError as error:
            section = re.split(r"\W", error.field or "")[0]
            of_plan = plan and not error.file and section in type(chosen).model_fields
            raise (error.in_file(plan) if of_plan else error) from None
        write_campaign(out, simulated.campaign)
    for path, text in ((write_plan, plan_toml(chosen)), (truth, simulated.truth_toml())):
        if path:
            write_whole(path, text.encode())
    terminal.print(*simulated.campaign.notes)
    terminal.print(f"{out}: {len(simulated.campaign.records)} records, seed {seed}")


CONVERT = Options("""
MEASUREMENT: HDF5, .mat, UFF 58, CSV or a folder of CSV
CAMPAIGN.h5: file to write (or give --out)
--out CAMPAIGN.h5: file to write
--columns ROLE=NAME,..: which variable is what, such as u=vir,y=qm,t=t; names of the channels: y_names=Sy1+Sz1
--rig: name of the rig, if the file has none
""")


def convert(
    source: Annotated[Path, CONVERT("MEASUREMENT")],
    file: Annotated[Path | None, CONVERT("CAMPAIGN.h5")] = None,
    out: Annotated[Path | None, CONVERT("--out")] = None,
    columns: Annotated[str | None, CONVERT("--columns")] = None,
    rig: Annotated[str | None, CONVERT("--rig")] = None,
    period_s: PERIOD = None,
    excitation: EXCITATION = None,
    sample_rate_Hz: SAMPLE_RATE = None,
    unit_y: UNIT_Y = None,
) -> None:
    """Convert a measurement file to a campaign in HDF5, and print the assumptions made."""
    from avis_ctrl.measurement.campaign import Campaign, in_short
    from avis_ctrl.measurement.formats import parse_columns, read_measurements
    from avis_ctrl.measurement.formats.hdf5 import write_campaign, write_frequency_response
    from avis_ctrl.study.files import require_hdf5_output

    target = out or file
    if target is None:
        raise InputError("missing; expected the file to write", field="--out")
    if file is not None and out is not None:
        raise InputError(f"give the output file once; {file} and --out were both given", field="--out", value=str(out))
    require_hdf5_output(target, source)
    terminal = Terminal()
    measured = read_measurements(
        source,
        parse_columns(columns) if columns else None,
        rig,
        **known_hints(period_s, excitation, sample_rate_Hz, unit_y),
    )
    if isinstance(measured, Campaign):
        write_campaign(target, measured)
        terminal.print(*in_short(measured.notes))
        terminal.print(
            f"{target}: {len(measured.records)} records of {len(measured.u_names)} inputs and "
            f"{len(measured.y_names)} outputs at {measured.sample_rate_Hz:g} Hz"
        )
    else:
        write_frequency_response(target, measured)
        terminal.print(
            f"{target}: frequency responses at {len(measured.frequency_Hz)} frequencies, {len(measured.inputs)} "
            f"inputs, {len(measured.outputs)} outputs"
        )
