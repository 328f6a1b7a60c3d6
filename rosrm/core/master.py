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

from rosrm.core import events as happened
from rosrm.core import handoffs, intake, keeping, lifecycle, moves, pruning, requests, upkeep
from rosrm.core.assigning import place_waiting
from rosrm.core.commands import Command
from rosrm.core.state import MasterState

_Handler = Callable[[MasterState, Any, float], None]

#: The transition table.
HANDLERS: Final[Mapping[type, _Handler]] = MappingProxyType(
    {
        happened.HostRegistered: intake.host_registered,
        happened.HostLeft: intake.host_left,
        happened.ProcessRequested: intake.process_requested,
        happened.ReadingsReceived: intake.readings_received,
        happened.UsagesReceived: intake.usages_received,
        happened.KeptStatesReceived: keeping.kept_states_received,
        happened.PeerRefused: intake.peer_refused,
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
        happened.OrderAnswered: moves.order_answered,
        happened.HandoffReported: handoffs.handoff_reported,
        happened.TimePassed: upkeep.time_passed,
    }
)


def step(state: MasterState, event: happened.Event, now: float) -> list[Command]:
    """Take one event in.

    Args:
        state: changed in place.
        event: what happened.
        now: seconds by the master's monotonic clock; never less than before.

    Returns:
        What to carry out, in order; records and intents first become durable.
    """
    HANDLERS[type(event)](state, event, now)
    moves.advance_all(state, now)
    place_waiting(state, now)
    state.plugins.note(state, now)
    return state.take()
