"""Functions shared by all readers of measurement files: tolerant fields, units, and one-line errors for any damage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from avis_ctrl.errors import InputError

STANDARD_GRAVITY = 9.80665  # m/s^2, ISO 80000-3
PREFIXES = {"": 1.0, "c": 1e-2, "m": 1e-3, "u": 1e-6, "n": 1e-9, "k": 1e3}
# Label -> (SI unit, factor to it).
UNITS: dict[str, tuple[str, float]] = {
    f"{prefix}{unit}": (unit, factor) for unit in ("V", "m", "m/s", "m/s^2", "N") for prefix, factor in PREFIXES.items()
}
UNITS |= {f"in{per}": (f"m{per}", 0.0254) for per in ("", "/s", "/s^2")}
UNITS |= dict.fromkeys(("Volt", "Volts"), ("V", 1.0)) | dict.fromkeys(("g", "gn"), ("m/s^2", STANDARD_GRAVITY))
UNITS["lbf"] = ("N", 4.4482216152605)
INPUT_UNITS, OUTPUT_UNITS, FLOOR_UNITS = ("V", "N"), ("V", "m/s", "m/s^2", "m"), ("m/s",)
INPUT_NAME = r"u_?\w*|a[xyz]?\d+"  # usual names of inputs
ALLOWED = {"u": INPUT_UNITS, "y": OUTPUT_UNITS, "floor": FLOOR_UNITS}


@dataclass(frozen=True)
class ReadingSettings:
    """most_bytes : largest file that is read whole into memory [bytes]: text and compressed numbers need about twice as
    much during conversion.
    """

    most_bytes: int = 1_500_000_000


SETTINGS = ReadingSettings()


def short(error: BaseException) -> str:
    """First line of a library's message, cut to a readable length."""
    lines = str(error).strip().splitlines()
    text = lines[0] if lines else type(error).__name__
    return text if len(text) <= 140 else text[:137] + "..."


@contextmanager
def reading(path: object, what: str = "the file") -> Iterator[None]:
    """Add the file name to errors raised inside, including those of the disk and of memory.

    Exceptions of h5py on damaged files become an InputError where h5py is called (`stored.access`), so that a bug in
    this package is not reported as a damaged file. Overflows give no warning here; the results are rejected as not
    finite.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            yield
    except InputError as error:
        if error.file is not None:
            raise
        raise error.in_file(path) from None
    except MemoryError:
        message = "the stated sizes do not fit in memory: the file is damaged, or too large to be read whole"
        raise InputError(message, file=path) from None
    except OSError as error:
        raise InputError(f"{what} cannot be read ({short(error)})", file=path) from error


@contextmanager
def within(where: str) -> Iterator[None]:
    """Add the part of the file, such as "record 00", to InputErrors raised inside."""
    try:
        yield
    except InputError as error:
        if error.file is not None or f"{error.field}:".startswith(f"{where}:"):
            raise
        field = f"{where}: {error.field}" if error.field else where
        raise InputError(error.expected, field=field, value=error.value) from None


def existing_file(path: str | Path) -> Path:
    """The path, if it is a readable file with content.

    Raises
    ------
    InputError : no such file, a directory, an empty file, no permission.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise InputError("expected a file, found a directory", file=path)
        with path.open("rb") as stream:
            if not stream.read(1):
                raise InputError("the file is empty (0 bytes)", file=path)
    except FileNotFoundError:
        raise InputError("no such file", file=path) from None
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot be opened ({short(error)})", file=path) from None
    return path


def require_small(path: Path, size: int | None = None) -> int:
    """Size in bytes of a file (or of its content, if known) that is read whole.

    Raises
    ------
    InputError : more than `ReadingSettings.most_bytes`; only HDF5 campaigns are read in pieces.
    """
    size = path.stat().st_size if size is None else size
    if size > SETTINGS.most_bytes:
        message = (
            f"has {size / 1e9:.3g} GB; this format is read whole, up to {SETTINGS.most_bytes / 1e9:.3g} GB: convert "
            "the file to an HDF5 campaign (/records/00/u and y), which is read in pieces"
        )
        raise InputError(message, file=path)
    return size


def printable(text: str) -> str:
    """A name from a file, printable on one line of a message."""
    return text if text.isprintable() else ascii(text)[1:-1]


def _single(value: Any) -> Any:
    """The value of a scalar, a 0-d array or an array with one element."""
    if isinstance(value, (np.ndarray, np.generic)):
        array = np.asarray(value)
        return array.reshape(-1).tolist()[0] if array.size == 1 and array.dtype.names is None else value
    if isinstance(value, (list, tuple)) and len(value) == 1:
        return _single(value[0])
    return value


def brief(value: Any) -> Any:
    """The value, shortened for messages."""
    if isinstance(value, np.ndarray):
        return f"array of shape {value.shape}, {value.dtype}"
    return value if len(repr(value)) <= 80 else repr(value)[:77] + "..."


def as_number(value: Any, field: str) -> float:
    """A finite real number from a scalar or an array with one element."""
    single = _single(value)
    if isinstance(single, bool) or not isinstance(single, (int, float)):
        raise InputError("expected one number", field=field, value=brief(single))
    try:
        number = float(single)
    except OverflowError:
        number = np.inf
    if not np.isfinite(number):
        raise InputError("expected a finite number", field=field, value=number)
    return number


def as_text(value: Any, field: str) -> str:
    """Text from str or bytes, bare or in an array with one element."""
    single = _single(value)
    if isinstance(single, bytes):
        single = single.decode("utf-8", "replace")
    if not isinstance(single, str):
        raise InputError("expected a text", field=field, value=brief(single))
    return single.strip().rstrip("\0").strip()


def as_names(value: Any, field: str, count: int | None = None) -> tuple[str, ...]:
    """Channel names from an array or list of str or bytes, or from one text (separated by commas for several).

    count : number of channels, if known.
    """
    if isinstance(value, np.ndarray):
        value = value.reshape(-1).tolist()
    if isinstance(value, (list, tuple)):
        names = tuple(as_text(item, field) for item in value)
    else:
        text = as_text(value, field)
        names = (text,) if count == 1 else tuple(part.strip() for part in text.split(","))
    if not all(name and name.isprintable() for name in names):
        raise InputError("expected printable names that are not empty", field=field, value=brief(names))
    if count is not None and len(names) != count:
        message = f"expected one name for each channel; there are {count} channels and {len(names)} names"
        raise InputError(message, field=field, value=brief(names))
    if len(set(names)) != len(names):
        raise InputError("expected different names", field=field, value=brief(names))
    return names


class Unit(NamedTuple):
    """SI unit, and the factor that converts stored numbers to it."""

    si: str
    factor: float


def unit_of(label: str, field: str, allowed: Sequence[str] | None = None) -> Unit:
    """SI unit and factor of a unit label; the spellings m/s^2, m/s2, m/s**2, m/s/s are equivalent.

    Raises
    ------
    InputError : an unknown unit, or a unit not allowed for this quantity.
    """
    text = label.strip().strip("[]()").replace(" ", "").replace("\u00b2", "^2").replace("**", "^")
    text = text.replace("\u00b5", "u").replace("\u03bc", "u").replace("sec", "s").replace("m/s/s", "m/s^2")
    text = text[:-1] + "^2" if text.endswith("s2") else text
    known = UNITS.get(text)
    if known is None or (allowed is not None and known[0] not in allowed):
        units = ", ".join(allowed or OUTPUT_UNITS)
        raise InputError(f"expected a unit of {units} (or mV, mm/s, g, ...)", field=field, value=label)
    return Unit(*known)


def units_of(value: Any, role: str, count: int) -> tuple[str, tuple[float, ...]]:
    """Common SI unit and the factor of each of `count` channels, from one label or one per channel."""
    field = f"{role} unit"
    array = np.asarray(value, object).reshape(-1) if isinstance(value, (np.ndarray, list, tuple)) else [value]
    if len(array) not in (1, count):
        raise InputError(f"expected one unit, or one for each of {count} channels", field=field, value=brief(value))
    units = [unit_of(as_text(item, field), field, ALLOWED[role]) for item in array]
    found = [unit.si for unit in units]
    if len(set(found)) > 1:
        raise InputError("expected one physical quantity for all channels", field=field, value=found)
    factors = tuple(unit.factor for unit in units)
    return found[0], factors * count if len(factors) == 1 else factors


def require(fields: Mapping[str, Any], name: str, expected: str) -> Any:
    """The value of a required field."""
    if name not in fields or fields[name] is None:
        raise InputError(f"missing; expected {expected}", field=name)
    return fields[name]


def stated_period(value: Any, field: str) -> float | None:
    """Period of a record in s; None if empty, NaN or 0, as struct arrays and tables mark records without a period."""
    single = None if isinstance(value, np.ndarray) and value.size == 0 else _single(value)
    none = single is None or (type(single) in (int, float) and (single == 0 or np.isnan(single)))
    return None if none else as_number(single, field)


def is_number(text: str) -> bool:
    """Whether a text is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def numbers(array: Any, field: str) -> np.ndarray:
    """A real array as float64.

    Raises
    ------
    InputError : text, objects, complex numbers or booleans.
    """
    array = np.asarray(array)
    if array.dtype.kind not in "fiu":
        raise InputError("expected real numbers", field=field, value=f"array of {kind_of(array.dtype)}")
    return array.astype(float)


def kind_of(dtype: np.dtype) -> str:
    """Kind of the elements of an array, in words."""
    words = {"O": "objects", "S": "bytes", "U": "text", "c": "complex numbers", "b": "booleans", "V": "structures"}
    return words.get(dtype.kind, str(dtype))
