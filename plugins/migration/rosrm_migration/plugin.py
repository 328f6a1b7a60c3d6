"""Registers the migration strategies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rosrm.hookspecs import hookimpl
from rosrm.ports import MigrationOffer
from rosrm_migration import criu
from rosrm_migration.criu import Criu, CriuOptions
from rosrm_migration.handoff import WATCH, Handoff, HandoffOptions, watch
from rosrm_migration.relaunch import Relaunch, RelaunchOptions


@hookimpl
def register_migration_strategies() -> Sequence[MigrationOffer]:
    """Offer `relaunch`, for processes without a state, and two for those with one.

    `handoff` where it is published on topics; `criu` where it is in memory alone.
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
            name="criu",
            create=Criu,
            options=CriuOptions,
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
            },
        ),
    ]


def _when_asked(step: str) -> Callable[[Mapping[str, Any]], Mapping[str, Any]]:
    """A step of `criu`; a slave that has no such moves never loads what it needs."""

    def execute(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        from rosrm_migration import criu_steps  # noqa: PLC0415 - see above

        answer: Mapping[str, Any] = getattr(criu_steps, step)(arguments)
        return answer

    return execute
