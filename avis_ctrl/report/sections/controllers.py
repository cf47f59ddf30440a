"""The controllers: gain over frequency, poles, loop and sensitivity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avis_ctrl.lti.norms import in_dB
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.report import words
from avis_ctrl.report.elements import Section, Table, listed, section
from avis_ctrl.report.figures import STYLES, Axis, Curve, Figure, Panel, controller_style, hertz, numbered
from avis_ctrl.report.settings import SETTINGS
from avis_ctrl.study.design_result import ControllerResult, DesignResult

HZ = np.geomspace(*SETTINGS.loop_Hz, SETTINGS.loop_points)


def controllers(result: DesignResult) -> Section:
    """The section on the controllers."""
    made = [c for c in result.controllers if c.K is not None]
    figures = (_gains(made), _bode(result), _loops(result, made))
    return section("Controllers", "controllers", _files(result, made), figures, _poles(result.controller("mu")))


def _system(c: ControllerResult) -> StateSpace:
    assert c.K is not None  # callers exclude the passive rig
    return c.K


def _files(result: DesignResult, made: list[ControllerResult]) -> Table:
    rate = result.rig.sample_rate_Hz
    return listed(
        f"The controllers and their state-space files. The fastest pole is compared with half the sample "
        f"rate of {words.number(rate, 4)} Hz. The gain at zero frequency converts offsets of the sensor "
        "electronics into drive voltage. The last column is the fraction of a drive's range that the largest "
        "offsets of the rig file use up, each with its worst-case sign.",
        made,
        {
            "controller": lambda c: c.title,
            "file": lambda c: f"controllers/{c.name}.json",
            "order": lambda c: str(c.order),
            "fastest pole": lambda c: f"{words.number(c.fastest_pole_Hz)} Hz",
            "relative to half the rate": lambda c: words.number(2 * c.fastest_pole_Hz / rate),
            "stable by itself": lambda c: words.yes(_system(c).is_stable()),
            "gain at zero frequency": lambda c: f"{words.number(c.rest.gain_Ns_per_m)} N s/m" if c.rest else "",
            "fraction of the range for offsets": lambda c: _offset(c.rest.percent) if c.rest else "",
        },
        "llrrrcrr",
    )


def _offset(percent: float) -> str:
    """Fraction of a drive's range in per cent; values up to 1e-4 % are round-off, shown as zero."""
    return f"{words.number(percent if percent > 1e-4 else 0.0)} %"


def _gains(made: list[ControllerResult]) -> Figure:
    omega = 2 * np.pi * HZ
    curves = []
    for c in made:
        sigma = np.linalg.svd(_system(c).frequency_response(omega), compute_uv=False)
        style = controller_style(c.name)
        curves.append(Curve(HZ, sigma[:, 0], c.title, style))
        if sigma.shape[1] > 1:
            curves.append(Curve(HZ, sigma[:, -1], "", replace(style, width=0.8)))
    return Figure(
        "controller_gains",
        "Singular values of the controllers, from measured velocity to force: largest (thick) and smallest (thin).",
        [Panel(hertz(), Axis("gain [N s/m]", "log"), curves)],
    )


def _bode(result: DesignResult) -> Figure:
    """Every entry of a small controller; of a large one the diagonal, and the largest gain beside it."""
    K = _system(result.controller("mu"))
    response = K.frequency_response(2 * np.pi * HZ)
    axes = [words.axis(name) for name in result.plant.axes]
    every = response[0].size <= SETTINGS.controller_entries
    sizes, phases = [], []
    for i, j in np.ndindex(response.shape[1:]):
        if every or i == j:
            style = numbered(i * K.ninputs + j if every else i)
            label = f"{axes[j]} to {axes[i]}"
            sizes.append(Curve(HZ, np.abs(response[:, i, j]), label, style))
            phases.append(Curve(HZ, (np.degrees(np.angle(response[:, i, j])) + 180) % 360 - 180, label, style))
    what = "each measurement to each command"
    if not every:
        coupling = np.where(np.eye(K.noutputs, dtype=bool), 0.0, np.abs(response)).max(axis=(1, 2))
        sizes.append(Curve(HZ, coupling, "largest gain between two axes", STYLES["faint"]))
        what = "the measurement of each axis to the command of the same axis, and the largest gain between two axes"
    return Figure(
        "controller_bode",
        f"Bode plot of the mu controller: {what}; the phase is wrapped into ±180 degrees.",
        [
            Panel(hertz(), Axis("gain [N s/m]", "log"), sizes),
            Panel(hertz(), Axis("phase [deg]", "linear", (-190.0, 190.0)), phases),
        ],
        2,
    )


def _loops(result: DesignResult, made: list[ControllerResult]) -> Figure:
    P = result.plant.synthesis.P
    omega = 2 * np.pi * HZ
    y, u = list(result.plant.synthesis.y), list(result.plant.synthesis.u)
    G = P.select(y, u).frequency_response(omega)
    loops, sensitivities, peaks = [], [], []
    for c in made:
        L = G @ _system(c).frequency_response(omega)
        S = np.linalg.inv(np.eye(L.shape[1]) - L)
        size = np.linalg.norm(S, ord=2, axis=(1, 2))
        peaks.append(f"{c.title} {words.decibel(float(size.max()))}")
        loops.append(Curve(HZ, in_dB(np.linalg.norm(L, ord=2, axis=(1, 2))), c.title, controller_style(c.name)))
        sensitivities.append(Curve(HZ, in_dB(size), c.title, controller_style(c.name)))
    return Figure(
        "loops",
        "Largest singular value of the open loop G K at the measurement (left) and of the "
        f"sensitivity (I − G K)⁻¹ (right); nominal plant. Peaks of the sensitivity: {'; '.join(peaks)}.",
        [
            Panel(hertz(), Axis("open loop [dB]", "linear", (-80.0, _above(loops, 50.0))), loops),
            Panel(hertz(), Axis("sensitivity [dB]", "linear", (-40.0, _above(sensitivities, 20.0))), sensitivities),
        ],
        2,
    )


def _above(curves: list[Curve], least: float) -> float:
    """End of an axis in dB that no curve exceeds, at least a given one."""
    return max(least, 10.0 * float(np.ceil(max(np.max(one.y) for one in curves) / 10)))


def _poles(mu: ControllerResult) -> Table:
    poles = sorted((p for p in _system(mu).poles() if p.imag >= 0), key=abs)
    beyond = len(poles) - SETTINGS.poles
    left = f" The fastest {beyond} are listed only in the file." if beyond > 0 else ""
    return listed(
        f"Poles of the mu controller, slowest first; a pair counts once.{left}",
        poles[: SETTINGS.poles],
        {
            "frequency": lambda p: f"{words.number(abs(p) / (2 * np.pi), 4)} Hz",
            "damping ratio": lambda p: words.number(-p.real / abs(p) if abs(p) > 0 else 1.0),
            "kind": lambda p: "pair" if p.imag > 0 else "real",
        },
        "rrl",
    )
