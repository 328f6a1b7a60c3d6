"""A third party's migration strategy: announces the move on the destination, then moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rosrm import (
    AwaitReady,
    Commit,
    Execute,
    MigrationOffer,
    Move,
    Plan,
    PositiveSeconds,
    Start,
    Stop,
    hookimpl,
)


@dataclass(frozen=True)
class TeleportOptions:
    """Options of the strategy in cluster.yaml.

    Attributes:
        patience: timeout of each step in seconds.
    """

    patience: PositiveSeconds = 10.0


class Teleport:
    """A strategy that announces the move on the destination, then stops the source first."""

    def __init__(self, _options: TeleportOptions) -> None:
        """Ignore the defaults: each move carries its options."""

    def propose(self, move: Move) -> Plan:
        """Announce, stop the source, start the destination, await its readiness."""
        wait = move.options.patience
        back = Start(move.fallback, move.source_host, wait)
        undo = Stop(move.destination, move.destination_host, wait)
        return Plan(
            (
                Execute("teleport.announce", move.destination_host, {"who": move.spec.name}, wait),
                Stop(move.source, move.source_host, wait, undo=back),
                Start(move.destination, move.destination_host, wait, undo=undo),
                AwaitReady(move.destination, move.destination_host, wait),
                Commit(),
            )
        )


def announce(arguments: Mapping[str, Any]) -> Mapping[str, Any]:
    """Announce the move, on the destination's slave."""
    return {"announced": arguments["who"]}


@hookimpl
def register_migration_strategies() -> Sequence[MigrationOffer]:
    """Offer the strategy and its executor."""
    return [
        MigrationOffer(
            "teleport",
            Teleport,
            TeleportOptions,
            "says so, then moves",
            executors={"teleport.announce": announce},
        )
    ]
