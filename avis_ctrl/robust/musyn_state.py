"""Where a mu synthesis stands, in a form that a JSON file holds: history, best and last loop, grid, phase."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti import StateSpace, lft_lower
from avis_ctrl.robust.dstep import PointwiseScalings
from avis_ctrl.robust.scalings import Scalings
from avis_ctrl.uncertainty.blocks import BlockStructure

FORMAT = "avis-musyn"
VERSION = 3
DONE = "done"
GIVEN = "given"
NOMINAL = "nominal"


@dataclass(frozen=True)
class Iteration:
    """One row of the history.

    gamma : measured H-infinity norm of the loop scaled by D(s); an upper bound of complex mu at every frequency.
    mu_upper : largest upper bound of complex mu over the frequency grid.
    order : states of K; d_order : sum of the orders of the scalings that K was made with.
    d_fit_error : what those realised scalings cost against the best ones at each frequency, relative.
    kind : how the scalings were made: "H-infinity" (identity), "start" (other constants, where the controllers to start
        from do nothing), "D-K", "descent" or "growth"; "nominal" is the H-infinity controller of the plant without its
        uncertainty, "given" one that the caller gave to start from.
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
    """A controller, the scalings it was made with, the norm of the loop they scale, and its peak mu on the grid."""

    K: StateSpace
    scalings: Scalings
    gamma: float
    mu: float

    def as_dict(self) -> dict[str, Any]:
        return {"K": {key: getattr(self.K, key).tolist() for key in "ABCD"}, "scalings": self.scalings.as_dicts(),
                "gamma": self.gamma, "mu": self.mu}


@dataclass(frozen=True, eq=False)
class State:
    """Phase (see `musyn_iteration`), last loop with its analysis, best loop, history.

    path : the best loop since the iteration began, or began again from other scalings; round_mu : its mu when this
        round of phases began.
    """

    phase: str = "D-K"
    points: PointwiseScalings | None = None
    last: Loop | None = None
    best: Loop | None = None
    path: Loop | None = None
    history: tuple[Iteration, ...] = ()
    round_mu: float = np.inf

    def as_dict(self, P: StateSpace, nmeas: int, ncon: int, dt: float) -> dict[str, Any]:
        """JSON form, with the sizes and the sample time of the problem it belongs to."""
        assert self.last is not None and self.best is not None and self.path is not None and self.points is not None
        return {"format": FORMAT, "version": VERSION, "problem": _problem(P, nmeas, ncon, dt),
                "phase": self.phase, "round_mu": self.round_mu, "omega": self.points.omega.tolist(),
                "last": self.last.as_dict(), "best": self.best.as_dict(),
                "path": self.path.as_dict(), "history": [asdict(row) for row in self.history]}

    @staticmethod
    def from_dict(saved: dict[str, Any], structure: BlockStructure, P: StateSpace, nmeas: int, ncon: int,
                  dt: float) -> State:
        """Inverse of `as_dict`; InputError for a state of another format or problem."""
        if not isinstance(saved, dict) or saved.get("format") != FORMAT or saved.get("version") != VERSION:
            raise InputError(f"expected a saved state of format {FORMAT!r}, version {VERSION}", field="state")
        problem = _problem(P, nmeas, ncon, dt)
        if saved.get("problem") != problem:
            raise InputError("the saved state belongs to another plant: sizes and sample time "
                             f"{saved.get('problem')}, not {problem}", field="state")
        n_y, n_u = P.outputs[P.noutputs - nmeas:], P.inputs[P.ninputs - ncon:]

        def loop(item: dict[str, Any]) -> Loop:
            A, B, C, D = (np.array(item["K"][key], float) for key in "ABCD")
            return Loop(StateSpace(A, B, C, D, 0.0, n_y, n_u), Scalings.from_dicts(structure, item["scalings"]),
                        float(item["gamma"]), float(item["mu"]))
        last = loop(saved["last"])
        points = analysed(P, last.K, structure, np.array(saved["omega"], float))
        return State(str(saved["phase"]), points, last, loop(saved["best"]), loop(saved["path"]),
                     tuple(Iteration(**row) for row in saved["history"]),
                     float(saved["round_mu"]))


def _problem(P: StateSpace, nmeas: int, ncon: int, dt: float) -> list[float]:
    """What a saved state and its problem must agree in: states, inputs, outputs, y, u, and the sample time if any."""
    return [P.nstates, P.ninputs, P.noutputs, nmeas, ncon, *([dt] if dt else [])]


def analysed(P: StateSpace, K: StateSpace, structure: BlockStructure, omega: np.ndarray) -> PointwiseScalings:
    """mu and the best scalings of the loop F_l(P, K) at each frequency [rad/s]."""
    return PointwiseScalings.of(omega, lft_lower(P, K).frequency_response(omega), structure)
