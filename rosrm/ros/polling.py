"""Subscriptions that are polled instead of served by an executor."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, Final

from rclpy.node import Node
from rclpy.qos import QoSProfile

#: Most messages that are taken from one reader in a row.
_AT_A_TIME: Final = 1000
#: Names that ROS allows for packages and messages.
_PACKAGE: Final = re.compile(r"[a-z][a-z0-9_]*")
_KIND: Final = re.compile(r"[A-Z][A-Za-z0-9]*")


def polled_subscription(node: Node, kind: Any, topic: str, qos: QoSProfile) -> Any:
    """Create a subscription whose messages stay serialised; the node is in no executor."""
    return node.create_subscription(kind, topic, _never_called, qos, raw=True)


def waiting(subscription: Any, most: int = _AT_A_TIME) -> Iterator[tuple[Any, Any]]:
    """Take received messages that no executor has served yet, with their information.

    Their number is limited, so the loop ends even if messages arrive faster than it takes them.
    """
    handle = subscription.handle
    take = partial(handle.take_message, subscription.msg_type, subscription.raw)
    with handle:
        yield from islice(iter(take, None), most)


def message_type(name: str) -> Any:
    """Return the class of a message type, named as "std_msgs/msg/Int64".

    Only generated packages of messages are imported, because the name may come from any node.

    Raises:
        ValueError: this host has no such type.
    """
    package, _, kind = name.partition("/msg/")
    if not (_PACKAGE.fullmatch(package) and _KIND.fullmatch(kind) and _is_generated(package)):
        raise ValueError(f"there is no package of messages for {name!r}")
    found = getattr(import_module(f"{package}.msg"), kind, None)
    if not hasattr(found, "get_fields_and_field_types"):
        raise ValueError(f"the package {package} has no message {kind!r}")
    return found


def _is_generated(package: str) -> bool:
    """Return True if a Python package comes with the type support of ROS messages."""
    spec = find_spec(package)
    places = [] if spec is None else spec.submodule_search_locations or []
    library = f"{package}_s__rosidl_typesupport_c*.so"
    return any(next(Path(place).glob(library), None) is not None for place in places)


def _never_called(_message: object) -> None:
    raise AssertionError("messages are polled, never called back")
