"""Clients of lifecycle nodes on this host: the slave reads and changes their states."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, Final

from rosrm.core.slave import events
from rosrm.core.slave.commands import ChangeLifecycleState, ReadLifecycleState
from rosrm.model.values import InstanceId
from rosrm.ros.slave.instance_clients import InstanceClients

#: Seconds after which a request for a state counts as lost; the core repeats it.
_PATIENCE: Final = 1.0


class LifecycleClients:
    """Requests to the managed lifecycle nodes.

    Args:
        take: takes events for the core.
    """

    def __init__(self, clients: InstanceClients, take: Callable[[events.Event], None]) -> None:
        self._clients = clients
        self._take = take

    def send(self, request: ReadLifecycleState | ChangeLifecycleState, now: float) -> None:
        """Send a request to a node; its answer becomes an event."""
        if isinstance(request, ReadLifecycleState):
            self._read(request)
        else:
            self._change(request, now)

    def _read(self, request: ReadLifecycleState) -> None:
        """Ask a node for its state, if discovery has found both services.

        The next request may be for a transition, and a request to an unknown service is lost.
        """
        instance, pid, lifecycle, at = request.instance, request.pid, request.lifecycle, request.at
        client = self._client(instance, "GetState", lifecycle.get_state)
        changing = self._client(instance, "ChangeState", lifecycle.change_state)

        def answered(response: Any) -> None:
            if response is not None:
                label = str(response.current_state.label)
                self._take(events.LifecycleStateRead(instance, pid, label, at))

        if client.service_is_ready() and changing.service_is_ready():
            self._clients.call(client, client.srv_type.Request(), at + _PATIENCE, answered)

    def _change(self, request: ChangeLifecycleState, now: float) -> None:
        """Ask a node for a transition."""
        instance, pid, transition = request.instance, request.pid, request.transition
        client = self._client(instance, "ChangeState", request.lifecycle.change_state)

        def answered(response: Any) -> None:
            if response is not None:
                done = bool(response.success)
                self._take(events.TransitionAnswered(instance, pid, transition, done))

        message = client.srv_type.Request()
        message.transition.id = getattr(
            import_module("lifecycle_msgs.msg").Transition, f"TRANSITION_{transition.upper()}"
        )
        self._clients.call(client, message, now + request.lifecycle.timeout, answered)

    def _client(self, instance: InstanceId, kind: str, name: str) -> Any:
        return self._clients.get(instance, getattr(import_module("lifecycle_msgs.srv"), kind), name)
