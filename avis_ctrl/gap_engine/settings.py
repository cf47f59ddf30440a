"""Every tuning value of the search for missing effects, with its unit, its meaning and the reason for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GapSettings:
    """Values that no data determine; all of them are part of a result's provenance.

    stiffness_percent : prior standard deviation of mass, moments of inertia and stiffnesses [%]; a rig file is drawn
        from scales and data sheets.
    damping_percent : the same of dampings [%], which data sheets hardly state.
    lines : spectral lines of a record that are fitted; with 8 drives and 6 sensors the response needs about 100, and
        three times as many make the estimate of the unexplained part precise.
    bands_per_octave : bands over which the relative error of a path counts as constant; a third of an octave is what a
        mode's flank takes to change by a factor of two.
    least_error : relative error of every path that nobody can exclude [1], the scale of its prior: cables, threads and
        glue change a response by 0.1 % from day to day.
    error_weight : degrees of freedom of that prior; two, the least with a finite mean of the precision.
    first_error : relative error of the paths in the first fit [1], before any residual is known.
    rounds : estimates of the variances, each from the fit before it.
    iterations : Gauss-Newton steps between two estimates of the variances.
    effect_sizes : prior standard deviation of an effect's strength, in units of its parameter's size; broad, so that it
        costs some nats and bends nothing.
    shape_spread : prior standard deviation of a parameter that shapes an effect (a frequency), relative to its start.
    refits : effects that are refitted at each step of the search, the best by the score test.
    longest : most effects that are named together.
    certain : gain of log evidence [nats] that a name needs beside the logarithm of the number of candidates: odds of
        a hundred.
    converged : change of the penalised sum of squares, relative to the number of data, below which a fit has converged.
    """

    stiffness_percent: float = 5.0
    damping_percent: float = 20.0
    lines: int = 300
    bands_per_octave: int = 3
    least_error: float = 1e-3
    error_weight: float = 2.0
    first_error: float = 0.05
    rounds: int = 4
    iterations: int = 6
    effect_sizes: float = 100.0
    shape_spread: float = 1.0
    refits: int = 6
    longest: int = 3
    certain: float = 4.6
    converged: float = 1e-6


SETTINGS = GapSettings()
