"""Construction of uncertain systems: numbers, disks, dynamics, matrices, state space, connection by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti import connect as connect_systems
from avis_ctrl.lti.interchange import as_system
from avis_ctrl.lti.statespace import StateSpace, as_names, real_array
from avis_ctrl.lti.statespace import tf as tf_of_numbers
from avis_ctrl.uncertainty.elements import ComplexDisk, Dynamics, Element, RealParameter
from avis_ctrl.uncertainty.uncertain_system import STATES, UncertainSystem, as_uncertain, ordered, reduced, stacked


def real(
    name: str,
    nominal: float,
    *,
    percent: float | tuple[float, float] | None = None,
    plus_minus: float | tuple[float, float] | None = None,
    range: tuple[float, float] | None = None,
) -> UncertainSystem:
    """An uncertain real number, given by exactly one of percent, plus_minus and range.

    percent, plus_minus : half the range, relative or absolute; a pair is (below, above). range : (low, high).
    If the range is not symmetric about the nominal value, delta = 0 is still the nominal value, and the value is a
    fractional function of delta. A result such as "stable for 0.73 times the declared uncertainty" means
    |delta| < 0.73; the ends of this range are not at 0.73 times the distances of low and high from the nominal value.

    Raises InputError for a range that does not contain the nominal value.

    Examples
    --------
    >>> k = ac.real("k", 2.0, range=(1.4, 2.6))
    >>> (1 / k + k**2).substitute(k=2.5)
    array([[6.65]])
    """
    if sum(one is not None for one in (percent, plus_minus, range)) != 1:
        raise InputError("expected exactly one of percent, plus_minus and range", field=name)
    try:
        if range is not None:
            low, high = (float(v) for v in range)
        else:
            size = percent if percent is not None else plus_minus
            down, up = np.broadcast_to(np.asarray(size, float), 2).tolist()
            if min(down, up) < 0:
                raise InputError("expected half a range, not negative", field=name, value=size)
            unit = abs(nominal) / 100 if percent is not None else 1.0
            low, high = nominal - down * unit, nominal + up * unit
        element = RealParameter(name, 1, 1, float(nominal), low, high)
    except (TypeError, ValueError) as error:
        raise error if isinstance(error, InputError) else InputError("expected numbers", field=name) from None
    return of_element(element, element.lft())


def complex_disk(name: str, centre: float = 0.0, radius: float = 1.0) -> UncertainSystem:
    """An uncertain complex number within `radius` of a real centre.

    Examples
    --------
    >>> ac.complex_disk("spring", 2.0, 0.1)                 # a spring with unknown loss
    UncertainSystem(number: spring within 0.1 of 2 (complex), 1 copy)
    """
    element = ComplexDisk(name, 1, 1, *(float(real_array(one, name)) for one in (centre, radius)))
    return of_element(element, element.lft())


def dynamics(name: str, weight: Any = 1.0, shape: tuple[int, int] = (1, 1)) -> UncertainSystem:
    """Unknown stable dynamics W(s) Delta(s) with a Delta of H-infinity norm at most 1.

    weight : W, scalar or square with shape[0] outputs: a number, a system, or a result of `uncertainty_weight`.
    shape : (outputs, inputs) of Delta. A channel with 20 % to 300 % uncertainty: G * (1 + dynamics("chain", W)).

    Raises InputError for a weight that does not fit, or is not stable.

    Examples
    --------
    20 % at rest, 100 % at about 1 rad/s:

    >>> chain = 1 + ac.dynamics("actuator", ac.tf([1.0, 0.2], [0.25, 1.0]))
    >>> P, blocks = chain.lft()
    >>> blocks.blocks
    (ComplexScalar(rows=1, cols=1, name='actuator'),)
    """
    if np.shape(shape) != (2,):
        raise InputError("expected (outputs, inputs)", field=f"{name}: shape", value=shape)
    element = Dynamics(name, *shape)
    rows, cols = shape
    n = np.zeros((cols, rows)), np.eye(cols), np.eye(rows), np.zeros(shape)
    Delta = UncertainSystem(*n, (element,), (1,))
    W = as_system(weight, f"{name}: weight")
    if not W.is_stable():
        raise InputError("expected a stable weight", field=f"{name}: weight")
    if W.D.shape not in ((1, 1), (rows, rows)):
        raise InputError(f"expected one output and input, or {rows}", field=f"{name}: weight", value=W.D.shape)
    return as_uncertain(W) * Delta


def matrix(rows: Sequence[Sequence[Any]] | Any) -> UncertainSystem:
    """A matrix of numbers, uncertain numbers, or blocks: matrix([[0, 1], [-k / m, -c / m]]).

    Raises InputError for rows of different lengths, or blocks that do not fit.

    Examples
    --------
    >>> k = ac.real("k", 2.0, percent=30)
    >>> ac.matrix([[k + 1, -1], [-1, 1]]).nominal
    array([[ 3., -1.],
           [-1.,  1.]])
    """
    if isinstance(rows, UncertainSystem):
        return rows
    if not isinstance(rows, (list, tuple)) and np.ndim(rows) == 0:
        rows = [[rows]]
    table = [list(row) if isinstance(row, (list, tuple, np.ndarray)) else [row] for row in rows]
    if not table or len({len(row) for row in table}) != 1:
        raise InputError("expected rows of one length", field="matrix", value=[len(row) for row in table])
    return reduced(stacked([stacked([as_uncertain(one) for one in row], 1) for row in table], 0))


def ss(
    A: Any,
    B: Any = None,
    C: Any = None,
    D: Any = None,
    *,
    dt: float = 0.0,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    states: Sequence[str] = (),
) -> Any:
    """A system x' = A x + B u, y = C x + D u whose matrices may have uncertain entries; D zero by default.

    Each matrix is an array, nested lists with uncertain numbers, or a result of `matrix`; A, B and C are [] for a
    static gain D. Returns a StateSpace if nothing is uncertain, otherwise an `UncertainSystem`. dt : sample time [s],
    0 for continuous time. ss(G) alone converts a system of python-control, or a matrix of gains.

    Raises InputError for shapes that do not fit.

    Examples
    --------
    Mass, spring and damper of Zhou, Doyle and Glover (1996, section 10.2); one copy of each parameter is enough:

    >>> m, c, k = ac.real("m", 3.0, percent=40), ac.real("c", 1.0, percent=20), ac.real("k", 2.0, percent=30)
    >>> plant = ac.ss([[0, 1], [-k / m, -c / m]], [[0], [1 / m]], [[1, 0]])
    >>> plant
    UncertainSystem(2 states, ['u0'] -> ['y0']: m = 3 +-40 %, 1 copy; k = 2 +-30 %, 1 copy; c = 1 +-20 %, 1 copy)
    >>> plant.substitute(m=2.5, k=1.9, c=1.1).dcgain()
    array([[0.52631579]])
    >>> len(plant.sample(20, seed=1))
    20
    """
    if B is None and C is None:
        return A if isinstance(A, UncertainSystem) else as_system(A, "A")
    a, b, c = (_matrix(one, name) for one, name in ((A, "A"), (B, "B"), (C, "C")))
    d = as_uncertain(np.zeros((c.shape[0], b.shape[1]))) if D is None else _matrix(D, "D")
    n = a.shape[0]
    if not n:
        b, c = (
            as_uncertain(np.zeros(shape)) if not one.d.size else one
            for one, shape in ((b, (0, d.shape[1])), (c, (d.shape[0], 0)))
        )
    elif d.shape == (1, 1) and not d.uncertain and not np.any(d.d):
        # D = 0 stands for a zero matrix of any size, as in python-control.
        d = as_uncertain(np.zeros((c.shape[0], b.shape[1])))
    if a.shape != (n, n) or b.shape[0] != n or c.shape[1] != n or d.shape != (c.shape[0], b.shape[1]):
        raise InputError(f"shapes do not fit: A {a.shape}, B {b.shape}, C {c.shape}, D {d.shape}")
    M = reduced(stacked([stacked([a, b], 1), stacked([c, d], 1)], 0))
    return _of_matrix(M, n, dt, inputs, outputs, states)


def tf(
    numerator: Any, denominator: Any, inputs: Sequence[str] = (), outputs: Sequence[str] = (), *, dt: float = 0.0
) -> Any:
    """System from a proper transfer function (coefficients in descending powers of s, or of z if dt is given).

    For a matrix of transfer functions, numerator[i][k] and denominator[i][k] are the coefficients from input k to
    output i, as in python-control. A common denominator may be given once. Entries of a column with the same
    denominator share their states.

    With one input and one output, coefficients may be uncertain; the result is then an `UncertainSystem`. dt : sample
    time [s], 0 for continuous time.

    Raises
    ------
    InputError : an improper entry (more zeros than poles), a zero denominator, tables of different shapes.

    Examples
    --------
    >>> ac.tf([25.0], [1.0, 10.0, 10.0, 10.0]).dcgain()
    array([[2.5]])
    >>> G = ac.tf([[[1.0], [2.0]], [[1.0, 0.0], [3.0]]], [1.0, 3.0, 2.0])        # 2 outputs, 2 inputs
    >>> G.nstates, G.dcgain()
    (4, array([[0.5, 1. ],
           [0. , 1.5]]))

    A mass on a spring, with uncertain mass:

    >>> m = ac.real("m", 2.0, percent=10)
    >>> ac.tf([1.0], [m, 0.4, 8.0])
    UncertainSystem(2 states, ['u0'] -> ['y0']: m = 2 +-10 %, 1 copy)
    """
    if not any(_has_uncertain(one) for one in (numerator, denominator)):
        return tf_of_numbers(numerator, denominator, inputs, outputs, dt=dt)
    num, den = (_coefficients(*one) for one in ((numerator, "numerator"), (denominator, "denominator")))
    n = len(den) - 1
    if len(num) > len(den):
        raise InputError(f"improper: numerator of degree {len(num) - 1} over denominator of degree {n}")
    num = [as_uncertain(0.0)] * (len(den) - len(num)) + num
    # Controllable canonical form; state k is scaled by the k-th power of the geometric mean of the nominal poles.
    size = abs(float(den[-1].nominal.item()) / float(den[0].nominal.item() or 1.0)) ** (1 / max(n, 1)) or 1.0
    powers = size ** np.arange(n)
    last = powers[-1] if n else 1.0
    highest = den[0].inverse() @ matrix([[*(-a * p / last for a, p in zip(den[:0:-1], powers, strict=True)), 1 / last]])
    output = num[0] * last * highest + matrix([[*(b * p for b, p in zip(num[:0:-1], powers, strict=True)), 0.0]])
    shift = [as_uncertain(size * np.eye(n - 1, n + 1, 1))] if n > 1 else []
    state = [highest] if n else []
    return _of_matrix(reduced(stacked([*shift, *state, output], 0)), n, dt, inputs, outputs, ())


def connect(parts: Mapping[str, Any] | Sequence[Any], inputs: Sequence[str], outputs: Sequence[str]) -> Any:
    """Interconnect certain, uncertain or python-control systems through signals of the same name.

    Returns a StateSpace, or an UncertainSystem if a part is uncertain.

    Parameters
    ----------
    parts : systems; a dict names them in error messages.
    inputs : external signals.
    outputs : signals that become outputs.

    Raises
    ------
    InputError : a signal that is driven twice or not at all. ComputationError : an algebraic loop.

    Examples
    --------
    >>> G = ac.ss([[0, 1], [-4, -0.4]], [[0], [1]], [[1, 0]], inputs=["force"], outputs=["x"])
    >>> K = ac.tf([8.0, 1.0], [0.01, 1.0], inputs=["e"], outputs=["force"])
    >>> error = ac.StateSpace([], [], [], [[1.0, -1.0]], inputs=["r", "x"], outputs=["e"])
    >>> ac.connect({"plant": G, "controller": K, "error": error}, ["r"], ["x"]).is_stable()
    True
    """
    inputs, outputs = as_names(inputs), as_names(outputs)
    named = dict(parts) if isinstance(parts, Mapping) else {f"part {k}": one for k, one in enumerate(parts)}
    whole, elements, w, z = {}, list[tuple[Element, int]](), list[str](), list[str]()
    for key, part in named.items():
        if not isinstance(part, UncertainSystem):
            whole[key] = as_system(part, key)
            continue
        P, n_w, n_z = part.opened()
        ws, zs = ([f"{key}|{name}" for name in names] for names in (P.inputs[:n_w], P.outputs[:n_z]))
        whole[key] = P.renamed([*ws, *part.inputs], [*zs, *part.outputs])
        elements += [(one, n) for one, n in zip(part.elements, part.copies, strict=True) if one != STATES]
        w, z = w + ws, z + zs
    if not elements:
        return connect_systems(whole, inputs, outputs)
    P = connect_systems(whole, [*w, *inputs], [*z, *outputs])
    n, nw, nz = P.nstates, len(w), len(z)
    parts_ = (
        np.block([[P.A, P.B[:, :nw]], [P.C[:nz], P.D[:nz, :nw]]]),
        np.vstack([P.B[:, nw:], P.D[:nz, nw:]]),
        np.hstack([P.C[nz:], P.D[nz:, :nw]]),
        P.D[nz:, nw:],
    )
    kinds = [(STATES, n), *elements] if n else elements
    return reduced(ordered(parts_, kinds, P.dt, P.inputs[nw:], P.outputs[nz:], P.states))


def of_element(element: Element, lft: np.ndarray) -> UncertainSystem:
    """The uncertain number of an element; lft (2, 2): its dependence on delta."""
    return UncertainSystem(lft[:1, :1], lft[:1, 1:], lft[1:, :1], lft[1:, 1:], (element,), (1,))


def _matrix(given: Any, name: str) -> UncertainSystem:
    """An uncertain matrix without states, from a two-dimensional array, rows or a single number; [] has no entries."""
    if isinstance(given, np.ndarray) and given.dtype != object:
        made = as_uncertain(given) if given.ndim in (0, 2) else None
    elif not isinstance(given, UncertainSystem) and np.size(given) == 0:
        made = as_uncertain(np.zeros((0, 0)))
    else:
        made = matrix([[given]]) if np.isscalar(given) else matrix(given)
    if made is None or made.nstates:
        raise InputError(
            "expected a matrix: numbers or uncertain numbers in rows",
            field=name,
            value=np.shape(given) if isinstance(given, np.ndarray) else "a system with states",
        )
    return made


def _of_matrix(
    M: UncertainSystem, n: int, dt: float, inputs: Sequence[str], outputs: Sequence[str], states: Sequence[str]
) -> Any:
    """The system with n states from M = [A B; C D]: a StateSpace if nothing is uncertain."""
    system = UncertainSystem(
        np.block([[M.d[:n, :n], M.c[:n]], [M.b[:, :n], M.a]]),
        np.vstack([M.d[:n, n:], M.b[:, n:]]),
        np.hstack([M.d[n:, :n], M.c[n:]]),
        M.d[n:, n:],
        (*[STATES] * bool(n), *M.elements),
        (*[n] * bool(n), *M.copies),
        float(dt),
        as_names(inputs),
        as_names(outputs),
        as_names(states),
    )
    if system.uncertain:
        return system
    return StateSpace(*system.matrices, system.dt, system.inputs, system.outputs, system.states)


def _has_uncertain(given: Any) -> bool:
    if isinstance(given, (list, tuple)) or (isinstance(given, np.ndarray) and given.dtype == object):
        return any(_has_uncertain(one) for one in given)
    return isinstance(given, UncertainSystem)


def _coefficients(given: Any, field: str) -> list[UncertainSystem]:
    """Uncertain coefficients of a polynomial, without leading zeros."""
    every = list(given) if isinstance(given, (list, tuple, np.ndarray)) else [given]
    if any(isinstance(one, (list, tuple)) for one in every):
        raise InputError(
            "expected one input and one output; for several, use matrix([[tf(...), ...], ...])", field=field
        )
    found = [as_uncertain(one) for one in every]
    if any(one.shape != (1, 1) or one.nstates for one in found):
        raise InputError("expected coefficients that are numbers or uncertain numbers", field=field, value=repr(given))
    while found and not found[0].uncertain and not found[0].d.item():
        found = found[1:]
    if not found and field == "denominator":
        raise InputError("the denominator is zero")
    return found or [as_uncertain(0.0)]
