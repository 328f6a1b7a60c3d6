"""The master's reducer: (state, event, now) -> commands. Each kind of event is one row below.

======================  =========================================================================
what happened           what the core does
======================  =========================================================================
HostRegistered          takes the host in, compares what it holds with what is intended
HostLeft                gives it no more work; its processes return to the queue as they end, or
                        are out of reach where the slave left them running
ProcessRequested        notes that the host asks; places what waits
ReadingsReceived        notes readings; places what waits
StatusesReceived        moves processes through their phases; drives migrations
UsagesReceived          lowers what is counted in flight by what now shows
KeptStatesReceived      notes which states a host keeps
SubmissionReceived      refuses or queues all of them; places
CancelRequested         takes out of the queue, or stops
RestartRequested        restarts where it runs, or queues anew what has ended
MigrationRequested      begins a migration
CheckpointRequested     begins to dump a process into an image
RestoreRequested        begins to restore a process from its image
HostStateRequested      cordons, uncordons, drains
PruneRequested          removes ended processes and departed hosts from the listings
OrderAnswered           notes that a slave took an order or refused it
HandoffReported         notes how far the nodes of a handoff are
AssignmentWithdrawn     queues the process again at its old place
PeerRefused             records it
TimePassed              looks at every deadline: silence, delivery, steps, hysteresis
======================  =========================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final

from rosrm.core.master import answers, lifecycle, plugin_failures, pruning, requests, tick
from rosrm.core.master import events as happened
from rosrm.core.master.assignment.assign import place_waiting
from rosrm.core.master.checkpoint import replication
from rosrm.core.master.commands import Command
from rosrm.core.master.hosts import registration
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import executor, handoff

_Handler = Callable[[MasterState, Any, float], None]

#: The transition table.
HANDLERS: Final[Mapping[type, _Handler]] = MappingProxyType(
    {
        happened.HostRegistered: registration.host_registered,
        happened.HostLeft: registration.host_left,
        happened.ProcessRequested: registration.process_requested,
        happened.ReadingsReceived: registration.readings_received,
        happened.UsagesReceived: registration.usages_received,
        happened.KeptStatesReceived: replication.kept_states_received,
        happened.PeerRefused: registration.peer_refused,
        happened.StatusesReceived: lifecycle.statuses_received,
        happened.AssignmentWithdrawn: lifecycle.assignment_withdrawn,
        happened.SubmissionReceived: requests.submission_received,
        happened.CancelRequested: requests.cancel_requested,
        happened.RestartRequested: requests.restart_requested,
        happened.MigrationRequested: requests.migration_requested,
        happened.CheckpointRequested: requests.checkpoint_requested,
        happened.RestoreRequested: requests.restore_requested,
        happened.HostStateRequested: requests.host_state_requested,
        happened.PruneRequested: pruning.prune_requested,
        happened.OrderAnswered: answers.order_answered,
        happened.HandoffReported: handoff.handoff_reported,
        happened.TimePassed: tick.time_passed,
    }
)


def step(state: MasterState, event: happened.Event, now: float) -> list[Command]:
    """Handle one event.

    Args:
        state: changed in place.
        event: what happened.
        now: seconds by the master's monotonic clock; never less than before.

    Returns:
        Commands to carry out, in order; records and intents first become durable.
    """
    HANDLERS[type(event)](state, event, now)
    executor.advance_all(state, now)
    place_waiting(state, now)
    plugin_failures.note(state, now)
    return state.take()
