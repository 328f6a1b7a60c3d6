"""Requests of the slave to component containers on its host."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from math import inf
from typing import Any, Final

from rclpy.parameter import Parameter

from rosrm.core.slave import events
from rosrm.core.slave.commands import ListComponents, LoadComponent
from rosrm.model.values import Component, InstanceId
from rosrm.ros.slave.instance_clients import InstanceClients
from rosrm.runtime.path_calls import RunPath

#: Seconds after which a request for a list counts as lost; the core repeats it.
_PATIENCE: Final = 1.0
_MISSING: Final = (
    "the ROS package composition_interfaces is missing on this host; install "
    "ros-$ROS_DISTRO-composition-interfaces"
)


class ComponentLoads:
    """Requests to component containers.

    Args:
        take: takes events for the core.
        filled: returns a function that fills the placeholders of a component with values of this
            host, which touches paths of users; that raises `LaunchError`.
        run: as `PathCalls.run`.
    """

    def __init__(
        self, clients: InstanceClients, take: Callable[[events.Event], None],
        filled: Callable[[InstanceId, Component], Callable[[], Component]], run: RunPath,
    ) -> None:  # fmt: skip
        self._clients = clients
        self._take = take
        self._filled = filled
        self._run = run

    def send(self, request: ListComponents | LoadComponent, now: float) -> None:
        """Send a request to a container; its answer becomes an event."""
        try:
            srv = import_module("composition_interfaces.srv")
        except ModuleNotFoundError:
            self._note_missing(request)
            return
        if isinstance(request, ListComponents):
            self._list(srv, request, now)
        else:
            self._load(srv, request)

    def _note_missing(self, request: ListComponents | LoadComponent) -> None:
        """Answer in place of a container: it has no components, and can load none."""
        instance, pid = request.instance, request.pid
        if isinstance(request, ListComponents):
            self._take(events.ComponentsListed(instance, pid, frozenset()))
        else:
            self._take(events.ComponentLoaded(instance, pid, request.component, _MISSING))

    def _list(self, srv: Any, request: ListComponents, now: float) -> None:
        """Ask a container for its list, if discovery has found both services.

        The next request may be for a load, and a request to an unknown service is lost.
        """
        instance, pid, services = request.instance, request.pid, request.services
        client = self._clients.get(instance, srv.ListNodes, f"{services}/list_nodes")
        loading = self._clients.get(instance, srv.LoadNode, f"{services}/load_node")

        def answered(response: Any) -> None:
            if response is not None:
                names = frozenset(map(str, response.full_node_names))
                self._take(events.ComponentsListed(instance, pid, names))

        if client.service_is_ready() and loading.service_is_ready():
            self._clients.call(client, srv.ListNodes.Request(), now + _PATIENCE, answered)

    def _load(self, srv: Any, request: LoadComponent) -> None:
        """Order a container to load a component, however long its constructor takes."""
        instance, component = request.instance, request.component

        def loaded(fault: str) -> None:
            self._take(events.ComponentLoaded(instance, request.pid, component, fault))

        def answered(response: Any) -> None:
            if response is not None:
                unsaid = "the container gives no reason"
                loaded("" if response.success else response.error_message or unsaid)

        def order(filled: Component) -> None:
            client = self._clients.get(instance, srv.LoadNode, f"{request.services}/load_node")
            self._clients.call(client, load_request(srv, filled), inf, answered)

        self._run(self._filled(instance, component), order, lambda fault: loaded(str(fault)))


def load_request(srv: Any, component: Component) -> Any:
    """Return the request to load a component."""
    return srv.LoadNode.Request(
        package_name=component.package, plugin_name=component.plugin,
        node_name=component.name, node_namespace=component.namespace,
        remap_rules=[f"{old}:={new}" for old, new in component.remappings.items()],
        parameters=_parameters(component.parameters),
        extra_arguments=_parameters(component.arguments),
    )  # fmt: skip


def _parameters(values: Mapping[str, Any]) -> list[Any]:
    return [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
