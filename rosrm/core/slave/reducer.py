"""The slave's reducer: (state, event, now) -> commands. Each kind of event is one row below.

======================  =========================================================================
what happened           what the core does
======================  =========================================================================
Registered              remembers the master's epoch; older ones are refused from now on; reports
                        again, if something went unheard meanwhile
MasterLost              forgets no end until a master has taken this host in again
AssignmentsReceived     has them launched, once, or holds them until a slot is free and those that
                        are being started are ready; one that was stopped before is refused
LaunchRefused           reports that the host cannot run it, and why
StopOrdered             has it stopped; one never heard of will never be started
FenceOrdered            the same, but at once
ContactConfirmed        tells the supervisor, where there is a fence that this renews
RestartOrdered          has it stopped and started again here
RestartPolicySet        has the supervisor keep it, unless it has ended or is not known: settled
RestartPolicyRecorded   the supervisor has it in its record: settled
ReportRequested         reports everything
SupervisorReported      follows the instance; a new run must become ready anew
SupervisorReplaced      the same; what the new one does not know is gone; reports everything, and
                        orders again what may have been lost with the former one
SeenInGraph             the instance is ready; a later run of this slave shall know
LookedAt                one that has been unhealthy for too long is ended as failed
TimePassed              an instance that is not ready in time is stopped; one whose fence passed
                        before its start is refused; old ends are forgotten
======================  =========================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rosrm.core.slave.commands import Command, Launch, Report
from rosrm.core.slave.events import Event
from rosrm.core.slave.handlers import HANDLERS
from rosrm.core.slave.state import SlaveState


def step(state: SlaveState, event: Event, now: float) -> Sequence[Command]:
    """Handle one event, and change the state in place.

    `now` is the slave's monotonic clock, in seconds; never less than before.
    """
    commands = HANDLERS[type(event)](state, event, now)
    if not state.registered and any(isinstance(command, Report) for command in commands):
        state.report_unconfirmed = True
    return commands


def step_all(state: SlaveState, events: Iterable[Event], now: float) -> list[Command]:
    """Handle several events, in order.

    A later event may drop an instance that an earlier one launches; then it is not launched.
    """
    commands = [command for event in events for command in step(state, event, now)]
    return [
        _still_held(state, command) if isinstance(command, Launch) else command
        for command in commands
    ]


def _still_held(state: SlaveState, launch: Launch) -> Launch:
    return Launch(tuple(one for one in launch.assignments if one.instance in state.held))
