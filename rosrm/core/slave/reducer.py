"""The slave's reducer: (state, event, now) -> commands. One row for each kind of event.

======================  =========================================================================
event                   action of the core
======================  =========================================================================
Registered              stores the master's epoch, and refuses older ones from then on; repeats a
                        report that no master may have received
MasterLost              remembers every end until a master has registered this host again
AssignmentsReceived     launches each instance once, as soon as the bounds on running and starting
                        instances allow; the supervisor may hold the next job until a slot is
                        free; refuses an instance that was stopped before
LaunchRefused           reports that the host cannot run the instance, and why
StartDelayed            reports why an instance that is starting does not run yet
StopOrdered             stops the instance; an unknown instance will never be started
FenceOrdered            kills the instance; an unknown instance will never be started
ContactConfirmed        sends the last contact to the supervisor, if a live instance has a fence
RestartOrdered          stops the instance, and starts it again on this host
AmendmentOrdered        orders the supervisor to change the instance; answers at once for one that
                        waits; refuses the order for one that has ended or is unknown
AmendmentRecorded       answers the order; refuses it if the instance had ended before
ReportRequested         reports all instances
SupervisorReported      updates the statuses; a new run must become ready again
SupervisorReplaced      the same; drops the instances that the new supervisor does not know,
                        reports all instances, and repeats orders that may be lost
SeenInGraph             marks the instance as ready, also for a later run of this slave; or reads
                        the state of a lifecycle node that the slave brings to a goal
LifecycleOrdered        changes the goal of a lifecycle node, and reads its state; answers when the
                        node has reached the goal
LifecycleStateRead      requests the next transition; at the goal, marks the instance as ready
TransitionAnswered      the same; ends the instance as failed if the transition failed
ComponentsListed        loads the next component that the container lacks; without one it is ready
ComponentLoaded         requests the list again; ends the container as failed if the load failed
LookedAt                ends an instance as failed if it has been unhealthy for too long
DevicesMissed           ends each running instance as failed that holds a missing device
TimePassed              stops an instance that is not ready in time, ends one as failed whose
                        lifecycle transition takes too long, reports one that still waits to
                        start, refuses one whose fence expired before its start, and drops old ends
Slept                   prolongs the time to be ready, and the time of a lifecycle transition
======================  =========================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from rosrm.core.slave.commands import Command, Launch, Report
from rosrm.core.slave.events import Event
from rosrm.core.slave.handlers import HANDLERS
from rosrm.core.slave.state import SlaveState


def step(state: SlaveState, event: Event, now: float) -> Sequence[Command]:
    """Handle one event, and change the state in place.

    `now` is the slave's boot clock, in seconds; never less than before.
    """
    state.now = now
    commands = [_as_reported(state, one) for one in HANDLERS[type(event)](state, event, now)]
    if not state.registered and any(isinstance(command, Report) for command in commands):
        state.report_unconfirmed = True
    return commands


def step_all(state: SlaveState, events: Iterable[Event], now: float) -> list[Command]:
    """Handle several events, in order.

    An instance that an earlier event launches and a later event drops is not launched.
    """
    commands = [command for event in events for command in step(state, event, now)]
    return [
        _without_dropped(state, command) if isinstance(command, Launch) else command
        for command in commands
    ]


def _without_dropped(state: SlaveState, launch: Launch) -> Launch:
    wanted = tuple(one for one in launch.assignments if one.instance in state.held)
    return replace(launch, assignments=wanted)


def _as_reported(state: SlaveState, command: Command) -> Command:
    """Return a report with the facts that only the slave knows; another command unchanged."""
    if not isinstance(command, Report):
        return command
    return Report(state.reported(command.statuses), command.complete)
