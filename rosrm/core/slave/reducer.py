"""The slave's reducer: (state, event, now) -> commands. Each kind of event is one row below.

======================  =========================================================================
event                   what the core does
======================  =========================================================================
Registered              stores the master's epoch, and refuses older ones from then on; repeats a
                        report that may have reached no master
MasterLost              keeps every end until a master has registered this host again
AssignmentsReceived     launches each once, or holds it until a slot is free and those that are
                        starting are ready; refuses one that was stopped before
LaunchRefused           reports that the host cannot run the instance, and why
StopOrdered             stops the instance; an unknown one will never be started
FenceOrdered            the same, but at once
ContactConfirmed        sends the contact to the supervisor, where there is a fence to renew
RestartOrdered          stops the instance, and starts it again here
RestartPolicySet        has the supervisor record the policy; for an instance that has ended or is
                        not known, the order is settled
RestartPolicyRecorded   settles the order
ReportRequested         reports everything
SupervisorReported      follows the instances; a new run must become ready again
SupervisorReplaced      the same; drops the instances that the new supervisor does not know,
                        reports everything, and repeats orders that may be lost
SeenInGraph             the instance is ready, also for a later run of this slave
LookedAt                ends an instance as failed if it has been unhealthy for too long
TimePassed              stops an instance that is not ready in time, refuses one whose fence passed
                        before its start, and drops old ends
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
