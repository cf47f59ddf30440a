"""Arithmetic of uncertain numbers, matrices and systems, as exact linear fractional transformations.

    i_out = a i_in + b u        i_in = diag(1/s I, delta_1 I, ..., Delta_k) i_out
    y     = c i_in + d u

States and uncertain elements are treated alike, as blocks from i_out to i_in (Zhou, Doyle and Glover, Robust and
Optimal Control, 1996, chapter 10). Sums, products, inverses and connections have the same form. Copies of one element
are ordered into one block; copies that no input can reach or no output can observe are removed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg as la

from avis_ctrl.checks import require_whole
from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.lti.interchange import as_system, plot_frequencies
from avis_ctrl.lti.interconnection import (
    Quadruple,
    feedback,
    inverse,
    parallel,
    return_difference,
    scaled_condition,
    series,
)
from avis_ctrl.lti.statespace import (
    StateSpace,
    common_dt,
    default_names,
    names_of_inverse,
    new_names,
    positions,
    signal_names,
    to_power,
)
from avis_ctrl.summary import count_of, html_table
from avis_ctrl.uncertainty.blocks import BlockStructure
from avis_ctrl.uncertainty.elements import ComplexDisk, Element, RealParameter
from avis_ctrl.uncertainty.lft_reduction import reduce_copies

# Element for the states: a block 1/s I (or z^-1 I). No uncertain element equals it, since these are of other classes.
STATES = Element("states")


@dataclass(frozen=True)
class UncertainSettings:
    """singular : condition number above which a matrix is not inverted; round-off alone gives 1e15.
    same : maximum difference of two LFTs, relative to the size of their entries, at which a reduction of copies is
    accepted; the round-off of a few hundred operations.
    inside : range of the deltas at which they are compared, as a fraction of the full range, away from a pole at its
    ends.
    affine : largest feedback from a delta to itself that is round-off, for the order of a product [1]."""

    singular: float = 1e13
    same: float = 1e-12
    inside: float = 0.7
    affine: float = 1e-9


SETTINGS = UncertainSettings()


@dataclass(frozen=True, eq=False, repr=False)
class UncertainSystem:
    """An uncertain system; an uncertain matrix if it has no states, an uncertain number if it has one entry.

    Created by the functions of `uncertain_models` and by arithmetic: + - and integer powers; * and / by a scalar act on
    each entry; @ (and * between matrices) is the product, or series connection. The other operand may be a number, an
    array, a StateSpace or a python-control system. Names are kept as by StateSpace: a product has the inputs of its
    right factor and the outputs of its left one; numbers change no names.

    a, b, c, d : the matrices above. elements, copies : the blocks in order, the states first if there are any.
    inputs, outputs, states : names; u0.., y0.., x0.. by default.

    Examples
    --------
    A spring known to 10 %, with an actuator whose dynamics are known to 20 %:

    >>> k = ac.real("k", 4.0, percent=10)
    >>> G = ac.tf([1.0], [1.0, 0.4, k], "force", "x") * (1 + ac.dynamics("actuator", 0.2))
    >>> G
    UncertainSystem(2 states, ['force'] -> ['x']: k = 4 +-10 %, 1 copy; actuator: dynamics of norm 1, 1 copy)
    >>> G.nominal.dcgain(), G.substitute(k=4.4, actuator=-1.0).dcgain()
    (array([[0.25]]), array([[0.18181818]]))
    >>> G.lft()[1].blocks
    (RealScalar(rows=1, cols=1, name='k'), ComplexScalar(rows=1, cols=1, name='actuator'))
    >>> sorted(G.values(seed=1)[0]), G.sample(3)[0]
    (['actuator', 'k'], StateSpace(3 states, continuous, ['force'] -> ['x']))
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    elements: tuple[Element, ...] = ()
    copies: tuple[int, ...] = ()
    dt: float = 0.0
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    states: tuple[str, ...] = ()

    # NumPy defers `array * system` to this class.
    __array_ufunc__ = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", signal_names(self.inputs, self.shape[1], "u", "input"))
        object.__setattr__(self, "outputs", signal_names(self.outputs, self.shape[0], "y", "output"))
        object.__setattr__(self, "states", signal_names(self.states, self.nstates, "x", "state", different=False))

    def __getattr__(self, name: str) -> Any:
        if hasattr(StateSpace, name):
            raise AttributeError(f"an uncertain system has no {name!r}: use .nominal.{name} or .substitute(...).{name}")
        raise AttributeError(f"'UncertainSystem' object has no attribute {name!r}")

    # -- properties --------------------------------------------------------------------------
    @property
    def shape(self) -> tuple[int, int]:
        """(outputs, inputs)."""
        return self.d.shape

    @property
    def matrices(self) -> Quadruple:
        """(a, b, c, d)."""
        return self.a, self.b, self.c, self.d

    @property
    def nstates(self) -> int:
        """Number of states."""
        return sum(n for one, n in zip(self.elements, self.copies, strict=True) if one == STATES)

    @property
    def _plain(self) -> bool:
        """Whether this is a matrix or number with default names."""
        return not self.nstates and (self.inputs, self.outputs) == default_names(*self.shape[::-1])

    @property
    def _number(self) -> bool:
        return self.shape == (1, 1) and self._plain

    @property
    def uncertain(self) -> dict[str, Element]:
        """The uncertain elements by name."""
        return {one.name: one for one in self.elements if one != STATES}

    def _slices(self) -> list[tuple[Element, int, slice, slice]]:
        """(element, copies, slice of i_in, slice of i_out) of each block."""
        places, w, z = [], 0, 0
        for one, n in zip(self.elements, self.copies, strict=True):
            places.append((one, n, slice(w, w + n * one.rows), slice(z, z + n * one.cols)))
            w, z = w + n * one.rows, z + n * one.cols
        return places

    def lft(self) -> tuple[StateSpace, BlockStructure]:
        """(P, blocks) as required by `mu_peak`, `musyn` and `worst_case_gain`: P has inputs (w_delta, u) and outputs
        (z_delta, y). InputError for dynamics with several channels that appear more than once."""
        blocks = BlockStructure(tuple(one.block(n) for one, n, _, _ in self._slices() if one != STATES))
        return self.opened()[0], blocks

    def opened(self) -> tuple[StateSpace, int, int]:
        """P as in `lft`, and the lengths of its w_delta and z_delta."""
        n = self.nstates
        w, z = list[str](), list[str]()
        for one, copies, _, _ in self._slices():
            if one != STATES:
                for names, letter, count in ((w, "w", copies * one.rows), (z, "z", copies * one.cols)):
                    names += [f"{letter}:{one.name}" + (f"[{k}]" if count > 1 else "") for k in range(count)]
        P = StateSpace(
            self.a[:n, :n],
            np.hstack([self.a[:n, n:], self.b[:n]]),
            np.vstack([self.a[n:, :n], self.c[:, :n]]),
            np.block([[self.a[n:, n:], self.b[n:]], [self.c[:, n:], self.d]]),
            self.dt,
            (*w, *self.inputs),
            (*z, *self.outputs),
            self.states,
        )
        return P, len(w), len(z)

    # -- members of the set ------------------------------------------------------------------
    @property
    def nominal(self) -> Any:
        """Every element at its nominal value (dynamics zero): a StateSpace, or an array (n_y, n_u) without states."""
        return self._closed({name: 0.0 for name in self.uncertain})

    def substitute(self, values: Mapping[str, Any] | None = None, **more: Any) -> Any:
        """The system with some elements at given values; a StateSpace or an array if no uncertain element remains.

        A real parameter takes a number, also one outside its declared range; a complex one a real number or a stable
        system (its value over frequency); dynamics take a number, a matrix or a stable system in place of Delta, of
        norm at most 1.

        Raises
        ------
        InputError : an unknown name, a value of the wrong kind. ComputationError : a division by zero.
        """
        given = {**(values or {}), **more}
        known = self.uncertain
        deltas: dict[str, Any] = {}
        for name, value in given.items():
            if name not in known:
                raise InputError(
                    f"expected some of {', '.join(known) or 'none: nothing is uncertain'}",
                    field="substitute",
                    value=name,
                )
            one = known[name]
            if isinstance(one, RealParameter):
                try:
                    deltas[name] = one.delta(float(value))
                except (TypeError, ValueError):
                    raise InputError("expected a number", field=name, value=value) from None
                except ZeroDivisionError:
                    raise InputError("expected a value nearer to the range", field=name, value=value) from None
            elif isinstance(one, ComplexDisk):
                deltas[name] = (as_system(value, name) + as_system(-one.centre)).scaled(1 / one.radius)
            else:
                deltas[name] = as_system(value, name)
        return self._closed(deltas)

    def values(self, n: int = 1, seed: int = 0) -> list[dict[str, Any]]:
        """n random sets of values for `substitute`: real parameters are uniform over their range; complex ones and
        dynamics are a first-order all-pass times a gain of at most 1, with a corner in the system's frequency range."""
        require_whole(n, "n", 0)
        rng = np.random.default_rng(seed)
        grid = np.array([0.1, 10.0])
        if self.nstates:
            nominal = self.nominal
            grid = plot_frequencies(nominal)[[0, -1]]
        found: list[dict[str, Any]] = []
        for _ in range(n):
            one_set: dict[str, Any] = {}
            for name, one in self.uncertain.items():
                if isinstance(one, RealParameter):
                    one_set[name] = float(rng.uniform(one.low, one.high))
                    continue
                Delta = _random_dynamics(one, rng, grid, self.dt)
                one_set[name] = (
                    Delta.scaled(one.radius) + as_system(one.centre) if isinstance(one, ComplexDisk) else Delta
                )
            found.append(one_set)
        return found

    def sample(self, n: int = 1, seed: int = 0) -> list[Any]:
        """n random systems of the set; see `values`."""
        return [self.substitute(one) for one in self.values(n, seed)]

    def _closed(self, deltas: Mapping[str, Any]) -> Any:
        """The system with the named elements closed by their normalised deltas (numbers or systems)."""
        system = self
        for name, delta in deltas.items():
            place = next(k for k, one in enumerate(system.elements) if one.name == name and one != STATES)
            element, n, w, z = system._slices()[place]
            if isinstance(delta, StateSpace):
                if delta.D.shape != (element.rows, element.cols):
                    raise InputError(
                        f"expected {element.rows} outputs and {element.cols} inputs", field=name, value=delta.D.shape
                    )
                inner = _repeated(as_uncertain(delta), n)
            else:
                inner = as_uncertain(delta * np.eye(n * element.rows, n * element.cols))
            system = _close(system, place, inner, w, z)
        return system if system.uncertain else system._certain()

    def _certain(self) -> Any:
        if not self.nstates:
            return self.d
        return StateSpace(self.a, self.b, self.c, self.d, self.dt, self.inputs, self.outputs, self.states)

    # -- arithmetic --------------------------------------------------------------------------
    def __add__(self, other: Any) -> UncertainSystem:
        X, Y = self, as_uncertain(other)
        if X.shape != Y.shape:
            raise InputError(f"sum of shapes {X.shape} and {Y.shape}")
        named = Y if X._plain else X
        return _of_both(parallel(X.matrices, Y.matrices), X, Y, named.inputs, named.outputs)

    def __neg__(self) -> UncertainSystem:
        return replace(self, c=-self.c, d=-self.d)

    def __sub__(self, other: Any) -> UncertainSystem:
        return self + (-as_uncertain(other))

    def __rsub__(self, other: Any) -> UncertainSystem:
        return as_uncertain(other) - self

    __radd__ = __add__

    def _affine(self) -> bool:
        """Whether a number is affine in the values of its elements, with no product or quotient of them. A parameter
        with an asymmetric range is a quotient of its delta, (nominal + b delta)/(1 + s delta): with delta/(1 + s delta)
        in place of delta, s is added to a."""
        a = self.a.copy()
        for one, n, w, z in self._slices():
            if one.skew:
                a[z, w] += one.skew * np.eye(n)
        return bool(np.all(np.abs(a) < SETTINGS.affine))

    def __matmul__(self, other: Any) -> UncertainSystem:
        X, Y = self, as_uncertain(other)
        inputs, outputs = X.inputs if Y._number else Y.inputs, Y.outputs if X._number else X.outputs
        if X.shape == Y.shape == (1, 1) and not (X.nstates or Y.nstates):
            # Numbers commute. Divisors act last, as a mass divides a sum of forces, so that the entries of a row share
            # them; and equal products of parameters get the same order.
            X, Y = sorted((X, Y), key=lambda one: (one._affine(), sorted(one.uncertain)))
        if X.shape[1] != Y.shape[0]:
            raise InputError(f"product of shapes {X.shape} and {Y.shape}")
        return _of_both(series(X.matrices, Y.matrices), X, Y, inputs, outputs)

    def __rmatmul__(self, other: Any) -> UncertainSystem:
        return as_uncertain(other) @ self

    def __mul__(self, other: Any) -> UncertainSystem:
        X, Y = self, as_uncertain(other)
        if X.shape == (1, 1) != Y.shape:
            return _repeated(X, Y.shape[0], Y.outputs) @ Y
        return X @ (Y if X.shape == (1, 1) or Y.shape != (1, 1) else _repeated(Y, X.shape[1], X.inputs))

    def __rmul__(self, other: Any) -> UncertainSystem:
        return as_uncertain(other) * self

    def inverse(self) -> UncertainSystem:
        """The inverse. ComputationError if the nominal value is not invertible."""
        if self.shape[0] != self.shape[1]:
            raise InputError("expected as many inputs as outputs", field="inverse", value=self.shape)
        if scaled_condition(self.d) > SETTINGS.singular:
            raise ComputationError(
                "the nominal value cannot be inverted",
                measured=f"D = {self.d.tolist()}",
                cause="a division by zero, or by a strictly proper system",
                next_step="choose a nominal value other than zero",
            )
        a, b, c, d = inverse(self.matrices)
        inputs, outputs = names_of_inverse(self.inputs, self.outputs)
        return replace(self, a=a, b=b, c=c, d=d, inputs=inputs, outputs=outputs)

    def __truediv__(self, other: Any) -> UncertainSystem:
        return self * as_uncertain(other).inverse()

    def __rtruediv__(self, other: Any) -> UncertainSystem:
        return as_uncertain(other) * self.inverse()

    def __pow__(self, power: int) -> UncertainSystem:
        return to_power(self, power, as_uncertain(np.eye(self.shape[0])))

    # -- connection --------------------------------------------------------------------------
    def feedback(self, other: Any = 1.0, sign: int = -1) -> UncertainSystem:
        """Closed loop with `other` from outputs to inputs, negative feedback by default: (I + X Y)^-1 X."""
        X, Y = self, as_uncertain(other)
        if Y.shape == (1, 1) and X.shape[0] == X.shape[1]:
            Y = _repeated(Y, X.shape[0], X.inputs)
        if Y.shape != (X.shape[1], X.shape[0]):
            raise InputError(f"feedback of shape {Y.shape} around {X.shape}")
        loop = return_difference(X.matrices, Y.matrices, sign)
        if np.linalg.cond(loop) > SETTINGS.singular:
            raise ComputationError(
                "the nominal loop is not well posed",
                measured=f"I + X Y = {loop.tolist()} at infinite frequency",
                cause="an algebraic loop of unit gain",
            )
        return _of_both(feedback(X.matrices, Y.matrices, sign), X, Y, X.inputs, X.outputs)

    def select(self, outputs: Any = None, inputs: Any = None) -> UncertainSystem:
        """The system with some of its outputs and inputs, by name or position."""
        rows, cols = positions(self.outputs, outputs, "output"), positions(self.inputs, inputs, "input")
        return reduced(
            replace(
                self,
                b=self.b[:, cols],
                c=self.c[rows],
                d=self.d[np.ix_(rows, cols)],
                inputs=tuple(self.inputs[k] for k in cols),
                outputs=tuple(self.outputs[k] for k in rows),
            )
        )

    def __getitem__(self, key: tuple[Any, Any]) -> UncertainSystem:
        rows, cols = key
        return self.select(rows, cols)

    def renamed(
        self,
        inputs: Sequence[str] | dict[str, str] | None = None,
        outputs: Sequence[str] | dict[str, str] | None = None,
    ) -> UncertainSystem:
        """The same system with new signal names (a full list, or a dict from old to new names)."""
        return replace(self, inputs=new_names(self.inputs, inputs), outputs=new_names(self.outputs, outputs))

    # -- display -----------------------------------------------------------------------------
    def _rows(self) -> list[tuple[str, str]]:
        return [(str(one), f"{n} {'copy' if n == 1 else 'copies'}") for one, n, _, _ in self._slices() if one != STATES]

    def __repr__(self) -> str:
        what = "; ".join(f"{text}, {count}" for text, count in self._rows()) or "nothing uncertain"
        if not self.nstates:
            return f"UncertainSystem({'number' if self.shape == (1, 1) else f'matrix {self.shape}'}: {what})"
        size = f"{count_of(self.nstates, 'state')}, {list(self.inputs)} -> {list(self.outputs)}"
        return f"UncertainSystem({size}: {what})"

    def _repr_html_(self) -> str:
        size = (
            f"{count_of(self.nstates, 'state')}, {list(self.inputs)} -> {list(self.outputs)}"
            if self.nstates
            else self.shape
        )
        return html_table(self._rows(), ("uncertain", "copies"), f"uncertain system, {size}")


# -- implementation ------------------------------------------------------------------------------
def as_uncertain(given: Any) -> UncertainSystem:
    """A number, array or system as an uncertain system."""
    if isinstance(given, UncertainSystem):
        return given
    P = as_system(given)
    n = P.nstates
    return UncertainSystem(P.A, P.B, P.C, P.D, (STATES,) * bool(n), (n,) * bool(n), P.dt, P.inputs, P.outputs, P.states)


def _repeated(X: UncertainSystem, n: int, names: tuple[str, ...] = ()) -> UncertainSystem:
    """X I_n; names : (n,) of both sides, by default u0.. and y0.."""
    parts = tuple(la.block_diag(*[one] * n) for one in X.matrices)
    return ordered(parts, _kinds(*[X] * n), X.dt, names, names, X.states * n)


def stacked(systems: Sequence[UncertainSystem], axis: int) -> UncertainSystem:
    """[X; Y; ...] (axis 0): outputs stacked, common inputs; [X Y ...] (axis 1): outputs added, separate inputs."""
    if len(systems) == 1:
        return systems[0]
    if len({one.shape[1 - axis] for one in systems}) > 1:
        what = ("columns", "rows")[axis]
        raise InputError(f"expected blocks of as many {what}", field="matrix", value=[one.shape for one in systems])
    a, b, c, d = zip(*(one.matrices for one in systems), strict=True)
    parts = (
        la.block_diag(*a),
        la.block_diag(*b) if axis else np.vstack(b),
        np.hstack(c) if axis else la.block_diag(*c),
        np.concatenate(d, axis),
    )
    return ordered(parts, _kinds(*systems), common_dt(*systems), (), (), sum((one.states for one in systems), ()))


def _kinds(*systems: UncertainSystem) -> list[tuple[Element, int]]:
    return [pair for one in systems for pair in zip(one.elements, one.copies, strict=True)]


def _of_both(
    parts: Quadruple, X: UncertainSystem, Y: UncertainSystem, inputs: Sequence[str], outputs: Sequence[str]
) -> UncertainSystem:
    return reduced(ordered(parts, _kinds(X, Y), common_dt(X, Y), tuple(inputs), tuple(outputs), X.states + Y.states))


def ordered(
    parts: Any,
    kinds: Sequence[tuple[Element, int]],
    dt: float,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    states: tuple[str, ...],
) -> UncertainSystem:
    """System with the states first, then one block per element, in order of first occurrence."""
    places: dict[str, tuple[Element, list[int], list[int]]] = {}
    w = z = 0
    for one, n in kinds:
        # No uncertain element has an empty name.
        key = "" if one == STATES else one.name
        known, ws, zs = places.setdefault(key, (one, [], []))
        if known != one:
            raise InputError(f"two different uncertain elements have this name: {known} and {one}", field=key)
        ws += range(w, w + n * one.rows)
        zs += range(z, z + n * one.cols)
        w, z = w + n * one.rows, z + n * one.cols
    order = sorted(places, key=lambda key: key != "")
    ws, zs = [i for key in order for i in places[key][1]], [i for key in order for i in places[key][2]]
    a, b, c, d = parts
    return UncertainSystem(
        a[np.ix_(zs, ws)],
        b[zs],
        c[:, ws],
        d,
        tuple(places[key][0] for key in order),
        tuple(len(places[key][1]) // places[key][0].rows for key in order),
        dt,
        inputs,
        outputs,
        states,
    )


def _close(system: UncertainSystem, place: int, inner: UncertainSystem, w: slice, z: slice) -> UncertainSystem:
    """The system with the block at `place` closed by i_in = inner(i_out); states of `inner` become states of it."""
    rest_w = [k for k in range(system.a.shape[1]) if not w.start <= k < w.stop]
    rest_z = [k for k in range(system.a.shape[0]) if not z.start <= k < z.stop]
    loop = np.eye(z.stop - z.start) - system.a[z, w] @ inner.d
    if np.linalg.cond(loop) > SETTINGS.singular:
        element = system.elements[place]
        raise ComputationError(
            "the system has no value here",
            measured=f"I - M Delta is singular at {element}",
            cause="a division by zero",
            next_step="choose a value inside the range",
        )
    # All signals as functions of (i_r, i_s, u): remaining internal signals, states of `inner` and inputs.
    a, b, c, d = system.a, system.b, system.c, system.d
    n, m = len(rest_w), inner.a.shape[1]
    seen = np.linalg.solve(loop, np.hstack([a[z][:, rest_w], a[z, w] @ inner.c, b[z]]))
    fed = inner.d @ seen
    fed[:, n : n + m] += inner.c
    rest, onto = np.ix_(rest_z, rest_w), a[rest_z][:, w] @ fed
    out = np.vstack(
        [
            np.hstack([a[rest], np.zeros((len(rest_z), m)), b[rest_z]]) + onto,
            np.hstack([np.zeros((m, n)), inner.a, np.zeros((m, b.shape[1]))]) + inner.b @ seen,
        ]
    )
    y = np.hstack([c[:, rest_w], np.zeros((c.shape[0], m)), d]) + c[:, w] @ fed
    kinds = [pair for k, pair in enumerate(_kinds(system)) if k != place] + _kinds(inner)
    return ordered(
        (out[:, : n + m], out[:, n + m :], y[:, : n + m], y[:, n + m :]),
        kinds,
        common_dt(system, inner),
        system.inputs,
        system.outputs,
        system.states + inner.states,
    )


def reduced(system: UncertainSystem) -> UncertainSystem:
    """The same system with fewer copies of scalar elements (`reduce_copies`, with each channel scaled to size one)."""
    slices = system._slices()
    scalar = [k for k, (one, *_) in enumerate(slices) if one.scalar and one != STATES]
    if not scalar:
        return system
    sizes = [slices[k][1] for k in scalar]
    inner_w, inner_z = (
        np.concatenate([np.arange(s[k].start, s[k].stop) for k in scalar])
        for s in ([one[2] for one in slices], [one[3] for one in slices])
    )
    outer_w = np.setdiff1d(np.arange(system.a.shape[1]), inner_w)
    outer_z = np.setdiff1d(np.arange(system.a.shape[0]), inner_z)
    A = system.a[np.ix_(inner_z, inner_w)]
    B = np.hstack([system.a[np.ix_(inner_z, outer_w)], system.b[inner_z]])
    C = np.vstack([system.a[np.ix_(outer_z, inner_w)], system.c[:, inner_w]])
    D = np.block([[system.a[np.ix_(outer_z, outer_w)], system.b[outer_z]], [system.c[:, outer_w], system.d]])
    rows, cols = _power_of_two(np.max(np.abs(C), axis=1)), _power_of_two(np.max(np.abs(B), axis=0))
    M, kept = reduce_copies(np.block([[A, B / cols], [C / rows[:, None], D / np.outer(rows, cols)]]), sizes)
    if kept == sizes:
        return system
    n = sum(kept)
    small = M[:n, :n], M[:n, n:] * cols, M[n:, :n] * rows[:, None], D
    if not _same((A, B, C, D), sizes, small, kept):
        return system
    p, q = len(outer_w), len(outer_z)
    a, b, c, _ = small
    parts = (
        np.block([[D[:q, :p], c[:q]], [b[:, :p], a]]),
        np.vstack([D[:q, p:], b[:, p:]]),
        np.hstack([D[q:, :p], c[q:]]),
        D[q:, p:],
    )
    kinds = [(one, n_one) for k, (one, n_one, _, _) in enumerate(slices) if k not in scalar]
    kinds += [(slices[k][0], n_one) for k, n_one in zip(scalar, kept, strict=True) if n_one]
    return ordered(parts, kinds, system.dt, system.inputs, system.outputs, system.states)


def _power_of_two(size: np.ndarray) -> np.ndarray:
    return np.exp2(np.round(np.log2(np.where(size > 0, size, 1.0))))


def _same(M: Quadruple, sizes: Sequence[int], small: Quadruple, kept: Sequence[int]) -> bool:
    """Whether two LFTs agree to round-off at random deltas; this detects wrong rank decisions."""
    rng = np.random.default_rng(0)

    def value(parts: Quadruple, counts: Sequence[int], delta: np.ndarray) -> np.ndarray:
        a, b, c, d = parts
        values = np.repeat(delta, counts)
        return d + c @ (values[:, None] * np.linalg.solve(np.eye(len(values)) - a * values, b))

    for _ in range(3):
        delta = SETTINGS.inside * rng.uniform(-1, 1, len(sizes))
        one, other = value(M, sizes, delta), value(small, kept, delta)
        size = np.maximum(np.abs(one), np.abs(M[3]))
        # An entry that is a difference of larger terms has their round-off.
        largest = np.outer(np.max(np.abs(M[2]), axis=1, initial=0.0), np.max(np.abs(M[1]), axis=0, initial=0.0))
        if np.any(np.abs(one - other) > SETTINGS.same * np.maximum(size, largest)):
            return False
    return True


def _random_dynamics(one: Element, rng: np.random.Generator, grid: np.ndarray, dt: float) -> StateSpace:
    """gain U (s - p)/(s + p) V' with a gain of at most 1."""
    corner = float(np.exp(rng.uniform(*np.log(grid))))
    gain = float(rng.uniform(-1, 1))
    U, _ = np.linalg.qr(rng.standard_normal((one.rows, one.rows)))
    V, _ = np.linalg.qr(rng.standard_normal((one.cols, one.cols)))
    k = min(one.rows, one.cols)
    UV = gain * U[:, :k] @ V[:, :k].T
    if dt:
        r = np.exp(-corner * dt)
        # (1 - r z)/(z - r)
        return StateSpace(r * np.eye(one.cols), np.eye(one.cols), (1 - r * r) * UV, -r * UV, dt)
    return StateSpace(-corner * np.eye(one.cols), np.eye(one.cols), -2 * corner * UV, UV)
