"""Standbys: a second instance on another host follows the state of a process.

A standby is the destination of a migration that `executor` executes up to the SWITCH step, where
the migration is paused. `failover` resumes it when the primary has ended.

======================  =====================================================================
process                 action on its standby
======================  =====================================================================
runs without standby    a standby is started as a shadow, on another host that has room
standby starts          `state_config` names primary and standby, until the standby is READY
standby has failed      the standby is stopped; another one starts after a delay that doubles
is restarted            a READY standby is replaced, because its state is of the former run
is in back-off          the primary is stopped for good, and the standby takes over
migrates                the standby stays until the commit, because the migration may fail
has ended               the standby is stopped
======================  =====================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Final

from rosrm.core.master import lifecycle
from rosrm.core.master.assignment.demands import demand_of, ranking_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import executor, failover, handoff
from rosrm.core.master.migration.start import plan_move, why_no_executor
from rosrm.core.master.outcomes import Rejected, StepFailed, StepProgress
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.hosts import Host
from rosrm.core.master.state.migration import Migration
from rosrm.core.master.state.process import DesiredState, Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Configure, HandoffPhase, ReportPhase, Start
from rosrm.model.values import EMPTY

#: First and longest time, in seconds, between a lost standby and the next one. Each lost standby
#: doubles it, unless the standby was ready for the longest time.
_FIRST_WAIT: Final = 2.0
_LONGEST_WAIT: Final = 60.0
#: Highest number of standbys that one review starts.
_AT_A_TIME: Final = 2


def review_standbys(state: MasterState, now: float) -> None:
    """Review every standby, and start missing ones."""
    for migration in list(state.standbys.values()):
        _review(state, migration, now)
    begun = 0
    for name in state.wants_standby:
        process = state.processes[name]
        if begun < _AT_A_TIME and _lacks_one(state, process, now):
            begun += _begin(state, process, now)


def _lacks_one(state: MasterState, process: Process, now: float) -> bool:
    alone = process.name not in state.standbys and process.name not in state.migrations
    calm = process.phase is ProcessPhase.RUNNING and process.wanted is DesiredState.RUN
    return alone and calm and len(process.instances) == 1 and now >= process.standby_backoff.until


# --- start of a standby -----------------------------------------------------------------------


def _begin(state: MasterState, process: Process, now: float) -> bool:
    owner = state.instances[process.owner]
    ranking = ranking_of(state, _demand(state, process, owner.host, process.moves.waiting(now)))
    if ranking.best() < 0:  # a host where a standby has failed is better than none
        ranking = ranking_of(state, _demand(state, process, owner.host, EMPTY))
    column = ranking.best()
    if column < 0:
        _wait(state, process, "no host has room for its standby", now)
        return False
    host = state.hosts.hosts[column]
    migration = plan_move(state, process, host, "standby", now)
    why = migration.reason if isinstance(migration, Rejected) else why_no_executor(state, migration)
    if isinstance(migration, Rejected) or why or not _can_wait(migration):
        why = why or "its migration strategy keeps no standby ready"
        _wait(state, process, f"it can have no standby: {why}", now)
        return False
    state.standbys[process.name] = migration
    state.reserve(migration.destination, process.spec, host, now, ranking)
    state.record(
        now, EventKind.STANDBY_BEGUN, f"the standby of {process.name} starts on {host.name}",
        process=process.name, host=host.name, facts={"number": migration.destination.number},
    )  # fmt: skip
    process.standby_reason = f"its standby starts on {host.name}"
    executor.advance_standby(state, migration, now)
    state.save(process)
    return True


def _can_wait(migration: Migration) -> bool:
    """Return True if the plan starts a shadow that is ready before the SWITCH step."""
    shadow, switch = (
        failover.index_of(phase, migration.plan.steps)
        for phase in (HandoffPhase.SHADOW, HandoffPhase.SWITCH)
    )
    return 0 <= shadow < switch and any(
        isinstance(step, Start) and step.shadow for step in migration.plan.steps[:shadow]
    )


def _demand(
    state: MasterState, process: Process, primary: Host, failed: Mapping[str, str]
) -> Demand:
    """Return the demand of a standby: that of the process, without hosts too near the primary.

    `failed`: further hosts that must not be chosen, each with the reason.

    A standby need not run near the neighbours of the process, but must run apart from others.
    """
    own = demand_of(state, process)
    excluded = {
        **process.forbidden_hosts, **failed,
        primary.name: "the primary runs there",
    }  # fmt: skip
    labels = primary.description.labels
    spread = [rule.by for rule in process.spec.neighbours if rule.group and not rule.prefer]
    apart_by = dict.fromkeys((*process.spec.standby.apart_by, *filter(None, spread)))
    neighbours = tuple(
        rule._replace(prefer=rule.prefer or rule.relation == "near") for rule in own.neighbours
    )
    for host in state.hosts.hosts:
        for label in apart_by:
            if label not in labels:
                why = f"{primary.name}, the host of the primary, has no label {label!r}"
                excluded.setdefault(host.name, f"{why}, in which the standby must differ")
                continue
            value = host.description.labels.get(label)
            if value is None:
                why = f"it has no label {label!r}, in which the standby must differ"
                excluded.setdefault(host.name, why)
            elif value == labels[label]:
                why = f"it has {label}={value}, as the host of the primary"
                excluded.setdefault(host.name, why)
    return Demand(
        process.spec, own.amounts, own.estimated, excluded, neighbours=neighbours,
        traffic=own.traffic, plugins=state.placement,
    )  # fmt: skip


def _wait(state: MasterState, process: Process, why: str, now: float) -> None:
    """Delay the next standby; record the reason once."""
    process.standby_backoff.until = now + _FIRST_WAIT
    if process.standby_reason != why:
        process.standby_reason = why
        state.record(now, EventKind.STANDBY_WAITS, f"{process.name}: {why}", process=process.name)


# --- review of a standby ----------------------------------------------------------------------


def _review(state: MasterState, migration: Migration, now: float) -> None:
    process = state.processes[migration.process]
    instance = state.instances.get(migration.destination.number)
    move = state.migrations.get(migration.process)
    has_ended = process.wanted is DesiredState.CANCEL or process.phase.is_terminal
    if has_ended or (move and move.committed):
        _end(state, process, now)
    elif move is not None:
        return
    elif instance is None:
        how = migration.how_ended(migration.destination)
        _failed(state, process, migration, f"{migration.destination} ended: {how}", now)
    elif process.owner != migration.source.number:
        _end(state, process, now)
    elif instance.host.draining:
        _lost(state, process, migration, f"{instance.host.name} is being drained", now)
    elif migration.source_restarted:
        _lost(state, process, migration, f"{migration.source} was restarted", now)
    elif (gave_up := _why_given_up(migration)) is not None:
        _failed(state, process, migration, gave_up, now)
    else:
        _advance(state, process, migration, now)


def _why_given_up(migration: Migration) -> str | None:
    """Return why the standby has aborted the handoff; None: it has not."""
    reported = migration.phases_of(migration.destination)
    if reported.keys().isdisjoint({ReportPhase.FAILED, ReportPhase.ABORTED}):
        return None
    why = reported.get(ReportPhase.FAILED) or reported.get(ReportPhase.ABORTED)
    return why or f"{migration.destination} has aborted the handoff"


def _advance(state: MasterState, process: Process, migration: Migration, now: float) -> None:
    outcome = executor.advance_standby(state, migration, now)
    if isinstance(outcome, StepFailed):
        late = f"{migration.destination} did not start in time"
        why = late if outcome.timed_out else outcome.reason
        _failed(state, process, migration, why, now)
    elif outcome is StepProgress.DONE:
        _note_ready(state, process, migration, now)
    elif isinstance(migration.current_step, Configure):
        host, waits = migration.destination_host.name, handoff.newest_reports(migration)
        process.standby_reason = f"its standby on {host} is not ready: {waits}"


def _note_ready(state: MasterState, process: Process, migration: Migration, now: float) -> None:
    host = migration.destination_host.name
    ready = f"its standby is ready on {host}"
    if process.standby_reason != ready:
        process.standby_reason, process.standby_since = ready, now
        state.record(
            now, EventKind.STANDBY_READY, f"the standby of {process.name} is ready on {host}",
            process=process.name, host=host,
        )  # fmt: skip


def _failed(
    state: MasterState, process: Process, migration: Migration, why: str, now: float
) -> None:
    """Replace a standby that has failed, if possible on another host."""
    host = migration.destination_host.name
    process.moves.note(host, f"its standby there has failed: {why}", now, _LONGEST_WAIT)
    _lost(state, process, migration, why, now)


def _lost(state: MasterState, process: Process, migration: Migration, why: str, now: float) -> None:
    if now - process.standby_since >= _LONGEST_WAIT:
        process.standby_backoff.tries = 0
    process.standby_since = inf
    wait = process.standby_backoff.note(now, _FIRST_WAIT, _LONGEST_WAIT)
    state.record(
        now, EventKind.STANDBY_LOST,
        f"{process.name} has no standby: {why}; the master starts another one in {wait:g} s",
        process=process.name, host=migration.destination_host.name,
    )  # fmt: skip
    _end(state, process, now)
    process.standby_reason = f"it has no standby: {why}"


def _end(state: MasterState, process: Process, now: float) -> None:
    """Stop the standby of a process, if it has one."""
    migration = state.standbys.pop(process.name, None)
    if migration is None:
        return
    process.standby_reason = ""
    handoff.close(state, migration)
    instance = state.instances.get(migration.destination.number)
    if instance is not None and process.owner != instance.id.number and not instance.stopping:
        lifecycle.stop_instance(state, instance, now)
    state.save(process)
