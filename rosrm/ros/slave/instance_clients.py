"""Service clients of the instances on this host."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.qos import qos_profile_services_default

from rosrm.model.values import InstanceId
from rosrm.ros.control import ControlClient
from rosrm.ros.participant import Participant


class InstanceClients:
    """Service clients by instance, created at the first request to each.

    They stay until the instance ends, because discovery would delay the first request of a new
    client.
    """

    def __init__(self, participant: Participant) -> None:
        self._node = participant.node
        self._calls = ControlClient(participant, "")
        self._clients: dict[InstanceId, dict[str, Any]] = {}

    def get(self, instance: InstanceId, kind: Any, name: str) -> Any:
        """Return the client of a service with an absolute name."""
        clients = self._clients.setdefault(instance, {})
        if name not in clients:
            clients[name] = self._node.create_client(
                kind, name, qos_profile=qos_profile_services_default
            )
        return clients[name]

    def call(self, client: Any, request: Any, deadline: float, done: Callable[[Any], None]) -> None:
        """Send a request; `done` gets the answer, or None at the deadline."""
        self._calls.call(client, request, deadline, done)

    def expire(self, now: float) -> None:
        """Drop requests without an answer."""
        self._calls.expire(now)

    def close(self, instance: InstanceId) -> None:
        """Destroy the clients of an instance that has ended."""
        for client in self._clients.pop(instance, {}).values():
            self._node.destroy_client(client)
