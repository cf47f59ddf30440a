"""Reading of TOML and JSON files, with each error reported as one readable line."""

from __future__ import annotations

import difflib
import json
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from avis_ctrl.errors import InputError

Content = TypeVar("Content", bound=BaseModel)
_UNITS = (
    "kg g t lb m mm cm um in N kN mN Nm Ns Nms kNs per rad deg V mV kV Hz kHz rtHz s ms us s2 Vs Vs2 kgm2 "
    "gmm2 kgmm2 gcm2"
)

# An unknown key, in a pydantic model and in a dataclass.
_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
# Wording of pydantic, such as "Input should be greater than or equal to 1", replaced by that of these messages.
_PLAIN = (
    ("^Input should be ", "expected "),
    ("expected a valid number", "expected a number"),
    ("expected a valid integer", "expected a whole number"),
    ("expected a valid string", "expected text in quotes"),
    ("expected a valid (list|tuple)", "expected a list in square brackets"),
    ("expected a valid boolean", "expected true or false"),
    (r"expected greater than or equal to (\S+)", r"expected a number, \1 or more"),
    (r"expected less than or equal to (\S+)", r"expected a number, \1 or less"),
    ("expected (greater|less) than", r"expected a number \1 than"),
    (r"^(?:List|Tuple) should have (.* items?) after validation, not (\d+)", r"expected \1; the list has \2"),
)


class Section(BaseModel):
    """A section of a file: only the declared keys, each of its declared type."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class Values:
    """Base of a dataclass that a section of a file is read into: only the declared keys.

    The types of its fields (`key_types`) say what is read; objects made in the program are not checked.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", allow_inf_nan=False)


def validated(model: type[Content], content: object, file: object = None) -> Content:
    """Content validated against a model. Raises InputError, which names the file if it is given."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        complaint = first_complaint(error, model)
        raise (complaint.in_file(file) if file is not None else complaint) from None


def first_complaint(error: ValidationError, model: type[BaseModel]) -> InputError:
    """The most informative validation error, as an `InputError` with field, value and what was expected.

    `model` is the model of the content; an unknown key is compared with its keys.
    """
    # An unknown key explains the missing key next to it, so it comes first.
    problems = error.errors()
    problem = min(problems, key=lambda one: one["type"] not in _UNKNOWN)
    *parents, last = problem["loc"] or ("file",)
    field = dotted(problem["loc"])
    if problem["type"] in _UNKNOWN:
        inner = _section_at(model, parents)
        known = list(keys_of(inner)) if inner else []
        value = None if isinstance(problem["input"], (dict, list)) else problem["input"]
        absent = [str(one["loc"][-1]) for one in problems if one["type"] == "missing" and [*one["loc"][:-1]] == parents]
        return InputError(_unknown_key(str(last), absent, known), field=field, value=value)
    if problem["type"] == "missing":
        kind = "section" if _section_at(model, [*parents, last]) else "key"
        return InputError(f"this {kind} is missing", field=field)
    value = problem["input"]
    if problem["type"] in ("model_type", "dict_type", "model_attributes_type", "dataclass_type"):
        return InputError("expected a section of keys", field=field, value=value)
    words = problem["msg"].removeprefix("Value error, ")
    for pattern, plain in _PLAIN:
        words = re.sub(pattern, plain, words)
    if problem["type"] == "float_type" and isinstance(value, str):
        words += " without quotes and without unit"
    return InputError(words, field=field, value=value)


def dotted(place: Sequence[int | str]) -> str:
    """("isolator", 1, "position_m") as isolator[2].position_m, counted from 1 as in the sources."""
    words = (
        f"[{part + 1}]" if isinstance(part, int) else f".{part if part.isprintable() else repr(part)}" for part in place
    )
    return "".join(words).lstrip(".")


def _unknown_key(key: str, absent: Sequence[str], known: Sequence[str]) -> str:
    """Suggested replacement of an unknown key: preferably one of the missing keys `absent`, else a `known` key."""
    if same := [name for name in known if _stem(name) == _stem(key)]:
        return f"the unit in this key is wrong; expected {same[0]}"
    for names in (absent, known):
        if near := difflib.get_close_matches(key, names, n=1):
            return f"unknown key; did you mean {near[0]}?"
    return f"unknown key; expected one of {', '.join(known)}"


def _stem(key: str) -> str:
    """The key without its unit: "mass_kg" and "mass_g" are both "mass"."""
    parts = key.split("_")
    while len(parts) > 1 and parts[-1] in _UNITS.split():
        parts.pop()
    return "_".join(parts)


def keys_of(model: type[Any]) -> dict[str, Any]:
    """Annotation of each key of a section, which is a `Section` or a dataclass of `Values`."""
    if issubclass(model, BaseModel):
        return {name: one.annotation for name, one in model.model_fields.items()}
    found, annotations = {}, get_type_hints(model, include_extras=True)
    for one in fields(model):
        notes = [note for note in get_args(annotations[one.name]) if isinstance(note, FieldInfo)]
        if not any(note.exclude for note in notes):
            found[next((note.alias for note in notes if note.alias), one.name)] = annotations[one.name]
    return found


def section_in(annotation: Any) -> type[Any] | None:
    """The section in an annotation such as list[Section] or Section | None."""
    if isinstance(annotation, type) and (issubclass(annotation, BaseModel) or is_dataclass(annotation)):
        return annotation
    return next((found for part in get_args(annotation) if (found := section_in(part))), None)


def _section_at(model: type[Any], place: Sequence[int | str]) -> type[Any] | None:
    """The section at a place of the content; None for a value."""
    found: type[Any] | None = model
    for part in place:
        if isinstance(part, str) and found is not None:
            found = section_in(keys_of(found).get(part))
    return found


def read_toml(path: Path, expected: str) -> dict[str, Any]:
    """Content of a TOML file. expected : description of the expected file, for messages.

    Raises
    ------
    InputError : the file does not exist, cannot be read, or is not TOML in UTF-8; one line that names the file.
    """
    return _read(path, tomllib.loads, "TOML", expected)


def read_json(path: Path, form: str, expected: str = "a file of avis design") -> dict[str, Any]:
    """Content of a JSON file whose key `format` must be `form`; errors as in `read_toml`."""
    content = _read(path, json.loads, "JSON", expected)
    found = content.get("format") if isinstance(content, dict) else None
    if found != form:
        raise InputError(f"expected {form!r}, {expected}", file=path, field="format", value=found)
    return content


def _read(path: Path, parse: Callable[[str], Any], language: str, expected: str) -> Any:
    text = ""
    try:
        # Editors on Windows may start a file with a byte-order mark.
        text = path.read_text(encoding="utf-8-sig")
        return parse(text)
    except FileNotFoundError:
        raise InputError(f"no such file; expected {expected}", file=path) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}; expected {expected}", file=path) from None
    except (ValueError, RecursionError) as error:
        said = " ".join(str(error).split())
        raise InputError(f"expected a {language} file in UTF-8; {said}{_cause(said, text)}", file=path) from None


def _cause(said: str, text: str) -> str:
    """The line in which the TOML parser found an error, and the usual cause; empty if it names no line."""
    at = re.search(r"\(at line (\d+), column (\d+)\)$", said)
    if at is None:
        return ""
    whole = text.split("\n")[int(at[1]) - 1]  # the parser counts no other line ends
    line = whole.strip()[:60]
    if re.match(r",\d", whole[int(at[2]) - 1 :]):
        return f": {line!r}; write a decimal point, not a comma"
    if said.startswith("Cannot overwrite a value"):
        return f": {line!r}; a section that occurs several times is written in double brackets, such as [[record]]"
    return f": {line!r}"
