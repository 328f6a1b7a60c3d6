"""Copy of a plugin's whole answer in exactly its declared types."""

from __future__ import annotations

import math
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import fields, is_dataclass
from functools import cache
from itertools import islice
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    NoReturn,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from rosrm.errors import PluginError, plain_text

T = TypeVar("T")

#: Maximum number of values in one answer, and of characters of a text in it.
MOST_VALUES: Final = 100_000
LONGEST_VALUE: Final = 1 << 16


def whole(value: object, hint: Any, where: str = "it") -> Any:
    """Return a copy of an answer in exactly the declared types, with all its parts.

    Each part is read once. A subclass of a text, number or dataclass, or a lazy sequence or
    mapping, would otherwise run the plugin's code outside of the guard, or answer otherwise there.

    Args:
        value: of a plugin, with any contents.
        hint: a type as in an annotation. Values of other types than texts, numbers, dataclasses and
            collections stay as they are.
        where: path of the value, for the message.

    Raises:
        PluginError: a part has another type; the text has the path to it.
    """
    return _Copy().of(value, hint, where)


def exact(value: object) -> Any:
    """Return a text or number as one of its base type, whose methods are no plugin's."""
    for kind, convert in _EXACT.items():
        if issubclass(type(value), kind):
            return convert(value)
    return value


def exact_fields(value: Any, kind: type[T]) -> T:
    """Return a dataclass of exactly this kind, with `exact` fields, whose types are unchecked."""
    return kind(*(exact(getattr(value, one.name)) for one in fields(kind)))  # type: ignore[arg-type]


#: The conversion of each base type, with which a subclass cannot interfere.
_EXACT: Final[Mapping[type[Any], Callable[[Any], Any]]] = {
    bool: lambda value: value,
    str: str.__str__,
    int: int.__int__,
    float: float.__float__,
}


class _Copy:
    """Copy of one answer, whose values are counted."""

    def __init__(self) -> None:
        self._left = MOST_VALUES

    def of(self, value: Any, hint: Any, where: str) -> Any:
        self._left -= 1
        if self._left < 0:
            raise PluginError(f"{where} has more than {MOST_VALUES} values")
        origin, arguments = get_origin(hint), get_args(hint)
        if hint is Any or hint is object or isinstance(hint, str):
            return value
        if origin is Annotated:
            return self.of(value, arguments[0], where)
        if origin is Literal:
            return _one_of(exact(value), hint, where)
        if origin in (Union, types.UnionType):
            return self._any(value, arguments, where)
        if origin is type or hint is type:
            return value if isinstance(value, type) else _refuse(where, value, "a class")
        if hint is Callable or origin is Callable or origin is getattr(Callable, "__origin__", 0):
            return value if callable(value) else _refuse(where, value, "a function")
        if isinstance(origin, type):
            return self._items(value, origin, arguments, where)
        return self._plain(value, hint, where)

    def _any(self, value: Any, hints: Sequence[Any], where: str) -> Any:
        faults = []
        for one in hints:
            try:
                return self.of(value, one, where)
            except PluginError as fault:
                faults.append(fault)
        raise faults[0]

    def _items(self, value: Any, origin: type[Any], hints: Sequence[Any], where: str) -> Any:
        kind = type(value)
        if issubclass(kind, str | bytes) or not issubclass(kind, origin):
            _refuse(where, value, f"a {origin.__name__}")
        if issubclass(origin, Mapping):
            return {
                (at := self.of(key, hints[0], f"a key of {where}")): self.of(
                    item, hints[1], f"{where}[{at!r:.60}]"
                )
                for key, item in value.items()
            }
        if issubclass(origin, tuple) and hints[-1:] != (Ellipsis,):
            parts = tuple(islice(value, len(hints) + 1))
            if len(parts) != len(hints):
                raise PluginError(f"{where} does not have exactly {len(hints)} values")
            return tuple(
                self.of(item, hint, f"{where}[{index}]")
                for index, (item, hint) in enumerate(zip(parts, hints, strict=True))
            )
        if issubclass(origin, Sequence | AbstractSet):
            found = (self.of(item, hints[0], f"{where}[{at}]") for at, item in enumerate(value))
            return _MADE.get(origin, tuple)(found)
        return value  # an iterator can be read only once: its reader checks it

    def _plain(self, value: Any, kind: Any, where: str) -> Any:
        if kind is None or kind is type(None):
            return None if value is None else _refuse(where, value, "None")
        if not isinstance(kind, type):
            return value
        if getattr(kind, "_is_protocol", False):
            return value if value is not None else _refuse(where, value, kind.__name__)
        is_number = kind in (int, float)
        accepted = (int, float) if kind is float else kind
        if (is_number and type(value) is bool) or not issubclass(type(value), accepted):
            _refuse(where, value, kind.__name__)
        if is_dataclass(kind):
            hints = _hints(kind)
            return kind(**{
                name: self.of(getattr(value, name), hint, f"{where}.{name}".removeprefix("."))
                for name, hint in hints.items()
            }) if hints else value  # fmt: skip
        found = exact(value)
        if type(found) is float and not math.isfinite(found):
            _refuse(where, found, "a finite number")
        if type(found) is str:
            _check_text(found, where)
        return found


#: Types of copies of collections; any other sequence becomes a tuple.
_MADE: Final[Mapping[type[Any], Callable[[Iterable[Any]], Any]]] = {
    list: list, set: set, frozenset: frozenset, AbstractSet: frozenset,
}  # fmt: skip


@cache
def _hints(kind: type[Any]) -> Mapping[str, Any]:
    """Return the declared type of each field; of fields whose types only a checker knows, none."""
    try:
        hints = get_type_hints(kind, include_extras=True)
    except NameError:
        return {}
    return {one.name: hints[one.name] for one in fields(kind) if one.init}


def _one_of(value: Any, hint: Any, where: str) -> Any:
    if any(type(value) is type(one) and value == one for one in get_args(hint)):
        return value
    return _refuse(where, value, hint)


def _check_text(text: str, where: str) -> None:
    if len(text) > LONGEST_VALUE:
        raise PluginError(f"{where} has {len(text)} characters; allowed: {LONGEST_VALUE}")
    try:
        text.encode()
    except UnicodeEncodeError:
        raise PluginError(f"{where} has a character that UTF-8 cannot hold") from None


def _refuse(where: str, value: object, wanted: object) -> NoReturn:
    shown = plain_text(repr(value)[:200])[:100]
    required = wanted if isinstance(wanted, str) else ", ".join(map(repr, get_args(wanted)))
    raise PluginError(f"{where} is {shown}; {required} is required")
