"""A measurement campaign: several records of one rig, in memory or on disk.

Records on disk are loaded whole or in pieces, so that a record of many gigabytes need not fit in memory.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from avis_ctrl.errors import InputError

Excitation = Literal["multisine", "noise", "rest", "floor", "sine"]
EXCITATIONS: tuple[str, ...] = get_args(Excitation)
FLOOR_NAMES = ("vx", "vy", "vz")


@dataclass(frozen=True)
class RecordHeader:
    """Metadata of a record (contract: campaign file).

    Attributes
    ----------
    name : such as "00".
    sample_rate_Hz : sample rate of every channel.
    samples : number of samples.
    u_names, y_names, floor_names : names of the channels; floor_names is empty if the floor was not measured.
    u_unit, y_unit, floor_unit : units, "V" for commanded voltages; "V", "m/s", "m/s^2" or "m" for y.
    excitation : "multisine" (periodic, from rest), "noise", "rest" (u = 0), "floor" (u = 0, floor shaken), or "sine"
        (one frequency, for stepped-sine calibrations; not part of the contract).
    level_V : r.m.s. of the driven voltages; it distinguishes records at different levels.
    start_s : time of the first sample, on the campaign's clock.
    period_s : period of a periodic record, otherwise None.

    Raises
    ------
    InputError : inconsistent values.
    """

    name: str
    sample_rate_Hz: float
    samples: int
    u_names: tuple[str, ...]
    y_names: tuple[str, ...]
    excitation: str
    level_V: float = 0.0
    start_s: float = 0.0
    period_s: float | None = None
    u_unit: str = "V"
    y_unit: str = "V"
    floor_names: tuple[str, ...] = ()
    floor_unit: str = "m/s"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sample_rate_Hz) and self.sample_rate_Hz > 0):
            raise self.error("sample_rate_Hz", "expected a positive sample rate in Hz")
        if self.samples < 2:
            raise self.error("samples", "expected at least two samples")
        if self.excitation not in EXCITATIONS:
            raise self.error("excitation", f"expected one of {', '.join(EXCITATIONS)}")
        for field in ("u_names", "y_names", "floor_names"):
            names = getattr(self, field)
            if len(set(names)) != len(names):
                raise self.error(field, "expected different channel names")
        if self.period_s is not None:
            self._check_period(self.period_s)

    def _check_period(self, period_s: float) -> None:
        if not (np.isfinite(period_s) and period_s > 0):
            raise self.error("period_s", "expected a positive period in s")
        count = period_s * self.sample_rate_Hz
        found = f"at {self.sample_rate_Hz:g} Hz it is {count:.6g}"
        if round(count) < 2:
            check = "check the sample rate and the unit of the time stamps"
            raise self.error("period_s", f"expected at least two samples in a period; {found}; {check}")
        if abs(count - round(count)) > 1e-6 * count:
            raise self.error("period_s", f"expected a whole number of samples; {found}")

    def error(self, field: str, expected: str) -> InputError:
        """The error for the value of a field of this header."""
        return InputError(expected, field=f"record {self.name}: {field}", value=getattr(self, field))

    def part(self, start: int, stop: int) -> RecordHeader:
        """Header of samples start .. stop."""
        return replace(self, samples=stop - start, start_s=self.start_s + start / self.sample_rate_Hz)

    @property
    def duration_s(self) -> float:
        """Number of samples over the sample rate."""
        return self.samples / self.sample_rate_Hz

    @property
    def period_samples(self) -> int | None:
        """Samples per period; None if the record is not periodic."""
        return None if self.period_s is None else round(self.period_s * self.sample_rate_Hz)

    @property
    def periods(self) -> int:
        """Number of whole periods; 0 if the record is not periodic."""
        return self.samples // self.period_samples if self.period_samples else 0


def ranges(samples: int, longest: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of consecutive pieces that together cover every sample once.

    longest : maximum length, 2 or more. The last piece has one sample more if a single sample, which is not a valid
        record, would otherwise remain.
    """
    if longest < 2:
        raise InputError("expected pieces of at least two samples", field="longest", value=longest)
    for start in range(0, max(samples - 1, 1), longest):
        left = samples - start
        yield start, samples if left <= longest + 1 else start + longest


def require_finite(
    array: np.ndarray, names: Sequence[str], field: str | None, place: Callable[[int], str] = "sample {}".format
) -> None:
    """Raise InputError for NaN or Inf in (samples, channels). place : gives the place of a row (from 0) in words."""
    good = np.isfinite(array)
    if not good.all():
        row, column = np.argwhere(~good)[0]
        raise InputError(
            f"expected finite numbers; NaN or infinite: {np.count_nonzero(~good)}, the first at {place(int(row))} "
            f"of channel {names[column]}",
            field=field,
            value=float(array[row, column]),
        )


class RecordSource(ABC):
    """A record, in memory or on disk."""

    header: RecordHeader

    @abstractmethod
    def load(self, start: int = 0, stop: int | None = None) -> Record:
        """Load samples start .. stop (to the end of the record by default) into memory.

        Raises
        ------
        InputError : samples that are not finite numbers, a truncated file.
        """

    def pieces(self, longest: int) -> Iterator[Record]:
        """The record in consecutive pieces; periodic records are cut between periods.

        longest : maximum number of samples of a piece. The last piece has one sample more if a single sample would
            otherwise remain.
        """
        step = longest
        if period := self.header.period_samples:
            if period > longest:
                words = f"expected periods of at most {longest} samples, to be read in pieces"
                raise self.header.error("period_s", words)
            step = longest // period * period
        for start, stop in ranges(self.header.samples, step):
            yield self.load(start, stop)


@dataclass(frozen=True, eq=False)
class Record(RecordSource):
    """A record in memory.

    u : (samples, n_u) commanded volts, held between samples; y : (samples, n_y); floor : (samples, 3) m/s or None.
    """

    header: RecordHeader
    u: np.ndarray
    y: np.ndarray
    floor: np.ndarray | None = None

    def __post_init__(self) -> None:
        h = self.header
        if self.floor is None and h.floor_names:
            raise InputError("floor channels are named but there are no floor samples", field=f"record {h.name}: floor")
        columns = {"u": h.u_names, "y": h.y_names} | ({} if self.floor is None else {"floor": h.floor_names})
        for role, names in columns.items():
            array, shape = np.asarray(getattr(self, role), float), (h.samples, len(names))
            field = f"record {h.name}: {role}"
            if array.shape != shape:
                words = f"expected shape {shape}: {h.samples} samples of {len(names)} channels"
                raise InputError(words, field=field, value=array.shape)
            require_finite(array, names, field)
            object.__setattr__(self, role, array)

    @property
    def time(self) -> np.ndarray:
        """(samples,) s on the campaign's clock."""
        return self.header.start_s + np.arange(self.header.samples) / self.header.sample_rate_Hz

    def load(self, start: int = 0, stop: int | None = None) -> Record:
        stop = self.header.samples if stop is None else stop
        if (start, stop) == (0, self.header.samples):
            return self
        floor = None if self.floor is None else self.floor[start:stop]
        return Record(self.header.part(start, stop), self.u[start:stop], self.y[start:stop], floor)


class Portion(RecordSource):
    """Samples start .. stop of another record, loaded on demand."""

    def __init__(self, whole: RecordSource, start: int, stop: int):
        self.whole, self.start, self.stop = whole, start, stop
        self.header = whole.header.part(start, stop)

    def load(self, start: int = 0, stop: int | None = None) -> Record:
        stop = self.header.samples if stop is None else stop
        return self.whole.load(self.start + start, self.start + stop)


@dataclass(frozen=True, eq=False)
class Campaign:
    """Records of one rig.

    rig : name of the rig; records : in order; source : file from which they were read; notes : assumptions and repairs
    of the reader, one sentence each.

    Raises
    ------
    InputError : no record; records that differ in channels, units or sample rate.
    """

    rig: str
    records: tuple[RecordSource, ...]
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.records:
            raise InputError("expected at least one record", field="records")
        first = self.records[0].header
        for field in ("sample_rate_Hz", "u_names", "y_names", "u_unit", "y_unit"):
            usual = getattr(first, field)
            for record in self.records:
                if getattr(record.header, field) != usual:
                    raise record.header.error(field, f"expected {usual!r} as in record {first.name}")

    @property
    def sample_rate_Hz(self) -> float:
        """Sample rate of all records."""
        return self.records[0].header.sample_rate_Hz

    @property
    def u_names(self) -> tuple[str, ...]:
        """Names of the inputs of all records."""
        return self.records[0].header.u_names

    @property
    def y_names(self) -> tuple[str, ...]:
        """Names of the outputs of all records."""
        return self.records[0].header.y_names

    @property
    def y_unit(self) -> str:
        """Unit of the outputs of all records."""
        return self.records[0].header.y_unit

    def named(self, name: str) -> RecordSource:
        """The record with this name."""
        for record in self.records:
            if record.header.name == name:
                return record
        raise InputError(f"expected one of {[r.header.name for r in self.records]}", field="record", value=name)

    def only(self, names: tuple[str, ...]) -> Campaign:
        """Campaign with only the named records."""
        return replace(self, records=tuple(self.named(name) for name in names))


def in_short(notes: tuple[str, ...]) -> tuple[str, ...]:
    """Notes of a campaign, with equal notes on several records merged into one line."""
    of: dict[str, list[str]] = {}
    for note in notes:
        head, colon, text = note.partition(": ")
        named = colon and head.startswith("record ")
        of.setdefault(text if named else note, []).append(head.removeprefix("record ") if named else "")
    return tuple(
        text if names == [""] else f"record{'s' if len(names) > 1 else ''} {', '.join(names)}: {text}"
        for text, names in of.items()
    )


def digest(campaign: Campaign, longest: int = 1 << 20) -> str:
    """SHA-256 of all headers and samples, for provenance; independent of the file format.

    longest : maximum number of samples loaded at once. Longer records are hashed piece by piece, so their digest
        depends on this value.
    """
    total = hashlib.sha256(campaign.rig.encode())
    for record in campaign.records:
        total.update(repr(record.header).encode())
        for start, stop in ranges(record.header.samples, longest):
            piece = record.load(start, stop)
            for array in (piece.u, piece.y, piece.floor):
                if array is not None:
                    total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()
