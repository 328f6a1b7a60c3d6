"""`criu`: a node moves with its whole memory, for what its state is on no topic.

The node leaves the ROS graph by itself (`rosrm_criu.node.PortableNode`), stands still, and is
dumped by CRIU. Its image is fetched by the destination and restored there, and the node joins the
graph anew.
The source stands still, and can go on, until the destination owns the name.
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
    """Plans a move of the whole memory."""

    def __init__(self, options: CriuOptions) -> None:
        self._options = options

    @property
    def ability(self) -> str:
        """The executor that tries CRIU on a host."""
        return ABILITY

    def host_fault(self, source: Mapping[str, str], destination: Mapping[str, str]) -> str:
        """Why an image of one host cannot be restored on another one; "": it can."""
        if source.get("host") != destination.get("host"):
            for one in (source, destination):
                if one.get("no_transfer"):
                    return f"no image can be sent to or from {one['host']}: {one['no_transfer']}"
        return mismatch(source, destination)

    def spec_fault(self, spec: ProcessSpec) -> str:
        """Why a process cannot be moved so; "" if it can."""
        if not spec.ros_node:
            return (
                "it moves only ROS nodes that can leave and rejoin (rosrm_criu.node.PortableNode), "
                "and this process is no node: set `ros: true`"
            )
        return ""

    def propose(self, move: Move) -> Plan:
        """Stand still, dump, fetch, restore, commit, join, end the source.

        Before the node is asked to leave, the destination says that it is ready.
        """
        fault = self.spec_fault(move.spec)
        if fault:
            raise ValueError(fault)
        return _Draft(move, move.options).plan()

    def checkpoint(self, move: Move) -> Plan:
        """Dump it where it runs, ROS node or not, and end it; no node is asked to leave."""
        return checkpoint_plan(move, move.options)

    def restore(self, move: Move) -> Plan:
        """Restore it where its image lies."""
        return restore_plan(move, move.options)

    def checkpoint_every(self, spec: ProcessSpec) -> float:
        """As its own options say."""
        return self._own(spec).checkpoint_every if spec.ros_node else 0.0

    def periodic(self, spec: ProcessSpec, instance: InstanceId, host: str, now: int) -> Execute:
        """Have the node leave, dump it, and have it join again."""
        return periodic_step(spec, instance, host, now, self._own(spec))

    @property
    def discard(self) -> str:
        """The executor that removes what has no use any more."""
        return SWEEP

    def _own(self, spec: ProcessSpec) -> OwnCriuOptions:
        return options_of(spec, self._options, OwnCriuOptions)


class _Draft:
    """One plan in the making."""

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

    # What is got ready at the destination, and what is fetched, has no undo: that would wait for a
    # host that may be lost, and the source with it. Both go by themselves after a while.

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
