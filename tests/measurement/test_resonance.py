"""One mode: exact, with noise, and none."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest

from avis_ctrl.errors import ComputationError, InputError
from avis_ctrl.measurement.frequency_response import FrequencyResponse
from avis_ctrl.measurement.frequency_response.resonance import resonance


def modes(f, parameters, rng, n_y=2, n_u=2):
    """Sum of R w^2 / (s^2 + 2 zeta w s + w^2)."""
    s = 2j * np.pi * f
    return sum(
        (w**2 / (s**2 + 2 * z * w * s + w**2))[:, None, None] * rng.standard_normal((n_y, n_u))
        for w, z in ((2 * np.pi * f0, z) for f0, z in parameters)
    )


def measured(f, G, noise, rng, claimed=None):
    n, n_y, n_u = G.shape
    e = noise * (rng.standard_normal(G.shape) + 1j * rng.standard_normal(G.shape)) / np.sqrt(2)
    C = np.broadcast_to((claimed or noise) ** 2 * np.eye(n_y), (n, n_y, n_y))
    return FrequencyResponse(
        f,
        G + e,
        C,
        np.broadcast_to(np.eye(n_u), (n, n_u, n_u)),
        tuple(f"u{j}" for j in range(n_u)),
        tuple(f"y{i}" for i in range(n_y)),
    )


@pytest.mark.parametrize("damping", [0.002, 0.02, 0.06])
def test_a_mode_beside_others_without_noise(rng, damping):
    """The background is a straight line, which limits the accuracy to a small part of the bandwidth."""
    f = np.arange(1, 200, 0.05)
    got = resonance(measured(f, modes(f, [(50.0, damping), (120.0, 0.01), (9.0, 0.02)], rng), 1e-9, rng, 1e-3), 51.0)
    assert got.frequency_Hz == pytest.approx(50.0, abs=0.02 * 2 * damping * 50)
    assert got.damping == pytest.approx(damping, rel=0.03)


@pytest.mark.slow
def test_standard_deviations_are_those_of_repeated_measurements():
    rng = np.random.default_rng(3)
    f = np.arange(30, 70, 0.1)
    G = modes(f, [(50.0, 0.01)], rng)
    got = [resonance(measured(f, G, 0.5, rng), 50.0) for _ in range(100)]
    for value, std, exact in (("frequency_Hz", "frequency_std_Hz", 50.0), ("damping", "damping_std", 0.01)):
        z = np.array([(getattr(r, value) - exact) / getattr(r, std) for r in got])
        assert np.std(z) == pytest.approx(1.0, abs=0.2)
        assert abs(np.mean(z)) < 0.3
    assert np.mean([r.misfit for r in got]) == pytest.approx(1.0, abs=0.05)


def test_residues_of_a_known_mode(rng):
    """w^2 R / ((s - p)(s - p*)) has residue w^2 R / (2 j Im p)."""
    f, w, z = np.arange(30, 70, 0.02), 2 * np.pi * 50, 0.005
    G = modes(f, [(50.0, z)], np.random.default_rng(1))
    R = np.random.default_rng(1).standard_normal((2, 2))
    got = resonance(measured(f, G, 1e-6, rng), 50.0)
    assert np.allclose(got.residue, w**2 * R / (2j * w * np.sqrt(1 - z**2)), rtol=0.01)


def test_where_there_is_no_mode(rng):
    f = np.arange(30, 70, 0.1)
    flat = measured(f, np.ones((f.size, 2, 2)), 0.01, rng)
    with pytest.raises(ComputationError, match="no mode found near 50 Hz"):
        resonance(flat, 50.0)
    # One entry, where the pole adds four real unknowns: noise passes for a mode no more often than allowed.
    found = 0
    for _ in range(60):
        with suppress(ComputationError):
            found += bool(resonance(measured(f, np.ones((f.size, 1, 1)), 0.01, rng), 50.0))
    assert found <= 1
    for bad in (500.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="near_Hz"):
            resonance(flat, bad)
