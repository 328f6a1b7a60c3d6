"""Migration strategy `lifecycle_node`: a managed lifecycle node is active on one host at a time.

The destination starts beside the source and is configured there, which may take long. Then the
source is deactivated, and the destination is activated: no data is lost for longer than these two
transitions take. The node needs no other support, but its state does not move.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from rosrm import (
    AwaitReady,
    Commit,
    Move,
    Plan,
    PositiveSeconds,
    ProcessSpec,
    SetLifecycle,
    Start,
    Stop,
)

#: Seconds for the orders to both slaves, in addition to the time-outs of the transitions.
_MARGIN: Final = 5.0


@dataclass(frozen=True)
class LifecycleNodeOptions:
    """Options of the strategy `lifecycle_node`, for all processes or for one.

    Attributes:
        start_timeout: seconds within which the new instance must run.
        settle: seconds for which the new node is inactive before the old one is deactivated, so
            that other nodes discover it.
    """

    start_timeout: PositiveSeconds = 10.0
    settle: PositiveSeconds = 1.0


class LifecycleNode:
    """Strategy that plans the migration of a managed lifecycle node."""

    def __init__(self, _options: LifecycleNodeOptions) -> None:
        """Ignore the options of the cluster, because each move carries its merged options."""

    def spec_fault(self, spec: ProcessSpec) -> str:
        """Return the reason why `lifecycle_node` cannot migrate a process; "" if it can."""
        return _fault(spec)

    def propose(self, move: Move) -> Plan:
        """Return the plan: configure there, deactivate here, activate there, stop here."""
        fault = _fault(move.spec) or _fault(move.destination_spec)
        if fault:
            raise ValueError(fault)
        there, here, options = move.destination_host, move.source_host, move.options
        started = move.destination_spec
        stop_there = Stop(move.destination, there, started.stop.timeout)
        return Plan(
            (
                Start(
                    move.destination, there, options.start_timeout, undo=stop_there, inactive=True
                ),
                AwaitReady(
                    move.destination, there, started.ready_timeout + options.settle,
                    settle=options.settle,
                ),
                _deactivate(move),
                SetLifecycle(
                    move.destination, there, "active", _seconds(started), undo=stop_there
                ),
                Commit(),
                Stop(move.source, here, move.spec.stop.timeout),
            )
        )  # fmt: skip


def _fault(spec: ProcessSpec) -> str:
    if spec.lifecycle.autostart == "active":
        return ""
    return "it moves only lifecycle nodes that their host activates: set `lifecycle: active`"


def _deactivate(move: Move) -> SetLifecycle:
    """Deactivate the source; it is activated again if the destination fails."""
    seconds = _seconds(move.spec)
    back = SetLifecycle(move.source, move.source_host, "active", seconds)
    return SetLifecycle(move.source, move.source_host, "inactive", seconds, undo=back)


def _seconds(spec: ProcessSpec) -> float:
    """Return the time-out of a change of the state: a node that was restarted needs two."""
    return spec.lifecycle.total_timeout + _MARGIN
