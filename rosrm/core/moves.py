"""Carrying out plans: one step at a time, forward, or back before the commit.

========  ==================  ==============================================================
the run   a step              what follows
========  ==================  ==============================================================
forward   is done             the next step; after the last, the move is complete
forward   fails, no commit    the undo of every step so far, newest first
forward   fails, committed    it is tried again; the process is shown as stuck until it is done
back      is done             the next undo; after the last, the source goes on
back      fails               it is tried again; the process is shown as stuck until it is done
========  ==================  ==============================================================
"""

from __future__ import annotations

from functools import singledispatch
from typing import Any, Final

from rosrm.core import events as happened
from rosrm.core import lifecycle
from rosrm.core.commands import Order
from rosrm.core.hosts import Host
from rosrm.core.migration import (
    AwaitReady,
    Commit,
    Execute,
    Move,
    Plan,
    Start,
    Step,
    Stop,
    plan_fault,
)
from rosrm.core.model import InstanceState
from rosrm.core.state import MasterState, Process, ProcessPhase, Run, Wanted
from rosrm.ports import Intent

_DONE: Final = ""
_RUNS: Final = frozenset({InstanceState.RUNNING, InstanceState.READY})


# --- begin ------------------------------------------------------------------------------------


def begin_move(
    state: MasterState, process: Process, destination: Host, cause: str, now: float
) -> str:
    """Begin to move a running process.

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
    )  # fmt: skip
    plan = _propose(state, name, move)
    if isinstance(plan, str):
        state.record(now, "plugin_failed", plan, process=process.name)
        return plan
    run = Run(
        process.name, plan, name, source.id, source.host, move.destination, destination, cause, now
    )
    state.runs[process.name] = run
    state.add_instance(move.destination, process.spec, destination, now, at_least=source.seen)
    state.set_phase(process, ProcessPhase.MIGRATING, now, f"to {destination.name}: {cause}")
    state.record(
        now, "migration_begun",
        f"{process.name} moves from {source.host.name} to {destination.name} by {name}: {cause}",
        process=process.name, host=destination.name,
        facts={
            "from": source.host.name, "to": destination.name, "strategy": name, "cause": cause,
            "steps": [_title(step) for step in plan.steps], "overlap": plan.overlap,
            "source": source.id.number, "destination": move.destination.number,
        },
    )  # fmt: skip
    _save(state, run)
    return ""


def why_immovable(state: MasterState, process: Process) -> str:
    """Why a process cannot be moved now; "" if it can."""
    strategy = process.spec.migration.strategy
    if process.name in state.runs:
        return f"{process.name} is moving already, to {state.runs[process.name].destination_host.name}"
    if process.phase is not ProcessPhase.RUNNING:
        return f"{process.name} is {process.phase.value}; only a running process can be moved"
    if strategy is None:
        return f"{process.name} has no migration strategy; give it `migration:` in its file"
    if strategy not in state.strategies:
        return (
            f"{process.name} wants the migration strategy {strategy!r}, which is not selected here; "
            f"there are {', '.join(sorted(state.strategies)) or 'none'}"
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


def order_answered(state: MasterState, event: happened.OrderAnswered, now: float) -> None:
    """A slave took an order, refused it, or did not answer in time."""
    name = state.runs_by_order.pop(event.order, None)
    run = state.runs.get(name) if name is not None else None
    if run is not None and run.order == event.order and event.code != "timeout":
        run.answer = (event.accepted, event.message or event.code)


def _advance(state: MasterState, run: Run, now: float) -> bool:
    """Look at the step in hand; True: there may be more to do at once."""
    if _source_ended_by_itself(state, run):
        _turn_back(state, run, f"{run.source} ended by itself", now)
    step = _step_in_hand(run)
    if step is None:
        _conclude(state, run, now)
        return False
    if not run.begun:
        run.begun, run.answer = True, None
        run.deadline = now + max(step.timeout, 0.0)
        _order(state, run, step, now)
    outcome = _outcome(step, state, run)
    if outcome is None and isinstance(step, Stop | Start):
        _order_again(state, run, step, now)
    if outcome is None and now >= run.deadline:
        outcome = f"{_title(step)} took longer than {step.timeout:g} s"
    if outcome is None:
        return False
    if outcome == _DONE:
        _next(state, run, step, now)
    else:
        _failed(state, run, step, outcome, now)
    return outcome == _DONE or run.undo is not None and not run.stuck


def _step_in_hand(run: Run) -> Step | None:
    steps = run.plan.steps if run.undo is None else run.undo
    return steps[run.index] if run.index < len(steps) else None


def _next(state: MasterState, run: Run, step: Step, now: float) -> None:
    state.record(
        now, "migration_step", f"{run.process}: {_title(step)} done", process=run.process,
        facts={"step": _title(step), "back": run.undo is not None},
    )  # fmt: skip
    process = state.processes[run.process]
    if isinstance(step, Commit):
        run.committed = True
        process.owner = run.destination.number
        process.migrations += 1
        process.moved_at = now
        state.save(process)
    elif isinstance(step, Start) and run.undo is not None:
        process.owner = step.instance.number
        state.save(process)
    run.index += 1
    run.begun = False
    _unstick(state, run, now)
    _save(state, run)


def _failed(state: MasterState, run: Run, step: Step, reason: str, now: float) -> None:
    state.record(
        now, "migration_step_failed", f"{run.process}: {reason}", process=run.process,
        facts={"step": _title(step), "back": run.undo is not None},
    )  # fmt: skip
    if run.undo is None and not run.committed:
        _turn_back(state, run, reason, now)
        return
    run.begun = False
    if not run.stuck:
        run.stuck = True
        way = "forward" if run.undo is None else "back"
        process = state.processes[run.process]
        state.set_phase(process, ProcessPhase.STUCK, now, f"no way {way}: {reason}; tried again")
        state.record(
            now, "migration_stuck", f"{run.process} is STUCK on its way {way}: {reason}",
            process=run.process,
        )  # fmt: skip


def _unstick(state: MasterState, run: Run, now: float) -> None:
    if run.stuck:
        run.stuck = False
        process = state.processes[run.process]
        state.set_phase(process, ProcessPhase.MIGRATING, now, f"to {run.destination_host.name}")


def _turn_back(state: MasterState, run: Run, reason: str, now: float) -> None:
    """Before the commit: undo every step so far, the one in hand included, newest first."""
    run.failure = reason
    so_far = run.plan.steps[: run.index + 1]
    run.undo = [step.undo for step in reversed(so_far) if step.undo is not None]
    run.index, run.begun = 0, False
    state.record(now, "migration_undone", f"{run.process} stays: {reason}", process=run.process)
    _save(state, run)


def _source_ended_by_itself(state: MasterState, run: Run) -> bool:
    if run.committed or run.undo is not None or run.source.number not in run.ended:
        return False
    ordered = run.plan.steps[: run.index + 1]
    return not any(isinstance(step, Stop) and step.instance == run.source for step in ordered)


# --- the end ----------------------------------------------------------------------------------


def _conclude(state: MasterState, run: Run, now: float) -> None:
    """The last step is done: the process goes its own way again."""
    del state.runs[run.process]
    state.emit(Intent("migration", run.process, None))
    process = state.processes[run.process]
    moved = run.undo is None
    process.moved_at = now
    for instance in list(state.instances_of(run.process)):
        if instance.id.number != process.owner and not instance.stopping:
            if instance.state is None:
                state.drop_instance(instance)  # it was counted, and never started
            else:
                lifecycle.stop_instance(state, instance, now)
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
        lifecycle.conclude(state, process, run.ended[process.owner], host, now)
        return
    if process.wanted is not Wanted.RUN:
        lifecycle.stop_instance(state, owner, now)
    ready = owner.state is InstanceState.READY
    state.set_phase(process, ProcessPhase.RUNNING if ready else ProcessPhase.STARTING, now)
    state.save(process)


# --- steps ------------------------------------------------------------------------------------


def _order(state: MasterState, run: Run, step: Step, now: float) -> None:
    """Ask the slave for what the step needs."""
    if isinstance(step, Commit | AwaitReady):
        return
    host = state.hosts.by_name[step.host]
    run.order, run.order_at = state.order_id(), now
    state.runs_by_order[run.order] = run.process
    if isinstance(step, Stop):
        state.emit(Order(run.order, host.host_id, "stop", step.instance))
    elif isinstance(step, Execute):
        state.emit(
            Order(
                run.order, host.host_id, "execute", executor=step.executor,
                arguments=step.arguments, timeout=step.timeout,
            )
        )  # fmt: skip
    else:
        _order_start(state, run, step, host, now)


def _order_start(state: MasterState, run: Run, step: Start, host: Host, now: float) -> None:
    spec = state.processes[run.process].spec
    if step.instance.number not in state.instances and step.instance.number not in run.ended:
        state.add_instance(step.instance, spec, host, now)
    assignment = state.assignment(step.instance, spec, step.node_name)
    state.emit(Order(run.order, host.host_id, "start", step.instance, assignment))


def _order_again(state: MasterState, run: Run, step: Stop | Start, now: float) -> None:
    """A start or stop may be given twice without harm; one may have been lost."""
    if now - run.order_at >= state.settings.order_retry:
        _order(state, run, step, now)


@singledispatch
def _outcome(step: Any, state: MasterState, run: Run) -> str | None:
    """Of the step in hand: None: not yet; "": done; else why it failed."""
    raise TypeError(step)


@_outcome.register
def _(step: Start, state: MasterState, run: Run) -> str | None:
    instance = state.instances.get(step.instance.number)
    if instance is None:
        return f"{step.instance} ended on {step.host}: {_end_of(run, step.instance.number)}"
    if run.answer is not None and not run.answer[0]:
        return f"{step.host} refused to start {step.instance}: {run.answer[1]}"
    return _DONE if instance.state in _RUNS else None


@_outcome.register
def _(step: AwaitReady, state: MasterState, run: Run) -> str | None:
    instance = state.instances.get(step.instance.number)
    if instance is None:
        return f"{step.instance} ended on {step.host}: {_end_of(run, step.instance.number)}"
    return _DONE if instance.state is InstanceState.READY else None


@_outcome.register
def _(step: Stop, state: MasterState, run: Run) -> str | None:
    return _DONE if step.instance.number not in state.instances else None


@_outcome.register
def _(step: Commit, state: MasterState, run: Run) -> str | None:
    return _DONE


@_outcome.register
def _(step: Execute, state: MasterState, run: Run) -> str | None:
    if run.answer is None:
        return None
    accepted, message = run.answer
    return _DONE if accepted else f"{step.executor} failed on {step.host}: {message}"


def _end_of(run: Run, number: int) -> str:
    status = run.ended.get(number)
    if status is None:
        return "it was never started"
    return status.message or f"exit code {status.exit_code}, signal {status.exit_signal}"


def _title(step: Step) -> str:
    """A step in a few words."""
    if isinstance(step, Commit):
        return "commit"
    if isinstance(step, Execute):
        return f"execute {step.executor} on {step.host}"
    word = {Start: "start", AwaitReady: "await ready", Stop: "stop"}[type(step)]
    return f"{word} {step.instance} on {step.host}"


