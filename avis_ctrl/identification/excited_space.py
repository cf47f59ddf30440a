"""Combinations of the drives that a campaign excites: six logical axes of a table with eight drives omit two.

A parametric fit does not need the response to each drive separately. The combinations that are not excited are
reported, because the parameters that depend on them (a single force constant, say) are taken as known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from avis_ctrl.identification.identifiability_text import combination_text
from avis_ctrl.identification.sparse_space import sparse_rows, whole_numbers
from avis_ctrl.measurement.campaign import Campaign, ranges
from avis_ctrl.measurement.frequency_response.local_fit import SETTINGS as LOCAL_FIT


@dataclass(frozen=True)
class ExcitedSpaceSettings:
    """piece : samples read at once [1], to limit the memory: 2 MB a channel."""

    piece: int = 1 << 18


SETTINGS = ExcitedSpaceSettings()


@dataclass(frozen=True, eq=False)
class ExcitedSpace:
    """The excited combinations of the drives (n_u) in a band.

    names : of the drives. driven : those that some record excites. unplayed : (d, k) combinations of the k driven ones
        that no record excites, sparse, in whole numbers if possible.
    """

    names: tuple[str, ...]
    driven: tuple[str, ...]
    unplayed: np.ndarray

    @property
    def full(self) -> bool:
        """Whether all combinations of the driven inputs are excited."""
        return not len(self.unplayed)

    @property
    def sentence(self) -> str:
        """Combinations that are not excited, in words; empty if everything is."""
        said = []
        if silent := [name for name in self.names if name not in self.driven]:
            its, it = ("their", "them") if len(silent) > 1 else ("its", "it")
            said.append(
                f"no record drives {', '.join(silent)}: {its} response is not measured, and the rig file's "
                f"values for {it} are taken as exact"
            )
        if not self.full:
            k, d = len(self.driven), len(self.unplayed)
            combinations = "; ".join(combination_text(zip(self.driven, row, strict=True)) for row in self.unplayed)
            said.append(
                f"the records excite {k - d} of {k} independent combinations of {', '.join(self.driven)}; not "
                f"excited: {combinations}. The fit does not need the response to each drive separately"
            )
        return "; ".join(said)


def excited_space(campaign: Campaign, band_Hz: tuple[float, float]) -> ExcitedSpace:
    """The combinations of drives that some record excites inside a band."""
    names = campaign.u_names
    gram = np.zeros((len(names),) * 2)
    for record in campaign.records:
        for start, stop in ranges(record.header.samples, SETTINGS.piece):
            u = record.load(start, stop).u
            if not np.any(u):
                continue
            f = scipy.fft.rfftfreq(len(u), 1 / record.header.sample_rate_Hz)
            U = scipy.fft.rfft(u, axis=0)[(f >= band_Hz[0]) & (f <= band_Hz[1]) & (f > 0)]
            gram += np.real(U.conj().T @ U)
    size = np.sqrt(np.diag(gram))
    driven = np.flatnonzero(size > LOCAL_FIT.span_tolerance * np.max(size, initial=0.0))
    if not driven.size or not np.any(size):
        return ExcitedSpace(names, (), np.zeros((0, 0)))
    size = size[driven]
    values, vectors = np.linalg.eigh(gram[np.ix_(driven, driven)] / np.outer(size, size))
    missing = vectors[:, values < LOCAL_FIT.span_tolerance**2]
    # w with w^T u = 0: in volts the entries are divided by the sizes.
    rows = [whole_numbers(row) for row in sparse_rows(missing / size[:, None], 1e-4)] if missing.size else []
    return ExcitedSpace(names, tuple(names[j] for j in driven), np.reshape(rows, (-1, len(driven))))
