"""The few coordinates that a controller is designed for, cut out of the six, and what the cut leaves out.

What happens to the other coordinates is said, not implied:
"locked" : they do not move (rows and columns struck; motion relative to the earth);
"free"   : they move as the mechanics has it: all six degrees of freedom, seen from the kept ones;
"loops"  : they are held by their own velocity feedback loops.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, connect, gain
from avis_ctrl.lti.norms import decibels
from avis_ctrl.rigs.logical_axes import ActuatorAxes, actuator_axes
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES

Others = Literal["locked", "free", "loops"]
Z_PHIX = ("z", "phi_x")


@dataclass(frozen=True, eq=False)
class ReducedRig:
    """A rig seen from the coordinates kept.

    system : inputs: all actuators [V], then "floor_<c>" [m, rad] (kept coordinates when locked, else
        all six); outputs "<c>" and "<c>_dot" of the kept coordinates.
    allocation : voltages that push one kept coordinate and no other.
    loops : what holds the others, velocity in, resisting force out; empty unless others is "loops".
    """

    system: StateSpace
    keep: tuple[str, ...]
    others: Others
    allocation: ActuatorAxes
    loops: dict[str, StateSpace]

    def logical(self) -> StateSpace:
        """The system with inputs "force_<c>" [N, N m] for the kept coordinates in place of the voltages."""
        n_u, n_f = len(self.allocation.actuators), self.system.ninputs - len(self.allocation.actuators)
        allocation = self.allocation.allocation
        mixer = np.block([[allocation, np.zeros((n_u, n_f))], [np.zeros((n_f, len(self.keep))), np.eye(n_f)]])
        forces = tuple(f"force_{name}" for name in self.keep)
        return self.system @ gain(mixer, (*forces, *self.system.inputs[n_u:]), self.system.inputs)


def reduce_rig(rig: Rig, keep: Sequence[str] = Z_PHIX, others: Others = "locked",
               loops: Mapping[str, float | StateSpace] | None = None) -> ReducedRig:
    """The rig seen from the coordinates `keep`.

    loops : for others="loops", by coordinate: a gain [N s/m, N m s/rad] or a SISO system L from velocity to
        resisting force, force = -L velocity. Absent, each other coordinate gets the gain of the
        classical rule, `critical_gains`; a coordinate that is not named stays free.

    Raises
    ------
    InputError : unknown coordinates or choices, a loop around a kept coordinate, actuators that
        cannot push a kept coordinate alone.
    """
    keep = tuple(keep)
    allocation = actuator_axes(rig, keep)
    if others != "loops" and loops is not None:
        raise InputError("loops go with others = 'loops' only", field="loops", value=sorted(loops))
    eom = rig.equations_of_motion()
    if others == "locked":
        return ReducedRig(eom.restricted(keep).state_space(), keep, others, allocation, {})
    outputs = [*keep, *(f"{name}_dot" for name in keep)]
    if others == "free":
        return ReducedRig(eom.state_space().select(outputs), keep, others, allocation, {})
    if others != "loops":
        raise InputError("expected locked, free or loops", field="others", value=others)
    held = _loop_systems(critical_gains(rig, keep) if loops is None else loops, keep)
    body = eom.state_space(forces=True)
    closed = connect({"rig": body.select(None, [name for name in body.inputs if not name.startswith("force_")
                                                or name.removeprefix("force_") in held]), **held},
                     [name for name in body.inputs if not name.startswith("force_")], outputs)
    return ReducedRig(closed, keep, others, allocation, {name: -loop for name, loop in held.items()})


def critical_gains(rig: Rig, keep: Sequence[str] = ()) -> dict[str, float]:
    """Velocity gains [N s/m, N m s/rad] that damp each coordinate not kept critically, the others locked.

    The classical rule: C_kk + g = 2 sqrt(M_kk K_kk).
    """
    eom = rig.equations_of_motion()
    M, C, K = np.diag(eom.M), np.diag(eom.C), np.diag(eom.K)
    gains = 2 * np.sqrt(M * K) - C
    return {name: float(g) for name, g in zip(COORDINATES, gains, strict=True) if name not in keep}


def _loop_systems(loops: Mapping[str, float | StateSpace], keep: tuple[str, ...]) -> dict[str, StateSpace]:
    """Loops as parts of a connection, "<c>_dot" to "force_<c>", sign included."""
    parts = {}
    for name, loop in loops.items():
        if name not in COORDINATES or name in keep:
            raise InputError(f"expected loops around coordinates other than {list(keep)}", field="loops", value=name)
        system = loop if isinstance(loop, StateSpace) else gain(loop)
        if system.D.shape != (1, 1):
            raise InputError("expected a loop of one input and one output", field=f"loops.{name}",
                             value=system.D.shape)
        parts[name] = (-system).renamed([f"{name}_dot"], [f"force_{name}"])
    return parts


@dataclass(frozen=True, eq=False)
class ReductionError:
    """What the model with the others locked misses against all six degrees of freedom.

    omega : (n_omega,) rad/s.
    reduced, full : (n_omega, n_keep, 2 n_keep) responses of the kept coordinates to their floor
        motion (transmissibility) and to the force on each; rotation counted as edge displacement, force on
        it as force at the edge, so that all entries of a kind share a unit.
    relative : (n_omega, n_keep, 2 n_keep) |reduced - full| over the largest singular value of the full
        response of that kind at that frequency.
    left_out : (n_omega, n_keep, n_dropped) full response to the floor coordinates that the reduced
        model does not have, in units as above.
    max_dB, rms_dB : by channel (output, input), of `relative`; rms over the frequencies given.
    """

    keep: tuple[str, ...]
    inputs: tuple[str, ...]
    dropped: tuple[str, ...]
    omega: np.ndarray
    reduced: np.ndarray
    full: np.ndarray
    relative: np.ndarray
    left_out: np.ndarray
    max_dB: dict[tuple[str, str], float]
    rms_dB: dict[tuple[str, str], float]


def reduction_error(rig: Rig, keep: Sequence[str] = Z_PHIX, others: Others = "free",
                    loops: Mapping[str, float | StateSpace] | None = None,
                    omega: ArrayLike | None = None) -> ReductionError:
    """Compare the locked reduction with the six degrees of freedom, the others "free" or in "loops".

    omega : rad/s; by default 400 points evenly in logarithm from 0.1 to 100 Hz.
    """
    omega = 2 * np.pi * np.geomspace(0.1, 100.0, 400) if omega is None else np.asarray(omega, float)
    full_rig = reduce_rig(rig, keep, others, loops)
    keep = full_rig.keep
    floors, forces = [f"floor_{name}" for name in keep], [f"force_{name}" for name in keep]
    dropped = tuple(name for name in full_rig.system.inputs if name.startswith("floor_") and name not in floors)
    lever = {name: rig.edge_m if "phi" in name else 1.0 for name in COORDINATES}
    rows = np.array([lever[name] for name in keep])
    columns = np.concatenate([1 / rows, rows])

    def response(system: StateSpace, inputs: Sequence[str], scale: np.ndarray) -> np.ndarray:
        return rows[:, None] * system.select(keep, inputs).frequency_response(omega) * scale

    reduced = response(reduce_rig(rig, keep, "locked").logical(), [*floors, *forces], columns)
    full = response(full_rig.logical(), [*floors, *forces], columns)
    outside = np.array([1 / lever[name.removeprefix("floor_")] for name in dropped])
    n = len(keep)
    largest = [np.linalg.norm(full[:, :, part], ord=2, axis=(1, 2)) for part in (slice(None, n), slice(n, None))]
    relative = np.abs(reduced - full) / np.repeat(np.stack(largest, axis=1), n, axis=1)[:, None, :]
    channels = [((out, inp), relative[:, i, j]) for i, out in enumerate(keep)
                for j, inp in enumerate([*floors, *forces])]
    return ReductionError(
        keep, (*floors, *forces), dropped, omega, reduced, full, relative,
        response(full_rig.system, dropped, outside),
        {name: decibels(np.max(e)) for name, e in channels},
        {name: decibels(np.sqrt(np.mean(e**2))) for name, e in channels})
