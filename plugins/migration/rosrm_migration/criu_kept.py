"""How `criu` dumps a process into an image that stays on its host, and restores it there.

The process takes no part in it, and keeps its DDS participant: its address and ports are the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rosrm.model.plan import Commit, Move, Plan, SetRestart, Start, Stop
from rosrm_migration.criu_building import execute, suspend

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
