"""A component container for nodes in Python: several nodes in one process with one participant.

It has the services of a container of rclcpp (`load_node`, `unload_node` and `list_nodes` below
`~/_container`), so `ros2 component` and launch files use it as one. A component is a class whose
constructor passes its keyword arguments on to rclpy's `Node`:

    class Talker(Node):
        def __init__(self, **options):
            super().__init__("talker", **options)
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Final

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import remove_ros_args

from rosrm.errors import describe_fault
from rosrm.node.component_links import FAULTS, ComponentLinks, destroy
from rosrm.node.identity import made_for
from rosrm.ros.fast_dds import announcing
from rosrm.ros.peer_announcements import request_announcements

try:
    from composition_interfaces.srv import ListNodes, LoadNode, UnloadNode
except ModuleNotFoundError as missing:
    raise SystemExit(
        "rosrm container: the ROS package composition_interfaces is missing. Install "
        "ros-$ROS_DISTRO-composition-interfaces by apt; with the ROS wheels, "
        "`pip install ./composition_interfaces` in the source of rosrm"
    ) from missing

#: Entry points of components that their packages declare.
GROUP: Final = "rclpy_components"
_SERVICES: Final = "~/_container"


class Container:
    """The nodes of one container, and its services.

    Args:
        executor: runs the callbacks of all nodes.
        name: by which components that are processes find it on its host; "": they do not.
    """

    def __init__(self, executor: SingleThreadedExecutor, name: str = "") -> None:
        self.node = Node("container")
        self._executor = executor
        self._components: dict[int, Node] = {}
        self._newest = 0
        executor.add_node(self.node)
        self.node.create_service(LoadNode, f"{_SERVICES}/load_node", self._load)
        self.node.create_service(UnloadNode, f"{_SERVICES}/unload_node", self._unload)
        self.node.create_service(ListNodes, f"{_SERVICES}/list_nodes", self._list)
        self._log = self.node.get_logger()
        self._links = ComponentLinks(name, executor, new_node, self._log) if name else None

    def close(self) -> None:
        """Destroy all nodes."""
        if self._links is not None:
            self._links.close()
        for node in (*self._components.values(), self.node):
            destroy(node, self._log.error)

    def _load(self, request: Any, response: Any) -> Any:
        """Load a component; the answer says why that failed."""
        try:
            node = self._made(request)
        except FAULTS as error:
            response.error_message = f"{request.plugin_name}: {describe_fault(error)}"
        if response.error_message:
            self.node.get_logger().error(f"cannot load {response.error_message}")
            gc.collect()  # a node whose constructor raised is in the graph until it is freed
            return response
        self._newest += 1
        self._components[self._newest] = node
        self._executor.add_node(node)
        response.success, response.unique_id = True, self._newest
        response.full_node_name = node.get_fully_qualified_name()
        return response

    def _made(self, request: Any) -> Node:
        """Return the node of a component.

        Raises:
            ValueError: there is no such component, or a component of its name is loaded already.
            TypeError: it is no node of rclpy.
        """
        overrides = [Parameter.from_parameter_msg(one) for one in request.parameters]
        plugin, words = request.plugin_name, _arguments(request)
        with made_for({}):  # it is no process of rosrm, although the container is one
            node = new_node(plugin, words, request.package_name, parameter_overrides=overrides)
        name = node.get_fully_qualified_name()
        if name in map(Node.get_fully_qualified_name, self._components.values()):
            node.destroy_node()
            raise ValueError(f"a component {name} is loaded already; give this one another name")
        if request.log_level:
            node.get_logger().set_level(LoggingSeverity(request.log_level))
        return node

    def _unload(self, request: Any, response: Any) -> Any:
        """Destroy a component."""
        node = self._components.pop(request.unique_id, None)
        if node is None:
            loaded = ", ".join(map(str, self._components)) or "none"
            response.error_message = f"no component {request.unique_id}; loaded: {loaded}"
            return response
        self._executor.remove_node(node)
        destroy(node, self._log.error)
        response.success = True
        return response

    def _list(self, _request: Any, response: Any) -> Any:
        """List the components."""
        response.unique_ids = list(self._components)
        names = map(Node.get_fully_qualified_name, self._components.values())
        response.full_node_names = list(names)
        return response


def new_node(plugin: str, arguments: Sequence[str], package: str = "", **options: Any) -> Node:
    """Return the node of a component; raises what its constructor raises.

    Args:
        arguments: command line of the node; that of the container does not apply.

    Raises:
        ValueError: there is no such component.
        TypeError: it is no node of rclpy.
    """
    component = find_component(package, plugin)
    node = component(cli_args=list(arguments), use_global_arguments=False, **options)
    if not isinstance(node, Node):
        raise TypeError(f"it makes a {type(node).__name__}, not a node of rclpy")
    return node


def find_component(package: str, plugin: str) -> Callable[..., Any]:
    """Return a component by the name that its package declares, or as "module:Class".

    Raises:
        ValueError: there is none, or the name fits several packages.
    """
    declared = [
        one for one in entry_points(group=GROUP, name=plugin)
        if not package or (one.dist is not None and _same(one.dist.name, package))
    ]  # fmt: skip
    if len(declared) > 1:
        raise ValueError(f"several packages have a component {plugin}; name one of them")
    if declared:
        return declared[0].load()  # type: ignore[no-any-return]  # entry points have no types
    module, colon, name = plugin.partition(":")
    if not colon:
        of = f" of the package {package}" if package else ""
        raise ValueError(f"no entry point {plugin!r}{of} in {GROUP}, and no name as module:Class")
    found: Callable[..., Any] | None = getattr(import_module(module), name, None)
    if found is None:
        raise ValueError(f"{module} has no class {name}")
    return found


def _same(distribution: str, package: str) -> bool:
    return distribution.replace("-", "_").lower() == package.lower()


def _arguments(request: Any) -> list[str]:
    """Return the command line of a component's node."""
    rules = list(request.remap_rules)
    if request.node_name:
        rules.append(f"__node:={request.node_name}")
    if request.node_namespace:
        rules.append(f"__ns:={request.node_namespace}")
    return ["--ros-args", *(word for rule in rules for word in ("-r", rule))]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a container until a signal ends it."""
    words = sys.argv if arguments is None else ["container", *arguments]
    rclpy.init(args=words)
    executor = SingleThreadedExecutor()
    with announcing(os.environ, "steady", udp=False):  # as for a migratable node
        container = Container(executor, _own_name(remove_ros_args(words)[1:]))
    request_announcements(rclpy.get_default_context().get_domain_id(), os.environ)
    try:
        with suppress(KeyboardInterrupt, ExternalShutdownException):  # the usual ends of a node
            executor.spin()
    finally:
        container.close()
        rclpy.try_shutdown()


def _own_name(words: Sequence[str]) -> str:
    """Return the name of this container on its host; "": rosrm has not started it."""
    process = os.environ.get("ROSRM_PROCESS", "")
    return words[0] if process and words else process


if __name__ == "__main__":
    main()
