"""`relaunch`: a stateless process is started anew at its destination, under the same name.

As in the paper (III-C1) the new instance comes up first and the old one is ended then: no moment
without one, and a moment with both. ROS 1 ended the older namesake by itself; ROS 2 only warns, so
the plan stops it. A process that declares `overlap: false` is stopped first, and started again at
its source where the destination fails.
"""

from __future__ import annotations

from dataclasses import dataclass

from rosrm import AwaitReady, Commit, Move, Plan, PositiveSeconds, Start, Stop


@dataclass(frozen=True)
class RelaunchOptions:
    """What can be set, for all processes or for one.

    Attributes:
        start_timeout: seconds within which the new instance must run.
        settle: seconds for which a new ROS node is ready before the old one is stopped, so that the
            others have found it.
    """

    start_timeout: PositiveSeconds = 10.0
    settle: PositiveSeconds = 1.0


class Relaunch:
    """Plans a stateless move."""

    def __init__(self, _options: RelaunchOptions) -> None:
        """Take nothing: each move brings its options."""

    def propose(self, move: Move) -> Plan:
        """Start there, be ready there, commit, stop here; or stop here first."""
        if move.spec.migration.overlap:
            return _start_first(move, move.options)
        return _stop_first(move, move.options.start_timeout)


def _start_first(move: Move, options: RelaunchOptions) -> Plan:
    settle = options.settle if move.spec.ros or move.spec.package is not None else 0.0
    ready, stop = move.spec.readiness.timeout + settle, move.spec.stop.timeout
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
            AwaitReady(move.destination, move.destination_host, move.spec.readiness.timeout),
            Commit(),
        ),
    )  # fmt: skip


def _stop_destination(move: Move) -> Stop:
    return Stop(move.destination, move.destination_host, move.spec.stop.timeout)
