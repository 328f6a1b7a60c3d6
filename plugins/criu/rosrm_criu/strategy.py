"""`criu`: migration of a node with its whole memory, for state that is on no topic.

The node itself leaves the ROS graph (`rosrm_criu.node.PortableNode`), is frozen, and is dumped by
CRIU. The destination fetches the image and restores it, and the node rejoins the graph. Until the
destination owns the name, the source stays frozen and can continue.
"""

from __future__ import annotations

from collections.abc import Mapping

from rosrm import Execute, InstanceId, Move, Plan, ProcessSpec, options_of
from rosrm_criu.engine.compatibility import mismatch
from rosrm_criu.options import CriuOptions, OwnCriuOptions
from rosrm_criu.plans import (
    HOST_CHECK,
    SWEEP,
    checkpoint_plan,
    move_plan,
    periodic_step,
    restore_plan,
)


class Criu:
    """The strategy that migrates the whole memory."""

    def __init__(self, options: CriuOptions) -> None:
        self._options = options

    @property
    def host_check(self) -> str:
        """Name the executor that tests CRIU on a host."""
        return HOST_CHECK

    def host_fault(self, source: Mapping[str, str], destination: Mapping[str, str]) -> str:
        """Return the reason why an image of one host cannot be restored on another; "": it can."""
        if source.get("host") != destination.get("host"):
            for one in (source, destination):
                if one.get("no_transfer"):
                    return f"no image can be sent to or from {one['host']}: {one['no_transfer']}"
        return mismatch(source, destination)

    def spec_fault(self, spec: ProcessSpec) -> str:
        """Return the reason why a process cannot migrate this way; "": it can."""
        if not spec.ros:
            return (
                "it moves only ROS nodes that can leave and rejoin (rosrm_criu.node.PortableNode), "
                "and this process is no node: set `ros: true`"
            )
        return ""

    def propose(self, move: Move) -> Plan:
        """Return a plan: freeze, dump, fetch, restore, commit, join, end the source.

        The destination reports that it is ready before the node is asked to leave.
        """
        fault = self.spec_fault(move.spec)
        if fault:
            raise ValueError(fault)
        return move_plan(move, move.options)

    def checkpoint(self, move: Move) -> Plan:
        """Return a plan to dump and end the process, ROS node or not; no node leaves the graph."""
        return checkpoint_plan(move, move.options)

    def restore(self, move: Move) -> Plan:
        """Return a plan to restore the process on the host of its image."""
        return restore_plan(move, move.options)

    def checkpoint_every(self, spec: ProcessSpec) -> float:
        """Return the seconds between periodic checkpoints from the process's options; 0: none."""
        return self._own(spec).checkpoint_every if spec.ros else 0.0

    def periodic(self, spec: ProcessSpec, instance: InstanceId, host: str, now: int) -> Execute:
        """Return a step in which the node leaves, is dumped, and rejoins."""
        return periodic_step(spec, instance, host, now, self._own(spec))

    @property
    def discard(self) -> str:
        """Name the executor that removes unneeded images."""
        return SWEEP

    def _own(self, spec: ProcessSpec) -> OwnCriuOptions:
        return options_of(spec, self._options, OwnCriuOptions)
