"""`criu`: migration of a node with its whole memory, for state that is on no topic.

The node itself leaves the ROS graph (`rosrm_criu.node.PortableNode`), is frozen, and is dumped by
CRIU. The destination fetches the image and restores it, and the node rejoins the graph. Until the
destination owns the name, the source stays frozen and can continue.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosrm import (
    Commit,
    Execute,
    InstanceId,
    Move,
    Plan,
    ProcessSpec,
    SetRestart,
    Start,
    Stop,
    options_of,
)
from rosrm_criu.engine.compatibility import mismatch
from rosrm_criu.options import CriuOptions, OwnCriuOptions
from rosrm_criu.plans import (
    ABILITY,
    AWAIT_RESTORED,
    CHECKPOINT,
    END,
    FETCH,
    GO_ON,
    INTRODUCE,
    JOIN,
    SWEEP,
    checkpoint_plan,
    execute,
    periodic_step,
    restore_plan,
    suspend,
)


class Criu:
    """The strategy that migrates the whole memory."""

    def __init__(self, options: CriuOptions) -> None:
        self._options = options

    @property
    def ability(self) -> str:
        """Name the executor that tests CRIU on a host."""
        return ABILITY

    def host_fault(self, source: Mapping[str, str], destination: Mapping[str, str]) -> str:
        """Return the reason why an image of one host cannot be restored on another; "": it can."""
        if source.get("host") != destination.get("host"):
            for one in (source, destination):
                if one.get("no_transfer"):
                    return f"no image can be sent to or from {one['host']}: {one['no_transfer']}"
        return mismatch(source, destination)

    def spec_fault(self, spec: ProcessSpec) -> str:
        """Return the reason why a process cannot migrate this way; "": it can."""
        if not spec.ros_node:
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
        return _Draft(move, move.options).plan()

    def checkpoint(self, move: Move) -> Plan:
        """Return a plan to dump and end the process, ROS node or not; no node leaves the graph."""
        return checkpoint_plan(move, move.options)

    def restore(self, move: Move) -> Plan:
        """Return a plan to restore the process on the host of its image."""
        return restore_plan(move, move.options)

    def checkpoint_every(self, spec: ProcessSpec) -> float:
        """Return the seconds between periodic checkpoints from the process's options; 0: none."""
        return self._own(spec).checkpoint_every if spec.ros_node else 0.0

    def periodic(self, spec: ProcessSpec, instance: InstanceId, host: str, now: int) -> Execute:
        """Return a step in which the node leaves, is dumped, and rejoins."""
        return periodic_step(spec, instance, host, now, self._own(spec))

    @property
    def discard(self) -> str:
        """Name the executor that removes unneeded images."""
        return SWEEP

    def _own(self, spec: ProcessSpec) -> OwnCriuOptions:
        return options_of(spec, self._options, OwnCriuOptions)


class _Draft:
    """Builder of one plan."""

    def __init__(self, move: Move, options: CriuOptions) -> None:
        self._move = move
        self._options = options

    def plan(self) -> Plan:
        move, options = self._move, self._options
        stop_there = Stop(move.destination, move.destination_host, move.spec.stop.timeout)
        return Plan(
            (
                suspend(move, options.start_timeout),
                self._introduce(),
                self._checkpoint(),
                self._fetch(),
                Start(
                    move.destination, move.destination_host, options.start_timeout,
                    undo=stop_there, restored=True,
                ),
                self._there(AWAIT_RESTORED, options.restore_timeout),
                Commit(),
                self._there(JOIN, options.join_timeout),
                SetRestart(
                    move.destination, move.destination_host, move.spec.restart,
                    options.start_timeout,
                ),
                self._here(END, options.start_timeout),
                Stop(move.source, move.source_host, move.spec.stop.timeout),
            )
        )  # fmt: skip

    # The preparation of the destination and the fetch have no undo, because an undo would wait for
    # a host that may be lost, and the source would wait too. Both are cleaned up after a timeout.

    def _introduce(self) -> Execute:
        options = self._options
        keep = self._until_dumped() + 2 * options.start_timeout
        return self._there(
            INTRODUCE, options.start_timeout, keep=keep,
            working_directory=self._move.spec.working_directory,
        )  # fmt: skip

    def _checkpoint(self) -> Execute:
        options = self._options
        there = options.transfer_timeout + options.start_timeout
        seconds = {"leave": options.leave_timeout, "dump": options.dump_timeout, "offer": there}
        go_on = self._here(GO_ON, options.join_timeout)
        return self._here(
            CHECKPOINT, self._until_dumped(),
            undo=go_on, seconds=seconds, max_rate=options.max_rate,
        )  # fmt: skip

    def _until_dumped(self) -> float:
        options = self._options
        return options.start_timeout + options.leave_timeout + options.dump_timeout

    def _fetch(self) -> Execute:
        options = self._options
        return self._there(
            FETCH, options.transfer_timeout, reserve=options.reserve,
            keep=options.start_timeout + options.restore_timeout,
        )  # fmt: skip

    def _here(
        self, executor: str, timeout: float, undo: Execute | None = None, **arguments: Any
    ) -> Execute:
        move = self._move
        return execute(move, move.source_host, executor, timeout, undo, **arguments)

    def _there(self, executor: str, timeout: float, **arguments: Any) -> Execute:
        move = self._move
        return execute(move, move.destination_host, executor, timeout, **arguments)
