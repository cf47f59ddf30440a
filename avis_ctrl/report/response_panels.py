"""Panels that compare measured frequency responses with models, the same in all reports."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.identification.measured_responses import MeasuredOverlay
from avis_ctrl.report import words
from avis_ctrl.report.figures import Axis, Band, Curve, Panel, Style, hertz, log_limits, markers
from avis_ctrl.report.settings import SETTINGS

FLOOR = ("vx", "vy", "vz")
MEASURED, SCATTER, TWO_SIGMA = Style("#222222"), Style("#7a7a7a"), Style("#222222", "dot", 1.4)
# Label, response (n, n_y, n_u), style.
Model = tuple[str, np.ndarray, Style]


def drives(seen: MeasuredOverlay) -> list[int]:
    """Columns of the drives, or of the floor inputs if there are no drives."""
    return [j for j, name in enumerate(seen.inputs) if name not in FLOOR] or list(range(len(seen.inputs)))


def unit(seen: MeasuredOverlay, j: int) -> str:
    """Unit of column j: per m/s for floor inputs, otherwise per unit of the drives, the first one in `seen.unit`."""
    output, _, inputs = seen.unit.partition(" per ")
    per = "m/s" if seen.inputs[j] in FLOOR else inputs.partition(";")[0]
    return words.unit(f"{output}/{f'({per})' if '/' in per or ' ' in per else per}")


def thin(count: int, most: int = SETTINGS.measured_points) -> np.ndarray:
    """Indices of at most `most` of `count` points, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def title(seen: MeasuredOverlay, i: int, j: int) -> str:
    """Title of a panel."""
    return f"{seen.outputs[i]} from {seen.inputs[j]}"


def magnitude(seen: MeasuredOverlay, i: int, j: int, models: Sequence[Model]) -> Panel:
    """Measured points with a band of two standard deviations to each side, and a line for each model."""
    f, size, two = seen.frequency_Hz, np.abs(seen.measured[:, i, j]), 2 * seen.measured_std[:, i, j]
    keep, lines = thin(len(f)), [(label, np.abs(G[:, i, j]), style) for label, G, style in models]
    low = 0.5 * float(min(np.quantile(size, 0.02), *(line.min() for _, line, _ in lines)))
    high = 2.0 * float(max(size.max(), *(line.max() for _, line, _ in lines)))
    curves = (
        markers(f[keep], size[keep], "measured", MEASURED),
        *(Curve(f, line, label, style) for label, line, style in lines),
    )
    band = Band(f, np.maximum(size - two, low), np.maximum(size + two, low), "measured, ± 2 σ", SCATTER)
    return Panel(hertz(), Axis(f"magnitude [{unit(seen, j)}]", "log", (low, high)), curves, [band], title(seen, i, j))


def difference(seen: MeasuredOverlay, i: int, j: int, models: Sequence[Model]) -> Panel:
    """Magnitude of the complex difference measured - model; by noise alone 86 % lie below the dotted line."""
    f, two = seen.frequency_Hz, 2 * seen.measured_std[:, i, j]
    lines = [(label, np.abs(seen.measured[:, i, j] - G[:, i, j]), style) for label, G, style in models]
    limits = log_limits(np.concatenate([two, *(line for _, line, _ in lines)]), 0.5, 2, (1e-3, 1.0), 0.01)
    curves = (
        *(Curve(f, line, f"measured less {label}", style) for label, line, style in lines),
        Curve(f, two, "two standard deviations of the measurement", TWO_SIGMA),
    )
    return Panel(hertz(), Axis(f"difference [{unit(seen, j)}]", "log", limits), curves, (), title(seen, i, j))
