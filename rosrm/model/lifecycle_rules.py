"""Rules on a process whose lifecycle node is brought to a state by its slave."""

from __future__ import annotations

from rosrm.model.values import ProcessSpec


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
