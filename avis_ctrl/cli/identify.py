"""`avis identify`, `avis predict` and `avis single-axis`: models from measurements, and predictions with them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from avis_ctrl.cli.console import Progress, Terminal
from avis_ctrl.cli.file_options import (
    EXCITATION,
    PERIOD,
    SAMPLE_RATE,
    UNIT_Y,
    factors,
    known_hints,
    read_campaign,
    read_measured,
    roles,
)
from avis_ctrl.cli.options import Options
from avis_ctrl.errors import AvisError, InputError

if TYPE_CHECKING:  # imports are deferred so that `avis --help` responds at once
    from avis_ctrl.study.identification import Identification


IDENTIFY = Options("""
MEASUREMENT: HDF5 campaign, .mat, UFF 58, CSV or a folder of CSV; records or frequency responses
--rig RIG: rig to start from: avis, halcyonics, halcyonics_loaded or a rig.toml
--out DIR: folder for rig, report and uncertainty
--columns ROLE=NAME,..: which variable of the file is what, such as u=V1+V2,y=S1,t=time; names of the channels:
    y_names=Sy1+Sz1
--parameter NAME: parameter to fit, such as 'isolator*.k_z' (repeatable); by default mass, inertia, stiffness, damping
--prior NAME=MEAN+-STD: prior knowledge of a parameter (repeatable)
--hold-out RECORD: record kept for validation (repeatable); chosen automatically by default
--band LOW HIGH: fitted band [Hz]; by default the excited band
--starts: number of starting points of the fit
--amplifier-corner: expected corner of the amplifiers' first-order lag [Hz]; by default none, or 300 Hz on a rig with
    accelerometers. For records of a table on isolators, the time constant is fitted (docs/gap_engine.md)
--kalman: also run the extended Kalman filter, for comparison
--design DESIGN.toml: design file whose rig and uncertainty are replaced by the identified ones; by default a design for
    z and phi_x with the weights of the shipped examples
--despite-gates: continue even if a gate reports a stop
--seed: seed of all random draws
""")


def identify(
    measurement: Annotated[Path, IDENTIFY("MEASUREMENT")],
    rig: Annotated[str, IDENTIFY("--rig")],
    out: Annotated[Path, IDENTIFY("--out")],
    columns: Annotated[str | None, IDENTIFY("--columns")] = None,
    period_s: PERIOD = None,
    excitation: EXCITATION = None,
    sample_rate_Hz: SAMPLE_RATE = None,
    unit_y: UNIT_Y = None,
    parameters: Annotated[list[str] | None, IDENTIFY("--parameter")] = None,
    priors: Annotated[list[str] | None, IDENTIFY("--prior")] = None,
    hold_out: Annotated[list[str] | None, IDENTIFY("--hold-out")] = None,
    band_Hz: Annotated[tuple[float, float] | None, IDENTIFY("--band")] = None,
    starts: Annotated[int, IDENTIFY("--starts")] = 3,
    amplifier_Hz: Annotated[float | None, IDENTIFY("--amplifier-corner")] = None,
    kalman: Annotated[bool, IDENTIFY("--kalman")] = False,
    design: Annotated[Path | None, IDENTIFY("--design")] = None,
    despite_gates: Annotated[bool, IDENTIFY("--despite-gates")] = False,
    seed: Annotated[int, IDENTIFY("--seed")] = 1,
) -> None:
    """Identify a rig and its uncertainty from measurements, and write a report.

    Writes rig.toml, uncertainty.json, design.toml, report.html, report.pdf and result.json into DIR. Then
    `avis design DIR/design.toml --out DIR2` designs controllers for the identified rig.
    """
    from avis_ctrl.measurement.campaign import Campaign, in_short
    from avis_ctrl.rigs import load_rig
    from avis_ctrl.study.design_file import read_design
    from avis_ctrl.study.file_names import IDENTIFICATION_FILES, REPORT_FILES
    from avis_ctrl.study.files import output_folder

    terminal = Terminal()
    start = load_rig(rig)
    template = None if design is None else read_design(design)  # raises at once, not after the fit
    measured = read_measured(measurement, start, columns, **known_hints(period_s, excitation, sample_rate_Hz, unit_y))
    notes = in_short(measured.notes) if isinstance(measured, Campaign) else ()
    terminal.print(*(f"[dim]{note}[/]" for note in notes))
    with output_folder(out, IDENTIFICATION_FILES) as folder, Progress(terminal) as progress:
        from avis_ctrl.report import rendered
        from avis_ctrl.report.identification.content import document
        from avis_ctrl.study.identification import IdentifyOptions, identify
        from avis_ctrl.study.identification_design import design_start
        from avis_ctrl.study.identification_output import write_identification

        options = IdentifyOptions(
            tuple(parameters or ()),
            dict(_prior(text) for text in priors or ()),
            tuple(hold_out) if hold_out else None,
            band_Hz,
            starts,
            kalman,
            despite_gates,
            seed,
            amplifier_Hz,
        )
        found = identify(measured, start, options, progress)
        progress("uncertainty for design")
        try:
            more, made = design_start(found, template)
            then = (
                f"; next: avis design {folder / 'design.toml'} --out {folder / 'design'}"
                if found.validation.explains
                else f"; the model does not explain the records; next: avis gap {measurement} --rig {rig} --out DIR"
            )
        except AvisError as error:
            # The identification is valid without the design files.
            more, made, then = {}, None, f"; uncertainty.json and design.toml were not written: {error}"
        progress("report")
        files = write_identification(found, folder, *rendered(document(found, made)), more)
    _summary(terminal, found)
    terminal.files(files, folder, *REPORT_FILES, then)


PREDICT = Options("""
DIR: output folder of avis identify, avis gap or avis gap-axis
CAMPAIGN: another campaign of the same rig; another record, if DIR is that of avis gap-axis
--out PRED.h5: file to write
--effects FILE.py: file with your own effects, if the models of avis gap contain them
""")


def predict(
    folder: Annotated[Path, PREDICT("DIR")],
    campaign: Annotated[Path, PREDICT("CAMPAIGN")],
    out: Annotated[Path, PREDICT("--out")],
    effects: Annotated[Path | None, PREDICT("--effects")] = None,
) -> None:
    """Predict the sensor signals of another campaign from its voltages and floor motion, and compare them with the
    measured ones.

    Writes /records/NN/y for an identified rig, or /records/NN/y_baseline and /records/NN/y_updated for the models of
    avis gap.
    """
    from avis_ctrl.study.file_names import GAP_FILE
    from avis_ctrl.study.files import require_hdf5_output
    from avis_ctrl.study.gap_axis import is_axis_gap, write_axis_predictions
    from avis_ctrl.study.prediction_file import compared, prediction_errors

    require_hdf5_output(out, campaign)
    terminal = Terminal()
    if is_axis_gap(folder):
        several = write_axis_predictions(folder, [campaign], out)
        rows = [(name, *(f"{100 * one:.3g} %" for one in both)) for name, *both in several]
        terminal.table(("record", "baseline", "updated"), rows, title="r.m.s. error relative to what was measured")
        terminal.print(f"{out}: {len(several)} records")
        return
    if effects is not None:
        from avis_ctrl.gap.effects.user_effects import load_effects

        load_effects(effects)
    if (folder / GAP_FILE).exists():
        from avis_ctrl.study.gap_files import gap_rig, write_gap_predictions

        rig, write = gap_rig(folder), write_gap_predictions
    else:
        from avis_ctrl.study.identification_output import read_identified, write_predictions

        rig, write = read_identified(folder)[0], write_predictions
    measured = read_campaign(campaign, rig)
    with Progress(terminal) as progress:
        write(folder, measured, out, progress)
        progress("prediction errors")
        errors = list(prediction_errors(out, measured))
    if errors:
        names = list(errors[0].relative)
        noisy = any(one.noise is not None for one in errors)
        rows = []
        for one in errors:
            noise = "" if one.noise is None else f"{100 * one.noise:.3g} %"
            rows.append((one.record, *(f"{100 * one.relative[name]:.3g} %" for name in names), *[noise] * noisy))
        title = "r.m.s. error relative to measured y; each record is predicted from rest"
        terminal.table(("record", *names, *["noise"] * noisy), rows, title=title)
        if noisy:
            terminal.print("noise, which cannot be predicted: differences between periods, or else the records at rest")
        if note := compared(errors):
            terminal.print(note)
    terminal.print(f"{out}: {len(measured.records)} records")


def _prior(text: str) -> tuple[str, tuple[float, float]]:
    name, _, rest = text.partition("=")
    mean, _, sigma = rest.partition("+-")
    try:
        return name.strip(), (float(mean), float(sigma))
    except ValueError:
        raise InputError("expected NAME=MEAN+-STD such as mass=500+-5", field="--prior", value=text) from None


def _summary(terminal: Terminal, found: Identification) -> None:
    from avis_ctrl.uncertain_value import rounded, text

    information = found.information
    loaded = " with its load" if getattr(found.rig, "load", None) else ""
    start = {name: one.value for name, one in found.campaign_fit.first.model.all_parameters().items()}
    start |= {name: one.value for name, one in found.start.parameters().items()}
    rows = []
    for name, value, sigma, unit in zip(
        information.names, information.values, information.standard_deviation, information.units, strict=True
    ):
        shown, std = rounded(value, sigma)
        rows.append((name, f"{start[name]:.6g}", shown, std if sigma < float("inf") else "only in combination", unit))
    header = ("parameter", "start", "identified", "+- 1 sigma", "unit")
    terminal.table(header, rows, title=f"{found.rig.name}{loaded}, identified")
    verdict, *validation = found.validation.sentences
    terminal.print(f"{verdict[:1].upper()}{verdict[1:]}.")
    said = [found.caution, *found.campaign_fit.notes, *validation, *found.identifiability.sentences]
    for one in found.campaign_fit.tolerances[:5]:
        said.append(f"{one.parameter}: {text(one.value, one.std, one.unit)}, moved by {one.moved:+.1f} tolerances")
    if found.advice:
        said.append(f"{found.advice[0]} (The report's section on identifiability lists other records that would help.)")
    terminal.print(*(f"- {sentence}" for sentence in said))


SINGLE_AXIS = Options("""
KIND: seismometer, decay, drive or oscillator
MEASUREMENT: a record; for a seismometer a folder with one CSV per frequency
--columns ROLE=NAME,..: seismometer: drive, and coil and/or displacement, or ground (then drive is its velocity);
    decay: y; drive: force, position, reference; oscillator: u, y; each also t
--scale ROLE=FACTOR,..: factors to SI units
--sample-rate: sample rate [Hz], if the file has no time column
""")


def single_axis(
    kind: Annotated[str, SINGLE_AXIS("KIND")],
    path: Annotated[Path, SINGLE_AXIS("MEASUREMENT")],
    columns: Annotated[str, SINGLE_AXIS("--columns")],
    scale: Annotated[str | None, SINGLE_AXIS("--scale")] = None,
    sample_rate_Hz: Annotated[float | None, SINGLE_AXIS("--sample-rate")] = None,
) -> None:
    """Fit a small model of one axis: a seismometer, a free decay, a drive with friction, or an oscillator."""
    from avis_ctrl.identification.single_axis.identify import identify_single_axis

    names, scales = roles(columns), factors(scale)
    found = identify_single_axis(kind, path, names, scale=scales or None, sample_rate_Hz=sample_rate_Hz)
    terminal = Terminal()
    terminal.print(_assumed_units(kind, names, scales), soft_wrap=True)
    terminal.print(*found.lines())


# Units that the fits assume for each role, after --scale.
UNITS = {
    "seismometer": {"drive": "N (m/s with ground)", "coil": "V", "displacement": "m", "ground": "V"},
    "decay": {"y": "any unit"},
    "drive": {"force": "N", "position": "m", "reference": "m"},
    "oscillator": {"u": "any unit", "y": "any unit"},
}


def _assumed_units(kind: str, roles: dict[str, str], factors: dict[str, float]) -> str:
    """One line with the unit assumed for each column."""
    said = [
        f"{role} = {roles[role]}{f' times {factors[role]:g}' if role in factors else ''} in {unit}"
        for role, unit in UNITS[kind].items()
        if role in roles
    ]
    unscaled = [
        role for role in roles if role in UNITS[kind] and role not in factors and UNITS[kind][role] != "any unit"
    ]
    change = f" (not scaled; if the file has another unit: --scale {unscaled[0]}=FACTOR)" if unscaled else ""
    return f"assumed units: {', '.join(said)}, t in s{change}"
