"""Bounds of the messages between the parts of rosrm: length of texts, entries of sequences, size.

The receiver checks them. Neither rclpy nor Fast DDS refuses a text or a sequence that is longer
than its interface allows, and for each publisher and subscription Fast DDS reserves a bounded
sequence a hundred times in its full length. So `rosrm_msgs` has no bounded types: the comments of
its fields state the bounds, where they differ from the general ones here.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple

from rosrm.errors import Refused
from rosrm.model.remembered import remembered
from rosrm.ros import sealed_codec
from rosrm.wording import sendable
from rosrm_msgs import msg

#: Most letters of a text, and most entries of a sequence.
MOST_LETTERS: Final = 1 << 16
MOST_ENTRIES: Final = 1 << 16
#: Most letters and entries of a whole message, and of the spec of one process.
LARGEST_MESSAGE: Final = 1 << 26
LARGEST_SPEC: Final = 1 << 20
#: Most letters and entries of a nested message whose size is cached.
_MOST_CACHED: Final = 512

#: Facts of an event that exceed their bound.
_CUT: Final = '{"cut": true}'

_OTHER_LETTERS: Final = {
    "Sealed.principal": sealed_codec.MOST_LETTERS,
    "ApplicationTarget.digest": 1 << 20,
    "KeyValue.value": 1 << 20,
    "ProcessSpec.command": 1 << 17,
    "ProcessSpec.arguments": 1 << 17,
    "Event.data": 1 << 20,
    "ControlHost_Request.arguments": 1 << 20,
    "ControlHost_Response.result": 1 << 20,
    "Explain_Response.explanation": 1 << 24,
    "Apply_Response.actions": 1 << 24,
    "SwitchMode_Response.actions": 1 << 24,
    "List_Response.application_list": 1 << 24,
    "List_Response.mode_list": 1 << 24,
}
_OTHER_ENTRIES: Final = {
    "Assignment.state_key": 32,
    "HostDescription.labels": 256,
    "HostDescription.resources": 16,
    "HostDescription.executors": 256,
    "HostDescription.launchers": 256,
    "HostDescription.absent": 256,
    "HostDescription.devices": 256,
    "Assignment.devices": 256,
    "DeviceNeed.units": 256,
    "ProcessSpec.devices": 256,
    "ProcessSpec.artifacts": 256,
    "ProcessStatus.devices": 256,
    "ProcessStatusBatch.devices": 256,
    "ProcessSpec.needs": 64,
    "ProcessSpec.required_labels": 256,
    "ProcessSpec.preferred_labels": 256,
    "ProcessSpec.avoided_labels": 256,
    "ProcessSpec.given": 256,
    "ProcessSpec.secrets": 256,
    "ProcessSpec.cpus": 1024,
    "ProcessSpec.parameter_sources": 256,
    "ProcessSpec.components": 256,
    "HostDescription.unenforced": 16,
    "HostDescription.cpus": 4096,
    "ProcessStatus.enforced": 16,
    "StandbyPolicy.apart_by": 256,
    "Schedule.at": 256,
    "Schedule.on": 7,
    "ProcessSpec.neighbours": 256,
    "NeighbourRule.processes": 1024,
    "ProcessSpec.talks_to": 256,
    "StartOrder.after": 256,
    "ProcessStatusBatch.failing": 1000,
    "ProcessUsage.others": 16,
    "ControlHost_Request.limits": 1,
    "Sealed.body": 1 << 24,
    "Submit_Request.processes": 10_000,
    "Apply_Request.targets": 1000,
    "LoadModes_Request.modes": 256,
    "Mode.targets": 1000,
    "ApplicationTarget.processes": 10_000,
    "List_Response.process_list": 1 << 20,
    "List_Response.plugin_list": 1 << 20,
    "StoreReplica_Request.data": 1 << 20,
    "ReadSnapshot_Response.data": 1 << 20,
    "StoreArtifact_Request.data": 1 << 20,
    "ReadArtifact_Response.data": 1 << 20,
    "ReadLog_Response.content": 1 << 20,
    "Introduce_Response.key": 32,
    "Introduce_Response.run": 16,
}


class Bound(NamedTuple):
    """Bound of a field.

    Attributes:
        field: its name.
        slot: attribute of messages with its value. The property of the same name is slower.
        entries: most entries; 0: it is no sequence.
        letters: most letters of the text, or of each text in the sequence; 0: it has none.
        nested: messages are in it.
    """

    field: str
    slot: str
    entries: int
    letters: int
    nested: bool


def _find_bounds(kind: Any) -> tuple[Bound, ...]:
    if not kind.__module__.startswith("rosrm_msgs."):
        return ()
    found = []
    for field, declared in kind.get_fields_and_field_types().items():
        name = f"{kind.__name__}.{field}"
        is_many = declared.startswith("sequence<")
        inner = declared.removeprefix("sequence<").removesuffix(">")
        entries = _OTHER_ENTRIES.get(name, MOST_ENTRIES) if is_many else 0
        letters = _OTHER_LETTERS.get(name, MOST_LETTERS) if inner == "string" else 0
        nested = inner.startswith("rosrm_msgs/") and _has_bounds(inner)
        if entries or letters or nested:
            found.append(Bound(field, f"_{field}", entries, letters, nested))
    return tuple(found)


def _has_bounds(name: str) -> bool:
    return bool(bounds_of(getattr(msg, name.rpartition("/")[2])))


#: Returns the bounds of a message's fields; none for a message that is not of rosrm. Typed, because
#: mypy does not accept a type as an argument of a cache.
bounds_of: Final[Callable[[Any], tuple[Bound, ...]]] = cache(_find_bounds)


def check_bounds(message: Any) -> int:
    """Return the number of characters and entries in a message.

    Raises:
        Refused: the message, or a field of it, exceeds its bound.
    """
    size = _size(message)
    if size > LARGEST_MESSAGE:
        raise Refused(f"a {type(message).__name__} of {size} characters; at most {LARGEST_MESSAGE}")
    return size


def fitted(row: Any) -> Any:
    """Return a row of a listing with each text and sequence cut to its bound.

    Otherwise receivers would refuse the whole listing because of one row with a longer text, or
    with a text that is no UTF-8.
    """
    for field, slot, entries, letters, nested in bounds_of(type(row)):
        value = getattr(row, slot)
        if entries and len(value) > entries:
            setattr(row, slot, value[:entries])
        if letters and not entries:
            if len(value) > letters or not value.isascii():
                cut = sendable(value[:letters])
                whole = len(value) <= letters or field != "data"  # JSON that was cut is none
                setattr(row, slot, cut if whole else _CUT)
        elif letters:
            setattr(row, slot, [sendable(text[:letters]) for text in getattr(row, slot)])
        elif nested:
            for one in getattr(row, slot) if entries else (value,):
                fitted(one)
    return row


def _size(message: Any) -> int:
    kind, size = type(message), 0
    for field, slot, entries, letters, nested in bounds_of(kind):
        value = getattr(message, slot)
        if entries:
            if len(value) > entries:
                raise _beyond(kind, field, "entries", len(value), entries)
            size += len(value)
        if letters:
            for text in value if entries else (value,):
                if len(text) > letters:
                    raise _beyond(kind, field, "characters", len(text), letters)
                size += len(text)
        elif nested:
            size += sum(map(_size, value)) if entries else _size_of_known(value)
    if size > LARGEST_SPEC and kind is msg.ProcessSpec:
        raise Refused(
            f"process {message.name!r:.60}: its texts have {size} characters; "
            f"at most {LARGEST_SPEC}"
        )
    return size


_size_of_known: Final = remembered(_size, lambda size: size <= _MOST_CACHED)


def _beyond(kind: type[Any], field: str, what: str, given: int, most: int) -> Refused:
    return Refused(f"{kind.__name__}.{field} has {given} {what}; at most {most}")


def call_bounded(callback: Callable[..., None], *arguments: Any) -> None:
    """Call a callback whose first argument may be a received message; raise `Refused` for size."""
    for received in arguments[:1]:
        check_bounds(received)
    callback(*arguments)
