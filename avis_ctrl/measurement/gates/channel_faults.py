"""Which channels are exchanged or flipped, by comparison of measured and expected responses.

Measured and expected responses pass through the same estimator (H1 over the same segments of the same u, the model's
y computed in the frequency domain), so that leakage changes both alike. With a channel's row (or column) M of the
measured
and E of the expected response, similarity is the real correlation

    c_ik = Re sum w E_k* M_i / sqrt(sum w |E_k|^2  sum w |M_i|^2),   w(f) = 1 / (|E(f)|^2 + noise(f)),  Frobenius norms

so that each frequency counts alike where the model expects something above the noise. It feels magnitude and phase.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avis_ctrl.measurement.gates.h1 import H1, Spectra, h1

# The other channel must agree better than the own one by this much in correlation (of at most 1).
MARGIN = 0.15


@dataclass(frozen=True, eq=False)
class Comparison:
    """Inner products of measured entry (i, j) with expected entry (k, l), and what normalises them.

    C : (n_y, n_y, n_u, n_u), index i, k, j, l; rows_M, rows_E : (n_y,) and columns_M, columns_E : (n_u,) norms.
    standard : largest standard deviation that noise gives a correlation.
    """

    C: np.ndarray
    rows_M: np.ndarray
    rows_E: np.ndarray
    columns_M: np.ndarray
    columns_E: np.ndarray
    measured: H1
    standard: float

    def rows(self, q: np.ndarray, c: np.ndarray | None = None) -> np.ndarray:
        """(n_y, n_y) correlation of measured row i with expected row k, columns matched by q with signs c."""
        j = np.arange(len(q))
        own = self.C[:, :, j, q] @ (np.ones(len(q)) if c is None else c)
        return own / (self.rows_M[:, None] * self.rows_E)

    def columns(self, p: np.ndarray, r: np.ndarray | None = None) -> np.ndarray:
        """(n_u, n_u), the same for columns, with rows matched by p with signs r."""
        i = np.arange(len(p))
        own = np.einsum("i,ijl->jl", np.ones(len(p)) if r is None else r, self.C[i, p])
        return own / (self.columns_M[:, None] * self.columns_E)

    def own(self, order: dict[str, np.ndarray], sign: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Correlation of each row (n_y,) and column (n_u,) with the expectation that order and sign give it."""
        p, q = order["row"], order["column"]
        entries = self.C[np.arange(len(p))[:, None], p[:, None], np.arange(len(q)), q] * np.outer(
            sign["row"], sign["column"]
        )
        return {
            "row": entries.sum(axis=1) / (self.rows_M * self.rows_E[p]),
            "column": entries.sum(axis=0) / (self.columns_M * self.columns_E[q]),
        }


def compare(pairs: list[tuple[Spectra, Spectra]]) -> Comparison | None:
    """Of measured and expected spectra of records (those of the commonest segment length); None where too few."""
    if not pairs:
        return None
    lengths = [len(m.f) for m, _ in pairs]
    common = max(set(lengths), key=lengths.count)
    chosen = [(m, e) for m, e in pairs if len(m.f) == common]
    measured, expected = h1([m for m, _ in chosen]), h1([e for _, e in chosen])
    if measured is None or expected is None:
        return None
    M, E = measured.G, expected.G
    size = np.linalg.norm(E, axis=(1, 2))
    inverse = np.linalg.pinv(measured.gram, hermitian=True)
    spread = np.sqrt(np.einsum("fi,fjj->fij", measured.noise, inverse).real.clip(0))
    w = 1 / np.maximum(size**2 + np.sum(spread**2, axis=(1, 2)), 1e-300)
    C = np.einsum("f,fij,fkl->ikjl", w, M, E.conj(), optimize=True).real
    rows_M, rows_E, columns_M, columns_E = (
        np.maximum(np.sqrt(np.einsum(to, w, np.abs(A) ** 2)), 1e-300) for to in ("f,fij->i", "f,fij->j") for A in (M, E)
    )
    variance = np.einsum("f,fij,fij->ij", w**2, spread**2, np.abs(E) ** 2, optimize=True) / 2
    live = columns_M > 1e-200
    standard = max(
        float(np.max(np.sqrt(variance.sum(axis=1)) / (rows_M * rows_E))),
        float(np.max((np.sqrt(variance.sum(axis=0)) / (columns_M * columns_E))[live], initial=0.0)),
    )
    return Comparison(C, rows_M, rows_E, columns_M, columns_E, measured, standard)


@dataclass(frozen=True, eq=False)
class Faults:
    """Measured row i is r[i] times expected row p[i], column j is c[j] times expected column q[j].

    before : correlation of each exchanged or flipped channel with its own expectation when it was found, keyed by
    ("row" or "column", index); after : with what was found.
    """

    p: np.ndarray
    q: np.ndarray
    r: np.ndarray
    c: np.ndarray
    before: dict[tuple[str, int], float]
    after: dict[tuple[str, int], float]


def explain(comparison: Comparison, limit: float) -> Faults:
    """The fewest exchanges and flips that explain the measured rows and columns, found one after the other.

    Each step takes the fault that raises the sum of all rows' and columns' correlations most, among those whose own
    channels gain more than twice the limit: a flip -2 c_ii, an exchange c_ik + c_ki - c_ii - c_kk. A symmetric rig
    turned about its axis is many exchanges at once: one by one, the simplest comes first.
    """
    n_y, n_u = len(comparison.rows_M), len(comparison.columns_M)
    order, sign = {"row": np.arange(n_y), "column": np.arange(n_u)}, {"row": np.ones(n_y), "column": np.ones(n_u)}
    before: dict[tuple[str, int], float] = {}
    for _ in range(n_y + n_u):
        start = comparison.own(order, sign)
        total = sum(float(c.sum()) for c in start.values())
        best: tuple[float, str, int, int] | None = None
        for what, i, k, flips in _steps(n_y, n_u):
            new_order, new_sign = _after(order, sign, what, i, k, flips)
            then = comparison.own(new_order, new_sign)
            extra = 0.5 * sum(flip < 0 for flip in flips) if k != i else 0.0
            gain = float((then[what] - start[what])[[i, k] if k != i else [i]].sum()) - extra
            raised = sum(float(c.sum()) for c in then.values()) - total - extra
            if gain > 2 * limit and (best is None or raised > best[0]):
                best, found = (raised, what, i, k), (new_order, new_sign)
        if best is None:
            break
        for index in best[2:]:
            before.setdefault((best[1], index), float(start[best[1]][index]))
        order, sign = found
    end = comparison.own(order, sign)
    after = {(what, i): float(end[what][i]) for what, i in before}
    r, c = _fewest(sign["row"], sign["column"], comparison.columns_M > 1e-200)
    return Faults(order["row"], order["column"], r, c, before, after)


def _steps(n_y: int, n_u: int) -> list[tuple[str, int, int, tuple[float, float]]]:
    """(row or column, i, k, signs): flips have i = k."""
    signs = ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0))
    steps = [(what, i, i, (-1.0, 1.0)) for what, n in (("row", n_y), ("column", n_u)) for i in range(n)]
    return steps + [
        (what, i, k, flips)
        for what, n in (("row", n_y), ("column", n_u))
        for i in range(n)
        for k in range(i)
        for flips in signs
    ]


def _after(
    order: dict[str, np.ndarray], sign: dict[str, np.ndarray], what: str, i: int, k: int, flips: tuple[float, float]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Order and signs after a step."""
    p, s = order[what].copy(), sign[what].copy()
    p[[i, k]] = p[[k, i]]
    s[i] *= flips[0]
    s[k] *= flips[1]
    return order | {what: p}, sign | {what: s}


def _fewest(r: np.ndarray, c: np.ndarray, live: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same signs, or all of them exchanged where that means fewer flips; inputs that never moved have no sign."""
    flipped = np.sum(r < 0) + np.sum(c[live] < 0)
    if 2 * flipped > len(r) + np.sum(live):
        return -r, np.where(live, -c, 1.0)
    return r, c
