"""Size of values in characters and entries, for the bounds of stores."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, partial
from typing import Any, Final


def size_of(value: object) -> int:
    """Return the number of characters and entries in a value, about its size as JSON.

    Fields of dataclasses with their defaults do not count.
    """
    return _counter_of(type(value))(value)


def _find_counter(kind: Any) -> Callable[[Any], int]:
    if issubclass(kind, (str, bytes)):
        return len
    if issubclass(kind, Mapping):
        return _size_of_mapping
    if issubclass(kind, (tuple, list, set, frozenset)):
        return _size_of_items
    if is_dataclass(kind):
        return partial(_size_of_fields, tuple((one.name, one.default) for one in fields(kind)))
    return lambda _: 1


#: How to count a value of a type. The size of each submitted spec is computed, and checks of
#: abstract classes would take most of that time. Typed, because mypy does not accept a type as an
#: argument of a cache.
_counter_of: Final[Callable[[Any], Callable[[Any], int]]] = cache(_find_counter)


def _size_of_mapping(value: Mapping[Any, Any]) -> int:
    if not value:
        return 0
    return len(value) + sum(size_of(key) + size_of(item) for key, item in value.items())


def _size_of_items(value: Any) -> int:
    return len(value) + sum(map(size_of, value)) if value else 0


def _size_of_fields(declared: tuple[tuple[str, object], ...], value: object) -> int:
    size = 0
    for name, default in declared:
        item = getattr(value, name)
        if item is not default:
            size += _counter_of(type(item))(item)
    return size
