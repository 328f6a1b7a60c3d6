"""Registration of the strategy `criu` with its executors, and of its launcher."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any, Final

from rosrm import Launcher, LauncherContext, LauncherOffer, MigrationOffer, hookimpl
from rosrm_criu import plans
from rosrm_criu.control.messages import VARIABLE
from rosrm_criu.options import (
    NAME,
    CriuOptions,
    HostCriuOptions,
    OwnCriuOptions,
    capabilities,
)
from rosrm_criu.strategy import Criu

Executor = Callable[[Mapping[str, Any]], Mapping[str, Any]]

#: Function of each step, below `rosrm_criu.executors`.
EXECUTORS: Final = {
    plans.HOST_CHECK: "move.report_capability",
    plans.MEASURE_MEMORY: "precopy.measure_memory",
    plans.EXPECT_COPY: "precopy.expect_copy",
    plans.COPY_MEMORY: "precopy.copy_memory",
    plans.FETCH_COPY: "precopy.fetch_copy",
    plans.COPY_CHANGES: "precopy.copy_changes",
    plans.FETCH_CHANGES: "precopy.fetch_changes",
    plans.REMOVE_COPY: "precopy.remove_copy",
    plans.INTRODUCE: "move.introduce",
    plans.CHECKPOINT: "move.checkpoint",
    plans.GO_ON: "move.go_on",
    plans.FETCH: "move.fetch_image",
    plans.AWAIT_RESTORED: "move.await_restored",
    plans.JOIN: "move.join",
    plans.END: "move.end",
    plans.KEEP: "checkpoint.keep",
    plans.RUN_ON: "checkpoint.run_on",
    plans.KILL: "checkpoint.kill",
    plans.TAKE: "checkpoint.take",
    plans.PUT_BACK: "checkpoint.put_back",
    plans.AWAIT_CHECKPOINT: "checkpoint.await_checkpoint",
    plans.DROP: "checkpoint.drop",
    plans.DUMP: "periodic.dump",
    plans.SWEEP: "periodic.sweep",
}


@hookimpl
def register_migration_strategies() -> Sequence[MigrationOffer]:
    """Offer `criu`, for processes with all their state in memory."""
    return [
        MigrationOffer(
            name=NAME,
            create=Criu,
            options=CriuOptions,
            own_options=OwnCriuOptions,
            host_options=HostCriuOptions,
            capabilities=capabilities,
            summary="the whole memory of a portable node is dumped, and restored elsewhere",
            executors={step: partial(_execute, step) for step in EXECUTORS},
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


def executor(step: str) -> Executor:
    """Return the function of a step; it loads the module, which most slaves never need."""
    module, name = EXECUTORS[step].split(".")
    function: Executor = getattr(import_module(f"rosrm_criu.executors.{module}"), name)
    return function


def _execute(step: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    return executor(step)(arguments)
