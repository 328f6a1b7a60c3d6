"""Rules on a process whose lifecycle node is brought to a state by its slave."""

from __future__ import annotations

from typing import Final

from rosrm.model.values import InstanceId, ProcessSpec

#: Services of a lifecycle node by which its slave reads and changes its state.
_SERVICES: Final = ("get_state", "change_state")


def lifecycle_fault(spec: ProcessSpec) -> str:
    """Return why the slave cannot change the lifecycle state of a process; "" if it can."""
    if not spec.lifecycle.is_managed:
        return ""
    if not spec.ros:
        return "lifecycle: only a ROS node has a lifecycle; set `ros: true` if this is one"
    if not spec.node:
        return (
            "lifecycle: the name of the node is required, and `node_name: keep` leaves it unknown"
        )
    if not spec.awaits_graph:
        return (
            "lifecycle: the slave changes the state when the node is in the ROS graph, and "
            "`readiness: running` does not wait for that"
        )
    return ""


def own_services(spec: ProcessSpec, instance: InstanceId) -> dict[str, str]:
    """Return remappings that give a managed lifecycle node services of its own.

    The destination of a move has the name of its source. In DDS both would execute a request to a
    service of one name, and a node of rclpy ends if it cannot make the requested transition.
    """
    if not spec.lifecycle.is_managed:
        return {}
    return {f"~/{name}": f"~/instance_{instance.number}/{name}" for name in _SERVICES}
