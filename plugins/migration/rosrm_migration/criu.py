"""`criu`: a node moves with its whole memory, for what its state is on no topic.

The node leaves the ROS graph by itself (`rosrm.node.PortableNode`), stands still, and is dumped by
CRIU. Its image is fetched by the destination and restored there, and the node joins the graph anew.
The source stands still, and can go on, until the destination owns the name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, Final

from rosrm.criu.fitting import mismatch
from rosrm.extensions.contracts import Capabilities
from rosrm.extensions.plans import (
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
from rosrm.extensions.units import Bytes, PositiveSeconds, Seconds
from rosrm_migration.criu_building import execute, suspend
from rosrm_migration.criu_kept import checkpoint_plan, restore_plan
from rosrm_migration.criu_periodic import SWEEP, periodic_step

#: Under which it is selected.
NAME: Final = "criu"
#: The executors of the plan; `criu_steps` has what they do.
ABILITY: Final = "criu_ability"
INTRODUCE: Final = "criu_introduce"
CHECKPOINT: Final = "criu_checkpoint"
GO_ON: Final = "criu_go_on"
FETCH: Final = "criu_fetch"
AWAIT_RESTORED: Final = "criu_await_restored"
JOIN: Final = "criu_join"
END: Final = "criu_end"


@dataclass(frozen=True)
class CriuOptions:
    """What can be set, for all processes or for one.

    Attributes:
        start_timeout: seconds within which a slave must take an order or start what it needs, and
            the destination start.
        leave_timeout: seconds within which the node must have left the ROS graph: a callback of its
            author is finished first.
        dump_timeout: seconds for dumping its memory.
        transfer_timeout: seconds for the image to get to the destination.
        restore_timeout: seconds for restoring it there.
        join_timeout: seconds within which the node must have joined the ROS graph again.
        max_rate: bytes a second that the image may take of the network; 0: all that there is. The
            default leaves something of a gigabit to others.
        reserve: bytes that stay free where the image goes to.
    """

    start_timeout: PositiveSeconds = 10.0
    leave_timeout: PositiveSeconds = 10.0
    dump_timeout: PositiveSeconds = 60.0
    transfer_timeout: PositiveSeconds = 120.0
    restore_timeout: PositiveSeconds = 60.0
    join_timeout: PositiveSeconds = 20.0
    max_rate: Bytes = 100_000_000
    reserve: Bytes = 256 << 20

    def __post_init__(self) -> None:
        """Refuse a rate that is none."""
        if self.max_rate < 0:
            raise ValueError(f"max_rate is {self.max_rate} bytes/s; allowed: 0 (no bound) or more")
        if self.reserve < 0:
            raise ValueError(f"reserve is {self.reserve} bytes; allowed: 0 or more")


@dataclass(frozen=True)
class OwnCriuOptions(CriuOptions):
    """What can be set for one process.

    Attributes:
        checkpoint_every: seconds from one periodic checkpoint to the next; 0: none. Not for all
            processes at once: each stands still for it.
    """

    checkpoint_every: Seconds = 0.0

    def __post_init__(self) -> None:
        """As those of all processes, and a pace that is one."""
        super().__post_init__()
        if not 0.0 <= self.checkpoint_every < inf:
            raise ValueError(
                f"checkpoint_every is {self.checkpoint_every:g} s; allowed: 0 (none) or more"
            )


def capabilities(options: OwnCriuOptions) -> Capabilities:
    """Return what the strategy can do for a process with these options."""
    periodic = options.checkpoint_every > 0.0
    return Capabilities(state="memory", restart_from_image=periodic, launcher=NAME)


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
                "it moves ROS nodes that leave and join by themselves (rosrm.node.PortableNode), "
                "and this process is no node: say `ros: true`"
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
