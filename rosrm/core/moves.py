"""Carrying out plans: one step at a time, forward, or back before the commit.

========  ==================  ==============================================================
the run   a step              what follows
========  ==================  ==============================================================
forward   is done             the next step; after the last, the move is complete
forward   fails, no commit    the undo of every step so far, newest first
forward   fails, committed    it is tried again; the process is shown as stuck until it is done
back      is done             the next undo; after the last, the source goes on
back      fails               it is tried again; the process is shown as stuck until it is done
any       cannot be done      it is left out: an instance that has ended never starts again
========  ==================  ==============================================================

A process that is to be cancelled turns back; one that is stuck is given up, and all its instances
are stopped. When neither source nor destination is left, the process returns to the queue.
"""

from __future__ import annotations

from dataclasses import replace

from rosrm.core import events as happened
from rosrm.core import lifecycle
from rosrm.core.hosts import Host
from rosrm.core.migration import (
    AwaitReady,
    Commit,
    Move,
    Plan,
    Start,
    Step,
    Stop,
    plan_fault,
)
from rosrm.core.model import InstanceId, InstanceState
from rosrm.core.placement import Ranking
from rosrm.core.state import MasterState, Process, ProcessPhase, Run, Wanted
from rosrm.core.steps import DONE, give_order, give_order_again, outcome_of, title
from rosrm.ports import Intent

# --- begin ------------------------------------------------------------------------------------


def begin_move(
    state: MasterState, process: Process, ranking: Ranking, destination: Host, cause: str,
    now: float,
) -> str:  # fmt: skip
    """Begin to move a running process to a host that has room for it by a ranking.

    Returns:
        "" or why it cannot be moved; then nothing has changed.
    """
    refusal = why_immovable(state, process)
    if refusal:
        return refusal
    source = state.instances[process.owner]
    name = process.spec.migration.strategy or ""
    move = Move(
        process.spec, source.id, source.host.name, state.new_instance_id(process),
        destination.name, state.new_instance_id(process), int(state.wall),
        source.node_name or process.name,
    )  # fmt: skip
    plan = _propose(state, name, move)
    if isinstance(plan, str):
        state.record(now, "plugin_failed", plan, process=process.name)
        return plan
    run = Run(
        process.name, plan, name, source.id, source.host, move.destination, destination, cause, now
    )
    state.runs[process.name] = run
    demand = ranking.demand
    state.charge_instance(
        move.destination, destination, now, demand.amounts, demand.estimated,
        ranking.need[:, destination.column],
    )  # fmt: skip
    state.set_phase(process, ProcessPhase.MIGRATING, now, f"to {destination.name}: {cause}")
    state.record(
        now, "migration_begun",
        f"{process.name} moves from {source.host.name} to {destination.name} by {name}: {cause}",
        process=process.name, host=destination.name,
        facts={
            "from": source.host.name, "to": destination.name, "strategy": name, "cause": cause,
            "steps": [title(step) for step in plan.steps], "overlap": plan.overlap,
            "source": source.id.number, "destination": move.destination.number,
        },
    )  # fmt: skip
    state.save(process)
    _save(state, run)
    return ""


def why_immovable(state: MasterState, process: Process) -> str:
    """Why a process cannot be moved now; "" if it can."""
    strategy = process.spec.migration.strategy
    if process.name in state.runs:
        return (
            f"{process.name} is moving already, to {state.runs[process.name].destination_host.name}"
        )
    if process.phase is not ProcessPhase.RUNNING:
        return f"{process.name} is {process.phase.value}; only a running process can be moved"
    if len(process.instances) > 1:
        return f"an earlier instance of {process.name} is still being stopped"
    if strategy is None:
        return f"{process.name} has no migration strategy; give it `migration:` in its file"
    if strategy not in state.strategies:
        return (
            f"{process.name} wants the migration strategy {strategy!r}, which is not selected "
            f"here; there are {', '.join(sorted(state.strategies)) or 'none'}"
        )
    return ""


def _propose(state: MasterState, name: str, move: Move) -> Plan | str:
    """The strategy's plan, or why there is none; a strategy that raises is named."""
    try:
        plan = state.strategies[name].propose(move)
        fault = plan_fault(plan, move)
    except Exception as error:  # noqa: BLE001 - a third party's code: anything may come
        return f"the migration strategy {name!r} gave no plan: {type(error).__name__}: {error}"
    return f"the migration strategy {name!r} gave an unsound plan: {fault}" if fault else plan


def _save(state: MasterState, run: Run) -> None:
    state.emit(
        Intent(
            "migration", run.process,
            {
                "strategy": run.strategy, "source": run.source.number,
                "source_host": run.source_host.name, "destination": run.destination.number,
                "destination_host": run.destination_host.name, "committed": run.committed,
                "index": run.index, "back": run.undo is not None,
            },
        )
    )  # fmt: skip


# --- go on ------------------------------------------------------------------------------------


def advance_all(state: MasterState, now: float) -> None:
    """Take every run as far as it goes now."""
    for run in list(state.runs.values()):
        while run.process in state.runs and _advance(state, run, now):
            pass


def moves_under_way(state: MasterState) -> int:
    """How many processes are moving; one that is stuck does not keep others from moving."""
    return sum(not run.stuck for run in state.runs.values())


def order_answered(state: MasterState, event: happened.OrderAnswered, now: float) -> None:
    """A slave took an order, refused it, or did not answer in time."""
    name = state.runs_by_order.pop(event.order, None)
    run = state.runs.get(name) if name is not None else None
    if run is not None and run.order == event.order and event.code != "timeout":
        run.answer = (event.accepted, event.message or event.code)


def _advance(state: MasterState, run: Run, now: float) -> bool:
    """Look at the step in hand; True: there may be more to do at once."""
    if run.undo is None and not run.committed:
        reason = _why_turn_back(state, run)
        if reason:
            _turn_back(state, run, reason, now)
    step = _step_in_hand(run)
    if step is None or (run.stuck and state.processes[run.process].wanted is Wanted.CANCEL):
        _conclude(state, run, now)
        return False
    if isinstance(step, Start) and run.undo is not None and not _goes_on(state, run):
        _go_on(state, run, now)
        return True
    if not run.begun:
        if now < run.retry_at:
            return False
        run.begun, run.answer = True, None
        run.deadline = now + max(step.timeout, 0.0)
        give_order(state, run, step, now)
    outcome = outcome_of(step, state, run)
    if outcome is None and isinstance(step, (Stop, Start)):
        give_order_again(state, run, step, now)
    if outcome is None and now >= run.deadline:
        outcome = f"{title(step)} took longer than {step.timeout:g} s"
    if outcome is None:
        return False
    if outcome == DONE:
        _next(state, run, step, now)
    else:
        _failed(state, run, step, outcome, now)
    return run.begun or not run.stuck


def _step_in_hand(run: Run) -> Step | None:
    steps = run.plan.steps if run.undo is None else run.undo
    return steps[run.index] if run.index < len(steps) else None


def _next(state: MasterState, run: Run, step: Step, now: float) -> None:
    state.record(
        now, "migration_step", f"{run.process}: {title(step)} done", process=run.process,
        facts={"step": title(step), "back": run.undo is not None},
    )  # fmt: skip
    process = state.processes[run.process]
    if isinstance(step, Commit):
        run.committed = True
        process.owner = run.destination.number
        process.migrations += 1
        process.moved_at = now
        if process.wanted is Wanted.REQUEUE:
            process.wanted = Wanted.RUN  # that was meant for the host which it has left
        state.save(process)
    elif isinstance(step, Start) and run.undo is not None:
        process.owner = step.instance.number
        state.save(process)
    _go_on(state, run, now)


def _cannot_be_done(state: MasterState, run: Run, step: Step, now: float) -> bool:
    """Trying again would never help: the instance has ended, or its slot was given away."""
    if not isinstance(step, (Start, AwaitReady)):
        return False
    instance = state.instances.get(step.instance.number)
    if instance is not None and instance.state is InstanceState.HELD:
        lifecycle.stop_instance(state, instance, now)
        return True
    return step.instance.number in run.ended


def _go_on(state: MasterState, run: Run, now: float) -> None:
    """To the next step, or the next undo."""
    run.index += 1
    run.begun = False
    run.retry_at = now
    if run.stuck:
        run.stuck = False
        process = state.processes[run.process]
        state.set_phase(process, ProcessPhase.MIGRATING, now, f"to {run.destination_host.name}")
    _save(state, run)


def _failed(state: MasterState, run: Run, step: Step, reason: str, now: float) -> None:
    if not run.stuck:
        state.record(
            now, "migration_step_failed", f"{run.process}: {reason}", process=run.process,
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
        way = "forward" if run.undo is None else "back"
        process = state.processes[run.process]
        state.set_phase(process, ProcessPhase.STUCK, now, f"no way {way}: {reason}; tried again")
        state.record(
            now, "migration_stuck", f"{run.process} is STUCK on its way {way}: {reason}",
            process=run.process,
        )  # fmt: skip


def _turn_back(state: MasterState, run: Run, reason: str, now: float) -> None:
    """Before the commit: undo every step so far, the one in hand included, newest first."""
    run.failure = reason
    so_far = run.plan.steps[: run.index + 1]
    run.undo = [step.undo for step in reversed(so_far) if step.undo is not None]
    run.index, run.begun = 0, False
    state.record(now, "migration_undone", f"{run.process} stays: {reason}", process=run.process)
    _save(state, run)


def _why_turn_back(state: MasterState, run: Run) -> str:
    """Why the steps before the commit are not worth going on with; "" if they are."""
    if state.processes[run.process].wanted is Wanted.CANCEL:
        return f"{run.process} is to be cancelled"
    end = run.ended.get(run.source.number)
    if end is not None and (end.completed or not _told_to_stop(run, run.source)):
        return f"{run.source} ended by itself"
    return ""


def _goes_on(state: MasterState, run: Run) -> bool:
    """The process is to go on where it was: nobody cancelled it, and it has not completed."""
    end = run.ended.get(run.source.number)
    completed = end is not None and end.completed
    return not completed and state.processes[run.process].wanted is Wanted.RUN


def _told_to_stop(run: Run, instance: InstanceId) -> bool:
    """The plan has ordered this instance to stop."""
    so_far = run.plan.steps if run.undo is not None else run.plan.steps[: run.index + 1]
    return any(isinstance(step, Stop) and step.instance == instance for step in so_far)


# --- the end ----------------------------------------------------------------------------------


def _conclude(state: MasterState, run: Run, now: float) -> None:
    """The last step is done: the process goes its own way again."""
    del state.runs[run.process]
    state.emit(Intent("migration", run.process, None))
    process = state.processes[run.process]
    moved = run.undo is None
    process.moved_at = now
    for instance in state.instances_of(process):
        if instance.id.number != process.owner and not instance.stopping:
            if instance.state is None and instance.id.number not in run.launched:
                state.drop_instance(instance)  # it was counted, and never started
            else:
                lifecycle.stop_instance(state, instance, now)
    for name in run.source_host.over_since:
        run.source_host.over_since[name] = now  # see first what this move brings
    state.record(
        now, "migrated" if moved else "stayed",
        f"{run.process} moved from {run.source_host.name} to {run.destination_host.name}"
        if moved else f"{run.process} stayed on {run.source_host.name}: {run.failure}",
        process=run.process, host=(run.destination_host if moved else run.source_host).name,
        facts={
            "from": run.source_host.name, "to": run.destination_host.name,
            "seconds": now - run.started, "cause": run.cause, "strategy": run.strategy,
        },
    )  # fmt: skip
    _settle_owner(state, process, run, now)


def _settle_owner(state: MasterState, process: Process, run: Run, now: float) -> None:
    owner = state.instances.get(process.owner)
    if owner is None:
        host = run.destination_host if run.committed else run.source_host
        end = run.ended[process.owner]
        told = process.owner == run.source.number and _told_to_stop(run, run.source)
        if told and not end.completed:
            end = replace(end, ordered=True)
        lifecycle.conclude(state, process, end, host, now)
        return
    if process.wanted is not Wanted.RUN and not owner.stopping:
        lifecycle.stop_instance(state, owner, now)
    state.set_phase(process, lifecycle.phase_in_sight(state, process, owner), now)
    state.save(process)
