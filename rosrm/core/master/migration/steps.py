"""Steps of a migration plan: their orders and their outcomes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from rosrm.core.master import lifecycle
from rosrm.core.master.events import OrderAnswered, OrderOutcome
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import handoff
from rosrm.core.master.outcomes import (
    StepFailed,
    StepOutcome,
    StepProgress,
    done_if,
)
from rosrm.core.master.state.hosts import HostCondition
from rosrm.core.master.state.migration import Migration
from rosrm.core.master.state.pending_orders import MigrationStep
from rosrm.core.master.state.process import Instance
from rosrm.model.lifecycle_rules import own_services
from rosrm.model.orders import (
    ENDED,
    STALE,
    UNKNOWN,
    AmendInstance,
    Order,
    RunExecutor,
    SetLifecycleState,
    StartInstance,
    StopInstance,
)
from rosrm.model.plan import (
    Aim,
    AwaitReady,
    AwaitReleased,
    Commit,
    Configure,
    Execute,
    SetLifecycle,
    SetRestart,
    Start,
    Step,
    Stop,
)
from rosrm.model.values import Amendment, InstanceState

_TITLES: Final[Mapping[type[Step], str]] = {
    Commit: "the commit",
    Start: "starting {0.instance} on {0.host}",
    AwaitReady: "waiting until {0.instance} is ready on {0.host}",
    AwaitReleased: "waiting until {0.instance} on {0.host} has delivered its last messages",
    Stop: "stopping {0.instance} on {0.host}",
    SetLifecycle: "bringing {0.instance} on {0.host} to the lifecycle state {0.state}",
    Execute: "the step {0.executor!r} of the migration strategy on {0.host}",
}
#: Conditions of a host that does not answer, and may never answer again.
_AWAY: Final = (HostCondition.LOST, HostCondition.LEFT, HostCondition.DETACHED)


# --- execution --------------------------------------------------------------------------------


def begin(state: MasterState, migration: Migration, step: Step, now: float) -> bool:
    """Begin the current step, unless it has begun; return False if it must wait."""
    if migration.begun:
        return True
    if now < migration.retry.until or _is_expected(state, migration, step):
        return False
    migration.begun, migration.answer = True, None
    migration.orders.clear()
    migration.deadline = now + _time_limit(state, migration, step)
    _give_order(state, migration, step, now)
    return True


def _time_limit(state: MasterState, migration: Migration, step: Step) -> float:
    """Return the seconds that a step may take.

    A start may fetch the artifacts of its process first. The start of a restored instance may not,
    because its source is frozen.
    """
    limit = max(step.timeout, 0.0)
    if isinstance(step, Start) and not step.restored:
        spec = state.processes[migration.process].spec
        limit += migration.spec_of(step.instance, spec).fetch_time
    return limit


def _is_expected(state: MasterState, migration: Migration, step: Step) -> bool:
    """Return True if a host that the step needs has not rejoined since the master started.

    The step waits until the host rejoins or its lease ends. Then the time-out of the step counts.
    """
    if isinstance(step, Commit):
        return False
    if not isinstance(step, Configure):
        concerned = [state.hosts.by_name[step.host]]
    else:
        both = (migration.source.number, migration.destination.number) if step.awaited else ()
        concerned = [state.instances[one].host for one in both if one in state.instances]
    return any(state.hosts.condition_of(host) is HostCondition.EXPECTED for host in concerned)


def outcome_of(state: MasterState, migration: Migration, step: Step, now: float) -> StepOutcome:
    """Return the outcome of the current step; repeat its order or end it at its time-out."""
    outcome = _outcome(state, migration, step, now)
    if outcome is StepProgress.PENDING:
        _give_order_again(state, migration, step, now)
        if now >= migration.deadline:
            outcome = _timed_out(state, migration, step, now)
    return outcome


def note_answer(state: MasterState, process: str, event: OrderAnswered, now: float) -> None:
    """Note the answer to an order of the current step of a migration.

    An answer counts even if the order was repeated since. Otherwise no step would complete on a
    link whose answers take longer than `order_retry`.

    The results of executors are arguments of later ones. The answer to the start of a standby is
    ignored, because that order is repeated anyway. An instance that has ended ends a setting by its
    report, which may be lost.
    """
    migration = state.migrations.get(process)
    if migration is None or event.order not in migration.orders:
        return
    step = migration.current_step
    is_given_again = event.code == STALE and not isinstance(step, Execute)
    if event.outcome is OrderOutcome.TIMEOUT or is_given_again:
        return
    if isinstance(step, SetRestart | SetLifecycle) and event.code in (ENDED, UNKNOWN):
        state.ask_for_report(state.hosts.by_name[step.host], now)
        return
    migration.answer = event
    instance = state.instances.get(step.instance.number) if isinstance(step, SetRestart) else None
    if event.accepted and isinstance(step, SetRestart) and instance is not None:
        _set_restarts_off(state, migration, step, instance)
    if event.accepted and event.result and isinstance(step, Execute):
        migration.results[step.executor] = event.result


# --- orders -----------------------------------------------------------------------------------


def _give_order(state: MasterState, migration: Migration, step: Step, now: float) -> None:
    """Send the order of a step to its slave, or publish the phase of a handoff to its nodes."""
    if isinstance(step, Commit | AwaitReady | AwaitReleased):
        return
    if isinstance(step, Configure):
        migration.order_at = now
        handoff.publish(state, migration, step.phase)
        return
    if isinstance(step, Start) and _in_the_way(state, migration, step, now):
        return
    host = state.hosts.by_name[step.host]
    order, purpose = _order_of(state, migration, step, now), MigrationStep(migration.process)
    migration.orders.add(state.send(host, order, purpose))
    migration.order_at = now


def _order_of(
    state: MasterState, migration: Migration,
    step: Start | Stop | Execute | SetRestart | SetLifecycle, now: float,
) -> Order:  # fmt: skip
    """Return the order of a step, and note its effects in the migration."""
    if isinstance(step, Stop):
        return StopInstance(step.instance)
    if isinstance(step, SetLifecycle):
        return SetLifecycleState(step.instance, step.state)
    if isinstance(step, Execute):
        return RunExecutor(step.executor, _arguments(migration, step), step.timeout)
    if isinstance(step, SetRestart):
        instance = state.instances.get(step.instance.number)
        if instance is not None and not instance.restarts_off:
            _set_restarts_off(state, migration, step, instance)
        return AmendInstance(step.instance, Amendment(step.restart))
    return _start(state, migration, step, now)


def _set_restarts_off(
    state: MasterState, migration: Migration, step: SetRestart, instance: Instance
) -> None:
    """Note which restart policy an instance may have from now on."""
    process = state.processes[migration.process]
    instance.restarts_off = step.restart != migration.spec_of(step.instance, process.spec).restart
    state.save(process)


def _arguments(migration: Migration, step: Execute) -> Mapping[str, Any]:
    return {**step.arguments, "results": migration.results} if migration.results else step.arguments


def _start(state: MasterState, migration: Migration, step: Start, now: float) -> StartInstance:
    process = state.processes[migration.process]
    spec, number = migration.spec_of(step.instance, process.spec), step.instance.number
    migration.launched.add(number)
    state.save_migration(migration)
    if number not in state.instances and number not in migration.ended:
        host, needs = state.hosts.by_name[step.host], state.estimate(spec)
        state.release_ended(process.name, host)
        devices = migration.source_devices if host is migration.source_host else ()
        state.add_instance(step.instance, spec, host, now, needs, devices=devices)
        state.save(process)
    instance, facts = state.instances.get(number), (step.node_name, step.shadow or step.restored)
    if instance is not None and (instance.node_name, instance.restarts_off) != facts:
        instance.node_name, instance.restarts_off = facts
        state.save(process)
    remappings = {**spec.remappings, **step.remappings}
    if step.instance == migration.destination:
        remappings |= own_services(spec, step.instance)
    remapped = replace(spec, remappings=remappings)
    assignment = state.assignment(
        step.instance, remapped, step.node_name, shadow=step.shadow, restored=step.restored,
        inactive=step.inactive,
    )  # fmt: skip
    return StartInstance(assignment)


def _in_the_way(state: MasterState, migration: Migration, step: Start, now: float) -> bool:
    """Return True if another instance of the process may run and must end before a start.

    Ignore a source with an image, because it is frozen. On the way back, stop every other instance,
    even if the plan allows two: the step that should have stopped it has failed.
    """
    process = state.processes[migration.process]
    back = migration.undo is not None
    beside = migration.plan.overlap > 0.0 or step.may_run_beside(process.spec.node)
    if not back and beside:
        return False
    others = [one for one in state.instances_of(process) if one.id != step.instance]
    for other in others:
        if back and not other.stopping:
            lifecycle.stop_instance(state, other, now)
    return bool(others)


def _give_order_again(state: MasterState, migration: Migration, step: Step, now: float) -> None:
    """Repeat the order for a start, a stop or a restart policy, because orders may be lost.

    These orders, and the phases of a handoff, are idempotent. A start that another instance delays
    is ordered as soon as the other instance has ended.
    """
    if isinstance(step, Configure):
        handoff.republish(state, migration, step, now)
    elif isinstance(step, Execute | AwaitReady | AwaitReleased | Commit):
        handoff.republish_unawaited(state, migration, now)
    elif _has_waited(migration, step) or now - migration.order_at >= state.settings.order_retry:
        _give_order(state, migration, step, now)


def _has_waited(migration: Migration, step: Step) -> bool:
    """Return True for a start that was not ordered yet, because another instance delayed it."""
    return isinstance(step, Start) and step.instance.number not in migration.launched


# --- outcomes ---------------------------------------------------------------------------------


def _timed_out(state: MasterState, migration: Migration, step: Step, now: float) -> StepOutcome:
    """Return the outcome of a step after its time-out."""
    if isinstance(step, Configure):
        return handoff.timed_out(state, migration, step, now)
    if isinstance(step, AwaitReleased):
        return StepProgress.DONE
    limit = _time_limit(state, migration, step)
    return StepFailed(f"{title(step)} took longer than {limit:g} s", timed_out=True)


def _outcome(state: MasterState, migration: Migration, step: Step, now: float) -> StepOutcome:
    """Return the outcome of the current step before its time-out."""
    match step:
        case Start():
            return _of_start(state, migration, step)
        case AwaitReady():
            return _of_wait(state, migration, step, now)
        case AwaitReleased():
            return done_if(handoff.is_released(state, migration, step.instance))
        case Stop():
            return done_if(step.instance.number not in state.instances)
        case Configure():
            return handoff.outcome(state, migration, step)
        case SetRestart() | SetLifecycle():
            return _of_setting(state, migration, step)
        case Commit():
            return StepProgress.DONE
        case Execute():
            return _of_executor(state, migration, step)


def _of_start(state: MasterState, migration: Migration, step: Start) -> StepOutcome:
    if step.instance.number in migration.ended:
        return _ended(migration, step)
    instance, answer = state.instances.get(step.instance.number), migration.answer
    if instance is None:
        return StepProgress.PENDING  # another instance must end first
    if answer is not None and not answer.accepted:
        return StepFailed(f"{step.host} refused to start {step.instance}: {answer.reason}")
    failed = _ended_before_commit(migration, instance)
    return failed or done_if(instance.is_running)


def _of_wait(state: MasterState, migration: Migration, step: AwaitReady, now: float) -> StepOutcome:
    instance = state.instances.get(step.instance.number)
    if instance is None:
        return _ended(migration, step)
    failed = _ended_before_commit(migration, instance)
    is_ready = instance.state is InstanceState.READY and now >= instance.ready_at + step.settle
    # Its program may have ended since the last report, and the next step may end its source.
    return failed or done_if(is_ready and state.knows_statuses(instance.host))


def _ended(migration: Migration, step: Start | AwaitReady | SetLifecycle) -> StepFailed:
    how = migration.how_ended(step.instance)
    return StepFailed(f"{step.instance} ended on {step.host}: {how}")


def _ended_before_commit(migration: Migration, instance: Instance) -> StepFailed | None:
    """Return the failure of a destination whose program has ended, although its slave restarts it.

    The source still runs or can start again, so a program that ends at its start is not repeated
    until the time-out.
    """
    is_repeated = instance.state is InstanceState.BACKOFF or instance.restarts
    if not is_repeated or instance.id != migration.destination:
        return None
    if migration.committed or migration.undo is not None:
        return None
    why = instance.message.partition("; restart ")[0] or "it was restarted"
    return StepFailed(f"{instance.id} ended on {instance.host.name}: {why}")


def _of_setting(
    state: MasterState, migration: Migration, step: SetRestart | SetLifecycle
) -> StepOutcome:
    instance = state.instances.get(step.instance.number)
    if instance is None:
        may_stop = migration.undo is None and not migration.committed
        if isinstance(step, SetLifecycle) and may_stop:
            return _ended(migration, step)
        return StepProgress.DONE  # an ended instance has no restarts and no state
    failed = _ended_before_commit(migration, instance)
    if isinstance(step, SetLifecycle) and failed is not None:
        return failed
    answer = migration.answer
    if answer is None or answer.accepted:
        return done_if(answer is not None)
    what = "restart policy" if isinstance(step, SetRestart) else "lifecycle state"
    return StepFailed(f"{step.host} did not change the {what} of {step.instance}: {answer.reason}")


def _of_executor(state: MasterState, migration: Migration, step: Execute) -> StepOutcome:
    answer = migration.answer
    if answer is not None and answer.accepted:
        return StepProgress.DONE
    if answer is not None:
        return StepFailed(f"{step.executor} failed on {step.host}: {answer.reason}")
    away = state.hosts.condition_of(state.hosts.by_name[step.host]).words(*_AWAY)
    # If the plan can still be undone, do not wait for the time-out, which would keep an instance
    # frozen. Otherwise wait for the host as long as an instance of the plan may be there.
    may_stop = migration.undo is None and not migration.committed
    if away and (may_stop or instances_are_gone(state, migration, step)):
        return StepFailed(f"{step.host} {away}")
    return StepProgress.PENDING


def instances_are_gone(state: MasterState, migration: Migration, step: Execute) -> bool:
    """Return True if a host is away, and its instances of a migration have ended or count as lost.

    An executor there has no effect any more, and the host may never return. A destination that was
    never ordered to start does not count.
    """
    host = state.hosts.by_name[step.host]
    if migration.aim is not Aim.MOVE or state.hosts.condition_of(host) not in _AWAY:
        return False
    destination = migration.destination
    unused = None if destination.number in migration.launched else destination
    instances = state.instances_of(state.processes[migration.process])
    return all(one.host is not host or one.id == unused for one in instances)


def title(step: Step) -> str:
    """Return a step as the subject of a sentence."""
    if isinstance(step, Configure):
        return handoff.TITLES[step.phase]
    if isinstance(step, SetRestart):
        what = "turning off the restarts" if step.restart.when == "never" else "allowing restarts"
        return f"{what} of {step.instance} on {step.host}"
    return _TITLES[type(step)].format(step)
