"""User-defined effects from a Python file: loaded, registered, and tested before a search relies on them."""

from __future__ import annotations

import hashlib
import sys
import traceback
import types
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avis_ctrl.errors import AvisError, InputError
from avis_ctrl.gap.effects.base import SETTINGS, Effect, EffectParameter, restore
from avis_ctrl.gap.effects.library import library
from avis_ctrl.gap.table_model import TableModel, active


@dataclass(frozen=True)
class OwnEffects:
    """Effects that a file has registered. sha256 : of its bytes as executed."""

    path: Path
    names: tuple[str, ...]
    sha256: str


def load_effects(path: str | Path) -> OwnEffects:
    """Run a Python file that registers effects. Its code runs with the user's rights.

    Raises
    ------
    InputError : no such file, a file that does not run, or one that registers nothing.
    """
    path = Path(path)
    try:
        source = path.read_bytes()
    except OSError as error:
        raise InputError(f"expected a Python file ({error.strerror or error})", file=path) from None
    before = library()
    module = types.ModuleType(f"avis_effects_{path.stem}")
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses and pickle look there
    try:
        exec(compile(source, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        restore(before)
        if isinstance(error, InputError):
            raise error.in_file(path) from None
        raise InputError(f"expected a Python file that runs: {one_line(error, path)}", file=path) from None
    names = tuple(name for name, effect in library().items() if before.get(name) is not effect)
    if not names:
        raise InputError("expected a class with @register; it registers no effect", file=path)
    return OwnEffects(path, names, hashlib.sha256(source).hexdigest())


def one_line(error: BaseException, path: Path | None = None) -> str:
    """An error of a user's file in one line, with the line number if known."""
    line = getattr(error, "lineno", None) if isinstance(error, SyntaxError) else None
    for frame in traceback.extract_tb(error.__traceback__):
        if path is not None and frame.filename == str(path):
            line = frame.lineno
    text = " ".join(str(error.msg if isinstance(error, SyntaxError) else error).split())
    return f"{'' if line is None else f'line {line}: '}{type(error).__name__}{': ' if text else ''}{text}"


def try_out(own: OwnEffects, model: TableModel) -> None:
    """Request places and parameters from each effect of a file, and apply it to a table.

    Raises
    ------
    InputError : an effect that fails, lacks its texts, or gives a response that is not finite.
    """
    known = library()
    for name in own.names:
        try:
            _tried(known[name], model)
        except AvisError as error:
            raise InputError(str(error), file=own.path, field=name) from None
        except Exception as error:
            raise InputError(
                f"expected an effect that runs: {one_line(error, own.path)}", file=own.path, field=name
            ) from None


def _tried(effect: Effect, model: TableModel) -> None:
    if not effect.name.isidentifier():
        raise InputError("expected letters, digits and _", field="name", value=effect.name)
    for field in ("title", "looks_like"):
        if not isinstance(getattr(effect, field, None), str):
            raise InputError("expected a few words", field=field)
    for method in ("places", "parameters"):
        if getattr(type(effect), method) is getattr(Effect, method) and not (method == "places" and effect.at):
            raise InputError("expected the method", field=method)
    for method in ("change", "rig_changes"):
        if effect.nonlinear and getattr(type(effect), method) is not getattr(Effect, method):
            raise InputError(
                "expected no such method in an effect that depends on amplitude or time; express all of it as force or "
                "volts",
                field=method,
            )
    omega = 2 * np.pi * np.array(SETTINGS.tried_Hz)
    for place in effect.places(model):
        parameters = effect.parameters(model, place)
        for one in parameters:
            _require_range(one)
        for start in effect.starts(model, place)[:1]:
            values = [
                float(value + one.size * (one.linear and value + one.size <= one.high))
                for one, value in zip(parameters, start, strict=True)
            ]
            added = model.with_effect(active(effect, model, place, values))
            if not np.all(np.isfinite(added.response(omega))):
                raise InputError("expected a finite response", field=f"place {place}", value=values)
            effect.reported(
                model,
                place,
                dict(zip((one.name for one in parameters), values, strict=True)),
                np.zeros((len(values), len(values))),
            )


def _require_range(one: EffectParameter) -> None:
    if not (np.isfinite([one.low, one.high]).all() and one.low < one.high):
        raise InputError("expected low below high, both finite", field=one.name, value=(one.low, one.high))
    if not 0 < one.size < np.inf:
        raise InputError("expected a positive size", field=one.name, value=one.size)
    if not one.linear and not one.grid:
        raise InputError("expected a grid of values, for it is not linear", field=one.name)
    if one.linear and not one.low <= one.none <= one.high:
        raise InputError(
            "expected its value without the effect (none) within low and high", field=one.name, value=one.none
        )
