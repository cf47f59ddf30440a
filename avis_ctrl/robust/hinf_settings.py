"""Tolerances of the H-infinity synthesis: plant, Riccati equations, search for gamma, measured closed loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class HinfSettings:
    """All values are ratios.

    rank_tolerance : smallest singular value of D12 (columns of unit length) or D21 (rows of unit length) below which
        the matrix counts as rank deficient: the formulas divide by it, which costs half of the digits.
    pbh_tolerance : smallest singular value of the PBH matrix relative to the norm of [A B], or of [A; C], below which a
        mode counts as uncontrollable, or unobservable: well above the round-off of its pole.
    no_column : length of a column of D12, or row of D21, relative to the typical size of its channel, below which it
        counts as zero: round-off of the plant data.
    rank_at_zero : singular value of a channel at one of its zeros (columns or rows of unit length) below which the
        direction counts as lost there: the accuracy of a computed zero.
    known_direction : largest relative error of the directions in which a control acts, or which a measurement detects,
        at one frequency; with a larger error the response there gives no bound. A direction never counts as lost
        because its gain is small: a control that has rolled off still acts, and a lost direction raises the bound.
    round_off : round-off of the data of a Riccati equation, or of its residual, relative to the sum of the magnitudes
        of its terms: a few rounding errors.
    response_tolerance : largest relative difference of two responses off the imaginary axis that counts as round-off.
    axis_tolerance : real part of a Hamiltonian eigenvalue, relative to its magnitude, up to which it counts as lying on
        the imaginary axis: its round-off.
    lagrangian_tolerance : largest asymmetry of X1' X2, whose entries are below 1: with a larger asymmetry the stable
        subspace is not accurate to six digits.
    negative : magnitude of a negative eigenvalue of X, relative to the largest eigenvalue, up to which it counts as
        round-off and is not examined further.
    zero_gamma : gamma relative to the gain of the open-loop channel w -> z, below which it counts as round-off.
    norm_accuracy : relative accuracy of a norm or a bound that is compared with gamma: that of `hinf_norm`.
    well_posed : condition number of I + D_K D22 above which the central controller, whose fast poles would cost half of
        the digits, is replaced by another.
    off_centre : norm of the constant parameter Q of that controller, relative to gamma; at 1 the norm of the loop may
        equal gamma, at 0 the controller is the central one.
    loop_accuracy : relative amount by which the norm of a closed loop must exceed a bound to contradict it: ten times
        the accuracy of the norm, to allow for the round-off of the loop.
    same_gamma : relative difference between two computations of gamma above which round-off is reported; a smaller
        difference changes no decision.
    far_beyond : controller poles faster than this multiple of the fastest plant pole come from the formulas, not from
        the plant; for the plant they act as a static gain.
    closer : fractions of the back-off at which a controller without those poles is tried: the smaller the fraction, the
        faster these poles.
    """

    rank_tolerance: float = 1e-8
    pbh_tolerance: float = 1e-10
    no_column: float = 1e-12
    rank_at_zero: float = 1e-9
    known_direction: float = 1e-6
    round_off: float = 8 * float(np.finfo(float).eps)
    response_tolerance: float = 1e-9
    axis_tolerance: float = 1e-10
    lagrangian_tolerance: float = 1e-6
    negative: float = 1e-10
    zero_gamma: float = 1e-9
    norm_accuracy: float = 1e-6
    well_posed: float = 1e6
    off_centre: float = 0.3
    loop_accuracy: float = 1e-5
    same_gamma: float = 1e-4
    far_beyond: float = 10.0
    closer: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03, 0.01)


SETTINGS = HinfSettings()
