"""A ROS 2 node without the topics and services that these examples do not use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

_WITHOUT_TYPE_SERVICE = ["--ros-args", "-p", "start_type_description_service:=false"]


@contextmanager
def lean_node(name: str, arguments: list[str]) -> Iterator[Node]:
    """Create a node for the lifetime of the context; signals stay the caller's.

    Args:
        name: The node's name, unless the arguments remap it.
        arguments: The command line; only what follows `--ros-args` is used.
    """
    with ros_context([*arguments, *_WITHOUT_TYPE_SERVICE]):
        node = Node(name, enable_rosout=False, start_parameter_services=False)
        yield node  # the frame keeps a reference, so that the caller need not


@contextmanager
def ros_context(arguments: list[str]) -> Iterator[None]:
    """Initialise ROS for the lifetime of the context; signals stay the caller's.

    Args:
        arguments: The command line; only what follows `--ros-args` is used.
    """
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    finally:
        rclpy.shutdown()
