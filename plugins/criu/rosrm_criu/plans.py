"""Plans of moves, checkpoints and restores by `criu`.

A checkpoint stays on its host, and the process keeps its DDS participant, so its address and ports
stay the same. A periodic checkpoint is one of a portable node that continues to run. The node
rejoins the ROS graph as a new participant after each. So its image can be used even if the process
has published since: peers treat the restored node's messages as those of a new node.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rosrm import (
    Commit,
    Execute,
    InstanceId,
    Move,
    Plan,
    ProcessSpec,
    RestartPolicy,
    SetRestart,
    Start,
    Step,
    Stop,
)

if TYPE_CHECKING:
    from rosrm_criu.options import CriuOptions

#: Executors of a migration; see `executors/move.py`, and for its copy `executors/precopy.py`.
HOST_CHECK: Final = "criu_host_check"
MEASURE_MEMORY: Final = "criu_measure_memory"
EXPECT_COPY: Final = "criu_expect_copy"
COPY_MEMORY: Final = "criu_copy_memory"
FETCH_COPY: Final = "criu_fetch_copy"
COPY_CHANGES: Final = "criu_copy_changes"
FETCH_CHANGES: Final = "criu_fetch_changes"
REMOVE_COPY: Final = "criu_remove_copy"
INTRODUCE: Final = "criu_introduce"
CHECKPOINT: Final = "criu_checkpoint"
GO_ON: Final = "criu_go_on"
FETCH: Final = "criu_fetch"
AWAIT_RESTORED: Final = "criu_await_restored"
JOIN: Final = "criu_join"
END: Final = "criu_end"
#: Those of the copy, without which a host of an older version can take part in a move.
_OF_THE_COPY: Final = frozenset(
    {
        MEASURE_MEMORY, EXPECT_COPY, COPY_MEMORY, FETCH_COPY, COPY_CHANGES, FETCH_CHANGES,
        REMOVE_COPY,
    }
)  # fmt: skip
#: Executors of a checkpoint and its restore; see `executors/checkpoint.py`.
KEEP: Final = "criu_keep"
RUN_ON: Final = "criu_run_on"
KILL: Final = "criu_kill"
TAKE: Final = "criu_take"
PUT_BACK: Final = "criu_put_back"
AWAIT_CHECKPOINT: Final = "criu_await_checkpoint"
DROP: Final = "criu_drop"
#: Executors of periodic checkpoints; see `executors/periodic.py`.
DUMP: Final = "criu_dump"
SWEEP: Final = "criu_sweep"

#: Seconds that the master waits longer than an executor, whose own error names the cause.
LONGER: Final = 5.0


def execute(
    move: Move, host: str, name: str, timeout: float, undo: Step | None = None, **arguments: Any
) -> Execute:
    """Return a step by an executor of `criu`.

    Args:
        move: the step's migration. Its attempt is identified by instances and time, because a
            master without its former journal assigns the same numbers again.
        host: where the step runs.
        name: of the executor.
        timeout: seconds for the executor.
        undo: the step that undoes this one.
        arguments: passed in addition to the common ones.
    """
    common = {
        "process": move.spec.name,
        "source": move.source.number,
        "destination": move.destination.number,
        "attempt": f"{move.source}-{move.destination.number}-{move.now}",
        "timeout": timeout,
        **arguments,
    }
    return Execute(name, host, common, timeout + LONGER, undo)


def suspend(move: Move, seconds: float) -> SetRestart:
    """Return a step that disables the source's restarts; else it could run beside its successor.

    Args:
        move: of the source.
        seconds: for the slave to accept the step and its undo.
    """
    give_back = SetRestart(move.source, move.source_host, move.spec.restart, seconds)
    return SetRestart(
        move.source, move.source_host, RestartPolicy("never"), seconds, undo=give_back
    )


def move_plan(move: Move, options: CriuOptions) -> Plan:
    """Return a plan: copy, freeze, dump, fetch, restore, commit, join, end the source.

    The preparation of the destination and the fetch have no undo, because an undo would wait for a
    host that may be lost, and the source would wait too. Each is cleaned up after a timeout. The
    undo of the copy comes last, when the source runs again.

    Args:
        move: of a portable node, to another host.
        options: of the process; all durations in seconds.
    """
    here, there, spec = move.source_host, move.destination_host, move.spec
    start = options.start_timeout
    until_dumped = 2 * start + options.leave_timeout + options.dump_timeout
    seconds = {
        "leave": options.leave_timeout, "dump": options.dump_timeout,
        "offer": options.transfer_timeout + start,
    }  # fmt: skip
    keep = until_dumped + options.transfer_timeout + 4 * start
    copy = () if move.lacking & _OF_THE_COPY else _precopy(move, options, keep)
    return Plan(
        (
            *copy,
            suspend(move, start),
            execute(
                move, there, INTRODUCE, start, keep=until_dumped + 2 * start,
                working_directory=spec.working_directory,
            ),
            execute(
                move, here, CHECKPOINT, until_dumped,
                undo=execute(move, here, GO_ON, options.join_timeout),
                seconds=seconds, max_rate=options.max_rate,
            ),
            execute(
                move, there, FETCH, options.transfer_timeout, reserve=options.reserve,
                keep=start + options.restore_timeout, working_directory=spec.working_directory,
            ),
            Start(
                move.destination, there, start,
                undo=Stop(move.destination, there, spec.stop.timeout), restored=True,
            ),
            execute(move, there, AWAIT_RESTORED, options.restore_timeout),
            Commit(),
            execute(move, there, JOIN, options.join_timeout),
            SetRestart(move.destination, there, spec.restart, start),
            execute(move, here, END, start),
            Stop(move.source, here, spec.stop.timeout),
        )
    )  # fmt: skip


def _precopy(move: Move, options: CriuOptions, keep: float) -> tuple[Execute, ...]:
    """Return the steps that copy the memory of the running node to the destination.

    The first copy takes long; what the node has written during it is copied once more. All steps
    succeed without a copy too: then the whole dump is sent.

    Args:
        move: of a portable node.
        options: of the process.
        keep: seconds after which an unused copy is removed.
    """
    here, there, start = move.source_host, move.destination_host, options.start_timeout
    longest = options.transfer_timeout
    offer = longest + start
    return (
        execute(move, here, MEASURE_MEMORY, start),
        # Its undo is that of the next step. No step at the source may have an undo before the node
        # is frozen, because the blackout counts from the first such step.
        execute(
            move, there, EXPECT_COPY, start, keep=longest + 2 * start,
            undo=execute(move, here, REMOVE_COPY, start),
        ),
        execute(
            move, here, COPY_MEMORY, longest, offer=offer, keep=3 * longest + keep,
            max_rate=options.max_rate,
        ),
        execute(
            move, there, FETCH_COPY, longest, reserve=options.reserve, keep=2 * longest + keep,
            undo=execute(move, there, REMOVE_COPY, start),
        ),
        execute(
            move, here, COPY_CHANGES, longest, offer=offer, keep=longest + keep,
            max_rate=options.max_rate,
        ),
        execute(move, there, FETCH_CHANGES, longest, reserve=options.reserve, keep=keep),
    )  # fmt: skip


def checkpoint_plan(move: Move, options: CriuOptions) -> Plan:
    """Return a plan to dump the process on its host, and to end it once its image owns the name."""
    here, seconds = move.source_host, options.start_timeout
    # Its timeout is the dump's, because it waits for a dump that is under way.
    run_on = execute(move, here, RUN_ON, options.dump_timeout)
    return Plan(
        (
            suspend(move, seconds),
            execute(move, here, KEEP, options.dump_timeout, undo=run_on),
            Commit(image=DROP),
            execute(move, here, KILL, seconds),
            Stop(move.source, here, move.spec.stop.timeout),
        )
    )


def restore_plan(move: Move, options: CriuOptions) -> Plan:
    """Return a plan to restore the process; its image stays until that succeeds, which is final."""
    here = move.destination_host
    alias = "" if move.source_node == move.spec.node else move.source_node
    put_back = execute(move, here, PUT_BACK, options.restore_timeout)
    return Plan(
        (
            execute(move, here, TAKE, options.start_timeout, undo=put_back),
            # No undo, because a stop would end a process that may no longer have an image.
            Start(move.destination, here, options.start_timeout, alias, restored=True),
            execute(move, here, AWAIT_CHECKPOINT, options.restore_timeout),
            Commit(),
            SetRestart(move.destination, here, move.spec.restart, options.start_timeout),
        )
    )


def periodic_step(
    spec: ProcessSpec, instance: InstanceId, host: str, now: int, options: CriuOptions
) -> Execute:
    """Return the step of one periodic checkpoint.

    Args:
        spec: of the process.
        instance: of a portable node.
        host: where it runs.
        now: unix time in whole seconds, so that each request is a new departure of the node.
        options: of this process.
    """
    seconds = {
        "leave": options.leave_timeout, "dump": options.dump_timeout, "join": options.join_timeout,
    }  # fmt: skip
    timeout = options.start_timeout + sum(seconds.values())
    arguments = {
        "process": spec.name, "source": instance.number, "destination": instance.number,
        "attempt": f"{instance}-periodic-{now}", "timeout": timeout, "seconds": seconds,
    }  # fmt: skip
    return Execute(DUMP, host, arguments, timeout + LONGER)
