"""`relaunch`: a stateless process is started anew at its destination, under the same name.

As in the paper (III-C1) the new instance comes up first and the old one is ended then: no moment
without one, and a moment with both. ROS 1 ended the older namesake by itself; ROS 2 only warns, so
the plan stops it. A process that declares `overlap: false` is stopped first, and started again at
its source where the destination fails.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Gt

from rosrm.core.migration import AwaitReady, Commit, Move, Plan, Start, Stop

#: Beyond the process's own grace: a signal, a report and a message take a moment.
_STOP_MARGIN = 5.0


@dataclass(frozen=True)
class RelaunchOptions:
    """What can be set.

    Attributes:
        start_timeout: seconds within which the new instance must run.
    """

    start_timeout: Annotated[float, Gt(0.0)] = 10.0


class Relaunch:
    """Plans a stateless move."""

    def __init__(self, options: RelaunchOptions) -> None:
        self._start_timeout = options.start_timeout

    def propose(self, move: Move) -> Plan:
        """Start there, be ready there, commit, stop here; or stop here first."""
        if move.spec.migration.overlap:
            return self._start_first(move)
        return self._stop_first(move)

    def _start_first(self, move: Move) -> Plan:
        ready = move.spec.readiness.timeout
        return Plan(
            (
                Start(
                    move.destination, move.destination_host, self._start_timeout,
                    undo=self._stop_destination(move),
                ),
                AwaitReady(move.destination, move.destination_host, ready),
                Commit(),
                Stop(move.source, move.source_host, _stop_timeout(move)),
            ),
            overlap=_stop_timeout(move) + ready,
        )  # fmt: skip

    def _stop_first(self, move: Move) -> Plan:
        return Plan(
            (
                Stop(
                    move.source, move.source_host, _stop_timeout(move),
                    undo=Start(move.fallback, move.source_host, self._start_timeout),
                ),
                Start(
                    move.destination, move.destination_host, self._start_timeout,
                    undo=self._stop_destination(move),
                ),
                AwaitReady(
                    move.destination, move.destination_host, move.spec.readiness.timeout
                ),
                Commit(),
            ),
        )  # fmt: skip

    def _stop_destination(self, move: Move) -> Stop:
        return Stop(move.destination, move.destination_host, _stop_timeout(move))


def _stop_timeout(move: Move) -> float:
    stop = move.spec.stop
    return stop.interrupt_grace + stop.terminate_grace + _STOP_MARGIN
