"""`avis gap`: the physical effects that a model lacks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from avis_ctrl.cli.console import Progress, Terminal
from avis_ctrl.cli.file_options import EXCITATION, PERIOD, SAMPLE_RATE, UNIT_Y, known_hints, read_campaign
from avis_ctrl.cli.options import Options
from avis_ctrl.errors import InputError

if TYPE_CHECKING:  # imports are deferred so that `avis --help` responds at once
    from avis_ctrl.study.gap import GapFinding


GAP = Options("""
CAMPAIGN: records of the rig: HDF5, .mat, UFF 58 or CSV
--rig RIG: avis, halcyonics, halcyonics_loaded or a rig.toml
--out DIR: folder for gap.json, report and models
--columns ROLE=NAME,..: which variable of the file is what, as in avis identify
--band LOW HIGH: fitted band [Hz]; by default the excited band
--amplifier-corner: expected corner of the amplifiers' first-order lag [Hz]; by default none, or 300 Hz on a rig with
    accelerometers. The time constant is fitted (docs/gap_engine.md)
--design: also design controllers on both models, to show the influence of the effect on mu (about a minute more);
    the default design is for a table on isolators
--design-file DESIGN.toml: as --design, with the axes, uncertainty and weights of this file instead of the default
    design for z and phi_x
--effects FILE.py: Python file with effects of your own, run before the search (docs/own_effect.md)
--despite-gates: continue even if a gate reports a stop
--seed: recorded in the results; no verdict depends on it
""")


def gap(
    campaign: Annotated[Path, GAP("CAMPAIGN")],
    rig: Annotated[str, GAP("--rig")],
    out: Annotated[Path, GAP("--out")],
    columns: Annotated[str | None, GAP("--columns")] = None,
    period_s: PERIOD = None,
    excitation: EXCITATION = None,
    sample_rate_Hz: SAMPLE_RATE = None,
    unit_y: UNIT_Y = None,
    band_Hz: Annotated[tuple[float, float] | None, GAP("--band")] = None,
    amplifier_Hz: Annotated[float | None, GAP("--amplifier-corner")] = None,
    design: Annotated[bool, GAP("--design")] = False,
    design_file: Annotated[Path | None, GAP("--design-file")] = None,
    effects: Annotated[Path | None, GAP("--effects")] = None,
    despite_gates: Annotated[bool, GAP("--despite-gates")] = False,
    seed: Annotated[int, GAP("--seed")] = 1,
) -> None:
    """Find where model and measurement disagree, and name the physical effects that the model lacks.

    Writes gap.json, gap.html, gap.pdf and the models baseline and updated (.json, .toml) into DIR. Then `avis predict
    DIR OTHER --out PRED.h5` predicts another campaign with both models.
    """
    from avis_ctrl.measurement.campaign import in_short
    from avis_ctrl.rigs import load_rig
    from avis_ctrl.study.file_names import DESIGN_FOLDER, GAP_FILES, GAP_REPORTS
    from avis_ctrl.study.files import output_folder
    from avis_ctrl.study.gap import GapOptions, find_gap

    terminal = Terminal()
    options = GapOptions(
        seed, band_Hz, True, despite_gates, amplifier_Hz, design or design_file is not None, design_file
    )  # raises at once if they are invalid
    if effects is not None:
        from avis_ctrl.gap.effects.user_effects import load_effects

        own = load_effects(effects)
        options = replace(options, own_effects=own)
        terminal.print(f"[dim]effects of your own: {', '.join(own.names)}[/]")
    start = load_rig(rig)
    if options.design:
        from avis_ctrl.study.gap_design import design_for

        design_for(start, design_file)  # raises at once, not after the search, if it is invalid
    measured = read_campaign(campaign, start, columns, **known_hints(period_s, excitation, sample_rate_Hz, unit_y))
    terminal.print(*(f"[dim]{note}[/]" for note in in_short(measured.notes)))
    folders = (DESIGN_FOLDER,) if options.design else ()
    with output_folder(out, GAP_FILES, folders) as folder, Progress(terminal) as progress:
        from avis_ctrl.report import rendered
        from avis_ctrl.report.gap.content import document
        from avis_ctrl.study.gap_files import write_gap

        try:
            found = find_gap(measured, start, options, progress)
        except InputError as error:
            raise error if error.file else error.in_file(campaign) from None
        progress("report")
        files = write_gap(
            folder, found.gap, *rendered(document(found)), found.to_json(), found.design.files if found.design else None
        )
    _summary(terminal, found)
    then = ""
    if found.design is not None and found.design.files:
        made = folder / DESIGN_FOLDER
        then = f"; next: avis design {made / 'design.toml'} --out {made / 'controller'}, then avis export"
    terminal.files(files, folder, *GAP_REPORTS, then)


def _summary(terminal: Terminal, found: GapFinding) -> None:
    gap = found.gap
    terminal.print(f"[bold]{gap.verdict}[/]: {gap.sentences[0]}")
    rows = [(stage.name, f"{100 * stage.nrmse:.3g} %", f"{stage.chi2_per_dof:.4g}") for stage in gap.stages]
    rows.append(("[dim]noise alone[/]", f"[dim]{100 * gap.noise_nrmse:.3g} %[/]", "[dim]1[/]"))
    header = ("stage", "error of held-out y, r.m.s.", "chi-square per degree of freedom")
    terminal.table(header, rows, title="gap on held-out records")
    said = [*gap.sentences[1:]]
    if gap.next_experiment:
        said.append(f"next: {gap.next_experiment}")
    elif gap.effects and found.design is None and not found.design_note:
        said.append(
            "next: --design shows the influence on the controller; avis predict tests the updated model "
            "on another campaign"
        )
    if found.design is not None:
        said += found.design.sentences
    if found.design_note:
        said.append(found.design_note)
    terminal.print(*(f"- {sentence}" for sentence in said))
