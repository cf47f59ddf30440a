"""Data for the fit: spectra of records, or frequency responses, in one form.

A block represents Y = G U + noise on lines omega for m experiments, with the covariance of the noise. A record is one
experiment (its own spectra, with the unknown transient of its ends). A measured frequency response of n_u inputs is n_u
experiments: any W with W W^H = S, its Gram matrix, makes the columns of Y = G W independent with the noise covariance
of one experiment (Pintelon and Schoukens, System Identification, 2nd ed., 2012, section 2.7).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avis_ctrl.errors import InputError


@dataclass(frozen=True, eq=False)
class SpectralBlock:
    """Y = G U + noise.

    Attributes
    ----------
    name : record or response that it comes from.
    omega : (n,) rad/s, positive.
    U : (n, n_in, m) inputs in the order of the model's (actuators, floor).
    Y : (n, n_y, m) outputs in the order of the model's sensors.
    noise : (n, 1 or m, n_y, n_y) covariance E[e e^H] of the noise of an experiment; None until it is known.
    dof : complex degrees of freedom of the estimate `noise`; infinite if it is exact.
    transient : whether the ends of a record add a transient, which the fit removes (m = 1).
    kind : records of one kind share their noise.
    shared : number of lines with common errors; together they have the information of one line.
    start_s, samples : start on the campaign's clock and length of the part of the record that it represents.
    """

    name: str
    omega: np.ndarray
    U: np.ndarray
    Y: np.ndarray
    noise: np.ndarray | None = None
    dof: float = np.inf
    transient: bool = False
    kind: str = ""
    shared: float = 1.0
    start_s: float = 0.0
    samples: int = 0

    def __post_init__(self) -> None:
        if not len(self.omega):
            raise InputError("expected at least one line", field=f"block {self.name}")

    @property
    def numbers(self) -> int:
        """Independent real numbers in Y."""
        return round(2 * self.Y.size / self.shared)

    @property
    def precision_factor(self) -> float:
        """Factor on the inverse of the estimated noise covariance: that of a Wishart matrix of n_y outputs and dof
        degrees of freedom is too large by dof/(dof - n_y). Raises InputError if dof is not larger than n_y."""
        n_y = self.Y.shape[1]
        if self.dof <= n_y:
            raise InputError(
                f"expected more than {n_y} degrees of freedom in the noise covariance",
                field=f"block {self.name}",
                value=self.dof,
            )
        return 1.0 if np.isinf(self.dof) else (self.dof - n_y) / self.dof

    def with_noise(self, noise: np.ndarray, dof: float = np.inf) -> SpectralBlock:
        """The block with the covariance of its noise, (n, n_y, n_y) or (n, m, n_y, n_y)."""
        n_y = self.Y.shape[1]
        return replace(self, noise=noise.reshape(len(self.omega), -1, n_y, n_y), dof=dof)

    def lines(self, keep: np.ndarray) -> SpectralBlock:
        """The block on some of its lines."""
        return replace(
            self,
            omega=self.omega[keep],
            U=self.U[keep],
            Y=self.Y[keep],
            noise=None if self.noise is None else self.noise[keep],
        )
