"""Hostile values for the fuzz tests: numbers at the ends of their types, odd texts, damaged data.

`make test` runs a fixed number of examples, the same each time. `make fuzz` runs many more with
random seeds (`scripts/fuzz.py`), and prints the seed and the smallest failing example.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import os
import types
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st

#: Times as many examples, with random seeds; 0: the fixed ones.
HUNT = int(os.environ.get("ROSRM_FUZZ_TIMES", "0"))


def fuzzed(examples: int, **more: Any) -> Callable[[Any], Any]:
    """Return the settings of a fuzz test with so many examples in `make test`."""
    return settings(
        max_examples=examples * max(1, HUNT), derandomize=not HUNT, database=None, deadline=None,
        phases=(Phase.generate, Phase.shrink),  # to explain failures, Hypothesis traces each line
        print_blob=True, suppress_health_check=list(HealthCheck), **more,
    )  # fmt: skip


# --- values -----------------------------------------------------------------------------------

_ENDS = [
    bits for size in (7, 8, 15, 16, 31, 32, 53, 63, 64) for bits in (1 << size, (1 << size) - 1)
]

ints = st.sampled_from([0, 1, 2, 3, *_ENDS, *(-one for one in _ENDS), 10**40])
#: Values of an unsigned field of 64 bits.
uint64s = st.sampled_from([0, 1, 2, 3, *(one for one in _ENDS if one < 1 << 64)])
floats = st.sampled_from(
    [0.0, -0.0, 0.5, 1.0, -1.0, math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 1e9, 3e38]
)
#: Texts as JSON and messages carry them: no lone surrogates.
texts = st.sampled_from(
    ["", "p", "a", "/", "..", "../../etc/passwd", "x" * 300, "\x1b[31mred", "a\nb", "a\0b",
     "%2e%2e", "\u202eabc", "é\u0301", "[red]", "{}", "null", "1e999", "*", "a b", "a#1", "-", "~"]
) | st.text(st.characters(exclude_categories=("Cs",)), max_size=8)  # fmt: skip
#: Texts of a program that writes no valid Unicode.
torn_texts = texts | st.sampled_from(["\ud800", "a\udcff"])

json_values = st.recursive(
    st.none() | st.booleans() | ints | floats | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=6,
)

_SCALARS: Mapping[Any, st.SearchStrategy[Any]] = {
    int: ints, float: floats, str: texts, bool: st.booleans(), bytes: st.binary(max_size=8),
    type(None): st.none(),
    Path: st.builds(Path, texts.filter(lambda text: "\0" not in text)),
}  # fmt: skip


def values_of(hint: Any, known: Mapping[Any, st.SearchStrategy[Any]] | None = None) -> Any:
    """Return a strategy for values of a type with hostile content.

    Args:
        hint: a dataclass, or the annotation of a field.
        known: strategies by type, or by the name of a field, in place of hostile ones.
    """
    known = known or {}
    if isinstance(hint, type) and hint in known:
        return known[hint]
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return st.sampled_from(arguments)
    if origin in (Union, types.UnionType):
        return st.one_of(*(values_of(one, known) for one in arguments))
    if hasattr(hint, "__metadata__"):
        return values_of(arguments[0], known)
    if origin in (tuple, list, set, frozenset):
        return _sequences(origin, arguments, known)
    if origin is not None and issubclass(origin, Mapping):
        keys, items = (values_of(one, known) for one in arguments)
        return st.dictionaries(keys, items, max_size=2)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return st.sampled_from(list(hint))
    if dataclasses.is_dataclass(hint):
        return _objects(hint, known)
    return _SCALARS.get(hint, json_values)


def _sequences(origin: Any, arguments: tuple[Any, ...], known: Mapping[Any, Any]) -> Any:
    if origin is tuple and Ellipsis not in arguments:
        return st.tuples(*(values_of(one, known) for one in arguments))
    return st.lists(values_of(arguments[0], known), max_size=3).map(origin)


def _objects(kind: Any, known: Mapping[Any, Any]) -> Any:
    hints = get_type_hints(kind, include_extras=True)
    return st.deferred(
        lambda: st.builds(
            kind,
            **{
                one.name: known[one.name]
                if one.name in known
                else values_of(hints[one.name], known)
                for one in dataclasses.fields(kind)
                if one.init
            },
        )
    )


# --- damage -----------------------------------------------------------------------------------


@st.composite
def damaged_bytes(draw: Any, whole: st.SearchStrategy[bytes] | bytes) -> bytes:
    """Draw bytes that differ from sound ones in a few places."""
    data = bytearray(whole if isinstance(whole, bytes) else draw(whole))
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(data)))
        what = draw(st.sampled_from(["cut", "flip", "insert", "remove", "number", "double"]))
        if what == "cut":
            del data[at:]
        elif what == "flip" and at < len(data):
            data[at] ^= draw(st.integers(1, 255))
        elif what == "insert":
            data[at:at] = draw(st.binary(max_size=8))
        elif what == "remove":
            del data[at : at + draw(st.integers(1, 16))]
        elif what == "number":
            size = draw(st.sampled_from([4, 8]))
            number = draw(uint64s) % (1 << 8 * size)
            data[at : at + size] = number.to_bytes(size, "little")
        elif what == "double":
            data[at:at] = data[: draw(st.integers(0, 64))]
    return bytes(data)


@st.composite
def damaged_json(draw: Any, plain: Any) -> Any:
    """Draw JSON that differs from sound JSON in a few places."""
    plain = copy.deepcopy(plain)
    for _ in range(draw(st.integers(1, 3))):
        place, key = draw(st.sampled_from(list(_places(plain)) or [(None, None)]))
        if place is None:
            return draw(json_values)
        what = draw(st.sampled_from(["replace", "replace", "remove", "rename"]))
        if what == "replace":
            place[key] = draw(json_values)
        elif what == "remove":
            del place[key]
        elif isinstance(place, dict):
            place[draw(texts)] = place.pop(key)
    return plain


def _places(plain: Any) -> Any:
    """Yield each container in a JSON value with each of its keys."""
    keys: Any = ()
    if isinstance(plain, dict):
        keys = list(plain)
    elif isinstance(plain, list):
        keys = range(len(plain))
    for key in keys:
        yield plain, key
        yield from _places(plain[key])


def damaged_text(plain: Any) -> st.SearchStrategy[bytes]:
    """Return a strategy for JSON texts: of the wrong shape, damaged, or no JSON at all."""
    sound = json.dumps(plain).encode()
    deep = st.sampled_from([b"[", b'{"a":', b"1", b"[1,"]).map(lambda piece: piece * 50_000)
    shaped = damaged_json(plain).map(lambda value: json.dumps(value).encode())
    return shaped | damaged_bytes(sound) | deep | st.binary(max_size=16)
