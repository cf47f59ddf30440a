"""State of a mu synthesis, with conversion to and from JSON: history, best and last loop, grid, phase."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, lft_lower
from avis_ctrl.robust.dstep import SETTINGS, PointwiseScalings
from avis_ctrl.robust.frequency_grid import resonances
from avis_ctrl.robust.mu_upper import upper_bound
from avis_ctrl.robust.scalings import Scalings
from avis_ctrl.uncertainty.blocks import BlockStructure

FORMAT = "avis-musyn"
VERSION = 4
DONE = "done"
GIVEN = "given"
NOMINAL = "nominal"
HINF = "H-infinity"


@dataclass(frozen=True)
class Iteration:
    """One row of the history.

    gamma : measured H-infinity norm of the loop scaled by D(s); an upper bound of complex mu at every frequency.
    mu_upper : largest upper bound of complex mu over the frequency grid and the resonances of the loop.
    order : states of K; d_order : sum of the orders of the scalings used for K.
    d_fit_error : relative cost of these realised scalings compared with the best scalings at each frequency; for
        scalings of equal order in all blocks on the grid only, otherwise also between its frequencies.
    kind : origin of the scalings: "H-infinity" (identity), "start" (other constants), "D-K", "descent" or "growth".
        "nominal" is the H-infinity controller of the plant without its uncertainty, "given" an initial controller of
        the caller.
    """

    iteration: int
    gamma: float
    mu_upper: float
    order: int
    d_fit_error: float
    d_order: int
    seconds: float
    kind: str


@dataclass(frozen=True, eq=False)
class Loop:
    """A controller, the scalings of its synthesis, the norm of the scaled loop, and its peak mu on the grid."""

    K: StateSpace
    scalings: Scalings
    gamma: float
    mu: float

    def as_dict(self) -> dict[str, Any]:
        """Content for a JSON file."""
        return {
            "K": {key: getattr(self.K, key).tolist() for key in "ABCD"},
            "scalings": self.scalings.as_dicts(),
            "gamma": self.gamma,
            "mu": self.mu,
        }


@dataclass(frozen=True, eq=False)
class State:
    """Phase (see `musyn_iteration`), last loop with its analysis, best loop, history.

    path : the best loop since the iteration started, or restarted from other scalings; round_mu : its mu at the start
        of this round of phases.
    """

    phase: str = "D-K"
    points: PointwiseScalings | None = None
    last: Loop | None = None
    best: Loop | None = None
    path: Loop | None = None
    history: tuple[Iteration, ...] = ()
    round_mu: float = np.inf

    def as_dict(self, P: StateSpace, structure: BlockStructure, nmeas: int, ncon: int, dt: float) -> dict[str, Any]:
        """JSON form, with a digest that identifies the problem."""
        assert self.last is not None and self.best is not None and self.path is not None and self.points is not None
        return {
            "format": FORMAT,
            "version": VERSION,
            "controller": [nmeas, ncon, dt],
            "problem": _digest(P, structure),
            "phase": self.phase,
            "round_mu": self.round_mu,
            "omega": self.points.omega.tolist(),
            "last": self.last.as_dict(),
            "best": self.best.as_dict(),
            "path": self.path.as_dict(),
            "history": [asdict(row) for row in self.history],
        }

    @staticmethod
    def from_dict(
        saved: dict[str, Any], structure: BlockStructure, P: StateSpace, nmeas: int, ncon: int, dt: float
    ) -> tuple[State, tuple[StateSpace, ...]]:
        """The state to continue from; for another problem (a changed weight, say) an empty state and its controllers.

        No measurement on another plant is reused; its controllers become candidates for the initial controller.
        Raises InputError for another format, and for controllers of other dimensions or sample time.
        """
        if not isinstance(saved, dict) or saved.get("format") != FORMAT or saved.get("version") != VERSION:
            raise InputError(f"expected a saved state of format {FORMAT!r}, version {VERSION}", field="state")
        if saved.get("controller") != [nmeas, ncon, dt]:
            raise InputError(
                "the saved state belongs to another plant: its controllers have numbers of y and u, and a "
                f"sample time, of {saved.get('controller')}, not {[nmeas, ncon, dt]}",
                field="state",
            )
        n_y, n_u = P.outputs[P.noutputs - nmeas :], P.inputs[P.ninputs - ncon :]

        def controller(item: dict[str, Any]) -> StateSpace:
            A, B, C, D = (np.array(item["K"][key], float) for key in "ABCD")
            return StateSpace(A, B, C, D, 0.0, n_y, n_u)

        def loop(item: dict[str, Any]) -> Loop:
            return Loop(
                controller(item),
                Scalings.from_dicts(structure, item["scalings"]),
                float(item["gamma"]),
                float(item["mu"]),
            )

        if saved["problem"] != _digest(P, structure):
            different = {json.dumps(saved[name]["K"]): saved[name] for name in ("best", "path", "last")}
            return State(), tuple(controller(item) for item in different.values())
        last = loop(saved["last"])
        points = analysed(P, last.K, structure, np.array(saved["omega"], float), last.gamma)
        return State(
            str(saved["phase"]),
            points,
            last,
            loop(saved["best"]),
            loop(saved["path"]),
            tuple(Iteration(**row) for row in saved["history"]),
            float(saved["round_mu"]),
        ), ()


def _digest(P: StateSpace, structure: BlockStructure) -> str:
    """Digest that identifies a problem: the same plant and blocks give the same digest."""
    numbers = hashlib.sha256(repr([block.as_dict() | {"name": ""} for block in structure.blocks]).encode())
    for matrix in (P.A, P.B, P.C, P.D):
        numbers.update(repr(matrix.shape).encode() + np.ascontiguousarray(matrix).tobytes())
    return numbers.hexdigest()


def analysed(
    P: StateSpace, K: StateSpace, structure: BlockStructure, omega: np.ndarray, gamma: float
) -> PointwiseScalings:
    """mu and the best scalings of the loop F_l(P, K) at each frequency [rad/s], and at resonances where mu is higher.

    gamma : norm of the scaled loop, which mu exceeds at no frequency. If the peak on the grid is as high, no peak was
    missed. Otherwise mu is also computed at the resonances of this loop; between them it changes little.
    """
    closed = lft_lower(P, K)
    points = PointwiseScalings.of(omega, closed.frequency_response(omega), structure)
    level, extra = SETTINGS.between * points.peak, np.setdiff1d(resonances(closed.poles()), omega)
    if gamma > level and extra.size:
        M = closed.frequency_response(extra)
        missed = upper_bound(M[:, None], structure, goal=level).beta > level
        if np.any(missed):
            points = points.extended(extra[missed], M[missed])
    return points
