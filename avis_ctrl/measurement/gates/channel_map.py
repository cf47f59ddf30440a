"""Gates that compare each channel with what the model expects of it: exchanged channels and polarity.

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
from scipy.optimize import linear_sum_assignment

from avis_ctrl.measurement.campaign import Campaign
from avis_ctrl.measurement.gates.excerpt import Excerpt, Gate
from avis_ctrl.measurement.gates.finding import Expectation, Finding, Limit, Picture, Response, Series, Severity
from avis_ctrl.measurement.gates.h1 import H1, Spectra, h1, segment_length, spectra, usable

# The other channel must agree better than the own one by this much in correlation (of at most 1).
MARGIN = 0.15
# A sign counts where the correlation is at least this large.
CLEAR = 0.3
# Two channels are one where their difference is below this part of either, after scaling.
COPY = 1e-3


@dataclass(frozen=True, eq=False)
class _Kept:
    record: str
    measured: Spectra | None
    expected: Spectra | None
    copies: list[tuple[int, int, float, float]]


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


class _Compared(Gate):
    """What both gates look at."""

    def look(self, seen: Excerpt, expectation: Expectation) -> _Kept:
        copies = _copies(seen)
        if not seen.driven:
            return _Kept(seen.header.name, None, None, copies)
        u, y, wrap = usable(seen)
        length = segment_length(len(u), int(np.count_nonzero(np.ptp(u, axis=0))))
        rate = seen.header.sample_rate_Hz
        measured = spectra(u, y, rate, length, wrap)
        if expectation.response is None:
            return _Kept(seen.header.name, measured, None, copies)
        model = predicted(expectation.response, u, rate, seen.header.u_names, wrap)
        order = _order(seen.header.y_names, expectation.y_names, model.shape[1])
        expected = None if order is None else spectra(u, model[:, order], rate, length, wrap)
        return _Kept(seen.header.name, measured, expected, copies)


class ChannelOrder(_Compared):
    """Exchanged or mislabelled channels, and copies of one channel under two names.

    With a model: the assignment of measured to expected rows (sensors) and columns (drives) of largest summed
    |correlation|,
    alternating between the two. An alarm needs each exchanged channel to agree better with the other's expectation by
    0.15 + 5 standard deviations of the correlation's noise, so that the noise's part of false alarms is below
    1e-6 each; 0.15 is above what stiffness errors of 5 % and damping errors of 20 % do (measured:
    tests/measurement/test_gates_channels.py).
    Without one, copies only: a channel that equals another one times a constant within 0.1 % of its r.m.s.; independent
    sensor noise of more than that keeps true channels apart.
    """

    name = "channel order"

    def conclude(self, kept: list[_Kept], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        found = self._copied(kept, campaign)
        comparison = compare(kept)
        if comparison is None:
            if not found:
                why = "no model was given" if expectation.response is None else "too few driven samples"
                found.append(
                    Finding(
                        self.name,
                        "note" if expectation.response is not None else "ok",
                        f"No channel is a copy of another; their order was not compared with a model ({why}).",
                        picture=_copy_picture(kept),
                    )
                )
            return found
        p, q = assignment(comparison)
        limit = MARGIN + 5 * comparison.standard
        rows, columns = np.abs(comparison.rows(q)), np.abs(comparison.columns(p))
        found += self._exchanged(rows, p, campaign.y_names, "Sensor", limit)
        found += self._exchanged(columns, q, campaign.u_names, "Drive", limit)
        if not found:
            own = np.diag(rows)
            worst = int(np.argmin(own))
            found.append(
                Finding(
                    self.name,
                    "ok",
                    "Every channel agrees best with its own expected response; the least, "
                    f"{campaign.y_names[worst]!r}, with correlation {own[worst]:.3f}.",
                    value=float(own[worst]),
                    picture=_picture(rows, campaign.y_names, "Sensor", limit),
                )
            )
        return found

    def _exchanged(
        self, c: np.ndarray, p: np.ndarray, names: tuple[str, ...], what: str, limit: float
    ) -> list[Finding]:
        clear = [i for i in range(len(p)) if p[i] != i and c[i, p[i]] - c[i, i] > limit]
        found: list[Finding] = []
        if not clear:
            return found
        done: set[int] = set()
        picture = _picture(c, names, what, limit)
        for i in clear:
            if i in done:
                continue
            cycle, k = [i], int(p[i])
            while k != i:
                cycle.append(k)
                k = int(p[k])
            done.update(cycle)
            pair = tuple(names[j] for j in cycle)
            gain = min(c[j, p[j]] - c[j, j] for j in cycle)
            listed = "; ".join(
                f"{names[j]!r} agrees with the model's {names[int(p[j])]!r} by {c[j, p[j]]:.2f}, with its own "
                f"by {c[j, j]:.2f}"
                for j in cycle
            )
            verb = "are exchanged" if len(pair) == 2 else "are mixed up"
            found.append(
                Finding(
                    self.name,
                    "stop",
                    f"{what}s {' and '.join(map(repr, pair))} {verb}: {listed} (correlation of "
                    "magnitude and phase). Exchange their names or their cables.",
                    pair,
                    value=float(gain),
                    limit=limit,
                    picture=picture,
                )
            )
        return found

    def _copied(self, kept: list[_Kept], campaign: Campaign) -> list[Finding]:
        found, names = [], campaign.y_names
        pairs = {(i, k) for of in kept for i, k, _, _ in of.copies}
        for i, k in sorted(pairs):
            hits = [(of.record, scale, rest) for of in kept for a, b, scale, rest in of.copies if (a, b) == (i, k)]
            record, scale, rest = hits[0]
            found.append(
                Finding(
                    self.name,
                    "stop",
                    f"Channel {names[k]!r} is {names[i]!r} times {scale:.6g} within {100 * rest:.2g} % of its r.m.s. in"
                    f" record {record}: one signal recorded twice. Check the wiring and the channel list; leave one of"
                    " them out.",
                    (names[i], names[k]),
                    tuple(h[0] for h in hits),
                    float(rest),
                    COPY,
                    _copy_picture(kept),
                )
            )
        return found


class Polarity(_Compared):
    """Flipped signs of drives (columns) and sensors (rows).

    Signs r_i, c_j in {-1, 1} that maximise sum r_i c_j C_ij of the correlations of all entries with their own
    expectation. The
    solution with the fewest flips is named; flipping all sensors cannot be told from flipping all drives, and the
    sentence says
    so where the two are equally many. A sign counts where |correlation| exceeds 0.3 + 5 standard deviations of its
    noise:
    below 1e-6 false alarms each.
    """

    name = "polarity"

    def conclude(self, kept: list[_Kept], campaign: Campaign, expectation: Expectation) -> list[Finding]:
        comparison = compare(kept)
        if comparison is None:
            why = "no model was given" if expectation.response is None else "too few driven samples"
            x = np.arange(len(campaign.y_names))
            picture = Picture(
                "Polarity of each sensor",
                "sensor number",
                "correlation [-]",
                (Series("not known", x, 0.0 * x, "points"),),
            )
            return [
                Finding(
                    self.name,
                    "ok" if expectation.response is None else "note",
                    f"Polarity was not compared with a model ({why}).",
                    picture=picture,
                )
            ]
        p, q = assignment(comparison)
        own = comparison.C[np.arange(len(p)), p][:, np.arange(len(q)), q]
        r, c = signs(own / (comparison.rows_M * comparison.rows_E[p])[:, None])
        row = np.diag(comparison.rows(q, c)[:, p])
        column = np.diag(comparison.columns(p, r)[:, q])
        limit = CLEAR + 5 * comparison.standard
        picture = Picture(
            "Correlation of each channel with its expected response",
            "channel number (sensors, then drives)",
            "correlation [-]",
            (
                Series("sensors", np.arange(len(p)), row, "bars"),
                Series("drives", len(p) + np.arange(len(q)), column, "bars"),
            ),
            (Limit("clear", limit), Limit("clear", -limit)),
        )
        found = []
        both = np.count_nonzero(r < 0) + np.count_nonzero(c < 0)
        total = len(r) + np.count_nonzero(comparison.measured.G.any(axis=(0, 1)))
        doubt = " It could as well be that all the other channels are flipped." if 2 * both == total else ""
        for flipped, correlation, names, what in (
            (r, np.abs(row), campaign.y_names, "Sensor"),
            (c, np.abs(column), campaign.u_names, "Drive"),
        ):
            for k in np.flatnonzero((flipped < 0) & (correlation > limit)):
                severity: Severity = "stop"
                found.append(
                    Finding(
                        self.name,
                        severity,
                        f"{what} {names[k]!r} has the opposite sign of the model (correlation {-correlation[k]:.2f}"
                        " where +1 is expected). Its leads are exchanged, or the model's axis points the other way;"
                        f" exchange them or flip the channel's sign.{doubt}",
                        (names[k],),
                        value=float(-correlation[k]),
                        limit=-limit,
                        picture=picture,
                    )
                )
        if not found:
            found.append(
                Finding(
                    self.name,
                    "ok",
                    f"All signs agree with the model (lowest correlation {np.abs(row).min():.2f} among sensors).",
                    value=float(np.abs(row).min()),
                    limit=limit,
                    picture=picture,
                )
            )
        return found


def predicted(response: Response, u: np.ndarray, rate: float, inputs: tuple[str, ...], wrap: bool) -> np.ndarray:
    """(samples, n_y) the model's y, from rest; periodic where `wrap`."""
    n = len(u) if wrap else 2 * len(u)
    f = np.fft.rfftfreq(n, 1 / rate)
    U = np.fft.rfft(u, n, axis=0)
    # Lines without power need no response of the model.
    power = np.sum(np.abs(U) ** 2, axis=1)
    keep = power > 1e-10 * power.max(initial=0.0)
    keep[0] = False
    Y: np.ndarray | None = None
    lines = np.flatnonzero(keep)
    for part in np.array_split(lines, max(1, len(lines) // 8192 + 1)):
        if not len(part):
            continue
        G = response(2 * np.pi * f[part], inputs)
        if Y is None:
            Y = np.zeros((len(f), G.shape[1]), complex)
        Y[part] = np.einsum("fij,fj->fi", G, U[part])
    if Y is None:
        return np.zeros((len(u), 0))
    return np.fft.irfft(Y, n, axis=0)[: len(u)]


def compare(kept: list[_Kept]) -> Comparison | None:
    """Correlations over all driven records of the commonest segment length."""
    pairs = [(k.measured, k.expected) for k in kept if k.measured is not None and k.expected is not None]
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


def assignment(comparison: Comparison) -> tuple[np.ndarray, np.ndarray]:
    """p (n_y,), q (n_u,): measured row i is expected row p[i], measured column j is expected column q[j]."""
    p, q = np.arange(len(comparison.rows_M)), np.arange(len(comparison.columns_M))
    for _ in range(4):
        before = p.copy(), q.copy()
        p = _best(np.abs(comparison.rows(q)))
        q = _best(np.abs(comparison.columns(p)))
        if np.array_equal(p, before[0]) and np.array_equal(q, before[1]):
            break
    return p, q


def _best(c: np.ndarray) -> np.ndarray:
    return np.asarray(linear_sum_assignment(-c)[1])


def signs(own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """r (n_y,), c (n_u,) of +-1 that maximise r own c, with the fewest -1; +1 where a channel has no say."""
    best: tuple[float, int, np.ndarray, np.ndarray] | None = None
    small = own if own.shape[0] <= own.shape[1] else own.T
    n = min(small.shape[0], 14)
    for code in range(1 << n):
        a = np.ones(small.shape[0])
        a[:n] = [-1.0 if code >> k & 1 else 1.0 for k in range(n)]
        reach = a @ small
        b = np.where(reach < 0, -1.0, 1.0)
        score, flips = float(np.abs(reach).sum()), int(np.sum(a < 0) + np.sum(b < 0))
        if best is None or score > best[0] * (1 + 1e-9) + 1e-12 or (score > best[0] * (1 - 1e-9) and flips < best[1]):
            best = score, flips, a, b
    assert best is not None
    a, b = best[2], best[3]
    return (a, b) if own.shape[0] <= own.shape[1] else (b, a)


def _order(names: tuple[str, ...], expected: tuple[str, ...] | None, rows: int) -> list[int] | None:
    """Rows of the model in the order of the campaign's channels; None where they do not correspond."""
    if expected is None:
        return list(range(rows)) if rows == len(names) else None
    return [expected.index(n) for n in names] if set(names) <= set(expected) and len(expected) == rows else None


def _copies(seen: Excerpt) -> list[tuple[int, int, float, float]]:
    """(i, k, scale, rest): channels with y_k = scale y_i up to a constant, within COPY of its r.m.s."""
    y = seen.first.y - seen.first.y.mean(axis=0)
    S = y.T @ y
    found = []
    for i in range(len(S)):
        for k in range(i + 1, len(S)):
            if S[i, i] > 0 and S[k, k] > 0:
                rest = max(0.0, 1 - S[i, k] ** 2 / (S[i, i] * S[k, k])) ** 0.5
                if rest < COPY:
                    found.append((i, k, float(S[i, k] / S[i, i]), rest))
    return found


def _copy_picture(kept: list[_Kept]) -> Picture:
    count = np.array([len(k.copies) for k in kept])
    return Picture(
        "Pairs of channels that are copies",
        "record number",
        "pairs [-]",
        (Series("pairs", np.arange(len(count)), count, "points"),),
    )


def _picture(c: np.ndarray, names: tuple[str, ...], what: str, limit: float) -> Picture:
    x = np.arange(len(names))
    others = np.max(np.where(np.eye(len(c), dtype=bool), -np.inf, c), axis=1) if len(c) > 1 else np.zeros(1)
    return Picture(
        f"{what}s against the model",
        f"{what.lower()} number ({', '.join(names)})",
        "correlation [-]",
        (Series("own expected response", x, np.diag(c), "points"), Series("best other", x, others, "points")),
    )
