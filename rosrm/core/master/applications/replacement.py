"""Replacement of a running process by an instance of another version of it.

A process with a migration strategy is migrated to the new instance, on its own host where that
fits: a stateful one so hands over its state. Others are stopped, and start again with the new spec.
"""

from __future__ import annotations

from collections.abc import Mapping

from rosrm.core.master import lifecycle
from rosrm.core.master.assignment.assign import unable
from rosrm.core.master.assignment.demands import ranking_of
from rosrm.core.master.assignment.flows import traffic_of
from rosrm.core.master.assignment.neighbours import neighbours_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.start import (
    begin_move,
    is_being_restarted,
    may_begin,
    plan_move,
    why_busy,
    why_no_executor,
)
from rosrm.core.master.outcomes import Rejected
from rosrm.core.master.scheduling.decision import decide
from rosrm.core.master.scheduling.feasibility import why_never
from rosrm.core.master.start_order import awaited_by
from rosrm.core.master.state.demand import Demand
from rosrm.core.master.state.process import DesiredState, Process, ProcessPhase
from rosrm.extensions.declared_fields import UnknownCapabilities
from rosrm.model.event_kinds import EventKind
from rosrm.model.values import ProcessSpec


class NeverFits(Rejected):
    """No host that is known may ever take the new version of a process."""


class Busy(Rejected):
    """Other work must end first, which has its own time limits."""


def try_replace(
    state: MasterState, process: Process, spec: ProcessSpec, cause: str, now: float
) -> Rejected | None:
    """Begin to replace a process that its slave has started; return why it must wait, if it must.

    Args:
        spec: the new spec; it differs in fields that need a new start.
        cause: phrase for records.
    """
    if process.name in state.migrations:
        return Busy(why_busy(state.migrations[process.name]))
    able = state.declared.capabilities_of(spec)
    if isinstance(able, UnknownCapabilities):
        return Rejected(able.reason)
    kept = able.state
    strategy = spec.migration.strategy
    can_move = strategy in state.strategies and kept != "memory"  # an image has the old program
    never = why_never(state.hosts, _demand(state, process, spec, process.forbidden_hosts))
    if never:
        return NeverFits(f"no host may take its new version: {never}")
    if process.phase is not ProcessPhase.RUNNING or not can_move:
        return _stop_and_start(state, process, spec, cause, now)
    if not may_begin(state, 1):
        return Busy("waits until another process has moved")
    refusal = _migrate(state, process, spec, cause, now)
    if refusal is not None and kept == "none":
        return _stop_and_start(state, process, spec, cause, now)
    return refusal


def _migrate(
    state: MasterState, process: Process, spec: ProcessSpec, cause: str, now: float
) -> Rejected | None:
    """Begin the migration of a process to an instance of a new spec; return why it cannot begin."""
    source = state.instances[process.owner]
    others = process.instances - {source.id.number}
    if others and process.name not in state.standbys:
        return Busy(f"an earlier instance of {process.name} is still being stopped")
    if is_being_restarted(state, process):
        return Busy(f"{process.name} is being restarted")
    excluded = {**process.forbidden_hosts, **unable(state, process, source.host.name)}
    ranking = ranking_of(state, _demand(state, process, spec, excluded))
    column = source.host.column if ranking.fits(source.host.column) else ranking.best()
    if column < 0:
        return Rejected(f"no host has room for the new version of {process.name} beside the old")
    host = state.hosts.hosts[column]
    migration = plan_move(state, process, host, cause, now, spec)
    if isinstance(migration, Rejected):
        return migration
    lacking = why_no_executor(state, migration)
    if lacking:
        return Rejected(lacking)
    decision = decide(ranking, chosen=column)
    begin_move(state, process, migration, ranking, now)
    state.note_decision(process, decision, "migrated", now)
    return None


def _demand(
    state: MasterState, process: Process, spec: ProcessSpec, excluded: Mapping[str, str]
) -> Demand:
    needs = state.estimate(spec)
    return Demand(
        spec, needs.amounts, needs.estimated, excluded, neighbours=neighbours_of(state, process),
        traffic=traffic_of(state, process), plugins=state.placement,
    )  # fmt: skip


def _stop_and_start(
    state: MasterState, process: Process, spec: ProcessSpec, cause: str, now: float
) -> Busy | None:
    """Stop a process; its start from the queue has the new spec.

    A running process is not stopped while its new version would wait for other processes. The
    result names them.
    """
    awaits, _ = awaited_by(state, spec.start_order, now)
    if awaits and process.phase is ProcessPhase.RUNNING:
        return Busy(f"its new version {awaits}")
    process.next_spec, process.wanted = spec, DesiredState.REQUEUE
    state.record(
        now, EventKind.REPLACED, f"{process.name} is stopped, and starts again: {cause}",
        process=process.name,
    )  # fmt: skip
    for instance in state.instances_of(process):
        if not instance.stopping:
            lifecycle.stop_instance(state, instance, now)
    state.save(process)
    return None
