"""Block structures: shapes, places, round trips."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plant_json import blocks_of

from avis_ctrl.errors import InputError
from avis_ctrl.uncertainty.blocks import Block, BlockStructure, ComplexFull, ComplexScalar, RealScalar

sizes = st.integers(1, 4)
blocks = st.one_of(
    st.builds(RealScalar, sizes, st.text(max_size=5)),
    st.builds(ComplexScalar, sizes),
    st.builds(ComplexFull, sizes, sizes, st.text(max_size=5)),
)
structures = st.lists(blocks, max_size=5).map(BlockStructure.of)


@settings(max_examples=60, deadline=None)
@given(structure=structures, seed=st.integers(0, 2**32 - 1))
def test_random_assemble_values_contains(structure, seed):
    delta = structure.random(np.random.default_rng(seed), norm=2.0)
    assert delta.shape == (structure.n_w, structure.n_z)
    assert structure.contains(delta)
    np.testing.assert_array_equal(structure.assemble(structure.values(delta)), delta)
    for block, w, z in structure.slices():
        assert np.linalg.norm(delta[w, z], 2) <= 2.0 * (1 + 1e-12)
        if block.kind == "real":
            assert np.all(delta[w, z].imag == 0)


@settings(max_examples=60, deadline=None)
@given(structure=structures)
def test_json_round_trip(structure):
    text = json.dumps([block.as_dict() for block in structure.blocks])
    assert blocks_of(json.loads(text)) == structure


def test_kinds_survive_equality():
    """A real and a complex scalar of one size are different blocks."""
    assert RealScalar(2) != ComplexScalar(2)
    assert ComplexScalar(2) != ComplexFull(2, 2)
    assert RealScalar(2, "k") == RealScalar(2, "k")


def test_places_of_blocks_that_are_not_square():
    structure = BlockStructure.of([RealScalar(2), ComplexFull(1, 3), ComplexScalar(1)])
    assert (structure.n_w, structure.n_z) == (4, 6)
    assert [(w, z) for _, w, z in structure.slices()] == [
        (slice(0, 2), slice(0, 2)),
        (slice(2, 3), slice(2, 5)),
        (slice(3, 4), slice(5, 6)),
    ]
    delta = structure.assemble([0.5, np.array([[1.0, 2.0j, 3.0]]), 1j])
    expected = np.zeros((4, 6), complex)
    expected[[0, 1], [0, 1]], expected[2, 2:5], expected[3, 5] = 0.5, [1.0, 2.0j, 3.0], 1j
    np.testing.assert_array_equal(delta, expected)


@pytest.mark.parametrize("spoil", ["outside", "unequal copies", "imaginary part of a real block"])
def test_contains_refuses(spoil, rng):
    structure = BlockStructure.of([RealScalar(2), ComplexFull(1, 2)])
    delta = structure.random(rng)
    assert structure.contains(delta)
    if spoil == "outside":
        delta[0, 3] = 1e-3
    elif spoil == "unequal copies":
        delta[1, 1] += 1e-3
    else:
        delta[[0, 1], [0, 1]] += 1e-3j
    assert not structure.contains(delta)
    assert not structure.contains(delta[:, :-1])


def test_performance_block_takes_w_rows_and_z_columns():
    structure = BlockStructure.of([RealScalar(1, "k")]).with_performance(2, 5)
    assert structure.blocks[-1] == ComplexFull(2, 5, "performance")
    assert (structure.n_w, structure.n_z) == (3, 6)


def test_complexified_holds_every_real_perturbation(rng):
    structure = BlockStructure.of([RealScalar(3, "k"), ComplexFull(2, 2)])
    assert structure.complexified().contains(structure.random(rng))
    assert not structure.contains(structure.complexified().random(rng))


def test_without_phases_on_demand(rng):
    assert np.all(BlockStructure.of([ComplexFull(2, 3), ComplexScalar(2)]).random(rng, real=True).imag == 0)


@pytest.mark.parametrize(
    "make", [lambda: RealScalar(0), lambda: ComplexScalar(-1), lambda: ComplexFull(1, 0), lambda: RealScalar(1.5)]
)
def test_sizes_are_whole_and_positive(make):
    with pytest.raises(InputError, match="at least 1"):
        make()


def test_a_sequence_with_something_else_is_refused():
    with pytest.raises(InputError, match="RealScalar"):
        BlockStructure.of([RealScalar(1), 2])


def test_one_block_is_a_structure():
    assert BlockStructure.of(RealScalar(2)).blocks == (RealScalar(2),)


def test_only_repeated_scalars_have_matrix_scalings():
    assert [b.repeated for b in (RealScalar(1), RealScalar(2), ComplexScalar(2), ComplexFull(2, 2))] == [
        False,
        True,
        True,
        False,
    ]
    assert issubclass(RealScalar, Block)
