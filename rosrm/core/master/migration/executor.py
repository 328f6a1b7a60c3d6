"""Execution of migration plans: one step at a time, forward, or back before the commit.

========  ==================  ==============================================================
the plan  a step              consequence
========  ==================  ==============================================================
forward   is done             the next step; after the last, the migration is complete
forward   fails, no commit    the undo of every step so far, newest first
forward   fails, committed    it is retried; the process is shown as stuck until it is done
back      is done             the next undo; after the last, the source resumes
back      fails               it is retried; the process is shown as stuck until it is done
any       cannot be done      it is left out: an instance that has ended never starts again, and
                              an executor step for an instance whose host is lost has no use.
                              An executor that ran and returned no object counts as done
back      destination active  forward to the commit: in a handoff the destination itself decides;
                              in a restore an executor has found that the process runs
standby   comes to SWITCH     it is paused, and goes forward once the source has ended
========  ==================  ==============================================================

Cancelling a process turns its migration back; a stuck one is given up, and all its instances are
stopped. When neither source nor destination is left, the process returns to the queue.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import Any, Final

from rosrm.core.master import lifecycle
from rosrm.core.master.checkpoint import image_requests, images
from rosrm.core.master.master_state import MasterState, Process, ProcessPhase, Run, Wanted
from rosrm.core.master.migration import failover, handoff
from rosrm.core.master.migration.steps import (
    begin,
    outcome_of,
    title,
)
from rosrm.core.master.outcomes import StepFailed, StepOutcome, StepProgress
from rosrm.core.master.state.migration import End
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
    Aim.MOVE: "the process is now the one at the destination: the move cannot be undone any more",
    Aim.CHECKPOINT: "the process is now in its image: the checkpoint cannot be undone any more",
    Aim.RESTORE: "the process is now the restored one: the restore cannot be undone any more",
}

# --- steps ------------------------------------------------------------------------------------


def advance_all(state: MasterState, now: float) -> None:
    """Advance every migration as far as possible now."""
    for run in list(state.runs.values()):
        while run.process in state.runs and _advance(state, run, now):
            pass


def advance_standby(state: MasterState, run: Run, now: float) -> StepOutcome:
    """Advance the migration of a standby up to its SWITCH step, where it is paused.

    Only the standby is started and configured: the primary keeps running as before, with its
    restarts. So the other steps before SWITCH are left out.

    Returns:
        The outcome of the current step; DONE: the migration is paused.
    """
    pause = failover.index_of(HandoffPhase.SWITCH, run.plan.steps)
    while run.index < pause:
        step = run.plan.steps[run.index]
        if isinstance(step, Start) or (isinstance(step, Configure) and step.awaited):
            if not begin(state, run, step, now):
                return StepProgress.PENDING
            if isinstance(step, Configure):
                run.deadline = inf  # a primary that is silent for long is no fault of its standby
            outcome = outcome_of(state, run, step, now)
            if outcome is not StepProgress.DONE:
                return outcome
        _go_on(state, run, now)
    return StepProgress.DONE


def _advance(state: MasterState, run: Run, now: float) -> bool:
    """Handle the current step; return True if more may be done at once."""
    _choose_way(state, run, now)
    step = run.step_in_hand
    if step is None or (run.stuck and state.processes[run.process].wanted is Wanted.CANCEL):
        _conclude(state, run, now)
        return False
    if isinstance(step, Start) and run.undo is not None and not _goes_on(state, run):
        _go_on(state, run, now)
        return True
    if not begin(state, run, step, now):
        return False
    outcome = outcome_of(state, run, step, now)
    if outcome is StepProgress.PENDING:
        return False
    if isinstance(outcome, StepFailed):
        _failed(state, run, step, outcome.reason, now)
    else:
        _next(state, run, step, now)
    return run.begun or not run.stuck


def _choose_way(state: MasterState, run: Run, now: float) -> None:
    """Choose the direction before the commit.

    A destination that is active decides; otherwise the fate of the source does.
    """
    if run.committed:
        return
    if handoff.is_active(state, run) or run.went_on:
        if run.undo is not None:
            _go_forward(state, run, now)
    elif run.undo is None:
        reason = _why_turn_back(state, run)
        if reason:
            _turn_back(state, run, reason, now)


def _next(state: MasterState, run: Run, step: Step, now: float) -> None:
    what = _COMMITTED[run.aim] if isinstance(step, Commit) else f"{title(step)}: done"
    state.record(
        now, EventKind.MIGRATION_STEP, f"{run.process}: {what}", process=run.process,
        facts={"step": title(step), "back": run.undo is not None},
    )  # fmt: skip
    process = state.processes[run.process]
    if isinstance(step, Commit):
        _commit(state, run, step, now)
    elif isinstance(step, Start) and run.undo is not None:
        process.owner = step.instance.number
        state.save(process)
    _go_on(state, run, now)


def _commit(state: MasterState, run: Run, step: Commit, now: float) -> None:
    process = state.processes[run.process]
    run.committed = True
    if run.aim is Aim.CHECKPOINT:
        image_requests.commit_to_image(state, process, run, step)
    else:
        process.owner = run.destination.number
        images.set_image(state, process, None)
    process.left_behind = None  # a source on a lost host has a successor now
    process.migrations += run.aim is Aim.MOVE
    process.moved_at = now
    if process.wanted is Wanted.REQUEUE:
        process.wanted = Wanted.RUN  # the requeue was meant for the source host
    state.save(process)


def _cannot_be_done(state: MasterState, run: Run, step: Step, now: float) -> bool:
    """Return True if a retry cannot help: the instance has ended, or its slot was given away."""
    if isinstance(step, Execute):
        # A retry would give the same bad result. In a restore, the result may say that the
        # destination is active, so that plan waits until the plugin is corrected.
        done = run.bad_result and run.aim is not Aim.RESTORE
        return done or image_requests.leave_behind(state, run, step)
    if not isinstance(step, (Start, AwaitReady)):
        return False
    instance = state.instances.get(step.instance.number)
    if instance is not None and instance.state is InstanceState.HELD:
        lifecycle.stop_instance(state, instance, now)
        return True
    return step.instance.number in run.ended


def _go_on(state: MasterState, run: Run, now: float) -> None:
    """Go to the next step, or the next undo."""
    run.index += 1
    run.begun = False
    run.retry_at = now
    if run.stuck:
        _not_stuck(state, run, now)
    state.save_run(run)


def _not_stuck(state: MasterState, run: Run, now: float) -> None:
    run.stuck = False
    process = state.processes[run.process]
    state.set_phase(process, ProcessPhase.MIGRATING, now, run.course)


def _failed(state: MasterState, run: Run, step: Step, reason: str, now: float) -> None:
    if not run.stuck:
        state.record(
            now, EventKind.MIGRATION_STEP_FAILED, f"{run.process}: {reason}", process=run.process,
            facts={"step": title(step), "back": run.undo is not None},
        )  # fmt: skip
    if run.undo is None and not run.committed:
        _turn_back(state, run, reason, now)
        return
    if _cannot_be_done(state, run, step, now):
        _go_on(state, run, now)
        return
    run.begun = False
    run.retry_at = now + state.settings.order_retry
    if not run.stuck:
        run.stuck = True
        end = "finished" if run.undo is None else "undone"
        process = state.processes[run.process]
        why = f"its {run.aim.value} cannot be {end} yet: {reason}; the master tries again"
        state.set_phase(process, ProcessPhase.STUCK, now, why)
        state.record(
            now, EventKind.MIGRATION_STUCK, f"{run.process} is stuck: {why}", process=run.process
        )


def _turn_back(state: MasterState, run: Run, reason: str, now: float) -> None:
    """Undo every step so far before the commit, the current one included, newest first."""
    run.failure = reason
    run.turn_back()
    state.record(
        now,
        EventKind.MIGRATION_UNDONE,
        f"the {run.aim.value} of {run.process} is undone: {reason}",
        process=run.process,
    )
    state.save_run(run)


def _go_forward(state: MasterState, run: Run, now: float) -> None:
    """Turn forward again, because the destination is active and owns the name."""
    run.undo, run.index, run.begun = None, run.commit_index, False
    run.retry_at = now
    if run.stuck:
        _not_stuck(state, run, now)
    state.record(
        now, EventKind.MIGRATION_REDONE,
        f"the {run.aim.value} of {run.process} is finished after all: {run.destination} is active",
        process=run.process,
    )  # fmt: skip
    state.save_run(run)


def _why_turn_back(state: MasterState, run: Run) -> str:
    """Return why a plan must turn back before its commit; "" if it need not."""
    if state.processes[run.process].wanted is Wanted.CANCEL:
        return f"{run.process} is to be cancelled"
    end = run.ended.get(run.source.number)
    if end is None:
        return ""
    excused = _told_to_stop(run, run.source) or handoff.is_switching(run) or _has_left_in_image(run)
    return f"{run.source} ended during the {run.aim.value}" if end.completed or not excused else ""


def _has_left_in_image(run: Run) -> bool:
    """Return True if the destination is restored from an image of the frozen source."""
    return any(
        isinstance(step, Start) and step.restored and step.instance.number in run.launched
        for step in run.plan.steps
    )


def _goes_on(state: MasterState, run: Run) -> bool:
    """Return True if the source shall run on: the process is neither cancelled nor completed."""
    end = run.ended.get(run.source.number)
    completed = end is not None and end.completed
    return not completed and state.processes[run.process].wanted is Wanted.RUN


def _told_to_stop(run: Run, instance: InstanceId) -> bool:
    """Return True if the plan has ordered this instance to stop."""
    return any(isinstance(step, Stop) and step.instance == instance for step in run.so_far)


# --- the end ----------------------------------------------------------------------------------


def _conclude(state: MasterState, run: Run, now: float) -> None:
    """End a migration after its last step: stop leftover instances, record the outcome."""
    handoff.close(state, run)
    state.end_run(run)
    process = state.processes[run.process]
    moved = run.undo is None
    process.moved_at = now
    standby = state.standbys.get(run.process)
    kept = {process.owner, standby.destination.number if standby else 0}
    for instance in state.instances_of(process):
        if instance.id.number not in kept and not instance.stopping:
            if instance.state is None and instance.id.number not in run.launched:
                state.drop_instance(instance)  # it had a reservation, and never started
            else:
                lifecycle.stop_instance(state, instance, now)
    for name in run.source_host.over_since:
        run.source_host.over_since[name] = now  # first await the effect of this migration
    kind, message = image_requests.ending_of(run)
    state.record(
        now, kind, message,
        process=run.process, host=(run.destination_host if moved else run.source_host).name,
        facts={
            "from": run.source_host.name, "to": run.destination_host.name,
            "seconds": now - run.started, "cause": run.cause, "strategy": run.strategy,
            "parts": _parts(run),
        },
    )  # fmt: skip
    if kind == "stayed" and process.decision and process.decision["kind"] == "migrated":
        process.decision = {**process.decision, "kind": kind}
    _settle_owner(state, process, run, now)


def _parts(run: Run) -> dict[str, Any]:
    """Return the durations that executors report, by their names."""
    return {name: result["seconds"] for name, result in run.results.items() if "seconds" in result}


def _settle_owner(state: MasterState, process: Process, run: Run, now: float) -> None:
    owner = state.instances.get(process.owner)
    if process.image is not None and process.owner == 0:
        image_requests.settle(state, process, run, now)
        return
    if owner is None:
        host = run.destination_host if run.committed else run.source_host
        lifecycle.conclude(state, process, _end_of_owner(process, run), host, now)
        return
    if process.wanted is not Wanted.RUN and not owner.stopping:
        lifecycle.stop_instance(state, owner, now)
    lifecycle.note_phase(state, process, owner, now)
    state.save(process)


def _end_of_owner(process: Process, run: Run) -> End:
    """Return the end of the owner as it would be without the migration."""
    end = run.ended[process.owner]
    policy = process.spec.restart
    if process.owner == run.source.number and _told_to_stop(run, run.source) and not end.completed:
        return replace(end, ordered=True)
    if process.owner in run.suspended and lifecycle.restarts_after(policy, end.status):
        how = run.how_ended(InstanceId(process.name, process.owner))
        why = f"restart by policy {policy.when!r}: {how}"
        return replace(end, gone=True, status=replace(end.status, message=why))
    return end
