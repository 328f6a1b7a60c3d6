"""Check of a plugin's whole answer against its declared type."""

from __future__ import annotations

import math
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import fields, is_dataclass
from functools import cache
from itertools import repeat
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

from rosrm.errors import PluginError, plain_text

#: Most values in one answer, and most letters of a text in it.
MOST_VALUES: Final = 100_000
LONGEST_VALUE: Final = 1 << 16


def fault_of(value: object, hint: Any, where: str = "") -> str:
    """Return why a value is not of its declared type, with the path to the fault; "": it is.

    Args:
        value: of a plugin, with any contents.
        hint: a type as in an annotation.
        where: path of the value, for the message.
    """
    return _Check().fault(value, hint, where)


def whole(value: object, hint: Any, where: str = "it") -> Any:
    """Return an answer that has its declared type in all its parts; raise `PluginError`."""
    fault = fault_of(value, hint, where)
    if fault:
        raise PluginError(fault)
    return value


class _Check:
    """Check of one answer, whose values are counted."""

    def __init__(self) -> None:
        self._left = MOST_VALUES

    def fault(self, value: Any, hint: Any, where: str) -> str:  # noqa: PLR0911 - one for each form
        self._left -= 1
        if self._left < 0:
            return f"{where} has more than {MOST_VALUES} values"
        origin, arguments = get_origin(hint), get_args(hint)
        if hint is Any or hint is object or isinstance(hint, str):
            return ""
        if origin is Annotated:
            return self.fault(value, arguments[0], where)
        if origin is Literal:
            return "" if _is_one_of(value, arguments) else _wrong(where, value, hint)
        if origin in (Union, types.UnionType):
            return self._any(value, arguments, where)
        if origin is type or hint is type:
            return "" if isinstance(value, type) else _wrong(where, value, "a class")
        if hint is Callable or origin is Callable or origin is getattr(Callable, "__origin__", 0):
            return "" if callable(value) else _wrong(where, value, "a function")
        if isinstance(origin, type):
            return self._items(value, origin, arguments, where)
        return self._plain(value, hint, where)

    def _any(self, value: Any, hints: Sequence[Any], where: str) -> str:
        faults = [self.fault(value, one, where) for one in hints]
        return "" if "" in faults else faults[0]

    def _items(self, value: Any, origin: type[Any], hints: Sequence[Any], where: str) -> str:
        if isinstance(value, str | bytes) or not isinstance(value, origin):
            return _wrong(where, value, f"a {origin.__name__}")
        if issubclass(origin, Mapping):
            pairs = ((f"{where}[{key!r:.60}]", key, item) for key, item in value.items())
            return next(
                filter(None, (
                    self.fault(key, hints[0], f"a key of {where}") or self.fault(item, hints[1], at)
                    for at, key, item in pairs
                )), "",
            )  # fmt: skip
        if issubclass(origin, tuple) and hints[-1:] != (Ellipsis,):
            if len(value) != len(hints):
                return f"{where} has {len(value)} values; {len(hints)} are required"
            each: Iterable[Any] = hints
        elif issubclass(origin, Sequence | AbstractSet):
            each = repeat(hints[0])
        else:  # an iterator can be read only once: its reader checks it
            return ""
        found = (
            self.fault(item, hint, f"{where}[{index}]")
            for index, (item, hint) in enumerate(zip(value, each))  # noqa: B905 - the types repeat
        )
        return next(filter(None, found), "")

    def _plain(self, value: Any, kind: Any, where: str) -> str:
        if kind is None or kind is type(None):
            return "" if value is None else _wrong(where, value, "None")
        if not isinstance(kind, type):
            return ""
        accepted = (int, float) if kind is float else kind
        is_bool = isinstance(value, bool) and kind in (int, float)
        if getattr(kind, "_is_protocol", False):
            return "" if value is not None else _wrong(where, value, kind.__name__)
        if is_bool or not isinstance(value, accepted):
            return _wrong(where, value, kind.__name__)
        if isinstance(value, float) and not math.isfinite(value):
            return _wrong(where, value, "a finite number")
        if isinstance(value, str):
            return _fault_of_text(value, where)
        if is_dataclass(kind):
            found = (
                self.fault(getattr(value, name), hint, f"{where}.{name}".removeprefix("."))
                for name, hint in _hints(kind).items()
            )
            return next(filter(None, found), "")
        return ""


@cache
def _hints(kind: type[Any]) -> Mapping[str, Any]:
    """Return the declared type of each field; of fields whose types only a checker knows, none."""
    try:
        hints = get_type_hints(kind, include_extras=True)
    except NameError:
        return {}
    return {one.name: hints[one.name] for one in fields(kind)}


def _is_one_of(value: Any, allowed: Sequence[Any]) -> bool:
    return any(type(value) is type(one) and value == one for one in allowed)


def _fault_of_text(text: str, where: str) -> str:
    if len(text) > LONGEST_VALUE:
        return f"{where} has {len(text)} letters; allowed: {LONGEST_VALUE}"
    try:
        text.encode()
    except UnicodeEncodeError:
        return f"{where} has a character that UTF-8 cannot hold"
    return ""


def _wrong(where: str, value: object, wanted: object) -> str:
    shown = plain_text(repr(value)[:200])[:100]
    required = wanted if isinstance(wanted, str) else ", ".join(map(repr, get_args(wanted)))
    return f"{where} is {shown}; {required} is required"
