"""A ROS 2 node without the topics and services that these examples have no use for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

_WITHOUT_TYPE_SERVICE = ["--ros-args", "-p", "start_type_description_service:=false"]


@contextmanager
def lean_node(name: str, arguments: list[str]) -> Iterator[Node]:
    """Is in the ROS graph for as long as the context lasts; signals stay the caller's.

    Args:
        name: The node's name, unless the arguments remap it.
        arguments: The command line; only what follows `--ros-args` is used.
    """
    with ros_context([*arguments, *_WITHOUT_TYPE_SERVICE]):
        node = Node(name, enable_rosout=False, start_parameter_services=False)
        yield node  # held here too: a caller need not name it to keep it in the graph


@contextmanager
def ros_context(arguments: list[str]) -> Iterator[None]:
    """Has ROS ready for as long as the context lasts; signals stay the caller's.

    Args:
        arguments: The command line; only what follows `--ros-args` is used.
    """
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    finally:
        rclpy.shutdown()
