"""Mixed-sensitivity H-infinity design: weights on S, K S and T, the generalized plant, and the controller.

Skogestad and Postlethwaite, Multivariable Feedback Control, 2005, section 9.3.6; Zhou, Doyle and Glover, 1996, chapter
6. Negative feedback, error e = r - G u, u = K e:

    z = (W_S e, W_KS u, W_T G u),        gamma = || (W_S S, W_KS K S, W_T T) ||
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti import append, connect, gain
from avis_ctrl.lti.interchange import as_system
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.robust.hinfsyn import Synthesis, hinfsyn
from avis_ctrl.summary import Shown
from avis_ctrl.uncertainty.uncertain_system import UncertainSystem


@dataclass(frozen=True, eq=False, repr=False)
class MixedSensitivity(Shown):
    """K with u = K (r - y), gamma measured on the loop, and the closed-loop transfer matrices.

    S, KS, T : from r to e, u and y. P : the generalized plant (r, u -> z, e). synthesis : the H-infinity result.
    """

    K: StateSpace
    gamma: float
    S: StateSpace
    KS: StateSpace
    T: StateSpace
    P: StateSpace
    synthesis: Synthesis


# Other spellings of the weights, without underscores and in capitals; W1, W2 and W3 are those of mixsyn.
SPELLINGS = {"W1": "W_S", "WS": "W_S", "W2": "W_KS", "WKS": "W_KS", "W3": "W_T", "WT": "W_T"}


def mixed_sensitivity(G: Any, W_S: Any = None, W_KS: Any = None, W_T: Any = None, **options: Any) -> MixedSensitivity:
    """Controller that makes the largest of |W_S S|, |W_KS K S| and |W_T T| small.

    Parameters
    ----------
    G : plant (avis_ctrl or python-control), continuous or sampled; of an `UncertainSystem` the nominal system is taken.
    W_S, W_KS, W_T : weights (systems, filters, numbers), with one channel for all signals, or with one input per
        signal (`matrix([[W, 0], [0, V]])`); None omits the term. The names W1, W2 and W3 are accepted, too.
    options : options of `hinfsyn`.

    Raises
    ------
    InputError : no weight, a weight that does not fit, an unknown option. ComputationError : no stabilising controller.

    Examples
    --------
    Skogestad and Postlethwaite, example 2.17, where gamma is 1.37:

    >>> G = ac.tf([200.0], [0.025, 1.0025, 10.1, 1.0])
    >>> made = ac.mixed_sensitivity(G, W_S=ac.tf([1 / 1.5, 10.0], [1.0, 1e-3]), W_KS=1.0, backoff=0.001)
    >>> round(made.gamma, 2)
    1.37
    """
    weights = _weights(options, W_S=W_S, W_KS=W_KS, W_T=W_T)
    G = as_system(G.nominal if isinstance(G, UncertainSystem) else G, "G")
    n_y, n_u = G.noutputs, G.ninputs
    r, e, u, y = ([f"{name}{k}" for k in range(n)] for name, n in (("r", n_y), ("e", n_y), ("u", n_u), ("y", n_y)))
    parts = {"G": G.renamed(u, y), "error": gain(np.hstack([np.eye(n_y), -np.eye(n_y)]), [*r, *y], e, G.dt)}
    z: list[str] = []
    for (name, weight), seen in zip(weights.items(), (e, u, y), strict=True):
        if weight is not None:
            W = _for(weight, len(seen), name)
            parts[name] = W.renamed(seen, own := [f"{name}{k}" for k in range(W.noutputs)])
            z += own
    if not z:
        raise InputError("expected at least one weight", field="W_S, W_KS, W_T")
    P = connect(parts, [*r, *u], [*z, *e])
    made = hinfsyn(P, n_y, n_u, **options)
    loop = connect({**{name: parts[name] for name in ("G", "error")}, "K": made.K.renamed(e, u)}, r, [*e, *u, *y])
    KS, T = loop.select(u).renamed(outputs=G.inputs), loop.select(y).renamed(outputs=G.outputs)
    return MixedSensitivity(made.K.renamed(outputs=G.inputs), made.gamma, loop.select(e), KS, T, P, made)


def _weights(options: dict[str, Any], **weights: Any) -> dict[str, Any]:
    """The weights, with those given under another spelling taken out of `options`; InputError for unknown options."""
    known = [one.name for one in inspect.signature(hinfsyn).parameters.values() if one.kind is one.KEYWORD_ONLY]
    for key in [key for key in options if key not in known]:
        name = SPELLINGS.get(key.upper().replace("_", ""))
        if name is None:
            raise InputError(
                f"unknown; expected the weights W_S, W_KS, W_T, or options of hinfsyn: {', '.join(known)}", field=key
            )
        if weights[name] is not None:
            raise InputError(f"given twice: {key} is another name of {name}", field=name)
        weights[name] = options.pop(key)
    return weights


def _for(weight: Any, n: int, name: str) -> StateSpace:
    W = as_system(weight, name)
    if not W.is_stable():
        raise InputError(
            "expected a stable weight: move poles on the imaginary axis slightly into the left half-plane",
            field=name,
            value=f"poles {np.array2string(W.poles(), precision=4)}",
        )
    if W.D.shape == (1, 1) and n > 1:
        return append(*[W] * n)
    if W.ninputs != n:
        wanted = f"1 or {n} inputs" if n > 1 else "1 input"
        raise InputError(
            f"expected {wanted}, one for each signal", field=name, value=f"a weight with {W.ninputs} inputs"
        )
    return W
