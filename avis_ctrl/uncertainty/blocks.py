"""Blocks of a structured perturbation Delta, w_delta = Delta z_delta.

A block with r rows and c columns maps c entries of z_delta to r entries of w_delta, so that the
matrix M connected to Delta (z_delta = M w_delta) has sum(cols) rows and sum(rows) columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from avis_ctrl.checks import is_whole
from avis_ctrl.errors import InputError

Kind = Literal["real", "complex", "full"]


@dataclass(frozen=True)
class Block:
    """One block of Delta; use RealScalar, ComplexScalar or ComplexFull."""

    rows: int
    cols: int
    name: str = ""
    kind: ClassVar[Kind]

    def __post_init__(self) -> None:
        for label, size in (("rows", self.rows), ("cols", self.cols)):
            if not is_whole(size, 1):
                raise InputError("a block needs a whole number of at least 1", field=label, value=size)

    @property
    def repeated(self) -> bool:
        """Whether the block is delta I with more than one copy, so that its scaling is a full matrix."""
        return self.kind != "full" and self.rows > 1

    @property
    def is_scalar_delta(self) -> bool:
        """Whether Delta of the block is a number times the identity."""
        return self.kind != "full"

    def as_dict(self) -> dict[str, Any]:
        """JSON form, as in docs/contracts/design.md."""
        return {"kind": self.kind, "rows": self.rows, "cols": self.cols, "name": self.name}


class RealScalar(Block):
    """delta I_n with delta real: a physical parameter.

    Examples
    --------
    >>> ac.RealScalar(2, "k")
    RealScalar(rows=2, cols=2, name='k')
    """

    kind = "real"

    def __init__(self, n: int = 1, name: str = ""):
        super().__init__(n, n, name)


class ComplexScalar(Block):
    """delta I_n with delta complex: one scalar of neglected dynamics, repeated n times.

    Examples
    --------
    >>> ac.ComplexScalar(1, "loss").kind
    'complex'
    """

    kind = "complex"

    def __init__(self, n: int = 1, name: str = ""):
        super().__init__(n, n, name)


class ComplexFull(Block):
    """A full complex matrix of rows x cols: neglected dynamics, or a performance channel.

    Examples
    --------
    >>> ac.ComplexFull(2, 3, "flexible modes").rows
    2
    """

    kind = "full"

    def __init__(self, rows: int, cols: int | None = None, name: str = ""):
        super().__init__(rows, rows if cols is None else cols, name)


@dataclass(frozen=True)
class BlockSettings:
    """many : number of blocks from which full scalings (matrices for repeated blocks, G for real blocks) cost more
    than they gain at most frequencies: 20 ms per matrix with one number per block, 37 ms with full scalings (34 blocks,
    47 signals); 24 and 142 ms if blocks of up to six rows are repeated (23 blocks, 49 signals)."""

    many: int = 16


SETTINGS = BlockSettings()


@dataclass(frozen=True)
class BlockStructure:
    """The blocks of Delta in order, with their positions in z_delta and w_delta.

    Examples
    --------
    >>> blocks = ac.BlockStructure.of([ac.RealScalar(2, "k"), ac.ComplexFull(1, 2, "flexible modes")])
    >>> blocks.n_w, blocks.n_z
    (3, 4)
    """

    blocks: tuple[Block, ...]

    @staticmethod
    def of(blocks: BlockStructure | Sequence[Block]) -> BlockStructure:
        """From any sequence of blocks; InputError for anything else."""
        if isinstance(blocks, BlockStructure):
            return blocks
        if not isinstance(blocks, (Block, Sequence)):
            raise InputError("expected a sequence of blocks", field="blocks", value=blocks)
        blocks = (blocks,) if isinstance(blocks, Block) else tuple(blocks)
        for block in blocks:
            if not isinstance(block, Block):
                raise InputError("expected RealScalar, ComplexScalar or ComplexFull", field="blocks", value=block)
        return BlockStructure(blocks)

    @property
    def n_w(self) -> int:
        """Length of w_delta: the number of columns of M."""
        return sum(block.rows for block in self.blocks)

    @property
    def n_z(self) -> int:
        """Length of z_delta: the number of rows of M."""
        return sum(block.cols for block in self.blocks)

    def slices(self) -> Iterator[tuple[Block, slice, slice]]:
        """(block, its rows of Delta, a slice of w_delta, and its columns, a slice of z_delta)."""
        w = z = 0
        for block in self.blocks:
            yield block, slice(w, w + block.rows), slice(z, z + block.cols)
            w, z = w + block.rows, z + block.cols

    def with_performance(self, n_w: int, n_z: int) -> BlockStructure:
        """These blocks followed by a full performance block from n_z outputs z to n_w inputs w."""
        return BlockStructure((*self.blocks, ComplexFull(n_w, n_z, "performance")))

    def complexified(self) -> BlockStructure:
        """Every real scalar replaced by a complex one: a superset of perturbations."""
        return BlockStructure(tuple(ComplexScalar(b.rows, b.name) if b.kind == "real" else b for b in self.blocks))

    @property
    def many(self) -> bool:
        """Whether there are so many blocks that scalings with one number per block are tried first."""
        return len(self.blocks) >= SETTINGS.many

    def simplified(self) -> BlockStructure:
        """Complexified, with every repeated scalar replaced by a full block: a superset of perturbations, with one real
        number per block as scaling."""
        return BlockStructure(
            tuple(ComplexFull(b.rows, b.cols, b.name) if b.repeated else b for b in self.complexified().blocks)
        )

    def assemble(self, values: Sequence[complex | np.ndarray]) -> np.ndarray:
        """Delta (n_w, n_z) from one value per block: a number for scalars, an array for full blocks."""
        delta = np.zeros((self.n_w, self.n_z), complex)
        for value, (block, w, z) in zip(values, self.slices(), strict=True):
            delta[w, z] = np.eye(block.rows) * value if block.is_scalar_delta else value
        return delta

    def values(self, delta: np.ndarray) -> list[complex | np.ndarray]:
        """Inverse of `assemble`."""
        return [
            delta[w, z] if not block.is_scalar_delta else complex(delta[w.start, z.start])
            for block, w, z in self.slices()
        ]

    def contains(self, delta: np.ndarray, tolerance: float = 1e-9) -> bool:
        """Whether a matrix has this structure (zero outside the blocks, repeated, real where required)."""
        if delta.shape != (self.n_w, self.n_z):
            return False
        rebuilt = self.assemble(
            [np.real(v) if b.kind == "real" else v for v, b in zip(self.values(delta), self.blocks, strict=True)]
        )
        error = np.max(np.abs(rebuilt - delta), initial=0.0)
        return bool(error <= tolerance * max(1.0, np.max(np.abs(delta), initial=0.0)))

    def random(self, rng: np.random.Generator, norm: float = 1.0, real: bool = False) -> np.ndarray:
        """A random Delta whose largest block norm is at most `norm` (real=True: with real entries)."""
        values: list[complex | np.ndarray] = []
        for block in self.blocks:
            if block.kind == "full":
                value = rng.standard_normal((block.rows, block.cols))
                if not real:
                    value = value + 1j * rng.standard_normal(value.shape)
                values.append(norm * rng.uniform() * value / np.linalg.norm(value, 2))
            elif block.kind == "real" or real:
                values.append(norm * rng.uniform(-1, 1))
            else:
                values.append(norm * np.sqrt(rng.uniform()) * np.exp(2j * np.pi * rng.uniform()))
        return self.assemble(values)
