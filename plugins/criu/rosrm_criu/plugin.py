"""Registration of the strategy `criu` with its executors, and of its launcher."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

from rosrm import Launcher, LauncherContext, LauncherOffer, MigrationOffer, hookimpl
from rosrm_criu import plans
from rosrm_criu.control.messages import VARIABLE
from rosrm_criu.options import NAME, CriuOptions, OwnCriuOptions, capabilities
from rosrm_criu.strategy import Criu


@hookimpl
def register_migration_strategies() -> Sequence[MigrationOffer]:
    """Offer `criu`, for processes with all their state in memory."""
    return [
        MigrationOffer(
            name=NAME,
            create=Criu,
            options=CriuOptions,
            own_options=OwnCriuOptions,
            capabilities=capabilities,
            summary="the whole memory of a portable node is dumped, and restored elsewhere",
            executors={
                plans.ABILITY: _when_asked("move", "report_capability"),
                plans.INTRODUCE: _when_asked("move", "introduce"),
                plans.CHECKPOINT: _when_asked("move", "checkpoint"),
                plans.GO_ON: _when_asked("move", "go_on"),
                plans.FETCH: _when_asked("move", "fetch_image"),
                plans.AWAIT_RESTORED: _when_asked("move", "await_restored"),
                plans.JOIN: _when_asked("move", "join"),
                plans.END: _when_asked("move", "end"),
                plans.KEEP: _when_asked("checkpoint", "keep"),
                plans.RUN_ON: _when_asked("checkpoint", "run_on"),
                plans.KILL: _when_asked("checkpoint", "kill"),
                plans.TAKE: _when_asked("checkpoint", "take"),
                plans.PUT_BACK: _when_asked("checkpoint", "put_back"),
                plans.AWAIT_KEPT: _when_asked("checkpoint", "await_kept"),
                plans.DROP: _when_asked("checkpoint", "drop"),
                plans.DUMP: _when_asked("periodic", "dump"),
                plans.SWEEP: _when_asked("periodic", "sweep"),
            },
        )
    ]


@hookimpl
def register_launchers() -> Sequence[LauncherOffer]:
    """Offer the launcher of the processes that migrate by `criu`, and of all restored ones."""
    return [
        LauncherOffer(
            name=NAME,
            create=_launcher,
            summary="starts portable nodes, and processes from images of their memory",
            variables=(VARIABLE,),
        )
    ]


def _launcher(context: LauncherContext) -> Launcher:
    """Load the launcher, in slaves only."""
    module = import_module("rosrm_criu.launcher")
    launcher: Launcher = module.CriuLauncher(context)
    return launcher


def _when_asked(module: str, step: str) -> Callable[[Mapping[str, Any]], Mapping[str, Any]]:
    """Return an executor that loads its module at the first call, as most slaves never need it."""

    def execute(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        executors = import_module(f"rosrm_criu.executors.{module}")
        answer: Mapping[str, Any] = getattr(executors, step)(arguments)
        return answer

    return execute
