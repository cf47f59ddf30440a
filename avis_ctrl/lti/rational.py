"""Scalar rational functions stored as first- and second-order factors, which are more accurate than coefficients.

The factors are s^2 + 2 zeta w s + w^2 and s + w. With w > 0 and zeta > 0 every pole and zero lies in the open left half
plane. The function is then stable and minimum phase and has a stable inverse (apart from its zeros at infinity).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import InputError
from avis_ctrl.lti.realisation import balance
from avis_ctrl.lti.statespace import StateSpace, gain, tf

Section = tuple[float, float]


@dataclass(frozen=True)
class Rational:
    """Proper, stable and minimum-phase function gain * prod(zero factors) / prod(pole factors).

    Parameters
    ----------
    gain : positive high-frequency gain (the ratio of leading coefficients).
    zero_pairs, pole_pairs : (w [rad/s], zeta) of the factors s^2 + 2 zeta w s + w^2.
    real_zeros, real_poles : w [rad/s] of the factors s + w.

    Raises
    ------
    InputError : a number that is not finite and positive, or more zeros than poles.
    """

    gain: float
    zero_pairs: tuple[Section, ...] = ()
    pole_pairs: tuple[Section, ...] = ()
    real_zeros: tuple[float, ...] = ()
    real_poles: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for field in ("gain", "zero_pairs", "pole_pairs", "real_zeros", "real_poles"):
            numbers = np.asarray(getattr(self, field), float)
            if not (np.all(np.isfinite(numbers)) and np.all(numbers > 0)):
                raise InputError(
                    "every number must be finite and positive (stable, minimum phase)",
                    field=field,
                    value=getattr(self, field),
                )
        if self.relative_degree < 0:
            raise InputError(
                f"improper: {self.order - self.relative_degree} zeros over {self.order} poles", field="zero_pairs"
            )

    @property
    def order(self) -> int:
        """Number of poles."""
        return 2 * len(self.pole_pairs) + len(self.real_poles)

    @property
    def relative_degree(self) -> int:
        """Number of poles minus number of zeros: the roll-off at high frequency in powers of 1/omega."""
        return self.order - 2 * len(self.zero_pairs) - len(self.real_zeros)

    def __call__(self, s: np.ndarray) -> np.ndarray:
        """Complex values at the points s [rad/s]."""
        s = np.asarray(s, complex)
        value = np.full(s.shape, self.gain, complex)
        for w, zeta in self.zero_pairs:
            value = value * (s * s + 2 * zeta * w * s + w * w)
        for w in self.real_zeros:
            value = value * (s + w)
        for w, zeta in self.pole_pairs:
            value = value / (s * s + 2 * zeta * w * s + w * w)
        for w in self.real_poles:
            value = value / (s + w)
        return value

    def magnitude(self, omega: np.ndarray) -> np.ndarray:
        """|H(j omega)| at the frequencies omega [rad/s]."""
        return np.abs(self(1j * np.asarray(omega, float)))

    def scaled(self, factor: float) -> Rational:
        """The same function with its gain multiplied by a factor."""
        return replace(self, gain=self.gain * factor)

    def inverse(self) -> Rational:
        """1/H; raises InputError unless H is biproper."""
        return Rational(1.0 / self.gain, self.pole_pairs, self.zero_pairs, self.real_poles, self.real_zeros)

    def zeros(self) -> np.ndarray:
        """Finite zeros [rad/s], complex."""
        return _roots(self.zero_pairs, self.real_zeros)

    def poles(self) -> np.ndarray:
        """Poles [rad/s], complex."""
        return _roots(self.pole_pairs, self.real_poles)

    def system(self, input: str = "u", output: str = "y") -> StateSpace:
        """Balanced cascade realisation of minimal order."""
        return cascade(self.zeros(), self.poles(), self.gain, input, output)


def _roots(pairs: Sequence[Section], real: Sequence[float]) -> np.ndarray:
    found = [np.roots([1.0, 2 * zeta * w, w * w]) for w, zeta in pairs]
    return np.concatenate([*found, -np.asarray(real, float)]).astype(complex)


def log_modulus(pairs: np.ndarray, real: np.ndarray, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log |product of factors at j omega| (n_omega,), and its derivatives (n_omega, 2 n + m) by their logarithms.

    pairs : (n, 2) logarithms of w [rad/s] and zeta of the factors s^2 + 2 zeta w s + w^2. real : (m,) logarithms of w
    of the factors s + w. omega : (n_omega,) [rad/s].
    """
    square = np.asarray(omega, float)[:, None] ** 2
    w2, w = np.exp(2 * pairs[:, 0]), np.exp(2 * real)
    damping = 4 * np.exp(2 * pairs[:, 1]) * w2 * square
    of_pair, of_real = (w2 - square) ** 2 + damping, square + w
    slopes = np.stack([(2 * w2 * (w2 - square) + damping) / of_pair, damping / of_pair], axis=2)
    value = 0.5 * (np.sum(np.log(of_pair), axis=1) + np.sum(np.log(of_real), axis=1))
    return value, np.hstack([slopes.reshape(square.size, -1), w / of_real])


def second_order_roots(corner_Hz: float, damping: float) -> np.ndarray:
    """Roots of s^2 + 2 zeta w s + w^2 [rad/s]."""
    return _roots([(2 * np.pi * corner_Hz, damping)], [])


def cascade(
    zeros: Sequence[complex] | np.ndarray,
    poles: Sequence[complex] | np.ndarray,
    leading: float,
    input: str = "u",
    output: str = "y",
) -> StateSpace:
    """leading * prod(s - z) / prod(s - p) as a balanced cascade of first- and second-order sections.

    A cascade keeps widely spread roots accurate; a single companion matrix would lose them. The poles of each section
    are paired with the nearest zeros, so that no partial product becomes large.

    Raises InputError if the function is improper or a complex root has no conjugate.
    """
    pole_sections, zero_sections = _real_sections(poles, "poles"), _real_sections(zeros, "zeros")
    if sum(len(z) for z in zero_sections) > sum(len(p) for p in pole_sections):
        raise InputError(
            f"improper: {len(np.atleast_1d(zeros))} zeros over {len(np.atleast_1d(poles))} poles", field="zeros"
        )
    if not pole_sections:
        return gain(leading, [input], [output])
    chain = None
    for den, num in zip(pole_sections, _matched(pole_sections, zero_sections), strict=True):
        numerator, denominator = (np.atleast_1d(np.poly(part)).real for part in (num, den))
        size = _section_size(numerator, denominator)
        leading *= size
        section = tf(list(numerator / size), list(denominator))
        chain = section if chain is None else section @ chain
    assert chain is not None
    spread = np.sign(leading) * np.sqrt(abs(leading)), np.sqrt(abs(leading))
    return balance(chain.scaled(*spread)).renamed([input], [output])


def _section_size(numerator: np.ndarray, denominator: np.ndarray) -> float:
    """Magnitude of a section at its corner frequency."""
    w = abs(denominator[-1]) ** (1.0 / (denominator.size - 1)) or 1.0
    value = abs(np.polyval(numerator, 1j * w) / np.polyval(denominator, 1j * w))
    return float(value) if np.isfinite(value) and value > 0 else 1.0


def _real_sections(roots: Sequence[complex] | np.ndarray, field: str) -> list[np.ndarray]:
    """Group roots into sections with real coefficients (conjugate pairs, real roots two by two), slowest first."""
    roots = np.atleast_1d(np.asarray(roots, complex))
    tolerance = 1e-9 * np.abs(roots)
    upper = roots[roots.imag > tolerance]
    lower = list(roots[roots.imag < -tolerance])
    real = sorted(roots[np.abs(roots.imag) <= tolerance].real, key=abs)
    sections = []
    for root in upper:
        mate = min(lower, key=lambda r: abs(r - np.conj(root)), default=None)
        if mate is None or abs(mate - np.conj(root)) > 1e-6 * abs(root):
            raise InputError(f"complex root {root:.4g} has no conjugate", field=field)
        lower.remove(mate)
        sections.append(np.array([root, np.conj(root)]))
    if lower:
        raise InputError(f"complex root {lower[0]:.4g} has no conjugate", field=field)
    sections += [np.array(real[k : k + 2], complex) for k in range(0, len(real), 2)]
    return sorted(sections, key=lambda s: float(np.max(np.abs(s))))


def _matched(poles: list[np.ndarray], zeros: list[np.ndarray]) -> list[np.ndarray]:
    """Zeros assigned to each pole section, at most as many as its poles.

    A zero section is assigned to the pole section nearest in frequency that has room for it. If no section has room for
    a pair of zeros, the pair is split, provided that it is real.
    """
    taken: list[np.ndarray] = [np.zeros(0, complex) for _ in poles]

    def place(section: np.ndarray) -> bool:
        room = [k for k, p in enumerate(poles) if len(p) - len(taken[k]) >= len(section)]
        if not room:
            return False
        size = np.max(np.abs(section))
        best = min(room, key=lambda k: abs(np.log((np.max(np.abs(poles[k])) + 1e-300) / (size + 1e-300))))
        taken[best] = np.concatenate([taken[best], section])
        return True

    for section in sorted(zeros, key=len, reverse=True):
        if not place(section):
            for root in section:
                if abs(root.imag) > 0 or not place(np.array([root])):
                    raise InputError("improper: more zeros than poles", field="zeros")
    return taken
