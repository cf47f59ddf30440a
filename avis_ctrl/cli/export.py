"""`avis export`: the controller for a rig's processor, with a certificate computed from the exported numbers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from avis_ctrl.cli.console import Progress, Terminal
from avis_ctrl.cli.options import Options

if TYPE_CHECKING:  # imports are deferred so that `avis --help` responds at once
    from avis_ctrl.export.anti_windup import Choice
    from avis_ctrl.export.package import Package

ORDERS = "orders.png"  # with --order: the orders tried and their mu


EXPORT = Options("""
DESIGN_DIR: folder that avis design wrote
--out DIR: folder for the controller's files
--controller NAME: a controller of the design; with --check, the one that DIR must have
--order N: export a new controller with at most N states for the axes of the design, found by descent on mu (two minutes
    or more)
--mu-at-most MU: with --order: mu that the new controller may have, instead of the design's requirement
--format LIST: some of c,mat,json; controller.json and certificate.json are always written
--float32: numbers and arithmetic in single precision
--check: write nothing: check that the files in DIR belong together and compute their certificate again
""")


def export(
    design_dir: Annotated[Path, EXPORT("DESIGN_DIR")],
    out: Annotated[Path, EXPORT("--out")],
    controller: Annotated[str | None, EXPORT("--controller", show_default="mu")] = None,
    order: Annotated[int | None, EXPORT("--order")] = None,
    mu_at_most: Annotated[float | None, EXPORT("--mu-at-most")] = None,
    formats: Annotated[str | None, EXPORT("--format", show_default="c,mat,json")] = None,
    float32: Annotated[bool, EXPORT("--float32")] = False,
    check: Annotated[bool, EXPORT("--check")] = False,
) -> None:
    """Write a controller for the rig's processor: sensor volts to drive volts, all axes.

    Writes controller.json, avis_controller.h and .c (C99), controller.mat, test_vectors.csv, restart_vectors.csv and
    certificate.json into DIR. The certificate is computed from the numbers in controller.json (docs/export.md).
    """
    from avis_ctrl import plot
    from avis_ctrl.checks import require_whole
    from avis_ctrl.errors import InputError
    from avis_ctrl.export.design_folder import open_design
    from avis_ctrl.export.fewer_states import mu_asked, with_fewer_states
    from avis_ctrl.export.package import FILES, FORMATS, check_package, formats_of, make_package
    from avis_ctrl.files import write_together
    from avis_ctrl.lti.norms import decibels
    from avis_ctrl.plot.axes import png
    from avis_ctrl.study.files import output_folder

    terminal, asked = Terminal(), FORMATS if formats is None else formats_of(formats)
    for option, value in (("--order", order), ("--format", formats), ("--float32", float32 or None)):
        if check and value is not None:
            raise InputError(f"--check writes no files; expected either --check or {option}", field=option, value=value)
    if order is not None:
        require_whole(order, "--order", 1)
    if mu_at_most is not None and not (order is not None and mu_at_most > 0):
        raise InputError(
            "expected a positive number, and only together with --order", field="--mu-at-most", value=mu_at_most
        )
    folder = open_design(design_dir)
    if check:
        with Progress(terminal) as progress:
            wrong = check_package(folder, out, progress, controller)
        if wrong:
            raise InputError(
                f"{len(wrong)} {'difference' if len(wrong) == 1 else 'differences'}: "
                f"{'; '.join(wrong[:2])}{'; and others, listed above' if len(wrong) > 2 else ''}. Export "
                "the controller again",
                file=out,
            )
        terminal.print(f"{out}: the files belong together, and the certificate is that of controller.json.")
        return
    controller = controller or "mu"
    K = folder.controller(controller)  # a wrong name is reported before anything is created
    with output_folder(out, (*FILES, ORDERS)) as path, Progress(terminal) as progress:
        pictures, most = dict[str, bytes](), float("inf")
        if order is not None:
            most = mu_asked(folder.design) if mu_at_most is None else mu_at_most
            progress(f"controller of {order} states: descent on mu from the one with {K.nstates} states")
            folder, controller = with_fewer_states(folder, controller, order, progress)
            orders = list(folder.added[controller].orders)
            title = "mu at most, with the design's model; the last one is exported"
            pictures[ORDERS] = png(lambda ax: plot.order(orders, ax).set_title(title), 6, 4)
        made = make_package(folder, controller, "float32" if float32 else "float64", asked, progress, most)
        files = write_together(path, pictures | made.contents, [path / name for name in (*FILES, ORDERS)])
    if order is not None:
        ends = {len(orders) - 1: "exported", 0: "of the folder"}
        rows = [(str(states), f"{mu:.4g}", ends.get(k, "")) for k, (states, mu) in enumerate(orders)]
        terminal.table(("states", "mu at most, design's model", ""), rows, title="order against mu")
    _summary(terminal, made)
    if (mu := made.certificate.content["mu_upper"]) > (allowed := mu_asked(folder.design)):
        terminal.print(f"mu of the code is at most {mu:.4g}; the design requires at most {allowed:g}.")
    peak_dB = min(folder.design.upper_limits("worst_case_peak_transmissibility_dB"), default=math.inf)
    if made.replay and (simulated := decibels(made.replay.gain)) > peak_dB:
        terminal.print(
            f"With all six axes, the gain of the worst plant simulated with the compiled code is {simulated:.2f} dB. "
            f"The design requires at most {peak_dB:g} dB for its axes, with the others locked; to include these, "
            "add them to keep in the design file."
        )
    terminal.print(f"{len(files)} files in {path}")


def _anti_windup(choice: Choice) -> str:
    """The chosen anti-windup, and the recovery at the highest level with and without it."""
    with_it, without = (1e3 * one[-1, 0] for one in (choice.chosen, choice.without))
    after = f"after floor motion that demands {choice.levels[-1]:g} times the drives' range"
    if choice.corner_Hz is None:
        return (
            "No anti-windup: each law tried slows the recovery at some level of the floor, or is no better; "
            f"{after} the payload moves with {without:.3g} mm/s r.m.s."
        )
    return (
        f"Anti-windup: lag of {choice.corner_Hz:g} Hz, gain {choice.gain:g}; {after} the payload moves with "
        f"{with_it:.3g} mm/s r.m.s., {without:.3g} mm/s without it."
    )


def _summary(terminal: Terminal, made: Package) -> None:
    found = made.certificate.content
    rows = (
        ("mu, upper bound", found["mu_upper"], ""),
        ("mu, lower bound", found["mu_lower"], ""),
        ("worst-case transmissibility, peak", found["worst_case_peak_transmissibility_dB"], " dB"),
        ("worst-case transmissibility in the band", found["worst_case_band_transmissibility_dB"], " dB"),
        ("worst-case gain, between samples too", found["between_samples"]["worst_case_gain_dB"], " dB"),
        ("worst plant simulated with the compiled code", made.replay and 20 * math.log10(made.replay.gain), " dB"),
        ("gain at zero frequency, drive volts per sensor volt", found["at_rest"]["gain_V_per_V"], " V/V"),
        (
            f"drive {found['at_rest']['drive']}: voltage for offsets of {1e3 * found['at_rest']['offset_V']:.3g} mV",
            found["at_rest"]["drive_V"],
            " V",
        ),
        ("the same, relative to its limit", found["at_rest"]["percent_of_limit"], " %"),
        ("bound on the payload velocity caused by rounding", found["rounding_noise_m_per_s"], " m/s"),
        ("execution time per sample on this machine", found["step_time_us"], " us"),
    )
    terminal.table(
        ("computed from the exported numbers", ""),
        [(name, "not measured" if value is None else f"{value:.4g}{unit}") for name, value, unit in rows],
        title="certificate",
        caption="Bounds: the axes of the design, with the others locked. Simulation: all six axes.",
    )
    terminal.print(_anti_windup(made.anti_windup), *(f"Not proved: {reason}" for reason in made.certificate.reasons))
