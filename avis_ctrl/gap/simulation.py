"""Time simulation of a table with effects: the sensor signals in a record, from u and floor alone.

The linear part is computed on the lines of the padded record (`line_response`). Forces that depend on amplitude or time
are computed from sample to sample (`time_stepping`) and then act on the same lines. The bandwidth is 500 Hz, or half
the sample rate: above it only the inertia of a table matters.

Limits: a record starts at rest, with nothing before it. Effects that change the volts depending on the motion use the
motion without this change. Records of more than `SimulationSettings.most_samples` samples are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.gap.effects.large_motion import LargeMotion
from avis_ctrl.gap.line_response import SETTINGS, LineResponse, line_response
from avis_ctrl.gap.motion_estimate import mount_rows, with_large_motion
from avis_ctrl.gap.record_motion import RecordMotion
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.gap.time_stepping import ForceResponse, march
from avis_ctrl.identification.response import N_Q


@dataclass(frozen=True, eq=False)
class Simulated:
    """y (samples, n_y) in the model's unit and order; deflection (samples, n_g) m of the mounts.

    defect : r.m.s. of d - d_0 - h * f(d), over that of d.
    """

    y: np.ndarray
    deflection: np.ndarray
    defect: float = 0.0


def simulate(
    model: TableModel,
    u: np.ndarray,
    floor: np.ndarray | None,
    sample_rate_Hz: float,
    *,
    start_s: float = 0.0,
    campaign_s: tuple[float, float] = (0.0, 1.0),
) -> Simulated:
    """The sensor signals before the converter: without rounding or clipping.

    Parameters
    ----------
    u : (samples, n_u) V, clipped here to the rig's drive limit. floor : (samples, 3) m/s, None for a floor at rest.
    start_s : time of the first sample on the campaign's clock. campaign_s : (first, last) time of the campaign, for
        effects that depend on time.

    Raises
    ------
    InputError : arrays of wrong shape, non-finite numbers, a sample rate other than the rig's, or a record too long.
    ComputationError : a motion that grows without bound, or a response that does not converge.
    """
    u, floor = _checked(model, u, floor)
    lines = line_response(model.linear, len(u), sample_rate_Hz)
    y, deflection = lines.record_response(u, floor)
    record = RecordMotion("", sample_rate_Hz, start_s, campaign_s, u, deflection, *mount_rows(model))
    effects = [one for one in model.effects if one.effect.nonlinear]
    changed = [volts for one in effects if (volts := one.effect.volts(record, one.place, one.by_name)) is not None]
    if changed:
        acting = u + sum(volts - u for volts in changed)
        y, deflection = lines.record_response(acting, floor)
        record = replace(record, volts=acting, deflection=deflection)
    pushing = [one for one in effects if one.effect.force(record, one.place, one.by_name) is not None]
    if not pushing or not deflection.size:  # without individual mounts there is no deflection for forces to act on
        return Simulated(y, deflection)
    return _with_forces(model, lines, record, floor, pushing)


def _checked(model: TableModel, u: np.ndarray, floor: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    u = np.asarray(u, float)
    if u.ndim != 2 or u.shape[1] != len(model.actuators) or len(u) < 2:
        raise InputError(
            f"expected (samples, {len(model.actuators)}) volts, two samples at least", field="u", value=u.shape
        )
    if floor is not None:
        floor = np.asarray(floor, float)
        if floor.shape != (len(u), 3):
            raise InputError(f"expected {(len(u), 3)}", field="floor", value=floor.shape)
    for field, array in (("u", u), ("floor", floor)):
        if array is not None and not np.all(np.isfinite(array)):
            raise InputError("expected finite numbers", field=field)
    limit = model.rig.limits_of(model.actuators)
    return np.clip(u, -limit, limit), floor


def _with_forces(
    model: TableModel,
    lines: LineResponse,
    record: RecordMotion,
    floor: np.ndarray | None,
    effects: Sequence[ActiveEffect],
) -> Simulated:
    """Step through time, then apply the forces to the whole record. Two residuals enter the next pass: non-causal parts
    of the response (as of a constant loss factor), and the second-order terms of large rotations, which are weak."""
    marching = [one for one in effects if not isinstance(one.effect, LargeMotion)]
    weak = next((one for one in effects if isinstance(one.effect, LargeMotion)), None)
    if "forces" not in lines.kept:
        lines.kept["forces"] = ForceResponse(lines)
    by_force = lines.kept["forces"]
    # Free motion in the coordinates of the force response; any values with the same deflection will do.
    to_z, n = np.linalg.pinv(by_force.shape), len(record.volts)
    defect, reading = float("nan"), None
    slow, correction, size = np.zeros((n, N_Q)), np.zeros((n, by_force.shape.shape[1])), 0.0
    linear = record.deflection.copy()
    for _ in range(SETTINGS.most_passes):
        free = linear + lines.in_time(by_force.whole(slow) @ by_force.shape.T)
        z_free = free @ to_z.T
        record.deflection[:] = free
        push, residual, missing = np.zeros((n, N_Q)), np.zeros_like(correction), np.zeros_like(correction)
        if marching:
            z, push = march(by_force, z_free + correction, marching, record, free - z_free @ by_force.shape.T)
            residual = z_free + lines.in_time(by_force.whole(push)) - z
        if weak:
            known = with_large_motion({"": record}, model)[""]
            more = np.asarray(weak.effect.force(known, weak.place, weak.by_name))
            reading = weak.effect.reading(known, weak.place, weak.by_name)
            missing, slow = lines.in_time(by_force.whole(more - slow)), more
        size = float(np.sqrt(np.mean(record.deflection**2))) or 1.0
        defect = float(np.sqrt(np.mean(((residual + missing) @ by_force.shape.T) ** 2))) / size
        if defect <= SETTINGS.defect:
            moved = by_force.whole(push + slow)[:, : by_force.n_x]
            return Simulated(*lines.record_response(record.volts, floor, moved, reading), defect)
        if not np.isfinite(defect):
            break
        correction = correction + residual
    raise ComputationError(
        "the forces of " + ", ".join(one.label for one in effects) + " do not converge",
        measured=f"residual of the equation of motion {defect:.2g} of the deflection after "
        f"at most {SETTINGS.most_passes} passes, deflection {size:.3g} m r.m.s.",
        cause="rotations that are not small, or a force that depends on later motion",
        next_step="a lower level, or leave the effect out of the simulation",
    )
