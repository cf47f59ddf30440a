"""Connection of systems by signal name, and linear fractional transformations.

A signal has one source (an output of a part, or an external input) and any number of destinations (inputs of parts
with the same name). A signal without a source or with two sources is an error that names the parts. User code
therefore never needs an index.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.interconnection import scaled_condition
from avis_ctrl.lti.statespace import StateSpace, append, gain


def summing_junction(output: str, terms: Sequence[str]) -> StateSpace:
    """Sum of signals: the terms ["a", "-b"] give output = a - b."""
    names = [term.lstrip("+-") for term in terms]
    signs = [-1.0 if term.startswith("-") else 1.0 for term in terms]
    return gain([signs], names, [output])


def connect(
    parts: dict[str, StateSpace] | Sequence[StateSpace], inputs: Sequence[str], outputs: Sequence[str]
) -> StateSpace:
    """Connect systems through signals of the same name.

    Parameters
    ----------
    parts : systems; the keys of a dict are used in error messages.
    inputs : external input signals, in order.
    outputs : output signals, in order (any output of a part, or an external input).

    Raises
    ------
    InputError : a signal with two sources, an input without a source, or an unknown output.
    ComputationError : an algebraic loop (the connection is not well posed).
    """
    named = parts if isinstance(parts, dict) else {f"part {k}": part for k, part in enumerate(parts)}
    source = signal_sources(named, inputs)
    if missing := [name for name in outputs if name not in source]:
        raise InputError(f"output {missing} is driven by nothing; the signals are {sorted(source)}")

    total = append(
        *(
            part.renamed([f"{key}:{n}" for n in part.inputs], [f"{key}:{n}" for n in part.outputs])
            for key, part in named.items()
        )
    )
    read = [name for part in named.values() for name in part.inputs]
    made = [name for part in named.values() for name in part.outputs]
    # u_parts = F y_parts + E u_external ;  y_out = G y_parts + H u_external
    F, E = _incidence(read, made), _incidence(read, inputs)
    G, H = _incidence(outputs, made), _incidence(outputs, inputs)
    A, B, C, D = _close(total, F, E)
    return StateSpace(A, B, G @ C, G @ D + H, total.dt, tuple(inputs), tuple(outputs), total.states)


def signal_sources(parts: dict[str, StateSpace], inputs: Sequence[str]) -> dict[str, str]:
    """The part (or "external input") that drives each signal; raises InputError as `connect` does."""
    source: dict[str, str] = {name: "external input" for name in inputs}
    if len(source) != len(inputs):
        raise InputError(f"external input named twice in {list(inputs)}")
    for key, part in parts.items():
        for name in part.outputs:
            if name in source:
                raise InputError(f"signal {name!r} is driven twice: by {source[name]} and by {key}")
            source[name] = key
    for key, part in parts.items():
        if undriven := [name for name in part.inputs if name not in source]:
            raise InputError(f"signal {undriven[0]!r} is read by {key} but driven by nothing")
    return source


def _incidence(names: Sequence[str], sources: Sequence[str]) -> np.ndarray:
    """(len(names), len(sources)): 1 where the names are equal, 0 elsewhere."""
    return np.equal.outer(np.array(names, object), np.array(sources, object)).astype(float)


def _close(total: StateSpace, F: np.ndarray, E: np.ndarray) -> tuple[np.ndarray, ...]:
    """(A, B, C, D) from the external inputs e to all outputs y of the parts, with u = F y + E e."""
    loop = np.eye(total.noutputs) - total.D @ F
    if total.noutputs and (condition := scaled_condition(loop)) > 1e12:
        raise ComputationError(
            "the connection is not well posed",
            cause="an algebraic loop of unit gain",
            measured=f"condition of I - D F, scaled, is {condition:.1e}",
            next_step="put a delay or a low-pass filter in the loop",
        )
    C = np.linalg.solve(loop, total.C)
    D = np.linalg.solve(loop, total.D @ E)
    return total.A + total.B @ F @ C, total.B @ (E + F @ D), C, D


def lft_lower(P: StateSpace, K: StateSpace) -> StateSpace:
    """Lower LFT F_l(P, K): closes u = K y around the last inputs and outputs of P."""
    n_y, n_u = K.ninputs, K.noutputs
    n_z, n_w = P.noutputs - n_y, P.ninputs - n_u
    if n_z < 0 or n_w < 0:
        raise InputError(f"controller {K.D.shape} does not fit plant {P.D.shape}")
    total = append(_anonymous(P, "p"), _anonymous(K, "k"))
    F = np.zeros((P.ninputs + n_y, P.noutputs + n_u))
    F[n_w : P.ninputs, P.noutputs :] = np.eye(n_u)
    F[P.ninputs :, n_z : P.noutputs] = np.eye(n_y)
    E = np.eye(P.ninputs + n_y, n_w)
    A, B, C, D = _close(total, F, E)
    return StateSpace(A, B, C[:n_z], D[:n_z], total.dt, P.inputs[:n_w], P.outputs[:n_z], P.states + K.states)


def lft_upper(P: StateSpace, Delta: StateSpace | np.ndarray) -> StateSpace:
    """Upper LFT F_u(P, Delta): closes w_delta = Delta z_delta around the first inputs and outputs of P."""
    delta = Delta if isinstance(Delta, StateSpace) else gain(Delta, dt=P.dt)
    n_w, n_z = delta.D.shape
    order_out = [*range(n_z, P.noutputs), *range(n_z)]
    order_in = [*range(n_w, P.ninputs), *range(n_w)]
    return lft_lower(P.select(order_out, order_in), delta)


def _anonymous(system: StateSpace, prefix: str) -> StateSpace:
    return system.renamed(
        [f"{prefix}u{k}" for k in range(system.ninputs)], [f"{prefix}y{k}" for k in range(system.noutputs)]
    )
