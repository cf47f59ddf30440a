"""Transients of records in a fit with path errors, removed by generalised least squares.

A whitened residual e contains T x with unknown x, the states at the ends of the records. With the inverse covariance
W = inv(I + B B^T) of noise and path errors (`weights`), the most likely x is

    x = inv(T W T^T) T W e                                            (rows of T are the transients)

Path errors are common to all records, and so couple their transients. What is left after subtracting T x has the
likelihood of the data that do not depend on x (restricted likelihood; D. A. Harville, J. Amer. Statist. Assoc. 72
(1977) 320-338).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from avis_ctrl.identification.maximum_likelihood import as_real, white_columns, whitened
from avis_ctrl.identification.response import FrequencyModel
from avis_ctrl.identification.spectra import span, transient_columns, transient_parts
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.weights import PathError


@dataclass(frozen=True, eq=False)
class Transients:
    """Transients of blocks at a model, which stay the same during a step of a fit: the response to fixed initial values
    is part of the model; all other transients are removed.

    bases : Q (N_b, r_b) per block, orthonormal whitened transients. rows : of each block in the stacked real residual.
    initial : body and inner initial values per block, as in `transient_parts`; None for a block without a transient.
    paths : path errors. along : (r, k) transients times Q of each path error. covariance : (r, r) inverse of T W T^T.
    price : decrease of the log-likelihood if x is integrated out.

    With a fixed basis the gradient is exact. `block_residual` leaves out that its basis depends on the parameters (L.
    Kaufman, BIT 15 (1975) 49-57); its gradient is exact with its own weights only.
    """

    bases: tuple[np.ndarray, ...]
    rows: tuple[slice, ...]
    initial: tuple[tuple[np.ndarray | None, np.ndarray | None], ...]
    paths: tuple[PathError, ...]
    along: tuple[np.ndarray, ...]
    covariance: np.ndarray
    price: float

    @staticmethod
    def none() -> Transients:
        """Of no blocks."""
        return Transients((), (), (), (), (), np.zeros((0, 0)), 0.0)

    @staticmethod
    def of(
        model: FrequencyModel,
        blocks: Sequence[SpectralBlock],
        whiteners: Sequence[np.ndarray],
        paths: Sequence[PathError] = (),
    ) -> Transients:
        """At a model, with the most likely initial values."""
        spans = [_span(model, block, L) for block, L in zip(blocks, whiteners, strict=True)]
        ends = np.cumsum([0, *(len(one.Q) for one in spans)])
        bases, rows = tuple(one.Q for one in spans), tuple(slice(*pair) for pair in pairwise(ends))
        along = tuple(_along(one, bases, ends) for one in paths)
        information = np.eye(sum(Q.shape[1] for Q in bases))
        for one, T in zip(paths, along, strict=True):
            information -= (T * one.share) @ T.T
        # Where path errors are far larger than the noise, the smallest eigenvalues are round-off.
        covariance = np.linalg.inv(information + np.finfo(float).eps * np.eye(len(information)))
        found = Transients(bases, rows, (), tuple(paths), along, covariance, _price(spans, blocks, information))
        residuals = [
            as_real(whitened(L, block.Y - model.answer(block, None, False).Y)[None])[0]
            for block, L in zip(blocks, whiteners, strict=True)
        ]
        e = np.concatenate(residuals)[None]
        parts = found._parts(found._coefficients(e, [one.along(e) for one in paths]))
        initial = tuple(
            transient_parts(one.X @ part[0], one.norms, block, model) if block.transient else (None, None)
            for one, part, block in zip(spans, parts, blocks, strict=True)
        )
        return replace(found, initial=initial)

    def remove_from(self, x: np.ndarray) -> list[np.ndarray]:
        """Subtract from whitened rows x (k, N) their most likely transients, in place; returns `Weights.along` of what
        is left."""
        along = [one.along(x) for one in self.paths]
        found = self._coefficients(x, along)
        for Q, rows, part in zip(self.bases, self.rows, self._parts(found), strict=True):
            if Q.size:
                x[:, rows] -= part @ Q.T
        return [of_x - found @ T for of_x, T in zip(along, self.along, strict=True)]

    def _coefficients(self, x: np.ndarray, along: Sequence[np.ndarray]) -> np.ndarray:
        """(k, r) most likely coefficients in the bases, of whitened rows (k, N) with these `Weights.along`."""
        found = np.concatenate([x[:, rows] @ Q for Q, rows in zip(self.bases, self.rows, strict=True)], axis=1)
        for one, of_x, T in zip(self.paths, along, self.along, strict=True):
            found -= (of_x * one.share) @ T.T
        return np.asarray(found @ self.covariance)

    def _parts(self, x: np.ndarray) -> list[np.ndarray]:
        """Coefficients (k, r) by block."""
        return np.split(x, np.cumsum([Q.shape[1] for Q in self.bases])[:-1], axis=1)


@dataclass(frozen=True, eq=False)
class _Span:
    """Q (N, r) and X (n_t, r) as `span`; columns (r, n_t) in terms of Q, and norms, of `transient_columns`."""

    Q: np.ndarray
    X: np.ndarray
    columns: np.ndarray
    norms: np.ndarray


def _span(model: FrequencyModel, block: SpectralBlock, L: np.ndarray) -> _Span:
    if not block.transient:
        return _Span(np.zeros((2 * block.Y.size, 0)), np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0))
    columns, norms = transient_columns(model, block.omega)
    white = white_columns(columns, L).T
    Q, X = span(white)
    return _Span(Q, X, Q.T @ white, norms)


def _along(one: PathError, bases: Sequence[np.ndarray], ends: np.ndarray) -> np.ndarray:
    """(r, k) transients of all blocks times Q of a path error."""
    found = []
    for Q, (low, high) in zip(bases, pairwise(ends), strict=True):
        here = (one.rows >= low) & (one.rows < high)
        found.append(Q[one.rows[here] - low].T @ one.Q[here])
    return np.concatenate(found)


def _price(spans: Sequence[_Span], blocks: Sequence[SpectralBlock], information: np.ndarray) -> float:
    """Decrease of the log-likelihood if the unknowns of the transients are integrated out: log det(I + N C)/2, with C
    the information of their columns, scaled to a unit diagonal, and N real data of the record.

    Each independent column costs log(N)/2 (unit-information prior, Schwarz 1978), a nearly dependent one less.
    """
    sizes = [one.columns.shape for one in spans]
    R, count = np.zeros(np.sum(sizes, axis=0)), []
    row = column = 0
    for one, block, (r, n) in zip(spans, blocks, sizes, strict=True):
        R[row : row + r, column : column + n] = one.columns
        count += [np.sqrt(block.numbers)] * n
        row, column = row + r, column + n
    if not count:
        return 0.0
    gram = R.T @ information @ R
    scale = np.array(count) / np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    return 0.5 * float(np.linalg.slogdet(np.eye(len(gram)) + gram * scale * scale[:, None])[1])
