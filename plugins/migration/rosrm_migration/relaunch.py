"""Migration strategy `relaunch`: a stateless process starts at its destination with its own name.

As in the paper (III-C1) the new instance starts first, and the old one is stopped afterwards. So
there is no moment without an instance, and a moment with both. ROS 1 ended the older node of the
same name; ROS 2 only warns, so the plan stops it. A process that declares `overlap: false`, or has
components, is stopped first, and started again at its source if the destination fails.
"""

from __future__ import annotations

from dataclasses import dataclass

from rosrm import AwaitReady, Commit, Move, Plan, PositiveSeconds, Start, Stop


@dataclass(frozen=True)
class RelaunchOptions:
    """Options of the strategy `relaunch`, for all processes or for one.

    Attributes:
        start_timeout: seconds within which the new instance must run.
        settle: seconds for which a new ROS node is ready before the old one is stopped, so that
            other nodes discover it.
    """

    start_timeout: PositiveSeconds = 10.0
    settle: PositiveSeconds = 1.0


class Relaunch:
    """Strategy that plans a stateless migration."""

    def __init__(self, _options: RelaunchOptions) -> None:
        """Ignore the options of the cluster, because each move carries its merged options."""

    def propose(self, move: Move) -> Plan:
        """Return the plan: start, await ready, commit, stop the source; or with the stop first."""
        # Two containers of one name would both load what their slaves request.
        containers = move.spec.components or move.destination_spec.components
        if move.spec.migration.overlap and not containers:
            return _start_first(move, move.options)
        return _stop_first(move, move.options.start_timeout)


def _start_first(move: Move, options: RelaunchOptions) -> Plan:
    started = move.destination_spec
    settle = options.settle if started.ros else 0.0
    ready, stop = started.ready_timeout + settle, move.spec.stop.timeout
    return Plan(
        (
            Start(
                move.destination, move.destination_host, options.start_timeout,
                undo=_stop_destination(move),
            ),
            AwaitReady(move.destination, move.destination_host, ready, settle=settle),
            Commit(),
            Stop(move.source, move.source_host, stop),
        ),
        overlap=stop + ready,
    )  # fmt: skip


def _stop_first(move: Move, start_timeout: float) -> Plan:
    return Plan(
        (
            Stop(
                move.source, move.source_host, move.spec.stop.timeout,
                undo=Start(move.fallback, move.source_host, start_timeout),
            ),
            Start(
                move.destination, move.destination_host, start_timeout,
                undo=_stop_destination(move),
            ),
            AwaitReady(
                move.destination, move.destination_host, move.destination_spec.ready_timeout
            ),
            Commit(),
        ),
    )  # fmt: skip


def _stop_destination(move: Move) -> Stop:
    return Stop(move.destination, move.destination_host, move.destination_spec.stop.timeout)
