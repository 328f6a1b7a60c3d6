"""The parts of a node's state: saved and published by the source, restored by the destination."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.node.cuts import PartKey, part_key
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
        self._restored: PartKey | None = None
        self._inherited: bytes | None = None
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
        data = self._saved()
        if data is None:
            return
        if len(data) > largest:
            self._key = None  # what was saved is not what was published last
            raise StateError(
                f"the state on {self.topic} has {len(data)} bytes, more than the {largest} that "
                f"may travel in one message: split it in several topics, or keep less"
            )
        self._inherited = None
        key = part_key(data)
        if key != self._key:
            self._key = key
            self.publisher.publish(data)

    def _saved(self) -> bytes | None:
        """The state now, serialised; None: it is what was published last."""
        try:
            message = self._save()
            self._check(message)
            return self._inherited if message is None else bytes(serialize_message(message))
        except StateError:
            self._key = None
            raise
        except Exception as error:  # the author's code: anything may come
            self._key = None
            raise StateError(
                f"saving {self.topic} raised {type(error).__name__}: {error}"
            ) from error

    def _check(self, message: Any) -> None:
        if message is None and self._key is None and self._inherited is None:
            raise StateError(
                f"saving {self.topic} returned None (unchanged) before it had returned any state"
            )
        if message is not None and not isinstance(message, self.message_type):
            raise StateError(
                f"saving {self.topic} returned a {type(message).__name__}, not a {self.type_name}"
            )

    def described(self) -> StatePart:
        """What a mark says of it. It was published before."""
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
        self._inherited = data  # "unchanged" may be the first that the author says of it


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
            node=self._node.get_fully_qualified_name(),
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
