"""Lower bound of mu: perturbations that make I - M Delta singular, found by repeated linearisation.

An eigenvalue of M Delta is moved to 1. To first order it is linear in Delta,

    lambda(Delta) = y^H M Delta x / (y^H x) = sum_real g_i delta_i + sum_complex g_i delta_i
                    + sum_full a_k^H Delta_k x_k / (y^H x),           a = M^H y,

and the Delta of minimum norm k that makes it 1 is known in closed form: with the multiplier 1 + j t,

    1/k = min over t of  sum_real |Re g_i + t Im g_i| + C sqrt(1 + t^2),
    C   = sum_complex |g_i| + sum_full |a_k| |x_k| / |y^H x|,

which is convex in t, with kinks where a real delta leaves its bound. For complex blocks alone this is the power
iteration of Packard, Fan and Doyle (Proc. 27th CDC, 1988); for real blocks alone it is Newton's method on
det(I - M Delta) = 0 with minimum ||Delta||. The initial Delta come from the null vectors of the upper bound's LMI.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from avis_ctrl.lti import StateSpace
from avis_ctrl.robust.mu_lmi import Array, LmiScalings, dagger, residual, selected
from avis_ctrl.robust.mu_power_kernel import FULL, search_complex
from avis_ctrl.robust.mu_upper import block_balance, expand, rescaled
from avis_ctrl.uncertainty.blocks import BlockStructure


@dataclass(frozen=True)
class MuLowerSettings:
    """singular : I - M Delta counts as singular if its smallest singular value is below this value plus the round-off
        of M Delta: an error of this size in Delta changes no printed digit of mu.
    meaningless : round-off of M Delta above which a small singular value proves nothing, and I - M Delta never counts
        as singular.
    eigenvalue : maximum distance from 1 of the nearest eigenvalue of M Delta at which I - M Delta counts as singular.
        If M Delta is far from normal, a small singular value alone proves nothing: for a nilpotent J, I - d J has
        determinant 1 for every d, but its smallest singular value decreases as a power of 1/d. Dividing Delta by the
        eigenvalue makes I - M Delta singular, so that this value is the relative error of the bound: one unit in the
        last printed digit.
    round_off : a lower bound of a peak is set to zero up to this fraction of the largest gain of N at any frequency. At
        the Nyquist frequency the terms of a sampled N cancel, and only round-off of that gain remains.
    few, many : number of starts of a quick and of a thorough search over complex blocks, from null vectors of the upper
        bound's LMI and mixtures of the best three. With 16 scalars, six do on average as well as 15 without damping.
    sweeps : maximum number of steps from one start; settled : relative change of ||Delta|| that ends it earlier. The
        best start is continued until the change is below the square of `settled`.
    damping : weight of the last Delta in the next Delta. Without damping the iteration cycles if mu is attained by
        several eigenvalues, and ends 1 % lower with 16 scalars.
    """

    singular: float = 1e-9
    meaningless: float = 1e-6
    eigenvalue: float = 1e-6
    round_off: float = 1e-14
    few: int = 3
    many: int = 6
    sweeps: int = 40
    settled: float = 1e-4
    damping: float = 0.5


SETTINGS = MuLowerSettings()


class _Step(NamedTuple):
    """Minimum-norm solution of the linearised equation."""

    k: Array  # (B,) norm of Delta
    phase: Array  # (B,) unit complex number, the common phase of the complex blocks
    real: Array  # (B, m) values of the real scalars


def _least_norm(g: Array, C: Array, t_fixed: Array | None = None) -> _Step:
    """Minimum ||Delta|| for a linearised eigenvalue of 1; g (B, m) of the real scalars, C (B,) of the other blocks.

    `t_fixed` (B,) prescribes the multiplier if the frequency is free; the frequency then zeroes the imaginary part.
    """
    a, b = g.real, g.imag
    batch, m = g.shape

    def height(t: Array) -> Array:
        return np.sum(np.abs(a[:, None] + t[..., None] * b[:, None]), axis=2) + C[:, None] * np.sqrt(1 + t**2)

    if t_fixed is not None:
        t, kink = t_fixed[:, None], np.full((batch, 1), -1)
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            bends = np.abs(b) > 1e-12 * np.abs(a)
            kinks = np.where(bends, -a / b, 0.0)
        order = np.argsort(kinks, axis=1)
        sorted_kinks = np.take_along_axis(kinks, order, axis=1)
        edges = np.concatenate([np.full((batch, 1), -np.inf), sorted_kinks, np.full((batch, 1), np.inf)], axis=1)
        low, high = edges[:, :-1], edges[:, 1:]
        below, above = np.isinf(low), np.isinf(high)
        low_end, high_end = np.where(below, 0.0, low), np.where(above, 0.0, high)
        middle = np.where(
            below,
            high_end - 1 - np.abs(high_end),
            np.where(above, low_end + 1 + np.abs(low_end), (low_end + high_end) / 2),
        )
        slope = np.sum(np.sign(a[:, None] + middle[..., None] * b[:, None]) * b[:, None], axis=2)
        inner = np.maximum(C[:, None] ** 2 - slope**2, 0.0)
        flat = np.where(inner > 0, -slope / np.sqrt(np.maximum(inner, 1e-300)), 0.0)
        # Kinks come first: an interval minimum that is clipped to the end of the interval means the kink.
        t = np.concatenate([sorted_kinks, np.clip(flat, low, high), np.zeros((batch, 1))], axis=1)
        owner = np.where(np.take_along_axis(bends, order, axis=1), order, -1)
        kink = np.concatenate([owner, np.full((batch, m + 2), -1)], axis=1)
    best = np.argmin(height(t), axis=1)[:, None]
    t, kink = np.take_along_axis(t, best, axis=1), np.take_along_axis(kink, best, axis=1)[:, 0]
    k = 1.0 / np.maximum(height(t)[:, 0], 1e-12)
    phase = ((1 + 1j * t) / np.sqrt(1 + t**2))[:, 0]
    real = k[:, None] * np.where(a + t * b >= 0, 1.0, -1.0)
    inside = np.flatnonzero(kink >= 0)
    if inside.size:
        j = kink[inside]
        turned = np.conj(phase[inside])[:, None] * g[inside]
        real[inside, j] = 0.0
        rest = -np.sum(turned * real[inside], axis=1).imag - phase[inside].imag
        slope_j = turned[np.arange(inside.size), j].imag
        ratio = rest / np.where(slope_j == 0, 1.0, slope_j)
        real[inside, j] = np.where(slope_j == 0, 0.0, np.clip(ratio, -k[inside], k[inside]))
    return _Step(k, phase, real)


def _eigenpair(A: Array, near: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Right and left eigenvectors x, y (B, n) of A for the eigenvalue nearest to `near`, by inverse iteration."""
    batch, n = A.shape[:2]
    shift = near * (1 + 1e-9 * (1 + 0.7j)) + 1e-14 * np.linalg.norm(A, axis=(1, 2))
    P = _inverse(A - shift[:, None, None] * np.eye(n))
    P /= np.maximum(np.linalg.norm(P, axis=(1, 2)), 1e-300)[:, None, None]
    P = P @ P
    P /= np.maximum(np.linalg.norm(P, axis=(1, 2)), 1e-300)[:, None, None]
    start = rng.standard_normal((2, batch, n)) + 1j * rng.standard_normal((2, batch, n))
    x, y = (P @ start[0][..., None])[..., 0], (dagger(P) @ start[1][..., None])[..., 0]
    return (
        x / np.maximum(np.linalg.norm(x, axis=1), 1e-300)[:, None],
        y / np.maximum(np.linalg.norm(y, axis=1), 1e-300)[:, None],
    )


def _inverse(B: Array) -> Array:
    """Inverse of each matrix, or of the nearest regular matrix if a pivot vanishes."""
    try:
        return np.linalg.inv(B)
    except np.linalg.LinAlgError:
        U, sigma, Vh = np.linalg.svd(B)
        floor = np.maximum(np.finfo(float).eps * sigma[:, :1], 1e-150)
        return (dagger(Vh) / np.maximum(sigma, floor)[:, None, :]) @ dagger(U)


class Linearised(NamedTuple):
    """The next Delta, its predicted norm, and the step of a free frequency (0 if it is fixed)."""

    delta: Array
    k: Array
    shift: Array


def next_delta(
    M: Array, delta: Array, structure: BlockStructure, rng: np.random.Generator, near: Array, slope: Array | None = None
) -> Linearised:
    """One step: M (B, n_z, n_w), delta (B, n_w, n_z). With `slope` dM/d omega the frequency is free, too."""
    x, y = _eigenpair(M @ delta, near, rng)
    e = np.sum(np.conj(y) * x, axis=1)
    e = np.where(np.abs(e) < 1e-12, 1e-12, e)
    a = (dagger(M) @ y[..., None])[..., 0]
    C, g = np.zeros(M.shape[0]), []
    for block, w, z in structure.slices():
        if block.kind == "full":
            C += np.linalg.norm(a[:, w], axis=1) * np.linalg.norm(x[:, z], axis=1) / np.abs(e)
            continue
        product = np.sum(np.conj(a[:, w]) * x[:, z], axis=1) / e
        if block.kind == "real":
            g.append(product)
        else:
            C += np.abs(product)
    q = t_fixed = None
    if slope is not None:
        q = np.einsum("bi,bij,bjk,bk->b", np.conj(y), slope, delta, x) / e
        # The multiplier must be orthogonal to the effect of the frequency.
        across = 1j * q * np.where(q.imag > 0, -1.0, 1.0)
        t_fixed = across.imag / np.maximum(across.real, 1e-9 * np.abs(q) + 1e-300)
    step = _least_norm(np.stack(g, axis=1) if g else np.zeros((M.shape[0], 0), complex), C, t_fixed)
    turn = step.k * step.phase * e / np.abs(e)
    new = turn[:, None, None] * aligned(a, x, structure, lambda product, _: np.zeros_like(product))
    reals = [(block.rows, w, z) for block, w, z in structure.slices() if block.kind == "real"]
    for value, (n, w, z) in zip(step.real.T, reals, strict=True):
        new[:, w, z] = value[:, None, None] * np.eye(n)
    shift = np.zeros(M.shape[0])
    if q is not None:
        made = np.einsum("bi,bij,bj->b", np.conj(a), new, x) / e
        shift = np.real(np.conj(q) * (1 - made)) / np.maximum(np.abs(q) ** 2, 1e-300)
    return Linearised(new, step.k, shift)


def block_norm(delta: Array, structure: BlockStructure) -> Array:
    """Largest block norm (B,) of Delta (B, n_w, n_z)."""
    return np.max(
        np.stack(
            [
                np.linalg.norm(delta[:, w, z], ord=2, axis=(1, 2))
                if block.kind == "full"
                else np.abs(delta[:, w.start, z.start])
                for block, w, z in structure.slices()
            ]
        ),
        axis=0,
    )


def is_singular(M: Array, delta: Array, structure: BlockStructure) -> Array:
    """Whether I - M Delta is singular (B,): smallest singular value below 1e-9 plus the round-off of M Delta, and an
    eigenvalue of M Delta within 1e-6 of 1.

    The balanced M is tested, which gives the same determinant; a badly scaled M appears singular for any Delta.
    """
    if not M.shape[0]:
        return np.zeros(0, bool)
    d_z, d_w = expand(structure, block_balance(M[:, None], structure))
    return _balanced_is_singular(M * d_z[:, :, None] / d_w[:, None, :], delta)


def _balanced_is_singular(M: Array, delta: Array) -> Array:
    A = M @ delta
    least = np.linalg.svd(np.eye(A.shape[-1]) - A, compute_uv=False)[:, -1]
    round_off = 1e-14 * np.linalg.norm(A, ord=2, axis=(1, 2))
    found = (least < SETTINGS.singular + round_off) & (round_off < SETTINGS.meaningless)
    away = np.min(np.abs(np.linalg.eigvals(A[found]) - 1), axis=1, initial=np.inf)
    found[found] = away < SETTINGS.eigenvalue
    return found


def _complex_part(structure: BlockStructure) -> Array:
    mask = np.zeros((structure.n_w, structure.n_z))
    for block, w, z in structure.slices():
        mask[w, z] = block.kind != "real"
    return mask


def scaled_to_singular(M: Array, delta: Array, structure: BlockStructure) -> Array:
    """Delta with its complex blocks multiplied by a common complex factor so that I - M Delta is exactly singular.

    Without complex blocks, the real blocks are scaled (exact at frequencies where M Delta has a real eigenvalue).
    Entries are inf if this is impossible.
    """
    mask = _complex_part(structure)
    n_z = structure.n_z
    real, rest = delta * (1 - mask), delta * mask
    free = not np.any(mask)
    if free:
        real, rest = np.zeros_like(delta), delta
    open_loop = np.eye(n_z) - M @ real
    with np.errstate(all="ignore"):
        regular = np.linalg.cond(open_loop) < 1e13
        inner = np.linalg.solve(np.where(regular[:, None, None], open_loop, np.eye(n_z)), M) @ rest
        values = np.linalg.eigvals(inner)
        values = np.where(np.abs(values) > 1e-13, 1 / np.where(values == 0, 1, values), np.inf)
        distance = np.where(np.isfinite(values), np.abs(values - 1), np.inf)
        factor = np.take_along_axis(values, np.argmin(distance, axis=1)[:, None], axis=1)[:, 0]
        factor = factor.real.astype(complex) if free else factor
        factor = np.where(regular, factor, 1.0)
        return real + factor[:, None, None] * rest


def _least_squares(product: Array, square: Array) -> Array:
    return np.clip(product / np.maximum(square, 1e-300), -1, 1)


def aligned(w: Array, z: Array, structure: BlockStructure, real: Callable[[Array, Array], Array]) -> Array:
    """Delta of norm 1 that best satisfies w = Delta z, block by block.

    real : value of a real block in -1..1, a function of Re(z^H w) and |z|^2.
    """
    delta = np.zeros((w.shape[0], structure.n_w, structure.n_z), complex)
    for block, iw, iz in structure.slices():
        wk, zk = w[:, iw], z[:, iz]
        if block.kind == "full":
            size = np.linalg.norm(wk, axis=1) * np.linalg.norm(zk, axis=1)
            delta[:, iw, iz] = wk[:, :, None] * np.conj(zk[:, None, :]) / np.where(size > 0, size, 1)[:, None, None]
            continue
        product = np.sum(np.conj(zk) * wk, axis=1)
        if block.kind == "real":
            value = real(product.real, np.sum(np.abs(zk) ** 2, axis=1))
        else:
            value = np.where(np.abs(product) > 0, product / np.maximum(np.abs(product), 1e-300), 1.0)
        delta[:, iw, iz] = value[:, None, None] * np.eye(block.rows)
    return delta


class MuLowerBound(NamedTuple):
    """beta (B,) with delta (B, n_w, n_z): ||delta|| = 1/beta and I - M delta singular; beta = 0, delta = 0 if none."""

    beta: Array
    delta: Array


def lower_bound(
    M: Array,
    structure: BlockStructure,
    upper: Array,
    scalings: LmiScalings,
    *,
    enough: float = 0.99,
    stages: int = 3,
    seed: int = 0,
) -> MuLowerBound:
    """Best verified perturbation for each M (B, n_z, n_w), starting from the null vectors of the upper bound's LMI.

    If the first three starts do not reach `enough` times the upper bound, further `stages` use more starts, the last
    stage with damping. Structures without real blocks use the compiled search first.
    """
    batch = M.shape[0]
    # Scalings of one number per block commute with every Delta: the search uses the balanced M.
    d_z, d_w = expand(structure, block_balance(M[:, None], structure))
    M = M * d_z[:, :, None] / d_w[:, None, :]
    # An upper bound at the level of the round-off of M means mu = 0: no search.
    above_noise = upper > 1e-10 * np.linalg.norm(M, ord=2, axis=(1, 2))
    size = np.where(above_noise, upper, 1.0)
    search = _Search(
        np.ascontiguousarray(M / size[:, None, None]),
        rescaled(scalings, 1 / d_z, 1 / d_w, 1 / size),
        structure,
        np.random.default_rng(seed),
        np.zeros(batch),
        np.zeros((batch, structure.n_w, structure.n_z), complex),
    )
    if all(block.kind != "real" for block in structure.blocks):
        search.complex_blocks(np.flatnonzero(above_noise), enough, SETTINGS.few if stages == 1 else SETTINGS.many)
        # Matrices without a verified perturbation go on to the slower search.
        above_noise &= search.value == 0.0
    for count, iterations, damping in ((3, 20, 0.0), (6, 30, 0.0), (6, 40, 0.5))[:stages]:
        search.any_blocks(np.flatnonzero(above_noise & (search.value < enough)), count, iterations, damping)
    return MuLowerBound(search.value * size, search.delta / size[:, None, None])


@dataclass(frozen=True, eq=False)
class _Search:
    """Search for perturbations of M (B, n_z, n_w), in units of its upper bound.

    value (B,), delta (B, n_w, n_z) : the largest verified 1/||Delta|| so far, and its Delta; 0 if there is none.
    """

    M: Array
    scalings: LmiScalings
    structure: BlockStructure
    rng: np.random.Generator
    value: Array
    delta: Array

    def null_vectors(self, live: Array, count: int) -> Array:
        """Approximate null vectors w (count, B, n_w) of the upper bound's LMI: the best three, then random mixtures."""
        scalings = selected(self.scalings, live)
        everywhere = np.ones(self.structure.n_w, bool)
        F = residual(self.M[live, None], scalings, np.ones(live.size), everywhere)[:, 0]
        values, vectors = np.linalg.eigh(scalings.X_w)
        root = vectors / np.sqrt(np.maximum(values, 1e-300))[:, None, :]
        _, null = np.linalg.eigh(dagger(root) @ F @ root)
        null = root @ null
        few = min(3, self.structure.n_w)
        made = []
        for k in range(count):
            mix = self.rng.standard_normal((live.size, few)) + 1j * self.rng.standard_normal((live.size, few))
            made.append(null[:, :, k] if k < few else np.einsum("bik,bk->bi", null[:, :, :few], mix))
        return np.stack(made)

    def complex_blocks(self, live: Array, enough: float, count: int) -> None:
        """The compiled search, for structures without real blocks."""
        if not live.size:
            return
        M, blocks = self.M[live], self.structure.blocks
        kinds = np.array([FULL if block.kind == "full" else 0 for block in blocks])
        w, z = (np.cumsum([0, *sizes]) for sizes in zip(*((b.rows, b.cols) for b in blocks), strict=True))

        def found_from(starts: Array, enough: float, settled: float) -> tuple[Array, Array, Array]:
            return search_complex(M, starts, kinds, w, z, SETTINGS.sweeps, SETTINGS.damping, enough, settled)

        value, found, vector = found_from(self.null_vectors(live, count), enough, SETTINGS.settled)
        # Continue from the best start to convergence.
        further, settled, _ = found_from(vector[None], np.inf, SETTINGS.settled**2)
        self.keep(live, np.where((further > value)[:, None, None], settled, found))

    def any_blocks(self, live: Array, count: int, iterations: int, damping: float) -> None:
        """Repeated linearisation from `count` starts."""
        if not live.size:
            return
        M, near = self.M[live], np.ones(live.size, complex)
        for w in self.null_vectors(live, count):
            delta = aligned(w, (M @ w[..., None])[..., 0], self.structure, _least_squares)
            for sweep in range(iterations):
                new = next_delta(M, delta, self.structure, self.rng, near).delta
                delta = damping * delta + (1 - damping) * new
                if sweep % 5 == 4:
                    self.keep(live, new)

    def keep(self, live: Array, delta: Array) -> None:
        """Take perturbations that are verified and better."""
        exact = scaled_to_singular(self.M[live], delta, self.structure)
        for candidate in (exact, delta) if not np.any(_complex_part(self.structure)) else (exact,):
            finite = np.all(np.isfinite(candidate), axis=(1, 2))
            candidate = np.where(finite[:, None, None], candidate, 0.0)
            norm = block_norm(candidate, self.structure)
            good = finite & (norm > 0)
            good[good] &= _balanced_is_singular(self.M[live[good]], candidate[good])
            value = np.where(good, 1 / np.where(good, norm, 1.0), 0.0)
            # A value above the upper bound is round-off that passed the singularity test.
            better = (value > self.value[live]) & (value <= 1 + 1e-6)
            self.value[live[better]], self.delta[live[better]] = value[better], candidate[better]


def singular_frequency(
    N: StateSpace,
    structure: BlockStructure,
    near: Array,
    level: float,
    band: tuple[float, float],
    *,
    count: int = 6,
    iterations: int = 40,
    seed: int = 2,
) -> tuple[float, float, Array] | None:
    """A small Delta that makes I - N Delta singular, and the frequency, also free: (beta, omega, delta); None if none.

    For real perturbations, whose critical frequency is in general not on a grid. `near` (n,) : initial values [rad/s].
    """
    rng = np.random.default_rng(seed)
    omega = np.repeat(near[np.isfinite(near) & (near > 0)], count)
    if not omega.size or not N.nstates or level <= 0:
        return None
    delta = np.stack([structure.random(rng, 1 / level) for _ in omega])
    best: tuple[float, float, Array] | None = None
    for sweep in range(iterations):
        M, slope = _response_and_slope(N, omega)
        near_one = np.ones(omega.size, complex) if sweep else _leading(M @ delta)
        step = next_delta(M, delta, structure, rng, near_one, slope)
        delta = step.delta
        omega = np.clip(omega + np.clip(step.shift, -0.3 * omega, 0.3 * omega), max(band[0], 1e-300), band[1])
        if sweep % 5 != 4:
            continue
        M, _ = _response_and_slope(N, omega)
        exact = scaled_to_singular(M, delta, structure) if np.any(_complex_part(structure)) else delta
        usable = np.flatnonzero(np.all(np.isfinite(exact), axis=(1, 2)))
        usable = usable[block_norm(exact[usable], structure) > 0]
        usable = usable[is_singular(M[usable], exact[usable], structure)]
        for k, norm in zip(usable, block_norm(exact[usable], structure), strict=True):
            if best is None or 1 / norm > best[0]:
                best = (float(1 / norm), float(omega[k]), exact[k])
    return best


def _leading(A: Array) -> Array:
    """The eigenvalue of largest real part (B,) of each matrix."""
    values = np.linalg.eigvals(A)
    return np.take_along_axis(values, np.argmax(values.real, axis=1)[:, None], axis=1)[:, 0]


def _response_and_slope(N: StateSpace, omega: Array) -> tuple[Array, Array]:
    """N(j omega) and dN/d omega = -j C inv(j omega I - A)^2 B, each (n, n_z, n_w)."""
    resolvent = 1j * omega[:, None, None] * np.eye(N.nstates) - N.A
    X = np.linalg.solve(resolvent, N.B.astype(complex))
    return N.C @ X + N.D, -1j * N.C @ np.linalg.solve(resolvent, X)
