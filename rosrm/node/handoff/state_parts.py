"""Parts of a node's state: saved and published by the source, restored by the destination."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable
from typing import Any, Final, NamedTuple

from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.errors import describe_fault
from rosrm.node.handoff.snapshot_assembler import PartKey, part_key
from rosrm.snapshots.format import MOST_CYCLES, Block
from rosrm_msgs.msg import StateMark, StatePart

#: Most bytes of one part. Fast DDS carried 400 MB, but a node takes 3 s to serialise 200 MB.
LARGEST_PART: Final = 256 << 20


class StateError(Exception):
    """A state cannot be saved or restored; the text names the state and the reason."""


class StateTopic:
    """One topic of a node's state; the arguments are those of `Migratable.keep_state`.

    The saved message stays in memory, because a later handoff seals it under another key.
    """

    def __init__(
        self, topic: str, message_type: Any, save: Callable[[], Any], restore: Callable[[Any], None]
    ) -> None:
        self.topic = topic
        self.message_type = message_type
        self.type_name = type_name(message_type)
        self._save = save
        self._restore = restore
        self._key: PartKey | None = None
        self._data: bytes | None = None
        self._published: bytes | None = None
        self._restored: PartKey | None = None
        self._refused = ""
        self._publish: Callable[[bytes], None] = lambda _: None

    def show_to(self, publish: Callable[[bytes], None]) -> None:
        """Use `publish` from now on; the next call publishes the part for the new successor."""
        self._publish, self._published = publish, None

    def publish(self) -> None:
        """Save the part and publish it, if it has changed; raises the errors of `refresh`."""
        self.refresh()
        self.show()

    def show(self) -> None:
        """Publish the saved part, if its successor does not have it."""
        if self._data is not None and self._data is not self._published:
            self._publish(self._data)
            self._published = self._data

    def refresh(self) -> None:
        """Save the part, if it has changed.

        Raises:
            StateError: the part cannot be saved, or is too large.
        """
        try:
            data = self._saved()
        except StateError as error:
            self._data = None  # a later "unchanged" would refer to a state never saved
            self._refused = self._refused or str(error)
            raise
        if data is not None:
            self._refused = ""
            if data != self._data:
                self._data, self._key = data, None

    def _saved(self) -> bytes | None:
        """Return the current state, serialised; None: unchanged since the last time."""
        try:
            message = self._save()
            self._check(message)
            data = None if message is None else bytes(serialize_message(message))
        except StateError:
            raise
        except Exception as error:  # the author's code may raise anything
            raise StateError(f"saving {self.topic} raised {describe_fault(error)}") from error
        if data is not None and len(data) > LARGEST_PART:
            raise StateError(
                f"the state on {self.topic} has {len(data)} bytes, more than the {LARGEST_PART} "
                f"that may travel in one message: split it in several topics, or keep less"
            )
        return data

    def _check(self, message: Any) -> None:
        if message is None and self._data is None:
            if self._refused:
                raise StateError(self._refused)  # the state is still the refused one
            raise StateError(
                f"saving {self.topic} returned None (unchanged) before it had returned any state"
            )
        if message is not None and not isinstance(message, self.message_type):
            raise StateError(
                f"saving {self.topic} returned a {type(message).__name__}, not a {self.type_name}"
            )

    def block(self) -> Block:
        """Return the part's block of a snapshot; the part must be refreshed."""
        if self._data is None:
            raise StateError(f"the state on {self.topic} was not saved")
        return Block(self._data, zlib.crc32(self._data))

    def described(self) -> StatePart:
        """Return the part's entry in a mark; the part must have been saved."""
        if self._key is None and self._data is not None:
            self._key = part_key(self._data)
        size, digest = self._key or (0, "")
        return StatePart(topic=self.topic, type=self.type_name, size=size, digest=digest)

    def restore_changed(self, data: bytes) -> None:
        """Restore a serialised message, unless it equals the last restored one.

        Raises:
            StateError: the message cannot be read, or the author's function raised.
        """
        key = part_key(data)
        if key == self._restored:
            return
        try:
            self._restore(deserialize_message(data, self.message_type))
        except Exception as error:  # the author's code may raise anything
            raise StateError(f"restoring {self.topic} raised {describe_fault(error)}") from error
        self._restored = key
        # The author's next `save` may return None (unchanged), which refers to this state.
        self._key, self._data, self._published = key, data, None


class DifferingPart(NamedTuple):
    """A part of which this node and a mark name different types; a missing one is "none"."""

    topic: str
    ours: str
    theirs: str


def differing_part(parts: Iterable[StateTopic], mark: StateMark) -> DifferingPart | None:
    """Return the first part that differs; None: all are the same."""
    ours = {part.topic: part.type_name for part in parts}
    marked = {part.topic: part.type for part in mark.parts}
    for topic in sorted(ours.keys() | marked.keys()):
        if ours.get(topic) != marked.get(topic):
            return DifferingPart(topic, ours.get(topic, "none"), marked.get(topic, "none"))
    return None


def size_fault(mark: StateMark) -> str:
    """Return a reason to refuse a mark for a number in it; "": there is none."""
    if mark.sequence >= MOST_CYCLES:
        return f"the mark of the state has the impossible number {mark.sequence}"
    for part in mark.parts:
        if part.size > LARGEST_PART:
            return f"the state on {part.topic} claims to have {part.size} bytes"
    return ""


def type_name(message_type: Any) -> str:
    """Return the ROS name of a Python message class, such as `std_msgs/msg/Int64`."""
    package, kind = message_type.__module__.split(".")[:2]
    return f"{package}/{kind}/{message_type.__name__}"


class ParametersPart(StateTopic):
    """The parameters of a node: those set at run time, and those that are only declared.

    A declared one has its value from the spec or the program, and a successor may have others.
    """

    def __init__(self, topic: str, node: Any) -> None:
        super().__init__(topic, ParameterEvent, self._all, self._take_over)
        self._node = node
        self._name = node.get_fully_qualified_name()  # read now: not available at shutdown
        self._changed = True
        self._count = 0
        self._declared = set(node._parameters)  # noqa: SLF001 - rclpy has no way to list all values
        self._set: set[str] = set()
        node.add_post_set_parameters_callback(self._note)

    def _note(self, parameters: list[Parameter]) -> None:
        self._changed = True
        names = {one.name for one in parameters}
        self._set |= names & self._declared
        self._declared |= names

    def _all(self) -> ParameterEvent | None:
        known = self._node._parameters  # noqa: SLF001 - rclpy has no way to list all values
        if not self._changed and len(known) == self._count:
            return None
        self._changed, self._count = False, len(known)
        event = ParameterEvent(node=self._name)
        for one in known.values():
            if one.type_ is not Parameter.Type.NOT_SET:
                was_set = one.name in self._set
                into = event.changed_parameters if was_set else event.new_parameters
                into.append(one.to_parameter_msg())
        return event

    def _take_over(self, event: ParameterEvent) -> None:
        declared = [Parameter.from_parameter_msg(one) for one in event.new_parameters]
        parameters = [Parameter.from_parameter_msg(one) for one in event.changed_parameters]
        for parameter in (*declared, *parameters):
            if not self._node.has_parameter(parameter.name):
                self._node.declare_parameter(parameter.name, parameter.value)
        differing = [one for one in parameters if not self._has(one)]
        # In one call, because the values may be valid only together.
        result = self._node.set_parameters_atomically(differing)
        if not result.successful:
            names = ", ".join(one.name for one in differing)
            raise ValueError(f"{names} cannot be set: {result.reason}")

    def _has(self, parameter: Parameter) -> bool:
        own = self._node.get_parameter_or(parameter.name, None)
        return own is not None and _content(own) == _content(parameter)


def _content(parameter: Parameter) -> tuple[Any, str]:
    """Return type and value in comparable form: NaN and serialised messages equal no copy."""
    value = parameter.value
    if hasattr(value, "__len__") and not isinstance(value, str):
        value = list(value)  # rclpy has lists, arrays or tuples
    return parameter.type_, repr(value)
