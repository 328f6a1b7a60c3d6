"""The master's reducer: (state, event, now) -> commands. One row for each kind of event.

======================  =========================================================================
event                   action of the core
======================  =========================================================================
HostRegistered          registers the host, reconciles its instances with the desired ones
HostLeft                marks the host as left, and queues its processes as they end; or marks it as
                        detached, if its slave leaves processes running
ProcessRequested        notes the open request of the host; places queued processes
ReadingsReceived        stores readings; places queued processes
StatusesReceived        moves processes through their phases; drives migrations
UsagesReceived          lowers reservations by the usage that readings now show
SnapshotsReported       replaces the known snapshots and replicas of a host
SubmissionReceived      queues all submitted processes, or refuses all; places queued processes
ApplicationsRequested   makes versions of applications the desired ones, or plans that
ModesLoaded             replaces the modes of the cluster
ModeRequested           switches to a mode, or plans that
CancelRequested         removes processes from the queue, or stops them
RestartRequested        restarts running processes in place, or queues ended ones again
MigrationRequested      begins a migration
CheckpointRequested     begins to dump a process into an image
RestoreRequested        begins to restore a process from its image
HostStateRequested      cordons, uncordons, drains
RebalanceRequested      evens out the load of the hosts, or replies with the moves that would
ReloadRequested         lets the master's file be read, then orders the slaves to read theirs
PruneRequested          removes ended processes and departed hosts from the listings
OrderAnswered           notes whether the slave accepted the order, and the result of an executor
HandoffReported         notes the reported phase of a handoff's source or destination
SourceStranded          lets a silent source resume whose handoff is not under way
AssignmentWithdrawn     returns the process to its place in the queue
PeerRefused             records the refusal
KeyRevoked              gives the host no work; its silence does the rest
SettingsRead            applies the settings, or refuses the file
TimePassed              checks every deadline: silence, delivery, steps, hysteresis
======================  =========================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final

from rosrm.core.master import (
    answers,
    lifecycle,
    plugin_failures,
    pruning,
    reloading,
    requests,
    tick,
)
from rosrm.core.master import events as happened
from rosrm.core.master.applications import requests as application_requests
from rosrm.core.master.checkpoint import replication
from rosrm.core.master.commands import Command, Reply
from rosrm.core.master.consequences import follow_up
from rosrm.core.master.hosts import registration
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import handoff
from rosrm.core.master.modes import switching
from rosrm.core.master.outcomes import RequestRefused

_Handler = Callable[[MasterState, Any, float], None]

#: Handler of each event.
HANDLERS: Final[Mapping[type, _Handler]] = MappingProxyType(
    {
        happened.HostRegistered: registration.host_registered,
        happened.HostLeft: registration.host_left,
        happened.ProcessRequested: registration.process_requested,
        happened.ReadingsReceived: registration.readings_received,
        happened.UsagesReceived: registration.usages_received,
        happened.SnapshotsReported: replication.snapshots_reported,
        happened.PeerRefused: registration.peer_refused,
        happened.KeyRevoked: registration.key_revoked,
        happened.StatusesReceived: lifecycle.statuses_received,
        happened.AssignmentWithdrawn: lifecycle.assignment_withdrawn,
        happened.SubmissionReceived: requests.submission_received,
        happened.ApplicationsRequested: application_requests.applications_requested,
        happened.ModesLoaded: switching.modes_loaded,
        happened.ModeRequested: switching.mode_requested,
        happened.CancelRequested: requests.cancel_requested,
        happened.RestartRequested: requests.restart_requested,
        happened.MigrationRequested: requests.migration_requested,
        happened.CheckpointRequested: requests.checkpoint_requested,
        happened.RestoreRequested: requests.restore_requested,
        happened.HostStateRequested: requests.host_state_requested,
        happened.RebalanceRequested: requests.rebalance_requested,
        happened.ReloadRequested: reloading.reload_requested,
        happened.PruneRequested: pruning.prune_requested,
        happened.OrderAnswered: answers.order_answered,
        happened.HandoffReported: handoff.handoff_reported,
        happened.SourceStranded: handoff.source_stranded,
        happened.SettingsRead: reloading.settings_read,
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
        Commands in the order of execution, once their records and intents are durable.
    """
    try:
        HANDLERS[type(event)](state, event, now)
    except RequestRefused as refusal:
        assert isinstance(event, happened.Request)
        state.emit(Reply(event.request, False, refusal.code, str(refusal)))
    follow_up(state, now)
    plugin_failures.note(state, now)
    return state.take()
