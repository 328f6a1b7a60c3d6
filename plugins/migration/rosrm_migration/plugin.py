"""Plugin hook that registers the migration strategies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, Final

from rosrm import MigrationOffer, hookimpl
from rosrm_migration import criu, criu_kept, criu_periodic
from rosrm_migration.criu import Criu, CriuOptions, OwnCriuOptions
from rosrm_migration.handoff import WATCH, Handoff, HandoffOptions, watch
from rosrm_migration.relaunch import Relaunch, RelaunchOptions

_KEPT: Final = "rosrm_migration.criu_kept_steps"
_PERIODIC: Final = "rosrm_migration.criu_periodic_steps"


@hookimpl
def register_migration_strategies() -> Sequence[MigrationOffer]:
    """Offer `relaunch` for stateless processes, and two strategies for stateful ones.

    `handoff` is for state that is published on topics; `criu` for state in memory alone.
    """
    return [
        MigrationOffer(
            name="relaunch",
            create=Relaunch,
            options=RelaunchOptions,
            summary="start at the destination, stop at the source; for stateless processes",
        ),
        MigrationOffer(
            name="handoff",
            create=Handoff,
            options=HandoffOptions,
            summary="the destination follows the source's state, and goes on from it",
            executors={WATCH: watch},
        ),
        MigrationOffer(
            name=criu.NAME,
            create=Criu,
            options=CriuOptions,
            own_options=OwnCriuOptions,
            summary="the whole memory of a portable node is dumped, and restored elsewhere",
            executors={
                criu.ABILITY: _when_asked("say_ability"),
                criu.INTRODUCE: _when_asked("introduce"),
                criu.CHECKPOINT: _when_asked("checkpoint"),
                criu.GO_ON: _when_asked("go_on"),
                criu.FETCH: _when_asked("fetch_image"),
                criu.AWAIT_RESTORED: _when_asked("await_restored"),
                criu.JOIN: _when_asked("join"),
                criu.END: _when_asked("end"),
                criu_kept.KEEP: _when_asked("keep", _KEPT),
                criu_kept.RUN_ON: _when_asked("run_on", _KEPT),
                criu_kept.KILL: _when_asked("kill", _KEPT),
                criu_kept.TAKE: _when_asked("take", _KEPT),
                criu_kept.PUT_BACK: _when_asked("put_back", _KEPT),
                criu_kept.AWAIT_KEPT: _when_asked("await_kept", _KEPT),
                criu_kept.DROP: _when_asked("drop", _KEPT),
                criu_periodic.DUMP: _when_asked("dump", _PERIODIC),
                criu_periodic.SWEEP: _when_asked("sweep", _PERIODIC),
            },
        ),
    ]


def _when_asked(
    step: str, module: str = "rosrm_migration.criu_steps"
) -> Callable[[Mapping[str, Any]], Mapping[str, Any]]:
    """Return a step of `criu` that imports its module on first use.

    A slave without such migrations never loads these modules.
    """

    def execute(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        answer: Mapping[str, Any] = getattr(import_module(module), step)(arguments)
        return answer

    return execute
