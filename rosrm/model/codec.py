"""Conversion of dataclasses to plain JSON values and back, driven by their type hints.

Readers are compiled once per type. A dataclass is read from an object, or from a list of its fields
in order (`dataclasses.astuple` as JSON). Each class of a union has a class attribute `KIND`, which
its JSON object has as `kind`. This module does not import pydantic, because the core and the lean
runtimes import it. pydantic checks the files of users.
"""

from __future__ import annotations

import json
import marshal
import types
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache, lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, TypeVar, Union, get_args, get_origin
from typing import get_type_hints as hints_of

from rosrm.errors import PluginError

T = TypeVar("T")
_Convert = Callable[[Any], Any]

_SCALARS: Final = (str, int, float, bool, type(None))
#: Types with values that are valid JSON.
_PLAIN: Final = frozenset(_SCALARS)
#: Annotations of fields that are written unchanged; `json` refuses a value of another type.
_PLAIN_HINTS: Final = ("str", "int", "float", "bool", str, int, float, bool)
#: Format of `marshal` without references, so that equal values have equal bytes.
_MARSHAL: Final = 2
#: Most values of a field that are shared, and most bytes of each.
_MOST_SHARED: Final = 64
_LONGEST_SHARED: Final = 1000
_JSON_OBJECT: Final = ("Mapping[str, Any]", Mapping[str, Any])


def _compiled_once(function: Callable[[Any], T]) -> Callable[[Any], T]:
    return cache(function)  # typed, because mypy accepts no type as argument of a cached function


class ByName:
    """Base class of enums that are written by name, not by value."""


# --- writing ----------------------------------------------------------------------------------


def to_plain(value: Any) -> Any:
    """Return a dataclass, mapping, sequence or scalar as JSON; raise `TypeError` for others."""
    return _writer(type(value))(value)


def fields_to_plain(value: Any, names: Iterable[str]) -> dict[str, Any]:
    """Return some fields of a value as JSON, by name."""
    plain = {name: getattr(value, name) for name in names}
    for name, item in plain.items():
        if type(item) not in _PLAIN:
            plain[name] = _writer(type(item))(item)
    return plain


def _plain(value: object) -> object:
    """Return the JSON equivalent of a read-only mapping or numpy number."""
    if isinstance(value, Mapping):
        return dict(value)
    item = getattr(value, "item", None)
    if callable(item):
        return item()
    raise TypeError(f"{type(value).__name__} is no JSON")


#: Encodes plain values as JSON. Created once, because `json.dumps` with a `default` creates an
#: encoder for each call.
to_json: Final = json.JSONEncoder(default=_plain).encode


@_compiled_once
def _writer(kind: Any) -> _Convert:
    if is_dataclass(kind):
        return _object_writer(kind)
    if issubclass(kind, Enum):
        return attrgetter("_name_" if issubclass(kind, ByName) else "_value_")
    if issubclass(kind, _SCALARS):
        return _unchanged
    if issubclass(kind, Path):
        return str
    if issubclass(kind, Mapping):
        return lambda value: {str(key): to_plain(item) for key, item in value.items()}
    if issubclass(kind, (list, tuple)):
        return lambda value: [to_plain(item) for item in value]
    if issubclass(kind, (set, frozenset)):
        return lambda value: [to_plain(item) for item in sorted(value)]
    raise TypeError(f"a value of type {kind.__name__} cannot be carried as JSON")


def _unchanged(value: Any) -> Any:
    return value


def _object_writer(kind: Any) -> _Convert:
    names = [field.name for field in fields(kind)]
    others = [field.name for field in fields(kind) if field.type not in _PLAIN_HINTS]
    objects = {field.name for field in fields(kind) if field.type in _JSON_OBJECT}
    first = {"kind": kind.KIND} if hasattr(kind, "KIND") else {}

    def write(value: Any) -> dict[str, Any]:
        plain = {name: getattr(value, name) for name in names}
        for name in others:
            item = plain[name]
            if name in objects:
                plain[name] = dict(item)
            elif item is not None:
                plain[name] = _writer(type(item))(item)
        return {**first, **plain} if first else plain

    return write


# --- reading ----------------------------------------------------------------------------------


class _Unfit(ValueError):
    """A value does not fit its type."""

    def __init__(self, text: str, joint: str = ": ", path: str = "") -> None:
        super().__init__(f"{path}{joint}{text}" if path else text)
        self.text = text
        self.joint = joint
        self.path = path

    def below(self, outer: str) -> _Unfit:
        """Return the same error with its path prefixed by the enclosing value."""
        dot = "." if self.path and not self.path.startswith("[") else ""
        return _Unfit(self.text, self.joint, f"{outer}{dot}{self.path}")


def from_plain(wanted: type[T], plain: Any) -> T:
    """Return a dataclass from plain values; raise `ValueError` with the path of the field.

    A missing field gets its default.
    """
    made: T = _reader(wanted)(plain)
    return made


def fields_from_plain(
    wanted: type[Any], plain: Mapping[str, Any], names: Iterable[str]
) -> dict[str, Any]:
    """Return the named fields of a dataclass that an object has, as keyword arguments.

    Raises:
        ValueError: with the path of an invalid field, or the name of a missing one without default.
    """
    given = {name: plain[name] for name in names if name in plain}
    shape = _shape(wanted)
    return _read_fields(shape, given, shape.required.intersection(names))


#: Maximum size in bytes of a plugin's value as JSON: of a plan, or a step.
LONGEST_OF_PLUGIN: Final = 1 << 19


def checked(value: T, kind: type[T], what: str) -> T:
    """Return a plugin's value after a round trip through JSON, as the journal restores it.

    Args:
        value: a dataclass.
        kind: its declared type. The plugin may derive its own, whose fields no journal can restore.
        what: name of the value in the message.

    Raises:
        PluginError: a field has the wrong type, or is not valid JSON.
    """
    try:
        text = json.dumps(to_plain(value), allow_nan=False)
        if len(text) > LONGEST_OF_PLUGIN:
            raise PluginError(
                f"an unsound {what}: {len(text)} bytes as JSON; allowed: {LONGEST_OF_PLUGIN}"
            )
        plain = json.loads(text)
        json.dumps(plain, ensure_ascii=False).encode()  # as messages hold it
        return from_plain(kind, plain)
    except UnicodeEncodeError:
        raise PluginError(f"an unsound {what}: it has a character that UTF-8 cannot hold") from None
    except (ValueError, TypeError) as fault:
        raise PluginError(f"an unsound {what}: {fault}") from fault


@_compiled_once
def _reader(hint: Any) -> _Convert:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _union_reader(arguments)
    if origin is Literal:
        return _choice_reader({allowed: allowed for allowed in arguments})
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping_reader(arguments[-1])
    if origin in (list, set, frozenset, tuple):
        return _sequence_reader(origin, arguments)
    return _class_reader(hint) if isinstance(hint, type) else _unchanged


def _class_reader(kind: Any) -> _Convert:
    if is_dataclass(kind):
        return _object_reader(kind)
    if issubclass(kind, Enum):
        return _choice_reader({_writer(kind)(member): member for member in kind})
    if issubclass(kind, Path):
        return _read_path
    return _scalar_reader(kind) if kind in _PLAIN else _unchanged


class _Shape(NamedTuple):
    """The fields of a dataclass.

    Attributes:
        readers: field name to a type that needs no reader, and the reader; in order.
        required: names of the fields without a default.
    """

    readers: Mapping[str, tuple[Any, _Convert]]
    required: frozenset[str]


@_compiled_once
def _shape(kind: Any) -> _Shape:
    hints = hints_of(kind)
    known = [field for field in fields(kind) if field.init]
    required = [f.name for f in known if f.default is MISSING and f.default_factory is MISSING]
    readers = {field.name: (hints[field.name], _field_reader(hints[field.name])) for field in known}
    return _Shape(readers, frozenset(required))


def _field_reader(hint: Any) -> _Convert:
    """Return the reader of a field; equal frozen dataclasses are read once, and then shared.

    A restarted master reads thousands of specs, most of them with the same policies. Those with
    mappings are not shared, because a plugin could change a mapping.
    """
    read = _reader(hint)
    if not is_dataclass(hint) or not hint.__dataclass_params__.frozen:  # type: ignore[union-attr]
        return read

    @lru_cache(maxsize=_MOST_SHARED)
    def read_exact(exact: bytes) -> Any:
        return read(marshal.loads(exact))  # noqa: S302 - the bytes are those of `read_once`

    def read_once(plain: Any) -> Any:
        if isinstance(plain, dict) and dict in map(type, plain.values()):
            return read(plain)
        try:
            exact = marshal.dumps(plain, _MARSHAL)  # unlike `==`, tells 1, 1.0 and True apart
        except ValueError:  # another type than those of JSON
            return read(plain)
        return read_exact(exact) if len(exact) <= _LONGEST_SHARED else read(plain)

    return read_once


def _object_reader(kind: Any) -> _Convert:
    is_of_union = hasattr(kind, "KIND")

    def read(plain: Any) -> Any:
        shape = _shape(kind)  # at the first use, because a field may have the type itself
        if isinstance(plain, list) and len(plain) <= len(shape.readers):
            plain = dict(zip(shape.readers, plain, strict=False))
        if not isinstance(plain, Mapping):
            raise _unfit("a mapping", plain)
        if is_of_union:
            plain = {name: item for name, item in plain.items() if name != "kind"}
        return kind(**_read_fields(shape, plain, shape.required))

    return read


def _read_fields(
    shape: _Shape, plain: Mapping[str, Any], required: frozenset[str]
) -> dict[str, Any]:
    readers = shape.readers
    if not plain.keys() <= readers.keys():
        unknown = ", ".join(sorted(plain.keys() - readers.keys()))
        raise _Unfit(f"unknown {unknown}; allowed: {', '.join(readers) or 'nothing'}")
    if not required <= plain.keys():
        missing = required - plain.keys()
        raise _Unfit(f"{', '.join(name for name in readers if name in missing)} is missing")
    values = {}
    for name, item in plain.items():
        plain_type, reader = readers[name]
        try:
            values[name] = item if type(item) is plain_type else reader(item)
        except _Unfit as fault:
            raise fault.below(name) from None
    return values


def _union_reader(choices: tuple[Any, ...]) -> _Convert:
    readers = {choice: _reader(choice) for choice in choices if choice is not type(None)}
    if len(readers) == 1:
        (read,) = readers.values()
    elif all(hasattr(choice, "KIND") for choice in readers):
        read = _by_kind({choice.KIND: reader for choice, reader in readers.items()})
    else:
        read = _first_fit(*readers.values())
    if len(readers) == len(choices):
        return read
    return lambda plain: None if plain is None else read(plain)


def _first_fit(first: _Convert, *others: _Convert) -> _Convert:
    def read(plain: Any) -> Any:
        try:
            return first(plain)
        except ValueError:
            for reader in others:
                with suppress(ValueError):
                    return reader(plain)
            raise

    return read


def _by_kind(readers: Mapping[str, _Convert]) -> _Convert:
    read_kind = _choice_reader(readers)

    def read(plain: Any) -> Any:
        if not isinstance(plain, Mapping):
            raise _unfit("a mapping", plain)
        try:
            reader = read_kind(plain.get("kind"))
        except _Unfit as fault:
            raise fault.below("kind") from None
        return reader(plain)

    return read


def _choice_reader(choices: Mapping[Any, Any]) -> _Convert:
    """Return a reader that maps each allowed JSON value to its choice."""

    def read(plain: Any) -> Any:
        if not isinstance(plain, (str, int)) or plain not in choices:
            allowed = ", ".join(map(str, choices))
            raise _Unfit(f"{plain!r}; allowed: {allowed}", " ")
        return choices[plain]

    return read


def _mapping_reader(hint: Any) -> _Convert:
    reader = _reader(hint)

    def read(plain: Any) -> Any:
        if not isinstance(plain, Mapping):
            raise _unfit("a mapping", plain)
        values = {}
        for name, item in plain.items():
            try:
                values[name] = reader(item)
            except _Unfit as fault:
                raise fault.below(name) from None
        return values

    return read


def _sequence_reader(origin: Any, arguments: tuple[Any, ...]) -> _Convert:
    readers = [_reader(hint) for hint in arguments if hint is not Ellipsis]
    is_fixed = origin is tuple and Ellipsis not in arguments

    def read(plain: Any) -> Any:
        if not isinstance(plain, (list, tuple)):
            raise _unfit("a list", plain)
        if is_fixed and len(readers) != len(plain):
            raise _unfit(f"a list of {len(readers)}", plain)
        values = []
        for at, item in enumerate(plain):
            try:
                values.append(readers[at if is_fixed else 0](item))
            except _Unfit as fault:
                raise fault.below(f"[{at}]") from None
        return origin(values)

    return read


def _scalar_reader(kind: Any) -> _Convert:
    def read(plain: Any) -> Any:
        if type(plain) is kind:
            return plain
        if kind is float and type(plain) is int:
            return float(plain)
        raise _unfit(kind.__name__, plain)

    return read


def _read_path(plain: Any) -> Path:
    if not isinstance(plain, str):
        raise _unfit("text", plain)
    return Path(plain)


def _unfit(wanted: str, plain: Any) -> _Unfit:
    return _Unfit(f"{wanted} is required, not {plain!r}")
