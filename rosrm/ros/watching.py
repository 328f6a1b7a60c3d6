"""Listens to a topic until a second publisher speaks there.

A message does not say who sent it (its info has no GID in Jazzy), but each writer counts what it
writes: two that speak in turn are heard as a count that falls.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from importlib import import_module
from typing import Any, Final

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

#: The least that can be asked for: it matches every publisher.
_ANY: Final = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)  # fmt: skip
#: Seconds between two looks.
_EVERY: Final = 0.005


def await_second_publisher(topic: str, type_name: str, timeout: float) -> Mapping[str, Any]:
    """Block until two publishers of a topic have been heard.

    Args:
        topic: absolute name.
        type_name: as "std_msgs/msg/Int64".
        timeout: seconds.

    Returns:
        How many messages were heard, and after how many seconds.

    Raises:
        TimeoutError: with what was heard instead.
    """
    begun = time.monotonic()
    kind = _type_of(type_name)
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node(
            "rosrm_watch", context=context, use_global_arguments=False, enable_rosout=False,
            start_parameter_services=False,
        )  # fmt: skip
        try:
            heard = _listen(node, topic, kind, begun + timeout)
            if heard < 0:
                return {"heard": -heard, "seconds": time.monotonic() - begun}
            reason = _missing(node, topic, type_name, heard)
        finally:
            node.destroy_node()
    finally:
        context.try_shutdown()
    raise TimeoutError(f"{reason}, in {timeout:g} s")


def _listen(node: Node, topic: str, kind: Any, deadline: float) -> int:
    """How many messages were heard; negative: of more than one publisher."""
    subscription = node.create_subscription(kind, topic, _never_called, _ANY, raw=True)
    heard, last = 0, 0
    handle = subscription.handle
    while time.monotonic() < deadline:
        with handle:
            taken = handle.take_message(kind, True)
        if taken is None:
            time.sleep(_EVERY)
            continue
        heard += 1
        count = int(taken[1]["publication_sequence_number"])
        if count <= last:
            return -heard
        last = count
    return heard


def _missing(node: Node, topic: str, type_name: str, heard: int) -> str:
    if heard:
        return f"only one publisher of {topic} was heard ({heard} messages)"
    types = {info.topic_type for info in node.get_publishers_info_by_topic(topic)}
    if not types:
        return f"nobody publishes {topic}"
    if type_name not in types:
        return f"{topic} is published as {', '.join(sorted(types))}, not {type_name}"
    return f"{topic} is published, and nothing was heard on it"


def _type_of(name: str) -> Any:
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(import_module(f"{package}.msg"), kind)
    except (AttributeError, ImportError, ValueError) as error:
        raise ValueError(f"there is no message type {name!r} on this host: {error}") from error


def _never_called(_message: object) -> None:
    raise AssertionError("the topic is polled, never called back")
