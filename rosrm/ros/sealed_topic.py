"""Topics whose messages are sealed by one link; imported by nodes only in a handoff."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.keys.links import Link, SealedMessage
from rosrm.keys.sealing import FORMAT, RUN_BYTES
from rosrm.ros.sealed_codec import Envelope, decode, encode, topic_channel
from rosrm_msgs import msg

#: Run of a receiver that is not known.
UNKNOWN_RUN: Final = bytes(RUN_BYTES)


class SealedTopic:
    """One topic whose messages are sealed by one link.

    Args:
        link: to the other side, or to both other parties of a handoff.
        principal: text that names the key of the link, see `rosrm.keys.names`.
        message_type: of the plain messages.
        name: of the topic, fully qualified.
    """

    def __init__(self, link: Link, principal: str, message_type: Any, name: str) -> None:
        self._link = link
        self._principal = principal
        self._message_type = message_type
        self._channel = topic_channel(message_type, name)
        self._own_run = b""
        self.name = name

    def seal(self, plain: bytes) -> bytes:
        """Return the CDR form of a sealed message, from a serialised message."""
        done = self._link.seal(self._channel, plain, UNKNOWN_RUN)
        self._own_run = done.run
        return encode(
            Envelope(FORMAT, self._principal, 0, done.run, UNKNOWN_RUN, done.counter, done.body)
        )

    def open(self, data: bytes) -> bytes | None:
        """Return a serialised message; None: it is not genuine, repeated, or of this side."""
        found = decode(data)
        if found is None or (found.format, found.principal) != (FORMAT, self._principal):
            return None
        if found.run == self._own_run:  # both directions of a handoff have one key
            return None
        message = SealedMessage(found.run, found.counter, bytes(found.body))
        return self._link.open(self._channel, message, found.receiver_run)

    def read(self, data: bytes) -> Any:
        """Return a message; None as in `open`."""
        plain = self.open(data)
        if plain is None:
            return None
        try:
            return deserialize_message(plain, self._message_type)
        except Exception:  # noqa: BLE001 - rclpy's error for bytes that are no message
            return None  # with `security: none`, anyone may have sent the bytes

    def publisher(self, node: Any, profile: QoSProfile, **named: Any) -> SealedWriter:
        """Create a publisher; `named` is passed to the node's method."""
        return SealedWriter(self, node.create_publisher(msg.Sealed, self.name, profile, **named))

    def subscription(
        self, node: Any, profile: QoSProfile, take: Callable[[bytes], None], **named: Any
    ) -> Any:
        """Create a subscription; `take` gets the argument of `open` and `read`."""
        return node.create_subscription(
            msg.Sealed, self.name, take, profile, raw=True, **named
        )  # fmt: skip


class SealedWriter:
    """Publisher of a sealed topic.

    Attributes:
        entity: rclpy's publisher.
    """

    def __init__(self, topic: SealedTopic, entity: Any) -> None:
        self._topic = topic
        self.entity = entity

    def publish(self, message: Any) -> None:
        """Send a message, serialised or not."""
        plain = message if isinstance(message, bytes) else serialize_message(message)
        self.entity.publish(self._topic.seal(plain))
