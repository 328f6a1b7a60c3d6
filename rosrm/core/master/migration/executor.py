"""Execution of migration plans, one step at a time: forward, or back (undo) before the commit.

========  ==================  ==============================================================
plan      current step        consequence
========  ==================  ==============================================================
forward   is done             the next step; after the last, the migration is complete
forward   fails, no commit    the undo of every step so far, newest first
forward   fails, committed    the step is retried; the process is stuck until it is done
back      is done             the next undo; after the last, the source resumes
back      fails               the step is retried; the process is stuck until it is done
any       cannot be done      the step is skipped: an instance that has ended never starts again,
                              an executor step for an instance on a lost host has no effect, and a
                              retry of an executor that returned no object gives the same result
back      destination active  forward to the commit: in a handoff the destination has reported that
                              it is active, in a restore an executor has found the process running
standby   is SWITCH           the plan is paused, and continues forward once the source has ended
========  ==================  ==============================================================

The cancellation of a process turns its migration back. A stuck migration is then given up, and all
its instances are stopped. If neither source nor destination is left, the process is queued again.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Final

from rosrm.core.master import lifecycle
from rosrm.core.master.checkpoint import image_requests, images
from rosrm.core.master.events import OrderOutcome
from rosrm.core.master.executor_results import seconds_of
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import blackout, failover, handoff
from rosrm.core.master.migration.steps import begin, outcome_of, title
from rosrm.core.master.outcomes import StepFailed, StepOutcome, StepProgress
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.migration import End, Migration
from rosrm.core.master.state.process import (
    DesiredState,
    PendingAmendment,
    Process,
    ProcessPhase,
)
from rosrm.core.master.state.spec_changes import with_in_place
from rosrm.model.event_kinds import EventKind
from rosrm.model.plan import (
    Aim,
    AwaitReady,
    Commit,
    Configure,
    Execute,
    HandoffPhase,
    Start,
    Step,
    Stop,
)
from rosrm.model.values import InstanceId, InstanceState

#: Message of the record of a commit.
_COMMITTED: Final = {
    Aim.MOVE: "the process now runs at the destination; the move can no longer be undone",
    Aim.CHECKPOINT: "the process is now in its image; the checkpoint can no longer be undone",
    Aim.RESTORE: "the process now runs from its image; the restore can no longer be undone",
}

#: Longest time, in seconds, between two tries of a step that must succeed.
_LONGEST_WAIT: Final = 30.0

# --- steps ------------------------------------------------------------------------------------


def advance_all(state: MasterState, now: float) -> None:
    """Advance every migration as far as possible now."""
    for migration in list(state.migrations.values()):
        while migration.process in state.migrations and _advance(state, migration, now):
            pass


def advance_standby(state: MasterState, migration: Migration, now: float) -> StepOutcome:
    """Advance the migration of a standby up to its SWITCH step, where it is paused.

    Only the steps that start and configure the standby are executed. The other steps before SWITCH
    concern the primary, which runs on unchanged, with its restarts.

    Returns:
        The outcome of the current step; DONE: the migration is paused.
    """
    pause = failover.index_of(HandoffPhase.SWITCH, migration.plan.steps)
    while migration.index < pause:
        step = migration.plan.steps[migration.index]
        if isinstance(step, Start) or (isinstance(step, Configure) and step.awaited):
            if not begin(state, migration, step, now):
                return StepProgress.PENDING
            if isinstance(step, Configure):
                migration.deadline = inf  # a standby does not fail because its primary is silent
            outcome = outcome_of(state, migration, step, now)
            if outcome is not StepProgress.DONE:
                return outcome
        _to_next_step(state, migration, now)
    return StepProgress.DONE


def _advance(state: MasterState, migration: Migration, now: float) -> bool:
    """Handle the current step; return True if more may be done at once."""
    _choose_direction(state, migration, now)
    step = migration.current_step
    if step is None or (
        migration.stuck and state.processes[migration.process].wanted is DesiredState.CANCEL
    ):
        _conclude(state, migration, now)
        return False
    if isinstance(step, Start) and migration.undo is not None and not _resumes(state, migration):
        _to_next_step(state, migration, now)
        return True
    if not begin(state, migration, step, now):
        return False
    blackout.note_begun(migration, step, now)
    outcome = outcome_of(state, migration, step, now)
    if outcome is StepProgress.PENDING:
        return False
    if isinstance(outcome, StepFailed):
        _failed(state, migration, step, outcome.reason, now)
    else:
        _done(state, migration, step, now)
    return migration.begun or not migration.stuck


def _choose_direction(state: MasterState, migration: Migration, now: float) -> None:
    """Choose the direction before the commit.

    An active destination leads forward. Otherwise the end of the source leads back.
    """
    if migration.committed:
        return
    if handoff.is_active(state, migration) or migration.destination_is_active:
        if migration.undo is not None:
            _go_forward(state, migration, now)
    elif migration.undo is None:
        reason = _undo_reason(state, migration)
        if reason:
            _begin_undo(state, migration, reason, now)


def _done(state: MasterState, migration: Migration, step: Step, now: float) -> None:
    what = _COMMITTED[migration.aim] if isinstance(step, Commit) else f"{title(step)}: done"
    state.record(
        now, EventKind.MIGRATION_STEP, f"{migration.process}: {what}", process=migration.process,
        facts={"step": title(step), "back": migration.undo is not None},
    )  # fmt: skip
    blackout.note_done(migration, step, now)
    process = state.processes[migration.process]
    if isinstance(step, Commit):
        _commit(state, migration, step, now)
    elif isinstance(step, Start) and migration.undo is not None:
        process.owner = step.instance.number
        state.save(process)
    _to_next_step(state, migration, now)


def _commit(state: MasterState, migration: Migration, step: Commit, now: float) -> None:
    process = state.processes[migration.process]
    migration.committed = True
    if migration.aim is Aim.CHECKPOINT:
        image_requests.commit_to_image(state, process, migration, step)
    else:
        process.owner = migration.destination.number
        if migration.spec is not None:
            state.set_spec(process, migration.spec)
        state.note_change(process.name)
        images.set_image(state, process, None)
    state.clear_left_behind(process)  # a source on a lost host has a successor now
    process.migrations += migration.aim is Aim.MOVE and migration.spec is None
    process.moved_at = now
    if process.wanted is DesiredState.REQUEUE:
        process.wanted = DesiredState.RUN  # the requeue was meant for the source host
    state.save(process)


def _cannot_be_done(state: MasterState, migration: Migration, step: Step, now: float) -> bool:
    """Return True if a retry cannot help: the instance has ended, or its slot was given away."""
    if isinstance(step, Execute):
        # A retry would give the same bad result. But the result of a restore may show that the
        # destination is active. So a restore stays stuck until the plugin is corrected.
        answer = migration.answer
        bad = answer is not None and answer.outcome is OrderOutcome.BAD_RESULT
        done = bad and migration.aim is not Aim.RESTORE
        return done or image_requests.leave_behind(state, migration, step)
    if not isinstance(step, Start | AwaitReady):
        return False
    instance = state.instances.get(step.instance.number)
    if instance is not None and instance.state is InstanceState.HELD:
        lifecycle.stop_instance(state, instance, now)
        return True
    return step.instance.number in migration.ended


def _to_next_step(state: MasterState, migration: Migration, now: float) -> None:
    """Turn to the next step, or the next undo."""
    migration.index += 1
    migration.begun = False
    migration.retry = Backoff()
    if migration.stuck:
        _not_stuck(state, migration, now)
    state.save_migration(migration)


def _not_stuck(state: MasterState, migration: Migration, now: float) -> None:
    migration.stuck = False
    process = state.processes[migration.process]
    state.set_phase(process, ProcessPhase.MIGRATING, now, migration.progress_text)


def _failed(state: MasterState, migration: Migration, step: Step, reason: str, now: float) -> None:
    if not migration.stuck:
        state.record(
            now, EventKind.MIGRATION_STEP_FAILED, f"{migration.process}: {reason}",
            process=migration.process,
            facts={"step": title(step), "back": migration.undo is not None},
        )  # fmt: skip
    if migration.undo is None and not migration.committed:
        _begin_undo(state, migration, reason, now)
        return
    if _cannot_be_done(state, migration, step, now):
        _to_next_step(state, migration, now)
        return
    migration.begun = False
    migration.retry.note(now, state.settings.order_retry, _LONGEST_WAIT)
    if not migration.stuck:
        migration.stuck = True
        end = "finished" if migration.undo is None else "undone"
        process = state.processes[migration.process]
        why = f"its {migration.aim.value} cannot be {end} yet: {reason}; the master retries"
        state.set_phase(process, ProcessPhase.STUCK, now, why)
        message = f"{process.name} is stuck: {why}"
        state.record(now, EventKind.MIGRATION_STUCK, message, process=process.name)


def _begin_undo(state: MasterState, migration: Migration, reason: str, now: float) -> None:
    """Begin the undo of all steps up to the current one, newest first."""
    migration.failure = reason
    migration.begin_undo()
    message = f"the {migration.aim.value} of {migration.process} is undone: {reason}"
    state.record(now, EventKind.MIGRATION_UNDONE, message, process=migration.process)
    state.save_migration(migration)


def _go_forward(state: MasterState, migration: Migration, now: float) -> None:
    """Turn forward again, because the destination is active and owns the name."""
    migration.undo, migration.index = None, migration.plan.steps.index(migration.commit)
    migration.begun, migration.retry = False, Backoff()
    if migration.stuck:
        _not_stuck(state, migration, now)
    state.record(
        now, EventKind.MIGRATION_REDONE,
        f"the {migration.aim.value} of {migration.process} is finished after all: "
        f"{migration.destination} is active",
        process=migration.process,
    )  # fmt: skip
    state.save_migration(migration)


def _is_given_up(state: MasterState, migration: Migration) -> bool:
    """Return True if a replacement is no longer desired, because the source has the version."""
    process = state.processes[migration.process]
    application = state.applications.get(process.spec.application)
    if migration.spec is None or application is None:
        return False
    desired = application.specs.get(process.name)
    return desired is not None and with_in_place(process.spec, desired) == desired


def _undo_reason(state: MasterState, migration: Migration) -> str:
    """Return why a plan must be undone before its commit; "" if it need not."""
    if state.processes[migration.process].wanted is DesiredState.CANCEL:
        return f"a cancellation of {migration.process} was requested"
    if _is_given_up(state, migration):
        return f"the application now requires the version that {migration.source} runs"
    expected = (
        _was_ordered_to_stop(migration, migration.source)
        or handoff.is_switching(migration)
        or _has_left_in_image(migration)
    )
    if migration.source.number not in migration.ended or expected:
        return migration.completion
    return migration.completion or f"{migration.source} ended during the {migration.aim.value}"


def _has_left_in_image(migration: Migration) -> bool:
    """Return True if the destination is restored from an image of the frozen source."""
    return any(
        isinstance(step, Start) and step.restored and step.instance.number in migration.launched
        for step in migration.plan.steps
    )


def _resumes(state: MasterState, migration: Migration) -> bool:
    """Return True if the source must run again: its process is neither cancelled nor completed."""
    wanted = state.processes[migration.process].wanted
    return not migration.completion and wanted is DesiredState.RUN


def _was_ordered_to_stop(migration: Migration, instance: InstanceId) -> bool:
    """Return True if the plan has ordered this instance to stop."""
    return any(
        isinstance(step, Stop) and step.instance == instance for step in migration.begun_steps
    )


# --- the end ----------------------------------------------------------------------------------


def _conclude(state: MasterState, migration: Migration, now: float) -> None:
    """End a migration after its last step: stop leftover instances, record the outcome."""
    handoff.close(state, migration)
    state.end_migration(migration)
    process = state.processes[migration.process]
    moved = migration.undo is None
    process.moved_at = now
    if migration.spec is not None and not moved and migration.failure != migration.completion:
        _note_not_replaced(state, process, migration)
    standby = state.standbys.get(migration.process)
    kept = {process.owner, standby.destination.number if standby else 0}
    for instance in state.instances_of(process):
        if instance.id.number not in kept and not instance.stopping:
            if instance.state is None and instance.id.number not in migration.launched:
                state.drop_instance(instance)  # it was reserved and never started
            else:
                lifecycle.stop_instance(state, instance, now)
    for name in migration.source_host.over_since:
        migration.source_host.over_since[name] = now  # first wait for the effect of this migration
    kind, message = image_requests.ending_of(migration)
    durations = {
        name: seconds_of(result)
        for name, result in migration.results.items()
        if "seconds" in result
    }
    silent = blackout.seconds(migration)
    state.record(
        now, kind, message, process=migration.process,
        host=(migration.destination_host if moved else migration.source_host).name,
        facts={
            "from": migration.source_host.name, "to": migration.destination_host.name,
            "seconds": now - migration.started, "cause": migration.cause,
            "strategy": migration.strategy, "parts": durations,
            **({} if silent is None else {"blackout": silent}),
        },
    )  # fmt: skip
    _note_try(state, process, migration, now)
    if kind is EventKind.STAYED and process.decision and process.decision["kind"] == "migrated":
        process.decision = {**process.decision, "kind": kind}
    _settle_owner(state, process, migration, now)


def _note_try(state: MasterState, process: Process, migration: Migration, now: float) -> None:
    """Remember a failed move of a process, which the master must not repeat at once."""
    there = migration.destination_host.name
    if migration.aim is not Aim.MOVE or migration.spec is not None:
        return
    if migration.undo is None:
        process.moves.forget(there)
    elif process.wanted is DesiredState.RUN:
        why = f"its move to {there} has failed: {migration.failure}"
        process.moves.note(there, why, now, state.settings.cooldown)


def _note_not_replaced(state: MasterState, process: Process, migration: Migration) -> None:
    """Note why the new version of a process was not started in its place."""
    application = state.applications.get(process.spec.application)
    task = application.tasks.get(process.name) if application is not None else None
    if application is not None and task is not None and task.begun:
        task.fault = migration.failure
        state.save_application(application)


def _settle_owner(state: MasterState, process: Process, migration: Migration, now: float) -> None:
    owner = state.owner_of(process)
    if process.image is not None and process.owner == 0:
        image_requests.settle(state, process, migration, now)
        return
    if owner is None:
        host = migration.destination_host if migration.committed else migration.source_host
        lifecycle.conclude(state, process, _end_of_owner(process, migration), host, now)
        return
    if process.wanted is not DesiredState.RUN and not owner.stopping:
        lifecycle.stop_owner(state, process, owner, now)
    if owner.restarts_off:  # the plan was given up, or turns them on nowhere
        state.unamended.setdefault(process.name, PendingAmendment(limits=False))
    lifecycle.note_phase(state, process, owner, now)
    state.save(process)


def _end_of_owner(process: Process, migration: Migration) -> End:
    """Return the end of the owner, corrected for an order of the migration to stop."""
    end = migration.ended[process.owner]
    was_source = process.owner == migration.source.number
    if was_source and not end.completed and _was_ordered_to_stop(migration, migration.source):
        return replace(end, ordered=True)
    return end
