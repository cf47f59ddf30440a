"""Models of a rig in the few coordinates that a controller is designed for, and the error of this reduction.

The treatment of the other coordinates is stated explicitly:
"locked" : they do not move relative to the earth (rows and columns deleted);
"free"   : they move: the model has all six degrees of freedom, with only the kept ones as outputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, gain
from avis_ctrl.lti.norms import decibels
from avis_ctrl.rigs.logical_axes import ActuatorAxes, actuator_axes
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES

Others = Literal["locked", "free"]
Z_PHIX = ("z", "phi_x")


@dataclass(frozen=True, eq=False)
class ReducedRig:
    """Model of a rig in the coordinates that are kept.

    system : inputs: all actuators [V], then "floor_<c>" [m, rad] (kept coordinates if locked, else
        all six); outputs "<c>" and "<c>_dot" of the kept coordinates.
    allocation : voltages that drive each kept coordinate, see `ActuatorAxes`.
    """

    system: StateSpace
    keep: tuple[str, ...]
    others: Others
    allocation: ActuatorAxes

    def logical(self) -> StateSpace:
        """The system with inputs "force_<c>" [N, N m] for the kept coordinates in place of the voltages."""
        n_u, n_f = len(self.allocation.actuators), self.system.ninputs - len(self.allocation.actuators)
        allocation = self.allocation.allocation
        mixer = np.block([[allocation, np.zeros((n_u, n_f))], [np.zeros((n_f, len(self.keep))), np.eye(n_f)]])
        forces = tuple(f"force_{name}" for name in self.keep)
        return self.system @ gain(mixer, (*forces, *self.system.inputs[n_u:]), self.system.inputs)


def reduce_rig(rig: Rig, keep: Sequence[str] = Z_PHIX, others: Others = "locked") -> ReducedRig:
    """Model of a rig in the coordinates `keep`.

    Raises
    ------
    InputError : unknown coordinates or choices, actuators that cannot drive the kept coordinates independently.
    """
    keep = tuple(keep)
    allocation = actuator_axes(rig, keep)
    eom = rig.equations_of_motion()
    if others == "locked":
        return ReducedRig(eom.restricted(keep).state_space(), keep, others, allocation)
    if others != "free":
        raise InputError("expected locked or free", field="others", value=others)
    seen = eom.state_space().select([*keep, *(f"{name}_dot" for name in keep)])
    return ReducedRig(seen, keep, others, allocation)


def critical_gains(rig: Rig, keep: Sequence[str] = ()) -> dict[str, float]:
    """Velocity gains [N s/m, N m s/rad] for critical damping of each coordinate that is not kept, the others locked.

    The classical rule: C_kk + g = 2 sqrt(M_kk K_kk).
    """
    eom = rig.equations_of_motion()
    M, C, K = np.diag(eom.M), np.diag(eom.C), np.diag(eom.K)
    gains = 2 * np.sqrt(M * K) - C
    return {name: float(g) for name, g in zip(COORDINATES, gains, strict=True) if name not in keep}


@dataclass(frozen=True, eq=False)
class ReductionError:
    """Error of the model with locked coordinates relative to the model with six degrees of freedom.

    omega : (n_omega,) rad/s.
    reduced, full : (n_omega, n_keep, 2 n_keep) responses of the kept coordinates to their floor
        motion (transmissibility) and to the force on each; rotations as edge displacement, moments as
        force at the edge, so that all entries of a kind have the same unit.
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


def reduction_error(rig: Rig, keep: Sequence[str] = Z_PHIX, omega: ArrayLike | None = None) -> ReductionError:
    """Error of the locked model relative to the model with six degrees of freedom.

    omega : rad/s; by default 400 logarithmically spaced points from 0.1 to 100 Hz.
    """
    omega = 2 * np.pi * np.geomspace(0.1, 100.0, 400) if omega is None else np.asarray(omega, float)
    full_rig = reduce_rig(rig, keep, "free")
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
    channels = [
        ((out, inp), relative[:, i, j]) for i, out in enumerate(keep) for j, inp in enumerate([*floors, *forces])
    ]
    return ReductionError(
        keep,
        (*floors, *forces),
        dropped,
        omega,
        reduced,
        full,
        relative,
        response(full_rig.system, dropped, outside),
        {name: decibels(np.max(e)) for name, e in channels},
        {name: decibels(np.sqrt(np.mean(e**2))) for name, e in channels},
    )
