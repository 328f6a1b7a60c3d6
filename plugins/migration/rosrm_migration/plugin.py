"""Registers the migration strategies."""

from __future__ import annotations

from collections.abc import Sequence

from rosrm.hookspecs import hookimpl
from rosrm.ports import MigrationOffer
from rosrm_migration.relaunch import Relaunch, RelaunchOptions


@hookimpl
def register_migration_strategies() -> Sequence[MigrationOffer]:
    """Offer `relaunch`, for processes without a state."""
    return [
        MigrationOffer(
            name="relaunch",
            create=Relaunch,
            options=RelaunchOptions,
            summary="start at the destination, stop at the source; for stateless processes",
        )
    ]
