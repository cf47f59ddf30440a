"""Detection of exchanged or flipped channels by comparison of measured and expected responses.

Both responses are computed with the same estimator (H1 over the same segments of the same u, with the model's y
computed in the frequency domain), so that leakage affects both alike. The hypothesis is that the measured row i is r_i
times the model's row p(i), and column j is c_j times its column q(j). The agreement of each row with the hypothesis is

    a_i = Re sum_f w e^(j omega t_i) sum_j M_ij (E P)_ij* / sqrt(sum w |M_i|^2  sum w |(E P)_i|^2),

with E the expected response in the order and signs of the hypothesis, P the projection onto the excited directions of
u, and w(f) = 1 / (|E|^2 + noise), so that all frequencies where the model predicts a response have equal weight. The
agreement does not depend on the gain, and the delay t_i is fitted, because a model may lack both effects; a phase lag
is nearly a delay.

The residual of the row, 1 - a_i^2, gives the likelihood of the hypothesis. The errors of a wrong model are similar at
neighbouring frequencies, and the responses to a table's drives differ by little more than a pattern. A row therefore
counts as N independent complex numbers, as many as a pattern over the excited directions times a shape over
third-octave bands: N = directions + thirds - 1. The log-likelihood ratio of two hypotheses is
N log((1 - a^2) / (1 - a'^2)). The agreement of an unrelated response exceeds a with probability (1 - a^2)^(N - 1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from avis_ctrl.measurement.gates.h1 import H1, Spectra, h1, thirds


@dataclass(frozen=True)
class MapSettings:
    """Thresholds for evidence of channel faults.

    false_alarm : probability that a correct map is reported as wrong, divided among the alternatives and delays; a stop
        interrupts the work, so it is smaller than for other alarms.
    least_agreement : minimum correlation of a channel with its assigned response; a model below it describes less than
        half the power of the data and provides no evidence.
    delay_s : range of fitted delays, from a u that is recorded late to the slowest loop.
    delay_step_s : step of the fitted delays, a tenth of a cycle at 100 Hz.
    closest : minimum value used for 1 - a^2: the residual of resonances that are 2.5 % away from the model's.
    still : fraction of a drive in the excited directions up to which it counts as not driven: round-off of the basis.
    """

    false_alarm: float = 1e-4
    least_agreement: float = 0.7
    delay_s: tuple[float, float] = (-0.005, 0.02)
    delay_step_s: float = 0.001
    closest: float = 0.1
    still: float = 1e-9

    @property
    def delays_s(self) -> np.ndarray:
        """(n,) trial delays, smallest magnitude first: zero is chosen if all fit equally well."""
        low, high = self.delay_s
        steps = np.arange(round(low / self.delay_step_s), round(high / self.delay_step_s) + 1)
        return self.delay_step_s * steps[np.argsort(np.abs(steps), kind="stable")]


SETTINGS = MapSettings()


@dataclass(frozen=True, eq=False)
class ModelComparison:
    """Inner products of measured entry (i, j) with expected entry (k, l), and their normalisation.

    C : (n_y, n_y, n_u, n_u), index i, k, j, l, the delay of the pair (i, k) removed. B : (n_y, n_u, n_u), of the
    expected entries (k, a) and (k, b). P : (n_u, n_u) projection onto the excited directions. rows_M : (n_y,) norms of
    the measured rows. delay_s : (n_y, n_y) fitted delays. delays : number of independent trial delays; the records
    cannot distinguish delays closer than 1 / (2 bandwidth). N : independent complex numbers in a row.
    """

    C: np.ndarray
    B: np.ndarray
    P: np.ndarray
    rows_M: np.ndarray
    delay_s: np.ndarray
    delays: int
    N: int
    measured: H1
    settings: MapSettings

    @property
    def moving(self) -> np.ndarray:
        """(n_u,) mask of the drives that move."""
        return np.diag(self.P) > self.settings.still

    def agreement(self, q: np.ndarray, c: np.ndarray) -> np.ndarray:
        """(n_y, n_y) agreement of measured row i with expected row k, columns matched by q with signs c."""
        own: np.ndarray = self.C[:, :, np.arange(len(q)), q] @ c
        power = np.einsum("kab,ab->k", self.B[:, q][:, :, q], self.P * np.outer(c, c))
        return np.asarray(own / np.maximum(self.rows_M[:, None] * np.sqrt(np.maximum(power, 0.0)), 1e-300))

    def likelihood(self, a: np.ndarray) -> np.ndarray:
        """Log-likelihood of agreements; a negative agreement is less likely than zero."""
        left = 1 - (1 - self.settings.closest) * a * np.abs(a)
        return np.asarray(-self.N * np.log(left))

    def evidence(self, alternatives: int) -> float:
        """Log-likelihood ratio that one of this many wrong alternatives reaches with probability `false_alarm`."""
        return float(np.log(alternatives / self.settings.false_alarm))

    def least(self, alternatives: int) -> float:
        """Minimum agreement of a channel with its assigned response."""
        unrelated = 1 - (self.settings.false_alarm / alternatives) ** (1 / max(self.N - 1, 1))
        return max(self.settings.least_agreement, float(np.sqrt(unrelated)))

    def p_value(self, gain: float, agreement: float, alternatives: int) -> float:
        """Upper bound on the probability that one of this many alternatives reaches this gain and agreement."""
        unrelated = max(1 - agreement**2, 0.0) ** max(self.N - 1, 1)
        return min(1.0, alternatives * max(float(np.exp(-gain)), unrelated))


def compare(
    pairs: list[tuple[Spectra, Spectra]],
    response: Callable[[np.ndarray], np.ndarray] | None = None,
    settings: MapSettings = SETTINGS,
) -> ModelComparison | None:
    """Compare measured and expected spectra of records with the most common segment length; None if they are too few.

    response : (n,) Hz -> (n, n_y, n_u) of the model. It is used (without leakage) if the voltages do not span all
        moving drives, because the records then do not determine the outputs for exchanged drives.
    """
    if not pairs:
        return None
    lengths = [len(m.f) for m, _ in pairs]
    common = max(set(lengths), key=lengths.count)
    chosen = [(m, e) for m, e in pairs if len(m.f) == common]
    measured, expected = h1([m for m, _ in chosen]), h1([e for _, e in chosen])
    if measured is None or expected is None:
        return None
    M, E = measured.G, expected.G
    P = measured.basis @ measured.basis.T
    if response is not None and measured.rank < np.count_nonzero(np.diag(P) > settings.still):
        E = response(measured.f)
    spread = measured.noise * np.trace(measured.covariance, axis1=1, axis2=2).real[:, None]
    w = 1 / np.maximum(np.sum(np.abs(E) ** 2, axis=(1, 2)) + np.sum(spread, axis=1), 1e-300)
    delay_s, turned = _delays(measured.f, w, M, E, settings)
    C = np.einsum("fik,fij,fkl->ikjl", turned, M, E.conj(), optimize=True).real
    B = np.einsum("f,fka,fkb->kab", w, E, E.conj(), optimize=True).real
    rows_M = np.sqrt(np.einsum("f,fij->i", w, np.abs(M) ** 2))
    tried, span_s = len(settings.delays_s), settings.delay_s[1] - settings.delay_s[0]
    delays = min(tried, 1 + int(np.ceil(2 * span_s * (measured.f[-1] - measured.f[0]))))
    N = measured.rank + len(thirds(measured.f)) - 1
    return ModelComparison(C, B, P, rows_M, delay_s, delays, N, measured, settings)


def _delays(
    f: np.ndarray, w: np.ndarray, M: np.ndarray, E: np.ndarray, settings: MapSettings
) -> tuple[np.ndarray, np.ndarray]:
    """(n_y, n_y) s, best-fitting delay of measured row i behind expected row k for any signs of the columns, and
    w e^(j omega delay) (n, n_y, n_y).
    """
    trial = settings.delays_s
    turn = np.exp(2j * np.pi * f * trial[:, None])
    products = np.einsum("f,fij,fkj->fikj", w, M, E.conj(), optimize=True)
    found = np.abs(np.tensordot(turn, products, 1).real).sum(axis=-1)
    best = trial[np.argmax(found, axis=0)]
    return best, w[:, None, None] * np.exp(2j * np.pi * f[:, None, None] * best)


@dataclass(frozen=True, eq=False)
class Faults:
    """Measured row i is r[i] times expected row p[i], column j is c[j] times expected column q[j].

    own, other : (n_y,) agreement of each row with its own expectation and with the one found for it; everything else as
    found. columns : for each exchanged or flipped drive, the row with the strongest evidence, and its agreement without
    and with the fault. p_value : for each exchanged or flipped row and column, an upper bound on the probability of so
    much evidence for a correct map, over all alternatives and delays.
    doubtful : rows ("row", i) and columns ("column", j) that would agree better in another order or sign, but without
    strong absolute evidence; they are not reported as faults.
    """

    p: np.ndarray
    q: np.ndarray
    r: np.ndarray
    c: np.ndarray
    own: np.ndarray
    other: np.ndarray
    columns: dict[int, tuple[int, float, float]]
    p_value: dict[tuple[str, int], float]
    doubtful: tuple[tuple[str, int], ...]


def explain(comparison: ModelComparison) -> Faults:
    """Smallest set of exchanges and flips that explains the measured rows and columns, by greedy search.

    Each step takes the fault with the largest gain in the likelihood of all rows together. The gain must exceed what
    noise produces among all steps, twice that for an exchange. For columns a single row must contribute half of this,
    because a wrong model makes all rows slightly wrong. A symmetric rig turned about its axis is many exchanges at
    once: one by one, the simplest comes first. At the end every affected channel must agree with its assigned response
    by more than `ModelComparison.least`, and better than with its own response by more than noise produces among all
    steps and delays. Otherwise the channel is doubtful, and no fault is reported.
    """
    n_y, n_u = len(comparison.rows_M), len(comparison.P)
    order, sign = {"row": np.arange(n_y), "column": np.arange(n_u)}, {"row": np.ones(n_y), "column": np.ones(n_u)}
    steps = [step for step in _steps(n_y, n_u) if step[0] == "row" or comparison.moving[[step[1], step[2]]].all()]
    alternatives = sum(1 if step[0] == "row" else n_y for step in steps)
    cost = comparison.evidence(alternatives)
    for _ in range(n_y + n_u):
        start = comparison.likelihood(_agreements(comparison, order, sign))
        best: tuple[float, dict[str, np.ndarray], dict[str, np.ndarray]] | None = None
        for what, i, k, flips in steps:
            new = _after(order, sign, what, i, k, flips)
            gain = comparison.likelihood(_agreements(comparison, *new)) - start
            faults = (i != k) * 2 + sum(flip < 0 for flip in flips)
            raised = float(gain.sum()) - cost * faults
            single = what == "row" or 2 * float(gain.max()) > cost
            if raised > 0 and single and (best is None or raised > best[0]):
                best = raised, *new
        if best is None:
            break
        order, sign = best[1:]
    r, c = _fewest(sign["row"], sign["column"], comparison.moving)
    return _judged(comparison, order["row"], order["column"], r, c, alternatives * comparison.delays)


def _judged(
    comparison: ModelComparison, p: np.ndarray, q: np.ndarray, r: np.ndarray, c: np.ndarray, alternatives: int
) -> Faults:
    """The faults, if the evidence for all of them is strong; otherwise no fault, and the doubtful channels."""
    n_y, n_u = len(p), len(q)
    rows, straight, ones = np.arange(n_y), np.arange(n_u), np.ones(n_y)
    least, evidence = comparison.least(alternatives), comparison.evidence(alternatives)
    a = comparison.agreement(q, c)
    other, own = r * a[rows, p], a[rows, rows]
    touched = [i for i in rows if p[i] != i or r[i] < 0]
    gain = comparison.likelihood(other) - np.maximum(comparison.likelihood(own), 0.0)
    doubtful = [("row", int(i)) for i in touched if other[i] < least or gain[i] < evidence]
    p_value = {("row", int(i)): comparison.p_value(gain[i], other[i], alternatives) for i in touched}
    columns: dict[int, tuple[int, float, float]] = {}
    for j in map(int, straight[(q != straight) | (c < 0)]):
        cycle = cycle_of(q, j)
        back_q, back_c = q.copy(), c.copy()
        back_q[cycle], back_c[cycle] = cycle, 1.0
        before = r * comparison.agreement(back_q, back_c)[rows, p]
        better = comparison.likelihood(other) - np.maximum(comparison.likelihood(before), 0.0)
        best = int(np.argmax(better))
        columns[j] = best, float(before[best]), float(other[best])
        p_value["column", j] = comparison.p_value(better.sum(), other[best], alternatives)
        if other[best] < least or 2 * better[best] < evidence or better.sum() < evidence:
            doubtful.append(("column", j))
    if doubtful:
        own = comparison.agreement(straight, np.ones(n_u))[rows, rows]
        return Faults(rows, straight, ones, np.ones(n_u), own, own, {}, {}, tuple(doubtful))
    return Faults(p, q, r, c, own, other, columns, p_value, ())


def cycle_of(order: np.ndarray, start: int) -> list[int]:
    """The cycle of the permutation `order` that contains `start`."""
    found, k = [start], int(order[start])
    while k != start:
        found.append(k)
        k = int(order[k])
    return found


def _agreements(comparison: ModelComparison, order: dict[str, np.ndarray], sign: dict[str, np.ndarray]) -> np.ndarray:
    """(n_y,) agreement of each row with the expectation that order and sign assign to it."""
    a = comparison.agreement(order["column"], sign["column"])
    return np.asarray(sign["row"] * a[np.arange(len(a)), order["row"]])


def _steps(n_y: int, n_u: int) -> list[tuple[str, int, int, tuple[float, float]]]:
    """All elementary faults (row or column, i, k, signs); flips have i = k."""
    signs, sizes = ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)), (("row", n_y), ("column", n_u))
    flips = [(what, i, i, (-1.0, 1.0)) for what, n in sizes for i in range(n)]
    pairs = [(what, i, k) for what, n in sizes for i in range(n) for k in range(i)]
    return flips + [(*pair, two) for pair in pairs for two in signs]


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
    """The same signs, or all of them reversed if this means fewer flips; inputs that never moved have no sign."""
    flipped = np.sum(r < 0) + np.sum(c[live] < 0)
    if 2 * flipped > len(r) + np.sum(live):
        return -r, np.where(live, -c, 1.0)
    return r, c
