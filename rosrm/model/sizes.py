"""Size of values in letters and entries, for the bounds of what others may store."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, Final


def size_of(value: object) -> int:
    """Return the number of letters and entries in a value, about its bytes as JSON.

    Fields of dataclasses with their defaults do not count.
    """
    if isinstance(value, (str, bytes)):
        return len(value)
    if isinstance(value, Mapping):
        return len(value) + sum(size_of(key) + size_of(item) for key, item in value.items())
    if isinstance(value, (tuple, list, set, frozenset)):
        return len(value) + sum(map(size_of, value))
    if is_dataclass(value):
        found = ((getattr(value, name), default) for name, default in _fields_of(type(value)))
        return sum(size_of(item) for item, default in found if item is not default)
    return 1


def _find_fields(kind: Any) -> tuple[tuple[str, object], ...]:
    return tuple((field.name, field.default) for field in fields(kind))


#: Typed, because mypy does not accept a type as an argument of a cache.
_fields_of: Final[Callable[[Any], tuple[tuple[str, object], ...]]] = cache(_find_fields)
