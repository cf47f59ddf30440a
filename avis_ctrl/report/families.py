"""Families of signals or parts that differ only by axis, channel or parameter, shown as one in diagram and table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from avis_ctrl.study.plant import DesignPlant
from avis_ctrl.uncertainty.generalized_plant import Signal

EXTERNAL = "external input"


@dataclass(frozen=True)
class PartFamily:
    """`count` parts of one kind whose names differ only by axis or channel."""

    name: str
    kind: str
    count: int


@dataclass(frozen=True)
class SignalFamily:
    """Signals of one role whose names differ only by axis, channel or parameter."""

    name: str
    members: tuple[str, ...]
    meaning: str
    unit: str
    source: str
    readers: tuple[str, ...]
    role: str


class Families:
    """Families of a plant: a star replaces axes and channels; the signals of all parameters form one family."""

    def __init__(self, plant: DesignPlant) -> None:
        self._stars = sorted([*plant.axes, *plant.actuators, *plant.sensors], key=len, reverse=True)
        self._parameters = {
            f"{side}:{tag}"
            for side in "wz"
            for tag in (name[2:] for name in plant.rig.system.inputs if name.startswith("w:"))
        }
        kinds = Counter((self.of(part.name), part.kind) for part in plant.full.parts)
        self.parts = tuple(PartFamily(name, kind, count) for (name, kind), count in kinds.items())
        self.signals = self._signal_families(plant.full.signals)

    def of(self, name: str) -> str:
        """Family name of a signal or part."""
        if name in self._parameters:
            return f"{name[:2]}parameters"
        for star in self._stars:
            for before, after in ((" ", ""), ("_", ""), ("", "_"), ("_", "_")):
                piece = f"{before}{star}{after}"
                ends = name.startswith(piece) if not before else name.endswith(piece) if not after else piece in name
                if ends:
                    return name.replace(piece, f"{before}*{after}", 1)
            if name == star:
                return "channel *"
        return name

    def _signal_families(self, signals: Sequence[Signal]) -> tuple[SignalFamily, ...]:
        found: dict[tuple[str, str], SignalFamily] = {}
        for s in signals:
            key = (self.of(s.name), s.role)
            readers = tuple(dict.fromkeys(self.of(reader) for reader in s.readers))
            members = (*found[key].members, s.name) if key in found else (s.name,)
            source = s.source if s.source == EXTERNAL else self.of(s.source)
            found[key] = SignalFamily(key[0], members, s.meaning, s.unit, source, readers, s.role)
        return tuple(found.values())
