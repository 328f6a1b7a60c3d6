"""Checkpoint and restore of a process on its own host: begin and outcome.

Both are plans like those of migrations, which `executor` executes: a failure before the commit is
undone, a later one retried. The commit of a checkpoint makes a checkpoint image (`images`) the
owner of the name, in place of an instance. The commit of a restore makes the restored instance the
owner.
"""

from __future__ import annotations

from typing import Final

from rosrm.core.master.assignment.assign import demand_to_restore
from rosrm.core.master.assignment.demands import ranking_of
from rosrm.core.master.checkpoint import images
from rosrm.core.master.hosts import capabilities
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.blackout import changes_source
from rosrm.core.master.migration.start import (
    is_being_restarted,
    move_of,
    planned,
    why_busy,
    why_no_executor,
)
from rosrm.core.master.migration.steps import instances_are_gone, title
from rosrm.core.master.outcomes import Rejected
from rosrm.core.master.scheduling.decision import verdict_of
from rosrm.core.master.scheduling.ranking import Ranking
from rosrm.core.master.state.migration import Migration
from rosrm.core.master.state.process import DesiredState, Image, Instance, Process, ProcessPhase
from rosrm.extensions.contracts import Imaging
from rosrm.extensions.declared_fields import UnknownCapabilities
from rosrm.extensions.plugin_calls import implements
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import Aim, Commit, Execute, Move
from rosrm.model.values import InstanceId
from rosrm.wording import listed, standing

#: Kind of the record at the begin of each.
_BEGUN: Final = {
    Aim.CHECKPOINT: EventKind.CHECKPOINT_BEGUN,
    Aim.RESTORE: EventKind.RESTORE_BEGUN,
}


# --- checkpoint -------------------------------------------------------------------------------


def begin_checkpoint(
    state: MasterState, process: Process, cause: str, now: float
) -> Rejected | None:
    """Begin to dump a running process into an image.

    Returns:
        None; or the reason why the process cannot be checkpointed, and nothing has changed.
    """
    refusal = why_no_checkpoint(state, process)
    if refusal:
        return Rejected(refusal)
    owner, name = state.instances[process.owner], _strategy_of(state, process)
    node = owner.node_name or process.spec.node
    move = move_of(state, process, owner.id, owner.host, owner.host, node)
    return _begin(state, process, move, name, Aim.CHECKPOINT, now, cause=cause)


def why_no_checkpoint(state: MasterState, process: Process) -> str:
    """Return why a process cannot be checkpointed now; "": its strategy is asked for a plan."""
    refusal = _why_not_dumped(state, process)
    if refusal:
        return refusal
    if is_being_restarted(state, process):
        return f"{process.name} is being restarted; it can be checkpointed afterwards"
    owner, name = state.instances[process.owner], _strategy_of(state, process)
    if not name:
        return _why_no_strategy(state, process)
    fault = capabilities.fault(state, name, owner.host, owner.host)
    return f"{process.name} cannot be checkpointed: {fault}" if fault else ""


def _why_not_dumped(state: MasterState, process: Process) -> str:
    if process.name in state.migrations:
        return why_busy(state.migrations[process.name])
    if process.phase is ProcessPhase.CHECKPOINTED:
        return f"{process.name} is checkpointed already: {images.reason_of(state, process)}"
    if process.phase is not ProcessPhase.RUNNING:
        stands = standing(process.phase.value)
        return f"{process.name} {stands}; only a running process is checkpointed"
    if process.spec.standby.wanted:
        return (
            f"{process.name} has a standby, which would take over: submit the process without "
            f"`standby` to checkpoint it"
        )
    able = state.declared.capabilities_of(process.spec)
    if isinstance(able, UnknownCapabilities) and process.spec.ros:
        return f"{process.name} cannot be checkpointed: {able.reason}"
    if state.declared.may_have_snapshots(process.spec):
        return (
            f"{process.name} moves by {process.spec.migration.strategy}: its node is identified by "
            f"the number of its instance, and the restored instance would have another one"
        )
    if process.instances - {process.owner}:
        return f"an earlier instance of {process.name} is still being stopped"
    return ""


def _strategy_of(state: MasterState, process: Process) -> str:
    """Return the process's own strategy if it supports images, else the first that does.

    "": no selected strategy supports images.
    """
    own = process.spec.migration.strategy or ""
    names = [*([own] if own in state.strategies else []), *state.strategies]
    return next((name for name in names if implements(state.strategies[name], Imaging)), "")


def _why_no_strategy(state: MasterState, process: Process) -> str:
    able = [f"`{name}`" for name, it in state.declared.capabilities.items() if it.state == "memory"]
    remedy = f"name {listed(able, 'or')}" if able else "install a strategy that can, and name it"
    return (
        f"no selected strategy can checkpoint {process.name}: {remedy} below "
        f"`migration: strategies:` in the cluster's file, and start the master again"
    )


# --- restore ----------------------------------------------------------------------------------


def begin_restore(state: MasterState, process: Process, cause: str, now: float) -> Rejected | None:
    """Begin to restore a process from its image, on the host of the image.

    Returns:
        None; or the reason why the process cannot be restored, and nothing has changed.
    """
    image = process.image
    refusal = why_no_restore(state, process)
    if refusal or image is None:
        return Rejected(refusal)
    host = state.hosts.by_name[image.host]
    ranking = ranking_of(state, demand_to_restore(state, process, image.needs))
    if not ranking.fits(host.column):
        why = verdict_of(ranking, host.column).reason
        return Rejected(
            f"{process.name} can be restored on {host.name} alone, where its image is, and does "
            f"not fit there now: {why or 'no room'}"
        )
    source = InstanceId(process.name, image.number)
    move = move_of(state, process, source, host, host, image.node_name or process.spec.node)
    return _begin(
        state, process, move, image.strategy, Aim.RESTORE, now, cause=cause, ranking=ranking
    )


def why_no_restore(state: MasterState, process: Process) -> str:
    """Return why a process cannot be restored, apart from the room that it needs; "": it can."""
    if process.name in state.migrations:
        return why_busy(state.migrations[process.name])
    image = process.image
    if image is None or process.phase is not ProcessPhase.CHECKPOINTED:
        stands = standing(process.phase.value)
        return f"{process.name} {stands}; only a checkpointed process is restored"
    if process.instances:
        return f"an earlier instance of {process.name} is still being stopped"
    away = images.why_away(state, image)
    if away:
        return f"{process.name} can be restored on {image.host} alone, which {away}"
    strategy: object = state.strategies.get(image.strategy)
    if not implements(strategy, Imaging):
        return (
            f"the image of {process.name} was made by {image.strategy!r}, which is not selected "
            f"here: name it below `migration: strategies:` in the cluster's file"
        )
    host = state.hosts.by_name[image.host]
    fault = capabilities.fault(state, image.strategy, host, host)
    return f"{process.name} cannot be restored: {fault}" if fault else ""


# --- both -------------------------------------------------------------------------------------


def _begin(
    state: MasterState, process: Process, move: Move, strategy: str, aim: Aim, now: float,
    *, cause: str, ranking: Ranking | None = None,
) -> Rejected | None:  # fmt: skip
    """Begin the plan of a strategy; return None, or the reason why there is no plan.

    `ranking`: if given, the needs in it are reserved at the destination.
    """
    migration = planned(state, strategy, move, cause, now, aim)
    if isinstance(migration, Rejected):
        return migration
    lacking = why_no_executor(state, migration)
    if lacking:
        return Rejected(lacking)
    state.migrations[process.name] = migration
    if ranking is not None:
        host = migration.destination_host
        state.reserve(migration.destination, process.spec, host, now, ranking)
    state.set_phase(process, ProcessPhase.MIGRATING, now, migration.progress_text)
    state.record(
        now, _BEGUN[aim], f"{process.name}: {migration.progress_text}; {cause}",
        process=process.name, host=move.destination_host,
        facts={
            "strategy": strategy, "cause": cause,
            "steps": [title(step) for step in migration.plan.steps],
            "source": move.source.number, "destination": move.destination.number,
        },
    )  # fmt: skip
    state.save(process)
    state.save_migration(migration)
    return None


def commit_to_image(
    state: MasterState, process: Process, migration: Migration, step: Commit
) -> None:
    """Make the image the owner of the name; its source stays frozen."""
    source: Instance | None = state.instances.get(migration.source.number)
    needs = {} if source is None else source.measured
    image = Image(
        migration.source.number, migration.source_host.name, migration.strategy, step.image,
        state.wall,
        "" if migration.source_node == process.spec.node else migration.source_node, needs,
    )  # fmt: skip
    process.owner = 0
    images.set_image(state, process, image)


def leave_behind(state: MasterState, migration: Migration, step: Execute) -> bool:
    """Return True if an executor step that cannot succeed is needless and may be skipped.

    An instance that may be frozen on that host is killed when the host rejoins, not re-adopted.
    """
    if migration.aim is Aim.CHECKPOINT:
        if migration.undo is None or migration.source.number not in migration.ended:
            return False
        _remove_unmade(state, migration)
    elif not instances_are_gone(state, migration, step):
        return False
    process = state.processes[migration.process]
    left = process.left_behind
    if left is None or left.host != step.host:
        return True
    is_source = left.number == migration.source.number
    if not is_source or any(changes_source(migration, begun) for begun in migration.begun_steps):
        state.clear_left_behind(process)
        state.save(process)
    return True


def _remove_unmade(state: MasterState, migration: Migration) -> None:
    """Remove the partial image that an undone checkpoint may have left."""
    host, drop = migration.source_host.name, migration.commit.image
    images.remove(state, migration.process, host, drop, migration.source.number)


def settle(state: MasterState, process: Process, migration: Migration, now: float) -> None:
    """Set the phase after a plan that ends with an image; remove a cancelled process's image."""
    if process.wanted is DesiredState.CANCEL:
        images.cancel(state, process, now, migration.destination.number)
    else:
        process.wanted = DesiredState.RUN
        failed = migration.aim is Aim.RESTORE
        trouble = f"it was not restored: {migration.failure}" if failed else ""
        images.note_checkpointed(state, process, now, trouble)
    state.save(process)


def ending_of(migration: Migration) -> tuple[EventKind, str]:
    """Return the kind and the message of the record at the end of a plan."""
    name, done = migration.process, migration.undo is None
    here, there = migration.source_host.name, migration.destination_host.name
    if migration.aim is Aim.CHECKPOINT:
        if done:
            return EventKind.CHECKPOINTED, f"{name} is checkpointed: its image is on {here}"
        return (
            EventKind.CHECKPOINT_FAILED,
            f"{name} was not checkpointed and still runs on {here}: {migration.failure}",
        )
    if migration.aim is Aim.RESTORE:
        if done:
            return EventKind.RESTORED, f"{name} was restored from its image on {here}"
        return EventKind.RESTORE_FAILED, f"{name} stays checkpointed on {here}: {migration.failure}"
    if done and migration.spec is not None:
        return EventKind.MIGRATED, f"{name} was replaced on {there} by its new version"
    if done:
        return EventKind.MIGRATED, f"{name} moved from {here} to {there}"
    return EventKind.STAYED, f"{name} stayed on {here}: {migration.failure}"
