"""How `criu` dumps a process into an image that stays on its host, and restores it there.

The process takes no part in it, and keeps its DDS participant: its address and ports are the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from rosrm.core.migration import Commit, Execute, Move, Plan, SetRestart, Start, Step, Stop
from rosrm.core.model import RestartPolicy

if TYPE_CHECKING:
    from rosrm_migration.criu import CriuOptions

#: The executors of the plans; `criu_kept_steps` has what they do.
KEEP: Final = "criu_keep"
RUN_ON: Final = "criu_run_on"
KILL: Final = "criu_kill"
TAKE: Final = "criu_take"
PUT_BACK: Final = "criu_put_back"
AWAIT_KEPT: Final = "criu_await_kept"
DROP: Final = "criu_drop"

_NEVER: Final = RestartPolicy("never")
#: Seconds that the master waits longer than the executor, which knows what it waited for.
_LONGER: Final = 5.0


def checkpoint_plan(move: Move, options: CriuOptions) -> Plan:
    """Dump it where it runs, and end it once its image owns the name."""
    here, seconds = move.source_host, options.start_timeout
    give_back = SetRestart(move.source, here, move.spec.restart, seconds)
    # What it waits for: a dump under way has to end first.
    run_on = _execute(RUN_ON, move, options.dump_timeout)
    return Plan(
        (
            SetRestart(move.source, here, _NEVER, seconds, undo=give_back),
            _execute(KEEP, move, options.dump_timeout, undo=run_on),
            Commit(image=DROP),
            _execute(KILL, move, seconds),
            Stop(move.source, here, move.spec.stop.timeout),
        )
    )


def restore_plan(move: Move, options: CriuOptions) -> Plan:
    """Restore it; its image stays until it is a process again, and then there is no way back."""
    here = move.destination_host
    alias = "" if move.source_node == move.spec.name else move.source_node
    put_back = _execute(PUT_BACK, move, options.restore_timeout)
    return Plan(
        (
            _execute(TAKE, move, options.start_timeout, undo=put_back),
            # Nor does its undo stop it: that would end what has no image any more.
            Start(move.destination, here, options.start_timeout, alias, restored=True),
            _execute(AWAIT_KEPT, move, options.restore_timeout),
            Commit(),
            SetRestart(move.destination, here, move.spec.restart, options.start_timeout),
        )
    )


def _execute(name: str, move: Move, timeout: float, undo: Step | None = None) -> Execute:
    arguments: Mapping[str, Any] = {
        "process": move.spec.name,
        "source": move.source.number,
        "destination": move.destination.number,
        "attempt": f"{move.source}-{move.destination.number}-{move.now}",
        "timeout": timeout,
    }
    return Execute(name, move.source_host, arguments, timeout + _LONGER, undo)
