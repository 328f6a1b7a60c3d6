"""Plugin hook that registers the migration strategies."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm import MigrationOffer, hookimpl
from rosrm_migration.handoff import WATCH, Handoff, HandoffOptions, capabilities, watch
from rosrm_migration.relaunch import Relaunch, RelaunchOptions


@hookimpl
def register_migration_strategies() -> Sequence[MigrationOffer]:
    """Offer `relaunch` for stateless processes, and `handoff` for state on topics."""
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
            summary="the destination follows the source's state, and continues from it",
            executors={WATCH: watch},
            capabilities=capabilities,
        ),
    ]
