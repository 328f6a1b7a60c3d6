"""Subscriptions that are polled instead of served by an executor."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from typing import Any, Final

from rclpy.node import Node
from rclpy.qos import QoSProfile

#: Most messages that are taken from one reader in a row.
_AT_A_TIME: Final = 1000


def polled_subscription(node: Node, kind: Any, topic: str, qos: QoSProfile) -> Any:
    """Create a subscription whose messages stay serialised; the node is in no executor."""
    return node.create_subscription(kind, topic, _never_called, qos, raw=True)


def waiting(subscription: Any, most: int = _AT_A_TIME) -> Iterator[tuple[Any, Any]]:
    """Take received messages that no executor has served yet, with their information.

    Their number is limited, so the loop ends even if messages arrive faster than it takes them.
    """
    handle = subscription.handle
    with handle:
        for _ in range(most):
            taken = handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            yield taken


def message_type(name: str) -> Any:
    """Return the class of a message type, named as "std_msgs/msg/Int64"."""
    package, _, kind = name.partition("/msg/")
    return getattr(import_module(f"{package}.msg"), kind)


def _never_called(_message: object) -> None:
    raise AssertionError("messages are polled, never called back")
