"""Loss and rejoin of a host, and the treatment of its instances.

A detached host, whose slave was stopped and left processes running, counts as lost when its lease
has passed: no process of it may start elsewhere sooner than after a loss.

=========================  ======================================================================
instance on a lost host    action
=========================  ======================================================================
owner of the name          given up at once, where a standby can take over;
                           else by `host_loss`: `wait`; after `delay` go `elsewhere`, or `stop`
possible owner             as the owner: the destination of a migration that may be active, or the
                           last instance of a process
cancelled                  tracked until its host reports its end or is pruned; with `elsewhere` and
                           `isolation: stop` given up after `delay`, when its fence has ended it
being restored             never given up, because its memory is on that host alone
other                      given up at once, for example a former source or a shadow
=========================  ======================================================================

An instance that is given up may still run while its host is silent; `readoption` handles it then.
While no host reports to the master, and for one lease afterwards, no instance is given up: the
master itself was cut off, and its hosts rejoin one by one.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rosrm.core.master import lifecycle
from rosrm.core.master.hosts import readoption
from rosrm.core.master.hosts.fencing import ended_after_loss
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import failover, handoff
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.process import (
    DesiredState,
    Instance,
    LeftBehind,
    Process,
    ProcessPhase,
)
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Aim

_OUT_OF_REACH: Final = (HostCondition.LOST, HostCondition.DETACHED)


def mark_lost(state: MasterState, host: Host, now: float) -> None:
    """Mark a host as lost: its processes are out of reach, not ended."""
    host.lost_since = now
    _note_phases(state, host, now)
    _review(state, host, now)


def detach(state: MasterState, host: Host, lease_end: float, now: float) -> None:
    """Mark a host as detached: its slave was stopped and left processes running."""
    host.detached_since, host.lost_since = now, lease_end
    _note_phases(state, host, now)


def _note_phases(state: MasterState, host: Host, now: float) -> None:
    for instance in state.instances_of(host):
        process = state.owned_by(instance)
        if process is not None and process.name not in state.migrations:
            lifecycle.note_phase(state, process, instance, now)


def mark_rejoined(state: MasterState, host: Host, now: float) -> None:
    """Restore the phases of a rejoined host's processes; retry what has failed without it."""
    for migration in state.migrations.values():
        if host in (migration.source_host, migration.destination_host):
            migration.retry = Backoff()
    for instance in state.instances_of(host):
        process = state.owned_by(instance)
        if process is None or process.name in state.migrations:
            continue
        if process.phase is ProcessPhase.UNREACHABLE or process.wanted is DesiredState.CANCEL:
            lifecycle.note_phase(state, process, instance, now)
    readoption.readopt_all(state, host, now)


def review_lost_hosts(state: MasterState, now: float) -> None:
    """Give up every due instance on lost or detached hosts."""
    for column in np.flatnonzero(state.hosts.having(_OUT_OF_REACH)):
        _review(state, state.hosts.hosts[column], now)


def _review(state: MasterState, host: Host, now: float) -> None:
    if now < host.lost_since:
        return
    for instance in state.instances_of(host):
        if _is_given_up(state, instance, now):
            _give_up(state, instance, now)


def _is_given_up(state: MasterState, instance: Instance, now: float) -> bool:
    process = state.processes.get(instance.id.process)
    if process is None:
        return True
    if now < state.contact_since + state.settings.lease:
        return False
    migration = state.migrations.get(process.name)
    if migration is not None and migration.aim is Aim.RESTORE and not migration.committed:
        return False
    if process.owner not in (0, instance.id.number) and not _may_be_active(state, instance):
        return True
    if process.owner == instance.id.number and failover.can_replace(state, process):
        return True
    policy = instance.spec.host_loss
    lost_for = now - instance.host.lost_since
    if process.wanted is DesiredState.CANCEL:
        # Giving the instance up frees its name, so it must have ended. Only an expired fence
        # ensures that.
        ends_at = max(policy.delay, ended_after_loss(instance.spec, state.settings))
        return policy.then == "elsewhere" and lost_for >= ends_at
    return policy.then in ("elsewhere", "stop") and lost_for >= policy.delay


def _may_be_active(state: MasterState, instance: Instance) -> bool:
    """Return True if the destination of a migration may be active, unknown to the master."""
    migration = state.migrations.get(instance.id.process)
    if migration is None or migration.committed or migration.destination != instance.id:
        return False
    may_run = instance.id.number in migration.launched and not instance.restarts_off
    alone = may_run and migration.plan.overlap == 0.0
    return alone or handoff.was_switched(migration)


def _give_up(state: MasterState, instance: Instance, now: float) -> None:
    host, process = instance.host, state.processes.get(instance.id.process)
    why = f"{host.name} {state.hosts.why_unreachable(host)}"
    state.record(
        now, EventKind.GIVEN_UP, f"{instance.id} is given up: {why}",
        process=instance.id.process, host=host.name, facts={"number": instance.id.number},
    )  # fmt: skip
    if process is not None and _may_be_readopted(process, instance):
        process.left_behind = LeftBehind(
            instance.id.number, host.name, instance.node_name, process.began, instance.spec,
            instance.restarts_off,
        )  # fmt: skip
        process.ran_before = process.ran_before_owner(instance)
    requeue = instance.spec.host_loss.then != "stop"
    lifecycle.gone(state, instance, now, why, requeue=requeue)


def _may_be_readopted(process: Process, instance: Instance) -> bool:
    """Return True if the instance owns the name and was not ordered to stop."""
    is_owner = process.owner == instance.id.number
    to_run = process.wanted is DesiredState.RUN and not instance.stopping
    return is_owner and to_run and instance.spec.host_loss.then == "elsewhere"
