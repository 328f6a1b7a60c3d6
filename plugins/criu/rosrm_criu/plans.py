"""The plans of checkpoints and restores, and what all plans of `criu` are made of.

A checkpoint stays on its host, and the process keeps its DDS participant: its address and ports are
the same. A periodic one is of a portable node that goes on. Its part in the ROS graph is made anew
after each, so an image may be used while the process that it is of has been heard since: its peers
take what it says for a new node's.
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

#: Executors of a move; `executors/move.py` has them.
ABILITY: Final = "criu_ability"
INTRODUCE: Final = "criu_introduce"
CHECKPOINT: Final = "criu_checkpoint"
GO_ON: Final = "criu_go_on"
FETCH: Final = "criu_fetch"
AWAIT_RESTORED: Final = "criu_await_restored"
JOIN: Final = "criu_join"
END: Final = "criu_end"
#: Executors of a checkpoint and of its restore; `executors/checkpoint.py` has them.
KEEP: Final = "criu_keep"
RUN_ON: Final = "criu_run_on"
KILL: Final = "criu_kill"
TAKE: Final = "criu_take"
PUT_BACK: Final = "criu_put_back"
AWAIT_KEPT: Final = "criu_await_kept"
DROP: Final = "criu_drop"
#: Executors of periodic checkpoints; `executors/periodic.py` has them.
DUMP: Final = "criu_dump"
SWEEP: Final = "criu_sweep"

#: Seconds that the master waits longer than an executor, which knows what it waited for.
LONGER: Final = 5.0


def execute(
    move: Move, host: str, name: str, timeout: float, undo: Step | None = None, **arguments: Any
) -> Execute:
    """A step by an executor of `criu`.

    Args:
        move: that it is of. An attempt is known by its instances and its time: a master without
            its former journal gives the same numbers once more.
        host: where it is done.
        name: of the executor.
        timeout: seconds that it has.
        undo: the way back.
        arguments: beside those that each executor gets.
    """
    told = {
        "process": move.spec.name,
        "source": move.source.number,
        "destination": move.destination.number,
        "attempt": f"{move.source}-{move.destination.number}-{move.now}",
        "timeout": timeout,
        **arguments,
    }
    return Execute(name, host, told, timeout + LONGER, undo)


def suspend(move: Move, seconds: float) -> SetRestart:
    """A source that its slave started again by itself would be active beside its successor."""
    give_back = SetRestart(move.source, move.source_host, move.spec.restart, seconds)
    return SetRestart(
        move.source, move.source_host, RestartPolicy("never"), seconds, undo=give_back
    )


def checkpoint_plan(move: Move, options: CriuOptions) -> Plan:
    """Dump it where it runs, and end it once its image owns the name."""
    here, seconds = move.source_host, options.start_timeout
    # What it waits for: a dump under way has to end first.
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
    """Restore it; its image stays until it is a process again, and then there is no way back."""
    here = move.destination_host
    alias = "" if move.source_node == move.spec.name else move.source_node
    put_back = execute(move, here, PUT_BACK, options.restore_timeout)
    return Plan(
        (
            execute(move, here, TAKE, options.start_timeout, undo=put_back),
            # Nor does its undo stop it: that would end what has no image any more.
            Start(move.destination, here, options.start_timeout, alias, restored=True),
            execute(move, here, AWAIT_KEPT, options.restore_timeout),
            Commit(),
            SetRestart(move.destination, here, move.spec.restart, options.start_timeout),
        )
    )


def periodic_step(
    spec: ProcessSpec, instance: InstanceId, host: str, now: int, options: CriuOptions
) -> Execute:
    """One checkpoint of an instance.

    Args:
        spec: of its process.
        instance: of a portable node.
        host: where it runs.
        now: unix time, whole seconds: each asking is another absence of the node.
        options: that hold for it.
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
