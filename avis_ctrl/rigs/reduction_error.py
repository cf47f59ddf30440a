"""Error of the model of a rig in the few coordinates that a controller is designed for.

In that model the other coordinates are locked: they do not move relative to the earth. In the model with six degrees
of freedom they move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
from numpy.typing import ArrayLike

from avis_ctrl.lti import StateSpace, gain
from avis_ctrl.lti.norms import decibels
from avis_ctrl.rigs.logical_axes import actuator_axes
from avis_ctrl.rigs.rig import Rig
from avis_ctrl.rigs.rigid_body import COORDINATES

Z_PHIX = ("z", "phi_x")


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

    Raises
    ------
    InputError : unknown coordinates, or coordinates that the actuators cannot drive independently.
    """
    omega = 2 * np.pi * np.geomspace(0.1, 100.0, 400) if omega is None else np.asarray(omega, float)
    keep = tuple(keep)
    allocation, eom = actuator_axes(rig, keep).allocation, rig.equations_of_motion()
    floors, forces = [f"floor_{name}" for name in keep], [f"force_{name}" for name in keep]
    dropped = tuple(f"floor_{name}" for name in COORDINATES if name not in keep)
    lever = {name: rig.edge_m if "phi" in name else 1.0 for name in COORDINATES}
    rows = np.array([lever[name] for name in keep])
    columns = np.concatenate([1 / rows, rows])

    def forced(system: StateSpace) -> StateSpace:
        """The system with forces on the kept coordinates in place of the voltages."""
        others = system.inputs[len(eom.actuators) :]
        mixer = la.block_diag(allocation, np.eye(len(others)))
        return system @ gain(mixer, (*forces, *others), system.inputs)

    def response(system: StateSpace, inputs: Sequence[str], scale: np.ndarray) -> np.ndarray:
        return rows[:, None] * system.select(keep, inputs).frequency_response(omega) * scale

    free = eom.state_space()
    reduced = response(forced(eom.restricted(keep).state_space()), [*floors, *forces], columns)
    full = response(forced(free), [*floors, *forces], columns)
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
        response(free, dropped, outside),
        {name: decibels(np.max(e)) for name, e in channels},
        {name: decibels(np.sqrt(np.mean(e**2))) for name, e in channels},
    )
