"""Conversion of frozen dataclasses to plain JSON values and back, without pydantic.

The values have been validated before. This module checks only their shape, because the two ends may
have different versions of rosrm or of a plugin.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


def to_plain(value: Any) -> Any:
    """Return a dataclass, mapping, sequence or scalar as JSON; raise `TypeError` for others."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Enum):
        return value.value
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [to_plain(item) for item in value]
    raise TypeError(f"a value of type {type(value).__name__} cannot be carried as JSON")


def from_plain(wanted: type[T], plain: Mapping[str, Any]) -> T:
    """Return a dataclass from plain values; raise `ValueError` that names the field."""
    hints = get_type_hints(wanted)
    known = {f.name: f for f in fields(wanted) if f.init}  # type: ignore[arg-type]
    strange = sorted(set(plain) - set(known))
    if strange:
        raise ValueError(f"unknown {', '.join(strange)}; allowed: {', '.join(known) or 'nothing'}")
    missing = [
        name
        for name, f in known.items()
        if name not in plain and f.default is MISSING and f.default_factory is MISSING
    ]
    if missing:
        raise ValueError(f"{', '.join(missing)} is missing")
    return wanted(**{name: _value(hints[name], plain[name], name) for name in plain})


def _value(hint: Any, plain: Any, where: str) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _one_of(arguments, plain, where)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping(arguments, plain, where)
    if origin in (list, set, frozenset, tuple):
        return _sequence(origin, arguments, plain, where)
    if not isinstance(hint, type):
        return plain  # Any, Literal and the like: unchanged
    return _scalar(hint, plain, where)


def _one_of(choices: tuple[Any, ...], plain: Any, where: str) -> Any:
    if plain is None:
        return None
    first = next((choice for choice in choices if choice is not type(None)), Any)
    for choice in choices:
        try:
            return _value(choice, plain, where)
        except ValueError:
            continue
    return _value(first, plain, where)


def _mapping(arguments: tuple[Any, ...], plain: Any, where: str) -> Any:
    if not isinstance(plain, Mapping):
        raise _unfit(where, "a mapping", plain)
    hint = arguments[1] if len(arguments) == 2 else Any
    return {key: _value(hint, item, f"{where}.{key}") for key, item in plain.items()}


def _sequence(origin: Any, arguments: tuple[Any, ...], plain: Any, where: str) -> Any:
    if isinstance(plain, str) or not isinstance(plain, (list, tuple)):
        raise _unfit(where, "a list", plain)
    if origin is tuple and Ellipsis not in arguments and len(arguments) == len(plain):
        hints = arguments
    else:
        hints = (arguments[0] if arguments else Any,) * len(plain)
    return origin(_value(hint, item, where) for hint, item in zip(hints, plain, strict=True))


def _scalar(hint: type[Any], plain: Any, where: str) -> Any:
    if is_dataclass(hint):
        if not isinstance(plain, Mapping):
            raise _unfit(where, "a mapping", plain)
        return from_plain(hint, plain)
    if issubclass(hint, Path) or issubclass(hint, Enum):
        try:
            return hint(plain)
        except TypeError:
            raise _unfit(where, "text", plain) from None
    if hint is float and isinstance(plain, int) and not isinstance(plain, bool):
        return float(plain)
    if hint is type(None) and plain is not None:
        raise _unfit(where, "null", plain)
    known = hint in (bool, int, float, str)
    if known and (not isinstance(plain, hint) or (hint is int and isinstance(plain, bool))):
        raise _unfit(where, hint.__name__, plain)
    return plain


def _unfit(where: str, wanted: str, plain: Any) -> ValueError:
    return ValueError(f"{where}: {wanted} is required, not {plain!r}")
