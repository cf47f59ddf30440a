"""Tolerances of the H-infinity synthesis: plant, Riccati equations, search for gamma, measured loop."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class HinfSettings:
    """All are ratios.

    rank_tolerance : singular value of D12 (columns of unit length) or D21 (rows) below which it lacks rank: the
        formulas divide by it, which costs half the digits.
    pbh_tolerance : smallest singular value of the PBH matrix by the norm of [A B], or of [A; C], below which no input
        moves a mode, or no measurement sees it: well above the round-off of its pole.
    rank_at_point : singular value of a channel at one frequency, by its typical size, up to which it lacks rank there:
        above the round-off of a response, but little, for lost rank raises a bound.
    response_tolerance : difference of two responses off the imaginary axis, by their size, up to which it is round-off.
    axis_tolerance : real part of an eigenvalue of the Hamiltonian by its magnitude, up to which it is on the imaginary
        axis: its round-off.
    lagrangian_tolerance : largest asymmetry of X1' X2, whose entries are below 1: with more, the stable subspace is not
        known to six digits.
    negative : size of a negative eigenvalue of X by the largest, up to which it is round-off and not looked at further.
    zero_gamma : gamma by the gain of the open channel w -> z, below which it is round-off.
    norm_accuracy : of a norm or a bound beside gamma: that of `hinf_norm`.
    loop_accuracy : by how much a closed loop's norm contradicts a bound: ten times that, for round-off of the loop.
    same_gamma : difference of two computations of gamma that says that round-off shows in it; less changes no decision.
    far_beyond : controller poles this many times the plant's fastest come from the formulas, not from the plant, which
        feels little but their gain.
    closer : shares of the back-off at which a controller without those poles is tried: the smaller, the nearer they are
        to a gain.
    """

    rank_tolerance: float = 1e-8
    pbh_tolerance: float = 1e-10
    rank_at_point: float = 1e-9
    response_tolerance: float = 1e-9
    axis_tolerance: float = 1e-10
    lagrangian_tolerance: float = 1e-6
    negative: float = 1e-10
    zero_gamma: float = 1e-9
    norm_accuracy: float = 1e-6
    loop_accuracy: float = 1e-5
    same_gamma: float = 1e-4
    far_beyond: float = 10.0
    closer: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03, 0.01)


SETTINGS = HinfSettings()
