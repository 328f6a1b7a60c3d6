"""Messages read and written without rclpy are those of rclpy."""

from __future__ import annotations

import random
from array import array
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.ros import cdr
from rosrm_msgs import msg, srv

_NUMBERS = {"octet": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I",
            "int32": "i", "uint64": "Q", "int64": "q", "float": "f", "double": "d"}  # fmt: skip


def kinds() -> Iterator[Any]:
    """Yield all types of messages that are sent."""
    for module in (msg, srv):
        for name in sorted(vars(module)):
            found = getattr(module, name)
            for kind in (found, getattr(found, "Request", None), getattr(found, "Response", None)):
                if hasattr(kind, "get_fields_and_field_types") and not name.endswith("_Event"):
                    yield kind


def filled(kind: Any, chance: random.Random) -> Any:
    """Return a message with random content."""
    message = kind()
    for field, declared in kind.get_fields_and_field_types().items():
        setattr(message, field, value_of(declared, chance))
    return message


def value_of(declared: str, chance: random.Random) -> Any:
    """Return a random value of a declared type."""
    if declared.startswith("sequence<"):
        inner = declared.removeprefix("sequence<").removesuffix(">")
        found = [value_of(inner, chance) for _ in range(chance.choice((0, 0, 1, 2, 5)))]
        return array(_NUMBERS[inner], found) if inner in _NUMBERS else found
    if declared == "string":
        return "".join(chance.choice("ab/~é€") for _ in range(chance.choice((0, 1, 3, 4, 9))))
    if declared == "boolean":
        return chance.random() < 0.5
    if declared in ("float", "double"):
        return chance.choice((0.0, -1.5, 2.0**20))
    if declared in _NUMBERS:
        return chance.choice((0, 1, 100))
    return filled(getattr(msg, declared.removeprefix("rosrm_msgs/")), chance)


@pytest.mark.parametrize("kind", list(kinds()), ids=lambda kind: str(kind.__name__))
def test_each_message_is_what_rclpy_reads(kind: Any) -> None:
    """Every type, with random content; nested messages are found again by their content."""
    chance = random.Random(kind.__name__)
    for _ in range(20):
        data = serialize_message(filled(kind, chance))
        assert cdr.read(kind, data) == deserialize_message(data, kind)


@pytest.mark.parametrize("kind", list(kinds()), ids=lambda kind: str(kind.__name__))
def test_rclpy_reads_each_message_that_is_written(kind: Any) -> None:
    """Every type, with random content, twice: the second time from the cache of nested messages."""
    chance = random.Random(kind.__name__)
    for _ in range(20):
        message = filled(kind, chance)
        for _ in range(2):
            assert deserialize_message(cdr.written(message), kind) == message
            assert deserialize_message(cdr.form_of(message), kind) == message


def test_a_nested_message_is_written_at_each_offset() -> None:
    """Its form is cached for each alignment, because the gaps in it differ."""
    restart = filled(msg.RestartPolicy, random.Random(1))
    for letters in range(9):
        spec = msg.ProcessSpec(kind="x" * letters, restart=restart)
        assert deserialize_message(cdr.written(spec), msg.ProcessSpec) == spec


def test_a_number_beyond_its_type_is_refused() -> None:
    """The caller gets a ValueError that names the message."""
    spec = cdr.read(msg.ProcessSpec, cdr.written(msg.ProcessSpec()))
    spec._priority = 2**40
    with pytest.raises(ValueError, match="ProcessSpec"):
        cdr.written(spec)


def test_equal_nested_messages_are_one_object() -> None:
    """Otherwise the spec of a process would take six times as long to read."""
    data = serialize_message(msg.ProcessSpec(name="a"))
    first, second = cdr.read(msg.ProcessSpec, data), cdr.read(msg.ProcessSpec, data)
    assert first.container is second.container
    changed = msg.ProcessSpec(name="a", container=msg.Container(image="b"))
    assert cdr.read(msg.ProcessSpec, serialize_message(changed)).container.image == "b"


def test_a_message_that_ends_early_is_refused() -> None:
    """Nothing but a ValueError is raised, and no message is made of half of its form."""
    data = serialize_message(filled(srv.Submit.Request, random.Random(1)))
    for end in range(len(data)):
        with suppress(ValueError):
            cdr.read(srv.Submit.Request, data[:end])
    with pytest.raises(ValueError, match="too short"):
        cdr.read(srv.Submit.Request, data[: len(data) // 2])
    with pytest.raises(ValueError, match="too short"):  # 2**32 - 1 processes
        cdr.read(msg.ProcessUsage, data[:4] + b"\xff" * 60)
    with pytest.raises(ValueError, match="little-endian"):
        cdr.read(srv.Submit.Request, b"\0\0" + data[2:])


def test_a_text_ends_at_its_first_nul() -> None:
    """No path or argument may have a NUL, also from a foreign sender."""
    data = serialize_message(msg.ProcessSpec(name="camera")).replace(b"camera", b"cam\0ra")
    assert cdr.read(msg.ProcessSpec, data).name == "cam"
    assert cdr.read(msg.ProcessSpec, data) == deserialize_message(data, msg.ProcessSpec)


def test_a_made_message_has_its_fields() -> None:
    """The constructor returns the same message."""
    spec = msg.ProcessSpec(name="a")
    fields = {name: getattr(spec, name) for name in spec.get_fields_and_field_types()}
    assert cdr.made(msg.ProcessSpec, **fields) == spec
