"""Plugin hook that registers the migration strategies."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm import MigrationOffer, hookimpl
from rosrm_migration.handoff import WATCH, Handoff, HandoffOptions, capabilities, watch
from rosrm_migration.lifecycle_node import LifecycleNode, LifecycleNodeOptions
from rosrm_migration.relaunch import Relaunch, RelaunchOptions


@hookimpl
def register_migration_strategies() -> Sequence[MigrationOffer]:
    """Offer `relaunch`, `lifecycle_node`, and `handoff` for state on topics."""
    return [
        MigrationOffer(
            name="relaunch",
            create=Relaunch,
            options=RelaunchOptions,
            summary="start at the destination, stop at the source; for stateless processes",
        ),
        MigrationOffer(
            name="lifecycle_node",
            create=LifecycleNode,
            options=LifecycleNodeOptions,
            summary="configure at the destination, deactivate, activate; for lifecycle nodes",
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
