"""A migration strategy for rosrm: a plan of steps, which the master executes."""

from dataclasses import dataclass

from rosrm import (
    AwaitReady,
    Commit,
    MigrationOffer,
    Move,
    Plan,
    PositiveSeconds,
    Start,
    Stop,
    hookimpl,
)


@dataclass(frozen=True)
class ExampleOptions:
    """Options of the strategy in cluster.yaml for all processes, and in a work file for one.

    Attributes:
        patience: seconds within which an instance must start.
    """

    patience: PositiveSeconds = 10.0


class ExampleStrategy:
    """Stops a process on its host, then starts it on another one."""

    def __init__(self, options: ExampleOptions) -> None:
        """Ignore the options, because `move.options` has them merged with those of the process."""

    def propose(self, move: Move) -> Plan:
        """Return the steps; a failure before the commit runs the undo of each step done so far."""
        start, stop = move.options.patience, move.spec.stop.timeout
        here, there = move.source_host, move.destination_host
        back = Start(move.fallback, here, start)
        away = Stop(move.destination, there, stop)
        return Plan(
            (
                Stop(move.source, here, stop, undo=back),
                Start(move.destination, there, start, undo=away),
                AwaitReady(move.destination, there, move.spec.readiness.timeout),
                Commit(),
            )
        )


@hookimpl
def register_migration_strategies() -> list[MigrationOffer]:
    """Offer the strategy by the name with which cluster.yaml and work.yaml choose it."""
    return [
        MigrationOffer(
            name="example",
            create=ExampleStrategy,
            options=ExampleOptions,
            summary="stops a process, then starts it on another host",
        )
    ]
