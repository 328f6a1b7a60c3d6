"""The parts of a node's state: saved and published by the source, restored by the destination."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.node.handoff.snapshot_assembler import PartKey, part_key
from rosrm.snapshots import Block
from rosrm_msgs.msg import StatePart


class StateError(Exception):
    """A state that cannot be saved or restored: what, and why."""


class Part:
    """One topic of a node's state.

    Args:
        topic: fully qualified.
        message_type: what travels.
        save: returns the message, or None: unchanged since the last time.
        restore: takes the message, and overwrites what the node had.

    Attributes:
        retained: what was saved is held also when it was published: it is kept elsewhere too.
    """

    def __init__(
        self,
        topic: str,
        message_type: Any,
        save: Callable[[], Any],
        restore: Callable[[Any], None],
    ) -> None:
        self.topic = topic
        self.message_type = message_type
        self.type_name = type_name(message_type)
        self._save = save
        self._restore = restore
        self._key: PartKey | None = None
        self._data: bytes | None = None
        self._published: PartKey | None = None
        self._restored: PartKey | None = None
        self._refused = ""
        self.retained = False
        self.publisher: Any = None

    def has_reader(self) -> bool:
        """Whether anybody listens to this part by itself."""
        return self.publisher is not None and self.publisher.get_subscription_count() > 0

    def publish(self, largest: int) -> None:
        """Publish it, if it has changed.

        Args:
            largest: bytes of one message.

        Raises:
            StateError: it cannot be saved, or is too large.
        """
        self.refresh(largest)
        if self._key != self._published:
            self.publisher.publish(self._data)
            self._published = self._key
        if not self.retained:
            self._data = None

    def refresh(self, largest: int) -> None:
        """Save it, if it has changed; otherwise as `publish`."""
        try:
            data = self._saved(largest)
        except StateError as error:
            self._key = self._data = None  # "unchanged" would speak of what nobody has
            self._refused = self._refused or str(error)
            raise
        if data is not None:
            self._refused = ""
        if data is not None:
            key = part_key(data)
            if key != self._key or self._data is None:
                self._key, self._data = key, data

    def _saved(self, largest: int) -> bytes | None:
        """The state now, serialised; None: it is what it was the last time."""
        try:
            message = self._save()
            self._check(message)
            if message is None:
                return None
            return self._sized(bytes(serialize_message(message)), largest)
        except StateError:
            raise
        except Exception as error:  # the author's code: anything may come
            raise StateError(
                f"saving {self.topic} raised {type(error).__name__}: {error}"
            ) from error

    def _check(self, message: Any) -> None:
        if message is None and self._key is None:
            if self._refused:
                raise StateError(self._refused)  # it is still what it was then
            raise StateError(
                f"saving {self.topic} returned None (unchanged) before it had returned any state"
            )
        if message is not None and not isinstance(message, self.message_type):
            raise StateError(
                f"saving {self.topic} returned a {type(message).__name__}, not a {self.type_name}"
            )

    def _sized(self, data: bytes, largest: int) -> bytes:
        if len(data) > largest:
            raise StateError(
                f"the state on {self.topic} has {len(data)} bytes, more than the {largest} that "
                f"may travel in one message: split it in several topics, or keep less"
            )
        return data

    def block(self) -> Block:
        """What is kept of it. It was refreshed before, and is retained."""
        if self._data is None or self._key is None:
            raise StateError(f"the state on {self.topic} was not saved")
        return Block(self._data, self._key.digest)

    def described(self) -> StatePart:
        """What a mark says of it. It was saved before."""
        size, digest = self._key or (0, 0)
        return StatePart(topic=self.topic, type=self.type_name, size=size, digest=digest)

    def restore_changed(self, data: bytes) -> None:
        """Take over a serialised message, unless it is what was taken over last.

        Raises:
            StateError: it cannot be read, or the author's function raised.
        """
        key = part_key(data)
        if key == self._restored:
            return
        try:
            self._restore(deserialize_message(data, self.message_type))
        except Exception as error:  # the author's code: anything may come
            raise StateError(
                f"restoring {self.topic} raised {type(error).__name__}: {error}"
            ) from error
        self._restored = key
        # "Unchanged" may be the first that the author says of it.
        self._key, self._data, self._published = key, data, None


def type_name(message_type: Any) -> str:
    """`std_msgs/msg/Int64` of the Python class."""
    package, kind = message_type.__module__.split(".")[:2]
    return f"{package}/{kind}/{message_type.__name__}"


class ParametersPart(Part):
    """The parameters of a node, as they were set at run time.

    Args:
        topic: fully qualified.
        node: rclpy's.
    """

    def __init__(self, topic: str, node: Any) -> None:
        super().__init__(topic, ParameterEvent, self._all, self._take_over)
        self._node = node
        self._name = node.get_fully_qualified_name()  # at the end ROS may not know it any more
        self._changed = True
        self._count = 0
        node.add_post_set_parameters_callback(self._note)

    def _note(self, _parameters: list[Parameter]) -> None:
        self._changed = True

    def _all(self) -> ParameterEvent | None:
        known = self._node._parameters  # noqa: SLF001 - rclpy has no way to list all values
        if not self._changed and len(known) == self._count:
            return None
        self._changed, self._count = False, len(known)
        return ParameterEvent(
            node=self._name,
            changed_parameters=[one.to_parameter_msg() for one in known.values()],
        )

    def _take_over(self, event: ParameterEvent) -> None:
        parameters = [Parameter.from_parameter_msg(one) for one in event.changed_parameters]
        for parameter in parameters:
            if not self._node.has_parameter(parameter.name):
                self._node.declare_parameter(parameter.name, parameter.value)
        differing = [one for one in parameters if not self._has(one)]
        # At once: they may be valid only together.
        result = self._node.set_parameters_atomically(differing)
        if not result.successful:
            names = ", ".join(one.name for one in differing)
            raise ValueError(f"{names} cannot be set: {result.reason}")

    def _has(self, parameter: Parameter) -> bool:
        own = self._node.get_parameter_or(parameter.name, None)
        return own is not None and _content(own) == _content(parameter)


def _content(parameter: Parameter) -> tuple[Any, str]:
    """Its type and value, by which it equals itself: NaN does not, nor do serialised messages."""
    value = parameter.value
    if hasattr(value, "__len__") and not isinstance(value, str):
        value = list(value)  # rclpy has lists, arrays or tuples
    return parameter.type_, repr(value)
