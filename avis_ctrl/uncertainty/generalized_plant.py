r"""The generalized plant, assembled by signal name.

                 +-----------+
     z_delta <---|           |<--- w_delta        Delta: uncertainty of the model
                 |           |
           z <---|     P     |<--- w              performance of the loop
                 |           |
        +-- y <--|           |<--- u <--+
        |        +-----------+          |
        +------------> K ---------------+         u = K y (positive feedback)

A `Diagram` collects parts whose inputs and outputs have signal names. It records which signals are
w_delta/z_delta (declared with an uncertainty block), w, z, u and y. Signals are found by name only, not by index.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from avis_ctrl.errors import InputError
from avis_ctrl.lti.connect import connect, lft_lower, signal_sources
from avis_ctrl.lti.statespace import StateSpace
from avis_ctrl.uncertainty.blocks import Block, BlockStructure

Role = Literal["w", "z", "u", "y"]


@dataclass(frozen=True)
class Signal:
    """A row of the connection table."""

    name: str
    meaning: str
    unit: str
    source: str
    readers: tuple[str, ...]
    role: str  # "w_delta", "z_delta", "w", "z", "u", "y" or "internal"


@dataclass(frozen=True, eq=False)
class GeneralizedPlant:
    """P with inputs (w_delta, w, u) and outputs (z_delta, z, y), its blocks and its connection table.

    Attributes
    ----------
    P : StateSpace with named signals.
    blocks : uncertainty blocks in the order of w_delta.
    w, z, u, y : names of the remaining signals.
    signals : the connection table.
    parts : the parts with their systems, for the block diagram.
    """

    P: StateSpace
    blocks: BlockStructure
    w: tuple[str, ...]
    z: tuple[str, ...]
    u: tuple[str, ...]
    y: tuple[str, ...]
    signals: tuple[Signal, ...] = ()
    parts: tuple[Part, ...] = ()

    @property
    def nmeas(self) -> int:
        """Number of measurements y."""
        return len(self.y)

    @property
    def ncon(self) -> int:
        """Number of controls u."""
        return len(self.u)

    @property
    def all_blocks(self) -> BlockStructure:
        """Uncertainty blocks and the performance block."""
        return self.blocks.with_performance(len(self.w), len(self.z))

    def closed(self, K: StateSpace | None) -> StateSpace:
        """N = F_l(P, K); without a controller, P with u = 0."""
        outputs, inputs = self.P.outputs[: self.P.noutputs - self.nmeas], self.P.inputs[: self.P.ninputs - self.ncon]
        if K is None:
            return self.P.select(list(outputs), list(inputs))
        return lft_lower(self.P, K)

    def restricted(self, w: Sequence[str], z: Sequence[str]) -> GeneralizedPlant:
        """The same connection with fewer performance signals; parts that no output depends on are omitted."""
        if unknown := [name for name in (*w, *z) if name not in (*self.w, *self.z)]:
            raise InputError(f"the performance signals are {[*self.w, *self.z]}", field="w, z", value=unknown)
        w_delta = self.P.inputs[: self.blocks.n_w]
        z_delta = self.P.outputs[: self.blocks.n_z]
        parts = _contributing(self.parts, [*z_delta, *z, *self.y])
        inputs, outputs = [*w_delta, *w, *self.u], [*z_delta, *z, *self.y]
        # An omitted input is zero.
        absent = [name for name in self.w if name not in w]
        systems = {p.name: p.system.select(None, [n for n in p.system.inputs if n not in absent]) for p in parts}
        kept = {name for part in parts for name in (*part.system.inputs, *part.system.outputs)}
        signals = tuple(s for s in self.signals if s.name in kept and s.name not in absent)
        return GeneralizedPlant(
            connect(systems, inputs, outputs), self.blocks, tuple(w), tuple(z), self.u, self.y, signals, parts
        )

    def nominal(self) -> GeneralizedPlant:
        """The plant with Delta = 0, without w_delta and z_delta."""
        P = self.P.select(slice(self.blocks.n_z, None), slice(self.blocks.n_w, None))
        return replace(self, P=P, blocks=BlockStructure(()))

    def as_dict(self) -> dict[str, Any]:
        """JSON form of the format avis-plant (docs/contracts/design.md)."""
        P = self.P
        return {
            "format": "avis-plant",
            "version": 1,
            "A": P.A.tolist(),
            "B": P.B.tolist(),
            "C": P.C.tolist(),
            "D": P.D.tolist(),
            "dt": P.dt,
            "inputs": list(P.inputs),
            "outputs": list(P.outputs),
            "nmeas": self.nmeas,
            "ncon": self.ncon,
            "blocks": [b.as_dict() for b in self.blocks.blocks],
            "performance": {"rows": len(self.w), "cols": len(self.z)},
        }


@dataclass(frozen=True, eq=False)
class Part:
    """One box of the block diagram."""

    name: str
    kind: str  # "rig", "actuator", "sensor", "weight", "uncertainty", "allocation", ...
    system: StateSpace


def _contributing(parts: Sequence[Part], outputs: Sequence[str]) -> tuple[Part, ...]:
    """The parts that the outputs depend on, directly or through other parts, in their order."""
    maker = {name: part for part in parts for name in part.system.outputs}
    needed: set[str] = set()
    frontier = [name for name in outputs if name in maker]
    while frontier:
        part = maker[frontier.pop()]
        if part.name not in needed:
            needed.add(part.name)
            frontier += [name for name in part.system.inputs if name in maker]
    return tuple(part for part in parts if part.name in needed)


class Diagram:
    """Collection of parts and named signals, from which the generalized plant is built.

    >>> diagram = Diagram()
    >>> diagram.add("rig", rig_system, kind="rig")
    >>> diagram.add("W_T z", weight, kind="weight")
    >>> plant = diagram.plant(w=["floor_z_dot"], z=["e_z"], u=["force_z"], y=["seen_z"])
    """

    def __init__(self) -> None:
        self._parts: list[Part] = []
        self._blocks: list[tuple[Block, list[str], list[str]]] = []
        self._meaning: dict[str, tuple[str, str]] = {}

    def add(self, name: str, system: StateSpace, kind: str = "system") -> None:
        """Add a part; its inputs read and its outputs drive the signals of the same names."""
        if any(part.name == name for part in self._parts):
            raise InputError("two parts of this name", field="diagram", value=name)
        self._parts.append(Part(name, kind, system))

    def uncertain(self, block: Block, w: Sequence[str], z: Sequence[str]) -> None:
        """Declare that `block` maps the signals z to the signals w."""
        if (len(w), len(z)) != (block.rows, block.cols):
            raise InputError(
                f"block of {block.rows} x {block.cols} given {len(w)} w and {len(z)} z signals",
                field="uncertainty",
                value=block.name,
            )
        self._blocks.append((block, list(w), list(z)))

    def means(self, signal: str, meaning: str, unit: str) -> None:
        """State meaning and unit of a signal, for the table of the report."""
        self._meaning[signal] = (meaning, unit)

    def plant(self, w: Sequence[str], z: Sequence[str], u: Sequence[str], y: Sequence[str]) -> GeneralizedPlant:
        """Close the connection.

        Raises
        ------
        InputError : a signal that is driven twice or not at all, or that is driven but not read.
        """
        parts = {part.name: part.system for part in self._parts}
        w_delta = [name for _, names, _ in self._blocks for name in names]
        z_delta = [name for _, _, names in self._blocks for name in names]
        inputs, outputs = [*w_delta, *w, *u], [*z_delta, *z, *y]
        source = signal_sources(parts, inputs)
        readers = {name: [p.name for p in self._parts if name in p.system.inputs] for name in source}
        if unread := [name for name in source if not readers[name] and name not in outputs]:
            raise InputError(
                f"it is driven by {source[unread[0]]} but read by nothing, and is no output",
                field="signal",
                value=unread[0],
            )
        roles = {
            **dict.fromkeys(w_delta, "w_delta"),
            **dict.fromkeys(z_delta, "z_delta"),
            **dict.fromkeys(w, "w"),
            **dict.fromkeys(z, "z"),
            **dict.fromkeys(u, "u"),
            **dict.fromkeys(y, "y"),
        }
        table = tuple(
            Signal(
                name,
                *self._meaning.get(name, ("", "")),
                source[name],
                tuple(readers[name]),
                roles.get(name, "internal"),
            )
            for name in source
        )
        return GeneralizedPlant(
            connect(parts, inputs, outputs),
            BlockStructure(tuple(b for b, _, _ in self._blocks)),
            tuple(w),
            tuple(z),
            tuple(u),
            tuple(y),
            table,
            tuple(self._parts),
        )
