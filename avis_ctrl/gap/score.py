"""Score test: the reduction of the residual by a small effect, beyond any re-identification.

At the fitted model, the whitened residual e and its derivative J with respect to the rig's parameters are known, with
the transients of the records removed. An effect that changes the response by c delta along directions delta
(whitened) lowers chi2 by at most

    b^T inv(A) b,   A = delta P delta^T,   b = delta P e,    P = I - J^T inv(J J^T) J

(Rao's efficient score; C. R. Rao 1948, W. K. Newey 1985). For noise alone this is chi-square distributed with as many
degrees of freedom as there are directions.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from avis_ctrl.gap.operators import Assembled
from avis_ctrl.gap.table_model import ActiveEffect, TableModel
from avis_ctrl.gap.table_response import AtMotion, TableResponse
from avis_ctrl.identification.fit_settings import SETTINGS as FIT_SETTINGS
from avis_ctrl.identification.fit_settings import FitSettings
from avis_ctrl.identification.likelihood import Data, Fitted, Profile
from avis_ctrl.identification.maximum_likelihood import whitened_real, whitener
from avis_ctrl.identification.parameter_sets import default_parameters
from avis_ctrl.identification.response import N_Q
from avis_ctrl.identification.spectral_block import SpectralBlock
from avis_ctrl.identification.transients import Transients
from avis_ctrl.identification.weights import with_distortion


@dataclass(frozen=True)
class ScoreSettings:
    """Settings of the score test and of the detection limits.

    step : step of a linear parameter for the difference quotient of its direction, in units of its size [1]: small
        compared with any curvature, large compared with round-off.
    least_left : minimum fraction of a direction that must remain after projecting out what re-identification absorbs
        [1]: a smaller remainder is round-off.
    least_singular : singular value of the parameters' directions over the largest, below which they determine nothing
        [1].
    least_direction : eigenvalue of the scaled Gram matrix of directions over the largest, below which the data do not
        determine a combination [1]: a step along it would be round-off.
    least_eigenvalue : eigenvalue of a scaled information matrix over the largest, below which it is round-off, which is
        about 1e-16 of the largest [1].
    detected : standard deviations from which an effect counts as detected [1] (`detection_limits`).
    """

    step: float = 1e-3
    least_left: float = 1e-5
    least_singular: float = 1e-6
    least_direction: float = 1e-9
    least_eigenvalue: float = 1e-12
    detected: float = 5.0


SETTINGS = ScoreSettings()


SYMMETRIC = tuple((i, j) for i in range(N_Q) for j in range(i, N_Q))


@dataclass(frozen=True)
class Reduction:
    """Reduction of chi2 by a set of directions: its size, the number of directions that the data determine, and
    coefficients."""

    chi2: float
    rank: int
    coefficients: np.ndarray


def scaled_eigh(G: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(k,) sizes, and eigenvalues and eigenvectors of G / (size size^T), which has a unit diagonal."""
    size = np.sqrt(np.maximum(np.diag(G), np.finfo(float).tiny))
    return size, *np.linalg.eigh(G / np.outer(size, size))


def reduction(G: np.ndarray, b: np.ndarray) -> Reduction:
    """b^T inv(G) b in the subspace that G determines."""
    size, values, vectors = scaled_eigh(G)
    known = values > SETTINGS.least_direction * max(values[-1], 1e-300)
    along = vectors.T @ (b / size)
    step = np.where(known, along / np.where(known, values, 1.0), 0.0)
    return Reduction(float(along @ step), int(known.sum()), vectors @ step / size)


def symmetric_coordinates(S: np.ndarray) -> np.ndarray:
    """(..., 21) coefficients of symmetric matrices (..., 6, 6) in the unit matrices e_i e_j^T + e_j e_i^T."""
    rows, columns = np.array(SYMMETRIC).T
    return S[..., rows, columns]


class Part:
    """One block at the model: its response with the initial values of its transient.

    body : (n, 12, 1) impulses and steps of the transient in the data. inner : (m,) initial internal states. The
    responses to both may be large and nearly cancel; an effect changes each of them.
    """

    def __init__(self, model: TableModel, block: SpectralBlock, body: np.ndarray | None, inner: np.ndarray | None):
        self.model, self.block, self.body, self.inner = model, block, body, inner
        self.L = whitener(block)
        self.made = model.assembled(block.omega)
        U = block.U if body is None else np.concatenate([block.U, body], axis=1)
        self.response = TableResponse(self.made, model.acting(U, block if model.nonlinear else None, inner))

    @property
    def s(self) -> np.ndarray:
        """(n, 1, 1) j omega."""
        return self.response.s

    def real(self, dY: np.ndarray) -> np.ndarray:
        """(k, n, n_y, m) of y to (k, N) real numbers, whitened."""
        return whitened_real(self.L, dY)

    def change(self, effect: ActiveEffect) -> np.ndarray:
        """(n, n_y, m) change of y by an effect, to first order."""
        response = self.response
        if effect.effect.nonlinear:
            return TableResponse(self.made, self.model.contribution(effect, self.block)).Y
        changed = Assembled(self.model.with_effect(effect).operators(self.block.omega))
        side = AtMotion(changed, replace(response.acting, inner=self._states_in(changed)), response.x)
        return side.Y - response.Y + response.left @ side.push

    def whole_change(self, effect: ActiveEffect) -> np.ndarray:
        """(n, n_y, m) change of y by an effect at full strength."""
        added = self.model.with_effect(effect)
        inner = self._states_in(added.assembled(self.block.omega))
        return added.answer(self.block, self.body, False, inner).Y - self.response.Y

    def _states_in(self, changed: Assembled) -> np.ndarray | None:
        """(m,) initial internal states in the order of a table with one more effect."""
        return None if self.inner is None else changed.states_of(self.made, self.inner)

    def by_impedance(self, dynamic: np.ndarray) -> np.ndarray:
        """(21, n, n_y, m): y per symmetric unit impedance on q, times dynamic (n,) [dynamic stiffness]."""
        q, per_force = self.response.x[:, :N_Q], self.response.left[:, :, :N_Q]
        out = []
        for i, j in SYMMETRIC:
            push = per_force[:, :, i, None] * q[:, None, j]
            if i != j:
                push = push + per_force[:, :, j, None] * q[:, None, i]
            out.append(-dynamic[:, None, None] * push)
        return np.array(out)


class Score:
    """The fitted model, prepared to score directions; its free parameters and the transients are projected out.

    model : fitted. blocks : with noise. kept : results that effects cache.
    """

    def __init__(self, model: TableModel, blocks: Sequence[SpectralBlock]):
        self.model = model
        self.kept: dict[Hashable, Any] = {}
        self.transients = Transients.of(model, blocks, [whitener(block) for block in blocks])
        self.parts = [
            Part(model, *one) for one in zip(blocks, *zip(*self.transients.initial, strict=True), strict=True)
        ]
        self.e = self._white([(part.block.Y - part.response.Y)[None] for part in self.parts])[0]
        J = self._white([model.answer(part.block, part.body, inner=part.inner).dY for part in self.parts])
        J = J * model.scales()[:, None]
        size = np.linalg.norm(J, axis=1)
        _, s, Vt = np.linalg.svd(J / np.where(size > 0, size, 1.0)[:, None], full_matrices=False)
        self.basis = Vt[s > SETTINGS.least_singular * s[0]]
        self.e = self.e - self.basis.T @ (self.basis @ self.e)

    @cached_property
    def chi2(self) -> float:
        """Sum of squares of the residual."""
        return float(self.e @ self.e)

    @cached_property
    def dof(self) -> int:
        """Degrees of freedom of the residual."""
        return len(self.e) - len(self.basis) - len(self.transients.covariance)

    def _white(self, dY: Sequence[np.ndarray]) -> np.ndarray:
        """(k, N) whitened rows of changes of y, one (k, n, n_y, m) per block, with the transients removed."""
        rows = np.concatenate([part.real(one) for part, one in zip(self.parts, dY, strict=True)], axis=1)
        self.transients.remove_from(rows)
        return rows

    def directions(self, dY: Sequence[np.ndarray]) -> np.ndarray:
        """(k, N) projected directions from changes of y, one (k, n, n_y, m) per block."""
        A = self._white(dY)
        rest = A - (A @ self.basis.T) @ self.basis
        rest[np.linalg.norm(rest, axis=1) < SETTINGS.least_left * np.linalg.norm(A, axis=1)] = 0
        return rest

    def of_effect(self, effect: ActiveEffect) -> np.ndarray:
        """(k, N): directions of the linear parameters of an effect at zero strength; without such parameters, the
        change of y by the whole effect."""
        return self.of_effects([effect])[0]

    def of_effects(self, effects: Sequence[ActiveEffect]) -> list[np.ndarray]:
        """`of_effect` of several effects, with one projection for all."""
        if not effects:
            return []
        changes = [self._changes(one) for one in effects]
        joint = self.directions([np.concatenate(own) for own in zip(*changes, strict=True)])
        return np.split(joint, np.cumsum([len(own[0]) for own in changes])[:-1])

    def _changes(self, effect: ActiveEffect) -> list[np.ndarray]:
        """(k, n, n_y, m) for each block: changes of y of `of_effect`."""
        linear = [j for j, one in enumerate(effect.parameters) if one.linear]
        if not linear:
            return [part.whole_change(effect)[None] for part in self.parts]
        stepped = []
        for j in linear:
            values = list(effect.values)
            step = SETTINGS.step * effect.parameters[j].size
            values[j] += step
            stepped.append((effect.at(values), step))
        return [np.array([part.change(one) / step for one, step in stepped]) for part in self.parts]

    def reduction(self, A: np.ndarray) -> Reduction:
        """Reduction of chi2 by directions (k, N)."""
        return reduction(A @ A.T, A @ self.e)


class EvidenceScore(Score):
    """`Score` with path errors integrated out and normal priors on all parameters.

    The priors are additional rows below the residuals: e = (e, -z), J = (J, I). A direction of an effect is zero there.
    """

    def __init__(self, fitted: Fitted, data: Data, settings: FitSettings = FIT_SETTINGS):
        full = fitted.model
        # Score tests of other models, by which an effect finds its starting values, keep the tolerances fixed.
        rig = tuple(name for name in full.base.names if name in default_parameters(full.rig))
        nominal = full.nominal and replace(full.nominal, names=rig)
        self.model, self.kept = replace(full, base=replace(full.base, names=rig), nominal=nominal), {}
        blocks = [
            with_distortion(block, level, fitted.variances, settings)
            for block, level in zip(data.blocks, data.levels, strict=True)
        ]
        self.transients = fitted.white.transients
        initial = self.transients.initial
        self.parts = [Part(self.model, block, *one) for block, one in zip(blocks, initial, strict=True)]
        self.profile = Profile(fitted, data, settings)
        self.basis, self.e = self.profile.basis, self.profile.e

    def directions(self, dY: Sequence[np.ndarray]) -> np.ndarray:
        """(k, N + n) as those of `Score`, with the rows of the priors."""
        return self.profile.free(
            np.concatenate([part.real(one) for part, one in zip(self.parts, dY, strict=True)], axis=1)
        )
