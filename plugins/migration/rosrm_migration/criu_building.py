"""What all plans of `criu` are made of."""

from __future__ import annotations

from typing import Any, Final

from rosrm import Execute, Move, RestartPolicy, SetRestart, Step

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
