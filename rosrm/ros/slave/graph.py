"""Presence of an instance's nodes in the ROS graph, also where other nodes have the same name.

Every rclcpp and rclpy node publishes `/parameter_events`; the endpoint's GID names its participant.
Fast DDS writes the machine and the process id into the GID, so an instance is recognised by its own
pids. With another vendor, any endpoint counts that did not exist when the instance started.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any, Final

from rclpy.node import Node

_TOPIC: Final = "/parameter_events"
_FAST_DDS: Final = b"\x01\x0f"
#: Vendor, host, process: the rest of a GID's prefix is random numbers and counters.
_HOST: Final = slice(2, 4)
_PID: Final = slice(4, 6)


class GraphWatch:
    """Finds instances in the graph, seen from one node.

    Args:
        node: any node of this participant.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._host = b""

    def endpoints(self, name: str) -> frozenset[bytes]:
        """Return the GIDs of all nodes' endpoints under a fully qualified name, as known now.

        "": under any name.
        """
        return frozenset(gid for owner, gid in self._all() if name in ("", owner))

    def sees(self, name: str, pids: Iterable[int], before: frozenset[bytes]) -> bool:
        """Return True if the instance that runs as one of `pids` has a node of this full name.

        `before` are the endpoints of that name when the instance was started.
        """
        own = {pid & 0xFFFF for pid in pids}
        return any(self._belongs(gid, own, before) for gid in self.endpoints(name))

    def is_of(self, gid: bytes, pids: Iterable[int]) -> bool:
        """Return True if an endpoint is known to belong to one of these processes of this host."""
        return self._belongs(gid, {pid & 0xFFFF for pid in pids}, frozenset((gid,)))

    def _belongs(self, gid: bytes, own: set[int], before: frozenset[bytes]) -> bool:
        if gid[:2] != _FAST_DDS:
            return gid not in before
        return gid[_HOST] == self._own_host() and int.from_bytes(gid[_PID], "little") in own

    def _own_host(self) -> bytes:
        """Return the host in this node's own GID: another host may have a process with any pid."""
        if not self._host:
            own, name = os.getpid() & 0xFFFF, self._node.get_fully_qualified_name()
            for owner, gid in self._all():
                ours = owner == name and int.from_bytes(gid[_PID], "little") == own
                if ours and gid[:2] == _FAST_DDS:
                    self._host = gid[_HOST]
        return self._host

    def _all(self) -> list[tuple[str, bytes]]:
        infos: list[Any] = self._node.get_publishers_info_by_topic(_TOPIC)
        return [(_qualified(info), bytes(info.endpoint_gid)) for info in infos]


def _qualified(info: Any) -> str:
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"
