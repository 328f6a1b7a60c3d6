"""Wait for the second publisher of a topic.

A message does not name its sender (its info has no GID in Jazzy), but each writer numbers its
messages. So the messages of two alternating writers show falling numbers. The graph names the
writers.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Final

import rclpy
from rclpy.node import Node

from rosrm import clocks
from rosrm.ros import qos
from rosrm.ros.polling import message_type, polled_subscription, waiting

#: The weakest requirements: they match every publisher.
_ANY: Final = qos.best_effort(depth=1000)
#: The graph's name of a node of which only the endpoints are known.
_UNKNOWN: Final = "_NODE_NAME_UNKNOWN_"
#: Seconds between two polls.
_EVERY: Final = 0.005


def await_second_publisher(
    topic: str, type_name: str, source: str, destination: str, timeout: float
) -> Mapping[str, Any]:
    """Block until both source and destination publish a topic, and no other node does.

    Args:
        topic: absolute name.
        type_name: as "std_msgs/msg/Int64".
        source, destination: names of their nodes, without namespace.

    Returns:
        The number of messages received, and the seconds that passed.

    Raises:
        TimeoutError: the message describes the messages received instead.
        ValueError: another node publishes there too, or there is no such type.
    """
    begun = clocks.boot_time()
    kind = _type_of(type_name)
    context = rclpy.Context()
    context.init(initialize_logging=False)
    try:
        node = Node(
            "rosrm_watch", context=context, use_global_arguments=False, enable_rosout=False,
            start_parameter_services=False,
        )  # fmt: skip
        try:
            names = frozenset((source, destination))
            received, both = _listen(node, topic, kind, names, begun + timeout)
            if both:
                return {"heard": received, "seconds": clocks.boot_time() - begun}
            reason = _missing(node, topic, type_name, received)
        finally:
            node.destroy_node()
    finally:
        context.try_shutdown()
    raise TimeoutError(f"{reason}, in {timeout:g} s")


def _listen(
    node: Node, topic: str, kind: Any, names: frozenset[str], deadline: float
) -> tuple[int, bool]:
    """Return the number of messages received, and True if they came from both publishers."""
    subscription = polled_subscription(node, kind, topic, _ANY)
    received, last, two = 0, 0, False
    while clocks.boot_time() < deadline:
        for _, info in waiting(subscription):
            received += 1
            count = int(info["publication_sequence_number"])
            two = two or count <= last
            last = count
        if two and _are_alone(node, topic, names):
            return received, True
        time.sleep(_EVERY)
    return received, False


def _are_alone(node: Node, topic: str, names: frozenset[str]) -> bool:
    """Return True if just these nodes publish there; the graph learns node names after topics."""
    found = {info.node_name for info in node.get_publishers_info_by_topic(topic)}
    others = sorted(found - names - {_UNKNOWN})
    if others:
        raise ValueError(
            f"{topic} is also published by {', '.join(others)}, so messages of the destination "
            f"cannot be told apart: with `protocol: paper` only the node itself may publish its "
            f"state"
        )
    return found == names


def _missing(node: Node, topic: str, type_name: str, received: int) -> str:
    if received:
        return f"only one publisher of {topic} sent messages ({received} received)"
    types = {info.topic_type for info in node.get_publishers_info_by_topic(topic)}
    if not types:
        return f"no node publishes {topic}"
    if type_name not in types:
        return f"{topic} is published as {', '.join(sorted(types))}, not {type_name}"
    return f"{topic} is published, but no message on it was received"


def _type_of(name: str) -> Any:
    try:
        return message_type(name)
    except (ImportError, ValueError) as error:
        raise ValueError(f"there is no message type {name!r} on this host: {error}") from error
