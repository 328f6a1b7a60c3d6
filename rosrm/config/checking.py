"""Validation of a document against a dataclass by pydantic, with rosrm's error messages."""

from __future__ import annotations

import json
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from typing import (
    Annotated,
    Any,
    Final,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from rosrm.config.documents import Node, Place, Problems
from rosrm.extensions.units import UnfitAmount
from rosrm.wording import get_close_matches, listed

T = TypeVar("T")

_STRICT: Final = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

#: Required kind of value for each type of pydantic error.
_WANTED: Final = {
    "bool_type": "true or false",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "finite_number": "a finite number",
    "string_type": "text",
    "path_type": "a path",
    "dataclass_type": "a mapping",
    "dict_type": "a mapping",
    "mapping_type": "a mapping",
    "list_type": "a list",
    "tuple_type": "a list",
}


_UNKNOWN_KEY: Final = frozenset({"unexpected_keyword_argument", "extra_forbidden"})

#: Keys of ROS 2 launch, Nomad, Kubernetes and Docker, and the equivalent keys of rosrm.
_ELSEWHERE: Final = {
    word: key
    for key, words in (
        ("labels", "host hosts machine machines node_selector nodeSelector affinity constraints"),
        ("needs", "resources requests memory cpu gpu"),
        ("command", "cmd entrypoint"),
        ("executable", "exec"),
        ("package", "pkg"),
        ("arguments", "args"),
        ("parameters", "params param"),
        ("remappings", "remap"),
        ("namespace", "ns"),
        ("environment", "env"),
        ("working_directory", "cwd workdir workingDir"),
        ("restart", "respawn"),
        ("kind", "type"),
    )
    for word in words.split()
}
#: Similarity from which a key counts as misspelt, not as a key of another tool.
_MISSPELT: Final = 0.8

#: Allowed values that are written otherwise in YAML.
_IN_YAML: Final = {"": '""', "True": "true", "False": "false"}

#: Wording of each bound of annotated_types.
_BOUNDS: Final = {
    "greater_than": "greater than",
    "greater_than_equal": "at least",
    "less_than": "less than",
    "less_than_equal": "at most",
}


def validated(wanted: type[T], node: Node, problems: Problems, where: str = "") -> T | None:
    """Return the value of a document, or note all problems and return None.

    Args:
        wanted: a dataclass; its annotations define the allowed values.
        node: the document or a part of it.
        problems: receives every problem.
        where: prefix of each value's path in messages.
    """
    try:
        holder: Any = _holder(cast(Any, wanted)).model_validate_json(
            json.dumps({"value": node.plain()})
        )
    except ValidationError as error:
        found = [dict(one) for one in error.errors(include_url=False)]
        # A key that is unknown to the tried member of a union may belong to another member.
        for one in [one for one in found if not _is_known(wanted, one)] or found:
            _note(wanted, node, one, problems, where)
        return None
    return cast(T, holder.value)


def salvaged(wanted: type[T], node: Node, problems: Problems) -> tuple[T | None, frozenset[str]]:
    """Read the correct members of a document, and note every problem.

    Returns:
        The value, with defaults for wrong members (None: a member without a default is wrong), and
        the keys of the wrong members. An unknown key counts as the key that its message suggests.
    """
    faults = Problems()
    value = validated(wanted, node, faults)
    problems.found.update(faults.found)
    if value is not None:
        return value, frozenset()
    known = [f.name for f in fields(cast(Any, wanted)) if f.init]
    right = {
        name: item for name, item in node.items.items()
        if name in known and not any(_lies_in(item, place) for place, _ in faults.found)
    }  # fmt: skip
    wrong = set(node.items) - set(right)
    meant = {close for name in wrong - set(known) for close in _closest_key(name, known)}
    value = validated(wanted, Node(right, node.place, node.key_place), Problems())
    return value, frozenset(wrong & set(known) | meant)


def _lies_in(node: Node, place: Place) -> bool:
    """Return True if a place is that of a value, of its key, or of a member of the value."""
    inner = node.value if isinstance(node.value, tuple) else node.items.values()
    return place in (node.place, node.key_place) or any(_lies_in(one, place) for one in inner)


def described(value: Any) -> str:
    """Return a short description of a given value for a message."""
    if value is None:
        return "nothing (null)"
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."


def near(given: str, allowed: Mapping[str, Any] | list[str] | tuple[str, ...]) -> str:
    """Return '; did you mean X?' or '.', followed by the list of allowed names."""
    return _meant(get_close_matches(given, list(allowed), 1), allowed)


def _closest_key(given: str, allowed: list[str]) -> list[str]:
    """Return the known key nearest to an unknown key, as a list of one item; [] if none is."""
    misspelt = get_close_matches(given, allowed, 1, _MISSPELT)
    equivalent = [key for key in allowed if key == _ELSEWHERE.get(given)]
    return misspelt or equivalent or get_close_matches(given, allowed, 1)


def _meant(close: list[str], allowed: Iterable[str]) -> str:
    """Return the text after an unknown name: a suggestion, and the allowed names."""
    meant = f"; did you mean {close[0]!r}?" if close else "."
    return f"{meant} Allowed: {', '.join(allowed) or 'none'}"


@cache
def _holder(wanted: type[Any]) -> type[BaseModel]:
    """Return a model with the dataclass as a field, which makes all nested types strict."""
    return create_model("Holder", __config__=_STRICT, value=(wanted, ...))


def _note(
    wanted: type[Any], node: Node, error: Mapping[str, Any], problems: Problems, where: str
) -> None:
    path = _path(wanted, error["loc"][1:])
    target = node.deepest(path)
    if error["type"] in _UNKNOWN_KEY:
        inside = _named(path[:-1], where)
        note = f"unknown key {path[-1]!r}" + (f" in {inside}" if inside else "")
        problems.add(target.key_place or target.place, note + _instead(wanted, path))
        return
    prefix = _named(path, where)
    example = _example(wanted, path, where) if error["type"] in _WANTED else ""
    problems.add(target.place, (f"{prefix}: " if prefix else "") + _message_of(error) + example)


def _instead(wanted: Any, path: tuple[str | int, ...]) -> str:
    """Return the text after an unknown key: where the key belongs, or the allowed keys."""
    given = str(path[-1])
    if any(given in getattr(owner, "SECTIONS", ()) for owner in _types_at(wanted, path[:-1])):
        return f"; `{given}` is a section of the file, beside `processes`"
    allowed = _keys(wanted, path[:-1])
    return _meant(_closest_key(given, allowed), allowed)


def _example(wanted: Any, path: tuple[str | int, ...], where: str) -> str:
    """Return examples of the innermost key of a path that has some; "": none has."""
    places = [(path[: end - 1], path[end - 1]) for end in range(len(path), 0, -1)]
    found = ((key, _examples(owner, key)) for at, key in places for owner in _types_at(wanted, at))
    key, forms = next((one for one in found if one[1]), (where, _examples(wanted, "")))
    return f", such as {listed((f'`{key}: {form}`' for form in forms), 'or')}" if forms else ""


def _examples(owner: Any, key: str | int) -> Sequence[str]:
    """Return examples of a key of a dataclass; "": of the dataclass itself."""
    examples: Mapping[str | int, Sequence[str]] = getattr(owner, "EXAMPLES", {})
    return examples.get(key, ())


def _named(path: tuple[str | int, ...], where: str) -> str:
    """Return a section and a path as text: `options of X: many[2].delay`."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return ": ".join(part for part in (where, text) if part)


def _message_of(error: Mapping[str, Any]) -> str:
    kind, given = error["type"], error.get("input")
    if kind == "value_error":
        return _cause(error["ctx"]["error"], error["loc"])
    if kind in ("missing", "missing_argument"):
        return "is missing"
    if kind == "literal_error":
        return _not_one_of(given, error["ctx"]["expected"])
    if kind in _BOUNDS:
        bound = next(iter(error["ctx"].values()))
        return f"{described(given)} is not {_BOUNDS[kind]} {bound}"
    if kind in _WANTED:
        return f"{_WANTED[kind]} is required, not {described(given)}"
    return f"{error['msg'][:1].lower()}{error['msg'][1:]}, and {described(given)} is given"


def _cause(error: ValueError, path: tuple[str | int, ...]) -> str:
    return error.of(str(path[-1])) if isinstance(error, UnfitAmount) else str(error)


def _not_one_of(given: Any, expected: str) -> str:
    words = [word.strip().strip("'") for word in expected.replace(" or ", ", ").split(",")]
    allowed = [_IN_YAML.get(word, word) for word in words]
    return f"{described(given)} is unknown{near(str(given), allowed)}"


def _is_known(wanted: type[Any], error: Mapping[str, Any]) -> bool:
    """Return True if an error reports an unknown key that another type at its place has."""
    path = _path(wanted, error["loc"][1:])
    return error["type"] in _UNKNOWN_KEY and path[-1] in _keys(wanted, path[:-1])


def _keys(wanted: Any, path: tuple[str | int, ...]) -> list[str]:
    """Return the keys of the dataclasses at a path."""
    types = [one for one in _types_at(wanted, path) if is_dataclass(one)]
    return list(dict.fromkeys(f.name for one in types for f in fields(one) if f.init))


def _path(wanted: Any, steps: Iterable[str | int]) -> tuple[str | int, ...]:
    """Return the path of an error in the document, converted from pydantic's path.

    pydantic's path also has "[key]" before a key, and below a union the type that was tried.
    """
    path: tuple[str | int, ...] = ()
    is_member = False
    for step in steps:
        is_member = not is_member and len(set(_types_at(wanted, path)) - {None, type(None)}) > 1
        if not is_member and step != "[key]":
            path = (*path, step)
    return path


def _types_at(wanted: Any, path: tuple[str | int, ...]) -> list[Any]:
    """Return the types that are allowed at a path."""
    found = [wanted]
    for step in path:
        found = [inner for one in found for inner in _inside(one, step)]
    return found


def _inside(wanted: Any, step: str | int) -> Iterator[Any]:
    """Return the unwrapped types that are allowed under a key or index of a type."""
    if is_dataclass(wanted) and isinstance(wanted, type):
        hint = get_type_hints(wanted, include_extras=True).get(str(step))
        yield from _unwrapped(hint)
        return
    arguments = get_args(wanted)
    if arguments:
        yield from _unwrapped(arguments[-1] if isinstance(step, str) else arguments[0])


def _unwrapped(hint: Any) -> Iterator[Any]:
    origin = get_origin(hint)
    if origin is Annotated:
        inner, *marks = get_args(hint)
        in_file = [mark.in_file() for mark in marks if hasattr(mark, "in_file")]
        yield from _unwrapped(in_file[0] if in_file else inner)
    elif origin in (Union, types.UnionType):
        for choice in get_args(hint):
            yield from _unwrapped(choice)
    else:
        yield hint
