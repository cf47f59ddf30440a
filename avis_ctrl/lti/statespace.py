"""Linear time-invariant systems in state space, with named signals.

    x' = A x + B u        (dt = 0)      or      x[k+1] = A x[k] + B u[k]     (dt > 0)
    y  = C x + D u

A system consists of plain read-only numpy arrays. It can be pickled and so passed between processes.
The operators keep the signal names; those of python-control do not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.linalg as la
from numpy.typing import ArrayLike

from avis_ctrl.checks import is_whole
from avis_ctrl.errors import InputError
from avis_ctrl.lti.interconnection import (
    Quadruple,
    feedback,
    inverse,
    parallel,
    return_difference,
    scaled_condition,
    series,
)
from avis_ctrl.summary import count_of

Names = tuple[str, ...]
Selector = str | int | slice | Sequence[str] | Sequence[int] | np.ndarray


@dataclass(frozen=True)
class ResponseSettings:
    """block : number of states of a block of the back substitution. Only the work inside the diagonal blocks is done
        row by row, all other work is matrix products.
    probes : number of frequencies at which a response is checked by elimination, which is slow.
    tolerance : largest relative difference accepted there [1]: far above the round-off of a well scaled system.
    null : singular value of s I - A relative to the largest, and part of an input or output relative to its norm, that
        counts as zero at a pole s [1]: some rounding errors.
    """

    block: int = 16
    probes: int = 6
    tolerance: float = 1e-6
    null: float = 1e-13


SETTINGS = ResponseSettings()


def real_array(given: Any, field: str) -> np.ndarray:
    """Floating-point array of real numbers. Raises InputError for anything else, complex numbers included."""
    try:
        array = np.asarray(given)
        real = np.asarray(array.real if np.iscomplexobj(array) else array, float)
    except (TypeError, ValueError):
        raise InputError("expected real numbers, in rows of equal length", field=field) from None
    if np.iscomplexobj(array) and np.any(array.imag):
        raise InputError("expected real numbers", field=field)
    return real


def as_names(given: Iterable[str] | None) -> Names:
    """Names as a tuple; a string is one name."""
    return () if given is None else (given,) if isinstance(given, str) else tuple(str(name) for name in given)


def signal_names(given: Iterable[str] | None, count: int, prefix: str, what: str, different: bool = True) -> Names:
    """Checked names of inputs, outputs or states; prefix0, prefix1, ... if none are given."""
    names = as_names(given)
    if not names:
        return tuple(f"{prefix}{k}" for k in range(count))
    if len(names) != count:
        raise InputError(f"expected {count} {what} names, got {len(names)}: {names}")
    if different and len(set(names)) != count:
        twice = sorted({name for name in names if names.count(name) > 1})
        raise InputError(f"{what} names must differ; {twice} appear more than once")
    return names


def default_names(ninputs: int, noutputs: int) -> tuple[Names, Names]:
    """(inputs, outputs) of a system whose signals have no names."""
    return signal_names((), ninputs, "u", "input"), signal_names((), noutputs, "y", "output")


def names_of_inverse(inputs: Names, outputs: Names) -> tuple[Names, Names]:
    """(inputs, outputs) of an inverse: those of the system exchanged, unless all are default names."""
    unnamed = (inputs, outputs) == default_names(len(inputs), len(outputs))
    return (inputs, outputs) if unnamed else (outputs, inputs)


@dataclass(frozen=True, eq=False)
class StateSpace:
    """State-space model with named inputs, outputs and states.

    Parameters
    ----------
    A, B, C, D : (n, n), (n, n_u), (n_y, n), (n_y, n_u) real arrays.
    dt : sample time in seconds; 0 for continuous time.
    inputs, outputs, states : names; u0.., y0.., x0.. by default.

    Raises
    ------
    InputError : inconsistent shapes, entries that are not finite, repeated input or output names.

    Examples
    --------
    >>> G = ac.StateSpace([[0, 1], [-4, -0.4]], [[0], [1]], [[1, 0]], [[0]], inputs=["force"], outputs=["x"])
    >>> G
    StateSpace(2 states, continuous, ['force'] -> ['x'])
    >>> (2 * G @ G).nstates, G.is_stable(), G.dcgain()      # @ or *: series connection, right-hand system first
    (4, True, array([[0.25]]))
    >>> control.damp(G.to_control(), doprint=False)[1]
    array([0.1, 0.1])
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float = 0.0
    inputs: Names = field(default=())
    outputs: Names = field(default=())
    states: Names = field(default=())

    def __post_init__(self) -> None:
        A, B, C = (real_array(getattr(self, name), f"matrix {name}") for name in "ABC")
        D = np.atleast_2d(real_array(self.D, "matrix D"))
        n_y, n_u = D.shape
        A = A.reshape(0, 0) if A.size == 0 else np.atleast_2d(A)
        n = A.shape[0]
        B = B.reshape(n, n_u) if B.size == 0 else B
        C = C.reshape(n_y, n) if C.size == 0 else C
        if A.shape != (n, n) or B.shape != (n, n_u) or C.shape != (n_y, n):
            raise InputError(f"shapes do not fit: A {A.shape}, B {B.shape}, C {C.shape}, D {D.shape}")
        for name, matrix in (("A", A), ("B", B), ("C", C), ("D", D)):
            if not np.all(np.isfinite(matrix)):
                raise InputError(f"matrix {name} has entries that are not finite")
            matrix = matrix.copy()
            matrix.setflags(write=False)
            object.__setattr__(self, name, matrix)
        if not (isinstance(self.dt, (int, float, np.number)) and np.isfinite(self.dt) and self.dt >= 0):
            raise InputError(f"dt must be 0 (continuous) or a positive number of seconds, not {self.dt!r}")
        object.__setattr__(self, "dt", float(self.dt))
        object.__setattr__(self, "inputs", signal_names(self.inputs, n_u, "u", "input"))
        object.__setattr__(self, "outputs", signal_names(self.outputs, n_y, "y", "output"))
        # State names are informative only: after a connection two parts may have states of the same name.
        object.__setattr__(self, "states", signal_names(self.states, n, "x", "state", different=False))

    # -- sizes and properties -------------------------------------------------------------
    @property
    def matrices(self) -> Quadruple:
        """(A, B, C, D)."""
        return self.A, self.B, self.C, self.D

    @property
    def nstates(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def ninputs(self) -> int:
        """Number of inputs."""
        return self.D.shape[1]

    @property
    def noutputs(self) -> int:
        """Number of outputs."""
        return self.D.shape[0]

    def poles(self) -> np.ndarray:
        """Eigenvalues of A [rad/s, or in the z plane when dt > 0]."""
        return np.asarray(la.eigvals(self.A)) if self.nstates else np.zeros(0, complex)

    def is_stable(self) -> bool:
        """All poles in the open left half plane (inside the unit circle when dt > 0)."""
        poles = self.poles()
        return bool(np.all(np.abs(poles) < 1)) if self.dt else bool(np.all(poles.real < 0))

    # -- evaluation -----------------------------------------------------------------------
    def __call__(self, s: complex) -> np.ndarray:
        """Transfer matrix (n_y, n_u) at the complex point s (or z); inf at a pole."""
        if not self.nstates or np.isinf(s):
            return self.D.astype(complex)
        return _eliminated(self.A, self.B, self.C, np.array([s]))[0] + self.D

    def frequency_response(self, omega: np.ndarray) -> np.ndarray:
        """Transfer matrices (n_omega, n_y, n_u) at the frequencies omega [rad/s]; inf gives D."""
        omega = np.atleast_1d(np.asarray(omega, dtype=float))
        response = np.broadcast_to(self.D.astype(complex), (omega.size, *self.D.shape)).copy()
        finite = np.isfinite(omega)
        if self.nstates and np.any(finite) and response.size:
            points = np.exp(1j * omega[finite] * self.dt) if self.dt else 1j * omega[finite]
            response[finite] += _resolvent(self.A, self.B, self.C, points)
        return response

    def dcgain(self) -> np.ndarray:
        """Real transfer matrix at zero frequency; inf if there is a pole."""
        return self(1.0 if self.dt else 0.0).real

    # -- algebra --------------------------------------------------------------------------
    # Makes numpy arrays and numbers on the left defer to the operators of this class.
    __array_ufunc__ = None

    def __matmul__(self, other: Any) -> StateSpace:
        """Series connection: `self @ other` feeds the outputs of other into the inputs of self, in order."""
        other = operand(other)
        if other is None:
            return NotImplemented
        if self.ninputs != other.noutputs:
            raise InputError(f"series connection of {other.noutputs} outputs into {self.ninputs} inputs")
        return StateSpace(
            *series(self.matrices, other.matrices),
            common_dt(self, other),
            other.inputs,
            self.outputs,
            self.states + other.states,
        )

    def __rmatmul__(self, other: Any) -> StateSpace:
        left = operand(other)
        return NotImplemented if left is None else left @ self

    def __mul__(self, other: Any) -> StateSpace:
        """Multiply all outputs by a number; with a system, the series connection as `@`."""
        return self.scaled(float(other)) if isinstance(other, (int, float, np.number)) else self.__matmul__(other)

    def __rmul__(self, other: Any) -> StateSpace:
        return self.scaled(float(other)) if isinstance(other, (int, float, np.number)) else self.__rmatmul__(other)

    def inverse(self) -> StateSpace:
        """The inverse, for S = (1 + L).inverse() or 1/(1 + L). InputError if D cannot be inverted."""
        if self.ninputs != self.noutputs or scaled_condition(self.D) > 1 / np.finfo(float).eps:
            raise InputError(
                "expected as many inputs as outputs, and a D that can be inverted: the inverse of a strictly proper "
                "system is improper",
                field="inverse",
                value=f"D = {self.D.tolist()}",
            )
        return StateSpace(*inverse(self.matrices), self.dt, *names_of_inverse(self.inputs, self.outputs), self.states)

    def __truediv__(self, divisor: Any) -> StateSpace:
        if isinstance(divisor, (int, float, np.number)):
            if not divisor:
                raise InputError("division by zero", field="divisor", value=divisor)
            return self.scaled(1 / float(divisor))
        divisor = operand(divisor)
        return NotImplemented if divisor is None else self @ divisor.inverse()

    def __rtruediv__(self, dividend: Any) -> StateSpace:
        return dividend * self.inverse()

    def __pow__(self, power: int) -> StateSpace:
        return to_power(self, power, gain(np.eye(self.noutputs), dt=self.dt))

    def __add__(self, other: Any) -> StateSpace:
        """Parallel connection of two systems of equal shape; a number can be added to a scalar system."""
        other = operand(other)
        if other is None:
            return NotImplemented
        if self.D.shape != other.D.shape:
            raise InputError(f"parallel connection of shapes {self.D.shape} and {other.D.shape}")
        return StateSpace(
            *parallel(self.matrices, other.matrices),
            common_dt(self, other),
            self.inputs,
            self.outputs,
            self.states + other.states,
        )

    def __neg__(self) -> StateSpace:
        return replace(self, C=-self.C, D=-self.D)

    __radd__ = __add__

    def __sub__(self, other: Any) -> StateSpace:
        other = operand(other)
        return NotImplemented if other is None else self + (-other)

    def __rsub__(self, other: Any) -> StateSpace:
        return -self + other

    def feedback(self, other: Any = 1.0, sign: int = -1) -> StateSpace:
        """Closed loop from r to y with y = self u, u = r + sign other y; a number stands for this gain in each channel.

        Raises InputError if the loop is not well posed.
        """
        K = operand(other)
        if K is not None and not K.nstates and K.D.shape == (1, 1) and self.ninputs == self.noutputs:
            K = gain(K.D * np.eye(self.noutputs), dt=K.dt)
        if K is None or K.D.shape != self.D.shape[::-1] or sign not in (-1, 1):
            raise InputError(
                f"expected {self.noutputs} inputs and {self.ninputs} outputs, and sign -1 or 1",
                field="other, sign",
                value=(np.shape(K.D) if K else type(other).__name__, sign),
            )
        if np.linalg.cond(return_difference(self.matrices, K.matrices, sign)) > 1 / np.finfo(float).eps:
            raise InputError("the loop is not well posed: an algebraic loop without a solution", field="other")
        return StateSpace(
            *feedback(self.matrices, K.matrices, sign),
            common_dt(self, K),
            self.inputs,
            self.outputs,
            self.states + K.states,
        )

    def scaled(self, left: np.ndarray | float = 1.0, right: np.ndarray | float = 1.0) -> StateSpace:
        """`left @ self @ right`, where a vector represents a diagonal matrix and a scalar a multiple of the identity.

        The signal names are kept if the factor is square.
        """
        L, R = _as_matrix(left, self.noutputs), _as_matrix(right, self.ninputs)
        outputs = self.outputs if L.shape[0] == self.noutputs else ()
        inputs = self.inputs if R.shape[1] == self.ninputs else ()
        return StateSpace(self.A, self.B @ R, L @ self.C, L @ self.D @ R, self.dt, inputs, outputs, self.states)

    def renamed(
        self,
        inputs: Sequence[str] | dict[str, str] | None = None,
        outputs: Sequence[str] | dict[str, str] | None = None,
    ) -> StateSpace:
        """The same system with new signal names (a full list, or a dict from old to new names)."""
        return replace(self, inputs=new_names(self.inputs, inputs), outputs=new_names(self.outputs, outputs))

    def select(self, outputs: Selector | None = None, inputs: Selector | None = None) -> StateSpace:
        """The subsystem of the selected inputs and outputs, by name or position, in the order given."""
        rows = positions(self.outputs, outputs, "output")
        cols = positions(self.inputs, inputs, "input")
        return StateSpace(
            self.A,
            self.B[:, cols],
            self.C[rows],
            self.D[np.ix_(rows, cols)],
            self.dt,
            tuple(self.inputs[k] for k in cols),
            tuple(self.outputs[k] for k in rows),
            self.states,
        )

    def __getitem__(self, key: tuple[Selector, Selector]) -> StateSpace:
        rows, cols = key
        return self.select(rows, cols)

    def similar(self, T: np.ndarray) -> StateSpace:
        """The same transfer matrix in the state coordinates x_new = inv(T) x."""
        return replace(self, A=np.linalg.solve(T, self.A @ T), B=np.linalg.solve(T, self.B), C=self.C @ T, states=())

    # -- python-control -------------------------------------------------------------------
    def to_control(self) -> Any:
        """Convert to a python-control StateSpace (imports control, which takes about two seconds).

        Dots in names become underscores, because python-control forbids dots; repeated names of states become its
        default names.
        """
        import control

        inputs, outputs, states = (
            [name.replace(".", "_") for name in names] for names in (self.inputs, self.outputs, self.states)
        )
        return control.ss(
            self.A,
            self.B,
            self.C,
            self.D,
            self.dt,
            remove_useless_states=False,
            inputs=inputs,
            outputs=outputs,
            states=states if len(set(states)) == len(states) else None,
        )

    @staticmethod
    def from_control(system: Any) -> StateSpace:
        """Convert a python-control StateSpace or TransferFunction."""
        if system.dt is True:
            raise InputError("expected a sample time in seconds; True leaves it unspecified", field="dt", value=True)
        if not hasattr(system, "A"):
            import control

            system = control.ss(system)
        return StateSpace(
            system.A,
            system.B,
            system.C,
            system.D,
            float(system.dt or 0.0),
            tuple(system.input_labels),
            tuple(system.output_labels),
            tuple(system.state_labels),
        )

    def __repr__(self) -> str:
        clock = f"dt = {self.dt:g} s" if self.dt else "continuous"
        poles = self.poles()
        growth = np.abs(poles) - 1 if self.dt else poles.real / np.max(np.abs(poles), initial=1e-300)
        # An integrator does not count as unstable; its pole is known only to round-off.
        unstable = int(np.count_nonzero(growth > 1e-9))
        size = count_of(self.nstates, "state") + (f", {count_of(unstable, 'unstable pole')}" if unstable else "")
        return f"StateSpace({size}, {clock}, {list(self.inputs)} -> {list(self.outputs)})"


def to_power(system: Any, power: int, identity: Any) -> Any:
    """Whole power of a square system. Raises InputError for another power, and the errors of `inverse`."""
    if not is_whole(power):
        raise InputError("expected a whole number", field="power", value=power)
    base = system if power >= 0 else system.inverse()
    result = base if power else identity
    for _ in range(abs(int(power)) - 1):
        result = result @ base
    return result


def new_names(old: Names, given: Sequence[str] | dict[str, str] | None) -> Names:
    """Names after `renamed`: a full list, or a dict from old to new names."""
    if given is None:
        return old
    if isinstance(given, dict):
        if missing := [name for name in given if name not in old]:
            raise InputError(f"no signal {missing} among {old}")
        return tuple(given.get(name, name) for name in old)
    return as_names(given)


def gain(matrix: ArrayLike, inputs: Sequence[str] = (), outputs: Sequence[str] = (), dt: float = 0.0) -> StateSpace:
    """Static gain, as a system without states."""
    D = np.atleast_2d(np.asarray(matrix, dtype=float))
    return StateSpace(
        np.zeros((0, 0)),
        np.zeros((0, D.shape[1])),
        np.zeros((D.shape[0], 0)),
        D,
        dt,
        as_names(inputs),
        as_names(outputs),
    )


def tf(
    numerator: Any, denominator: Any, inputs: Sequence[str] = (), outputs: Sequence[str] = (), *, dt: float = 0.0
) -> StateSpace:
    """System in balanced companion form from a proper transfer function (coefficients in descending powers of s, or of
    z if it is sampled with the sample time dt [s]).

    Tables as for `avis_ctrl.uncertainty.uncertain_models.tf`. Entries of a column with the same denominator share their
    states.

    Raises
    ------
    InputError : an improper entry (more zeros than poles), a zero denominator, tables of different shapes.
    """
    nums = _table(numerator, "numerator")
    dens = _table(denominator, "denominator")
    if len(dens) == len(dens[0]) == 1:
        dens = [dens[0] * len(nums[0]) for _ in nums]
    shape = len(nums), len(nums[0])
    if {len(row) for row in nums} != {shape[1]} or [len(row) for row in dens] != [shape[1]] * shape[0]:
        raise InputError(f"expected tables of {shape[0]} rows and {shape[1]} columns", field="numerator, denominator")
    A, B, C, D = list[np.ndarray](), list[np.ndarray](), list[np.ndarray](), np.zeros(shape)
    for k in range(shape[1]):
        rows = {i: _proper(nums[i][k], dens[i][k]) for i in range(shape[0])}
        for den in dict.fromkeys(tuple(den) for _, den in rows.values()):
            sharing = [i for i, (_, own) in rows.items() if tuple(own) == den]
            part = _companion(np.array([rows[i][0] for i in sharing]), np.array(den))
            D[sharing, k] = part.D[:, 0]
            A.append(part.A)
            B.append(part.B @ np.eye(shape[1])[[k]])
            C.append(np.eye(shape[0])[:, sharing] @ part.C)
    return StateSpace(la.block_diag(*A), np.vstack(B), np.hstack(C), D, dt, as_names(inputs), as_names(outputs))


def _table(given: Any, field: str) -> list[list[np.ndarray]]:
    """Table of coefficients by output and input, from a single entry or a table."""
    depth, first = 0, given
    while isinstance(first, (list, tuple)) or np.ndim(first):
        if not len(first):
            raise InputError("expected coefficients", field=field)
        depth, first = depth + 1, first[0]
    if depth not in (0, 1, 3):
        raise InputError("expected coefficients, or rows with coefficients for each input", field=field)
    try:
        rows = given if depth == 3 else [[given]]
        table = [[np.trim_zeros(np.atleast_1d(real_array(one, field)), "f") for one in row] for row in rows]
    except (TypeError, InputError):
        raise InputError("expected real coefficients, or rows with coefficients for each input", field=field) from None
    if not all(np.isfinite(one).all() for row in table for one in row):
        raise InputError("expected finite coefficients", field=field)
    return table


def _proper(num: np.ndarray, den: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator of equal length, normalised to a monic denominator."""
    if den.size == 0:
        raise InputError("the denominator is zero")
    if num.size > den.size:
        raise InputError(f"improper: numerator of degree {num.size - 1} over denominator of degree {den.size - 1}")
    return np.concatenate([np.zeros(den.size - num.size), num / den[0]]), den / den[0]


def _companion(nums: np.ndarray, den: np.ndarray) -> StateSpace:
    """Single-input system with numerators nums (n_y, n + 1) over the monic denominator den (n + 1,)."""
    n, D = den.size - 1, nums[:, :1]
    if n == 0:
        return gain(D)
    A, B = np.zeros((n, n)), np.zeros((n, 1))
    A[:-1, 1:] = np.eye(n - 1)
    A[-1], B[-1] = -den[:0:-1], 1.0
    # State k is scaled by w0^k, with w0 the geometric mean of the poles, so that all states have similar magnitude.
    w0 = abs(den[-1]) ** (1.0 / n) if den[-1] else max(np.max(np.abs(np.roots(den)), initial=0.0), 1.0)
    system = StateSpace(A, B, (nums[:, 1:] - D * den[1:])[:, ::-1], D).similar(np.diag(w0 ** np.arange(n)))
    size = np.sqrt(np.linalg.norm(system.B) * np.linalg.norm(system.C)) or 1.0
    return system.similar(np.eye(n) * (np.linalg.norm(system.B) / size if np.linalg.norm(system.C) else 1.0))


def append(*systems: StateSpace) -> StateSpace:
    """Block-diagonal connection of systems with all their signals (default names if any name repeats)."""

    def joined(names: Iterable[Names]) -> Names:
        together = sum(names, ())
        return together if len(set(together)) == len(together) else ()

    return StateSpace(
        la.block_diag(*(s.A for s in systems)),
        la.block_diag(*(s.B for s in systems)),
        la.block_diag(*(s.C for s in systems)),
        la.block_diag(*(s.D for s in systems)),
        common_dt(*systems),
        joined(s.inputs for s in systems),
        joined(s.outputs for s in systems),
        sum((s.states for s in systems), ()),
    )


def operand(given: Any) -> StateSpace | None:
    """Convert a number, a matrix, or a system of this package or python-control to a StateSpace.

    None for other types and for complex numbers.

    The types of python-control are recognised by their attributes, because importing the library takes two seconds.
    """
    if isinstance(given, StateSpace):
        return given
    if isinstance(given, (int, float, np.number, np.ndarray)):
        if np.iscomplexobj(given):
            return None
        return gain(np.atleast_2d(np.asarray(given, float)))
    if hasattr(given, "A") or hasattr(given, "num"):
        return StateSpace.from_control(given)
    return None


def _as_matrix(factor: np.ndarray | float, size: int) -> np.ndarray:
    factor = np.asarray(factor, dtype=float)
    return factor * np.eye(size) if factor.ndim == 0 else np.diag(factor) if factor.ndim == 1 else factor


def common_dt(*systems: Any) -> float:
    """The sample time of systems to be connected; a static gain is compatible with any. InputError if they differ."""
    clocks = {s.dt for s in systems if s.nstates} or {s.dt for s in systems if s.dt} or {0.0}
    if len(clocks) > 1:
        raise InputError(f"systems of different sample times cannot be connected: {sorted(clocks)} s")
    return clocks.pop()


def positions(names: Names, asked: Selector | None, what: str) -> list[int]:
    """Indices of signals given by name or number, in the order given; all signals for None."""
    if asked is None:
        return list(range(len(names)))
    if isinstance(asked, slice):
        return list(range(len(names)))[asked]
    wanted: list[Any] = [asked] if isinstance(asked, (str, int, np.integer)) else list(asked)
    found = []
    for one in wanted:
        if isinstance(one, str):
            if one not in names:
                raise InputError(f"no {what} named {one!r}; there are {list(names)}")
            found.append(names.index(one))
        elif -len(names) <= int(one) < len(names):
            found.append(int(one))
        else:
            raise InputError(f"no {what} {one}; there are {len(names)}")
    return found


def _resolvent(A: np.ndarray, B: np.ndarray, C: np.ndarray, points: np.ndarray) -> np.ndarray:
    """C inv(s I - A) B at many points s, from one complex Schur form and batched back substitution.

    The Schur form is accurate only relative to the largest states. If slow states are much smaller, as in a
    controller with fast poles, the response at low frequency can lose all accuracy. It is therefore compared at a few
    points with Gaussian elimination, which is accurate for each state. Around points where the two differ, elimination
    replaces it.
    """
    if points.size < 4:
        return _eliminated(A, B, C, points)
    balanced, (scale, _) = la.matrix_balance(A, permute=False, separate=True)
    T, U = la.schur(balanced, output="complex")
    with np.errstate(divide="ignore", invalid="ignore"):  # at poles, which are computed again below
        response = _back_substituted(T, U.conj().T @ (B / scale[:, None]), (C * scale) @ U, points)
    order = np.argsort(np.abs(points))
    place = np.unique(np.linspace(0, points.size - 1, SETTINGS.probes).astype(int))
    probes = order[place]
    exact = _eliminated(A, B, C, points[probes])
    # At a pole both are infinite and cannot be compared.
    finite = np.isfinite(exact).all(axis=(1, 2))
    wrong = np.zeros(place.size)
    size = np.linalg.norm(exact[finite], axis=(1, 2))
    error = np.linalg.norm(response[probes[finite]] - exact[finite], axis=(1, 2))
    wrong[finite] = ~(error <= SETTINGS.tolerance * size)
    doubtful = order[np.interp(np.arange(points.size), place, wrong) > 0]
    doubtful = np.union1d(doubtful, np.flatnonzero(~np.isfinite(response).all(axis=(1, 2))))
    response[doubtful] = _eliminated(A, B, C, points[doubtful])
    return response


def _eliminated(A: np.ndarray, B: np.ndarray, C: np.ndarray, points: np.ndarray) -> np.ndarray:
    """C inv(s I - A) B point by point; inf in the entries of which s is a pole."""
    identity, right = np.eye(A.shape[0]), B.astype(complex)
    response = np.empty((points.size, C.shape[0], B.shape[1]), complex)
    for k, s in enumerate(points):
        try:
            response[k] = C @ np.linalg.solve(s * identity - A, right)
        except np.linalg.LinAlgError:
            response[k] = _at_pole(s * identity - A, right, C)
    return response


def _at_pole(M: np.ndarray, B: np.ndarray, C: np.ndarray) -> np.ndarray:
    """C inv(M) B for a singular M = s I - A: inf in the entries that see a mode at s, the others without this mode; inf
    in all entries if s is a defective eigenvalue.

    With M V = 0, U^H M = 0 and the projector P = V inv(U^H V) U^H, the rest is the x with M x = (I - P) b and P x = 0.
    """
    left, sizes, right = np.linalg.svd(M)
    none = sizes <= SETTINGS.null * sizes[0]
    U, V = left[:, none], np.conj(right[none].T)
    overlap = np.conj(U.T) @ V
    if np.linalg.norm(overlap, -2) <= SETTINGS.null**0.5:
        return np.full((C.shape[0], B.shape[1]), np.inf, complex)
    P = V @ np.linalg.solve(overlap, np.conj(U.T))
    x = np.linalg.lstsq(M, B - P @ B, rcond=SETTINGS.null)[0]
    seen = np.linalg.norm(C @ V, axis=1) > SETTINGS.null * np.linalg.norm(C, axis=1)
    excited = np.linalg.norm(np.conj(U.T) @ B, axis=0) > SETTINGS.null * np.linalg.norm(B, axis=0)
    return np.where(np.outer(seen, excited), np.inf, C @ (x - P @ x))


def _back_substituted(T: np.ndarray, B: np.ndarray, C: np.ndarray, points: np.ndarray) -> np.ndarray:
    """C inv(s I - T) B for upper triangular T, in blocks of states, for all points at once."""
    n, columns = B.shape
    x = np.zeros((n, points.size * columns), complex)
    pivots = np.repeat(points, columns) - np.diag(T)[:, None]
    right = np.tile(B, (1, points.size))
    for stop in range(n, 0, -SETTINGS.block):
        block = slice(max(stop - SETTINGS.block, 0), stop)
        right[block] += T[block, stop:] @ x[stop:]
        for k in range(stop - 1, block.start - 1, -1):
            x[k] = (right[k] + T[k, k + 1 : stop] @ x[k + 1 : stop]) / pivots[k]
    return np.moveaxis((C @ x).reshape(-1, points.size, columns), 1, 0).copy()
