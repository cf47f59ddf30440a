"""The rig: drawing, parameters, modes, drives and sensors, and the error of the reduced ("small") model."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from avis_ctrl.lti.norms import in_dB
from avis_ctrl.report import words
from avis_ctrl.report.elements import Drawing, Heading, Paragraph, Piece, Section, Table, listed, section, table
from avis_ctrl.report.figures import Axis, Curve, Figure, Panel, Style, hertz, numbered
from avis_ctrl.report.rig_drawing import rig_drawing
from avis_ctrl.rigs.instruments import Sensor
from avis_ctrl.rigs.reduction_error import ReductionError
from avis_ctrl.rigs.rig import Parameter, Rig
from avis_ctrl.simulation.sampled_loop import lever_arms
from avis_ctrl.study.design_result import DesignResult
from avis_ctrl.summary import joined

# By measured quantity: kind of sensor, unit of its gain, and scale factor and unit of its limit.
_KINDS = {
    "velocity": ("geophone", "V s/m", 1e3, "mm/s"),
    "acceleration": ("accelerometer", "V s²/m", 1.0, "m/s²"),
    "displacement": ("position sensor", "V/m", 1e3, "mm"),
}
_NUMBERED = re.compile(r"(?P<group>[A-Za-z_]+)(?P<number>\d+)\.(?P<rest>.+)")


def rig(result: DesignResult) -> Section:
    """The section on the rig."""
    one = result.rig
    drawing = Drawing(
        "rig",
        f"The rig {one.name} by its named points, to scale; the outline is drawn around the "
        "points and is not the real contour. The edge lever turns the rotation phi_x into a "
        "displacement.",
        rig_drawing(one),
        f"Top view and side view of the rig {one.name}",
    )
    tables = (_parameters(one), _modes(one), _drives(one), _sensors(one), _electronics(result))
    return section("The rig", "rig", drawing, tables, _reduction(result))


def _parameters(one: Rig) -> list[Piece]:
    plain: list[tuple[str, str, str, str]] = []
    grouped: dict[str, dict[str, dict[int, Parameter]]] = {}
    for name, p in one.parameters().items():
        if match := _NUMBERED.fullmatch(name):
            rows = grouped.setdefault(match["group"], {})
            rows.setdefault(match["rest"], {})[int(match["number"])] = p
        elif not name.startswith(("actuator.", "place.", "direction.")):  # these are in the tables that follow
            plain.append((name, _value(p.value), words.unit(p.unit), p.description))
    found: list[Piece] = [table("Parameters of the rig.", ("name", "value", "unit", "what it is"), plain, "lrll")]
    for group, rows in grouped.items():
        numbers = sorted({n for row in rows.values() for n in row})
        body = [
            (
                rest,
                words.unit(next(iter(row.values())).unit),
                *(_value(row[n].value) if n in row else "" for n in numbers),
            )
            for rest, row in rows.items()
        ]
        found.append(
            table(
                f"Parameters by {group}: stiffness k, damping c and position p along each axis, the "
                f"position relative to the geometric centre.",
                ("name", "unit", *(f"{group} {n}" for n in numbers)),
                body,
                "ll" + "r" * len(numbers),
            )
        )
    return found


def _value(value: float) -> str:
    return f"{value:.6g}".replace("-", "−")


def _modes(one: Rig) -> Table:
    eom = one.equations_of_motion()
    edge = lever_arms(one, eom.coordinates)
    modes = eom.natural_frequencies()
    rows = []
    for frequency, shape in zip(modes.frequencies_Hz, modes.shapes.T, strict=True):
        damping = float(shape @ eom.C @ shape) / (4 * np.pi * frequency)
        moved = np.abs(shape * edge)
        moved /= moved.max()
        main = sorted(
            ((share, name) for share, name in zip(moved, eom.coordinates, strict=True) if share > 0.1), reverse=True
        )
        rows.append(
            (
                f"{words.number(frequency)} Hz",
                words.number(damping, 2),
                ", ".join(f"{name} {share:.2f}" for share, name in main),
            )
        )
    return table(
        "Natural frequencies of the six degrees of freedom without control, modal damping, and mode shapes "
        "(largest coordinate = 1, rotations as displacement at the edge lever).",
        ("frequency", "damping ratio", "moves mainly"),
        rows,
        "rrl",
    )


def _drives(one: Rig) -> Table:
    actuators = one.mounted_body().actuators
    limits = one.limits_of([a.name for a in actuators]).tolist()
    return listed(
        "Drives: position relative to the geometric centre, direction of the force on the payload for a "
        "positive voltage.",
        list(zip(actuators, limits, strict=True)),
        {
            "name": lambda row: row[0].name,
            "x, y, z [m]": lambda row: _position(row[0].position),
            "direction": lambda row: _direction(row[0].direction),
            "force constant": lambda row: f"{words.number(row[0].constant_N_per_V)} N/V",
            "limit": lambda row: f"±{words.number(row[1])} V",
            "largest force": lambda row: f"±{words.number(row[0].constant_N_per_V * row[1])} N",
        },
        "lllrrr",
    )


def _sensors(one: Rig) -> Table:
    columns: dict[str, Callable[[Sensor], str]] = {
        "name": lambda s: s.name,
        "kind": lambda s: _KINDS[s.quantity][0],
        "x, y, z [m]": lambda s: _position(np.array(s.position)),
        "direction": lambda s: _direction(np.array(s.direction)),
        "gain": lambda s: f"{_value(s.gain)} {_KINDS[s.quantity][1]}",
        "corner": _corner,
        "noise": lambda s: f"{words.number(1e3 * s.noise_rms_V)} mV",
    }
    if (converter := one.converter) is not None:

        def limit(s: Sensor) -> str:
            *_, scale, unit = _KINDS[s.quantity]
            return f"±{words.number(scale * converter.range_V / s.gain)} {unit}"

        columns["limit"] = limit
    beyond = ", motion at the converter's limit" if converter is not None else ""
    return listed(
        "Sensors on the payload: position relative to the geometric centre, direction of the motion that "
        "gives a positive voltage, gain in the passband with preamplifier, corner with the damping ratio in "
        f"brackets, r.m.s. of white noise per sample{beyond}. "
        "Position sensors, if any, measure relative to the chassis.",
        one.sensors(),
        columns,
        "llllrlrr",
    )


def _position(position: np.ndarray) -> str:
    return ", ".join(map(_value, position))


def _direction(direction: np.ndarray) -> str:
    """A direction along an axis is named after the axis."""
    along = int(np.argmax(np.abs(direction)))
    if abs(direction[along]) < 1 - 1e-9:
        return ", ".join(map(words.number, direction))
    return ("−" if direction[along] < 0 else "+") + "xyz"[along]


def _corner(s: Sensor) -> str:
    """Corner and damping ratio of the sensor with its filters, except the anti-alias filter, and of a geophone's
    suspension if different."""
    own = list(s.poles)
    for pole in s.low_pass:
        own.remove(pole)
    if not own:
        return "none"
    poles, side = np.array(own), "high-pass" if s.zeros else "low-pass"
    omega = float(np.prod(np.abs(poles)) ** (1 / len(poles)))
    text = f"{side} {words.hertz(omega)}"
    if len(poles) == 1:
        return text
    damping = float(-np.mean(poles.real) / omega)
    text += f" ({words.number(damping, 2)})"
    if s.suspension is None or np.allclose(s.suspension, (omega / (2 * np.pi), damping)):
        return text
    return f"{text}; suspension {words.number(s.suspension[0])} Hz ({words.number(s.suspension[1], 2)})"


def _electronics(result: DesignResult) -> Table:
    one, loop = result.rig, result.design.loop
    rows = [
        ("sample rate", f"{words.number(one.sample_rate_Hz, 4)} Hz"),
        ("delay from sample to voltage", f"{words.number(1e3 * one.loop_delay_s)} ms"),
        ("amplifier corner", f"{words.number(loop.amplifier_corner_Hz)} Hz"),
        ("edge lever of phi_x", f"{words.number(one.edge_m)} m"),
    ]
    if one.acquisition is not None:
        rows.append(("converter", f"{one.acquisition.adc_bits} bits, ±{words.number(one.acquisition.adc_range_V)} V"))
    return table("Clock, amplifiers, converter and edge lever.", ("what", "value"), rows, "ll")


def _reduction(result: DesignResult) -> list[Piece]:
    error = result.reduction
    if not error.left_out.size:
        told = "The controller is designed on a model with all six degrees of freedom; no coordinate is locked."
        return [Heading("Design model"), Paragraph(told)]
    kept = joined(list(error.keep))
    text = (
        f"The controller is designed on a model of {kept} alone, with the other coordinates locked. The table and "
        "the figure show the difference from the model with six degrees of freedom, relative to the largest gain "
        "at the same frequency. The design model does not contain floor motion along the other axes; the "
        f"transmissibility from these axes to {kept} is at most "
        f"{words.decibel(float(np.max(np.abs(error.left_out), initial=0.0)))}. " + _largest(error)
    )
    return [
        Heading("Error of the design model"),
        Paragraph(text),
        listed(
            "Difference between the design model and six degrees of freedom, relative to the largest gain, over "
            "0.1 to 100 Hz.",
            list(error.max_dB),
            {
                "output": lambda channel: words.axis(channel[0]),
                "input": lambda channel: channel[1],
                "largest": lambda channel: words.quantity(error.max_dB[channel], "dB"),
                "r.m.s.": lambda channel: words.quantity(error.rms_dB[channel], "dB"),
            },
            "llrr",
        ),
        _compared(error),
    ]


def _largest(error: ReductionError) -> str:
    """Frequency and channel at which the error of the design model is largest, and its size."""
    out, name = max(error.max_dB, key=lambda channel: error.max_dB[channel])
    k, j = error.keep.index(out), error.inputs.index(name)
    place = int(np.argmax(error.relative[:, k, j]))
    return (
        f"The difference is largest at {words.hertz(float(error.omega[place]))}, from {name} to {out}: "
        f"{words.number(100 * float(error.relative[place, k, j]))} % of the largest gain there."
    )


def _compared(error: ReductionError) -> Figure:
    f, curves, apart = error.omega / (2 * np.pi), [], []
    for k, name in enumerate(error.keep):
        colour = numbered(k).colour
        curves += [
            Curve(f, in_dB(error.full[:, k, k]), f"{name}, six degrees of freedom", Style(colour, "solid", 2.2)),
            Curve(f, in_dB(error.reduced[:, k, k]), f"{name}, design model", Style("#111111", "dot", 1.6)),
        ]
        apart.append(Curve(f, in_dB(error.relative[:, k, k]), f"{name}, difference", Style(colour, "dash", 1.4)))
    largest = np.linalg.norm(error.left_out, ord=2, axis=(1, 2)) if error.left_out.size else np.zeros(f.size)
    curves.append(Curve(f, in_dB(largest), "from the floor's other axes", numbered(3)))
    gain, difference = Axis("gain [dB]", "linear", (-80.0, 40.0)), Axis("difference [dB]", "linear", (-140.0, 20.0))
    left = Panel(hertz(), gain, curves, (), "transmissibility along each controlled axis")
    right = Panel(hertz(), difference, apart, (), "difference, relative to the largest gain")
    return Figure(
        "reduction",
        "Transmissibility without control, floor to payload along each controlled axis: six degrees "
        "of freedom (coloured) and the design model on top of it (black, dotted), with the contribution of "
        "the floor's other axes. Beside it, their difference.",
        (left, right),
        2,
    )
