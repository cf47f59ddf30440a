"""Tables of keys as the text of a TOML file; `tomllib` only reads."""

from __future__ import annotations

import json
from typing import Any


def toml_text(table: dict[str, Any]) -> str:
    """Keys, then sections with their subsections, then lists of sections; sections without keys are omitted."""
    return "\n".join("\n".join(lines) + "\n" for lines in _sections("", table))


def toml_value(value: Any) -> str:
    """A value on one line; a table as an inline table, an array as a list."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(key)} = {toml_value(one)}" for key, one in value.items()) + " }"
    # JSON and TOML write numbers, booleans, strings and lists alike, except for one character that TOML requires
    # escaped.
    return json.dumps(value, ensure_ascii=False, default=lambda array: array.tolist()).replace("\x7f", "\\u007f")


def _sections(title: str, table: dict[str, Any]) -> list[list[str]]:
    """Lines of a section and of its subsections."""
    inner = {key: value for key, value in table.items() if isinstance(value, dict)}
    many = {
        key: value for key, value in table.items() if value and isinstance(value, list) and isinstance(value[0], dict)
    }
    plain = _lines({key: value for key, value in table.items() if key not in inner and key not in many})
    found = [[f"[{title}]", *plain] if title else plain] if plain else []
    before = f"{title}." if title else ""
    for key, value in inner.items():
        found += _sections(before + _key(key), value)
    return found + [[f"[[{before}{_key(key)}]]", *_lines(one)] for key, value in many.items() for one in value]


def _lines(table: dict[str, Any]) -> list[str]:
    return [f"{_key(key)} = {toml_value(value)}" for key, value in table.items()]


def _key(key: str) -> str:
    return key if key.replace("_", "").isalnum() and key.isascii() else toml_value(key)
