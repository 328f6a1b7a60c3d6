"""Lifecycle of instances, and its effect on their processes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Final

from rosrm.core.master import adoption, dependants, restarts
from rosrm.core.master import events as happened
from rosrm.core.master.assignment.prefetch import learn_run_time, review_slots
from rosrm.core.master.assignment.reservations import learn_from, settle_reservation
from rosrm.core.master.hosts import readoption
from rosrm.core.master.hosts.devices import note_devices
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration import failover
from rosrm.core.master.plugin_failures import note_on_host
from rosrm.core.master.rescheduling import next_attempt, note_run
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.hosts import Host, HostCondition
from rosrm.core.master.state.learned_needs import NO_NEEDS
from rosrm.core.master.state.migration import End, Migration
from rosrm.core.master.state.process import DesiredState, Instance, Process, ProcessPhase
from rosrm.model.event_kinds import EventKind
from rosrm.model.orders import FenceInstance, Order, StopInstance
from rosrm.model.plan import Start
from rosrm.model.sizes import size_of
from rosrm.model.values import (
    LARGEST_NUMBER,
    InstanceId,
    InstanceState,
    InstanceStatus,
    Kind,
    ProcessSpec,
    RestartPolicy,
)
from rosrm.wording import ending_of, first_line, standing

#: Phase of a process by the state of its owning instance.
_PHASE: Final = {
    None: ProcessPhase.ASSIGNED,
    InstanceState.HELD: ProcessPhase.ASSIGNED,
    InstanceState.STARTING: ProcessPhase.STARTING,
    InstanceState.RUNNING: ProcessPhase.STARTING,
    InstanceState.READY: ProcessPhase.RUNNING,
    InstanceState.BACKOFF: ProcessPhase.BACKOFF,
    InstanceState.STOPPING: ProcessPhase.STOPPING,
}
#: Kind of the record when a process enters a phase.
_EVENT: Final = {
    ProcessPhase.ASSIGNED: EventKind.ASSIGNED,
    ProcessPhase.STARTING: EventKind.STARTING,
    ProcessPhase.RUNNING: EventKind.RUNNING,
    ProcessPhase.BACKOFF: EventKind.BACKOFF,
    ProcessPhase.STOPPING: EventKind.STOPPING,
    ProcessPhase.FINISHED: EventKind.FINISHED,
    ProcessPhase.FAILED: EventKind.FAILED,
    ProcessPhase.CANCELLED: EventKind.CANCELLED,
}
#: Maximum number of strays of one host that the master tracks until they end.
_MOST_STRAYS: Final = 256
#: Maximum number of characters and entries of the status of an instance.
_LARGEST_STATUS: Final = 10_000
#: Reported states in which nothing of the instance runs, and so the readings do not show it.
_DOWN: Final = frozenset({InstanceState.STARTING, InstanceState.BACKOFF})
#: Seconds after the first refusal of a process by a host, after which the host is asked again.
FIRST_EXCLUSION: Final = 60.0
#: Ends that no restart policy follows.
_NO_RESTART: Final = frozenset({InstanceState.REFUSED, InstanceState.FENCED})
_ALIVE: Final = frozenset({InstanceState.STARTING, InstanceState.RUNNING, InstanceState.READY})


def statuses_received(state: MasterState, event: happened.StatusesReceived, now: float) -> None:
    """Apply the status reports of a slave in order; drop late ones, which are known already."""
    host = state.hosts.find(event.host_id, event.incarnation)
    if host is None or state.hosts.condition_of(host) is HostCondition.DETACHED:
        return  # the slave's last message had all instances that it left running
    place = state.hosts.note_statuses(host, event.sequence, now)
    if place == "far ahead":
        fault = f"a status batch of {host.name} was refused: sequence {event.sequence} is far ahead"
        state.record_seldom(host, EventKind.PEER_REFUSED, now, fault)
    if place in ("late", "far ahead"):
        return
    note_on_host(state, host, event.failing_plugins(), now)
    note_devices(state, host, event.devices, now)
    if event.complete:
        state.note_report(host)
        reconcile(state, host, event.statuses, now)
        for instance in state.instances_of(host):
            restarts.review(state, instance, now)  # a repeated order may have waited for the report
        return
    if place == "after a gap" and host.column not in state.reports_awaited:
        state.ask_for_report(host, now)
    for status in event.statuses:
        take_status(state, host, status, now)


def reconcile(
    state: MasterState, host: Host, statuses: Iterable[InstanceStatus], now: float,
    *, registering: bool = False,
) -> None:  # fmt: skip
    """Reconcile all instances that a host holds with the desired ones.

    An assignment that the host has not reported yet may be on its way, unless the host is
    `registering`: a slave accepts nothing that was sent before its registration.
    """
    held = {status.instance: status for status in statuses}
    state.skip_numbers(max((one.number for one in held), default=0))
    for status in held.values():
        take_status(state, host, status, now)
    for instance in state.instances_of(host):
        if instance.id in held:
            continue
        if instance.state is None and (not registering or _yet_to_start(state, instance)):
            continue
        gone(state, instance, now, f"{host.name} does not run it any more")


def _yet_to_start(state: MasterState, instance: Instance) -> bool:
    """Return True if a plan has reserved room for an instance and not ordered its start yet."""
    migration = state.migrations.get(instance.id.process)
    return migration is not None and any(
        isinstance(step, Start) and step.instance == instance.id
        for step in migration.remaining_steps
    )


def _bounded(status: InstanceStatus) -> InstanceStatus:
    """Return a status with bounded texts and lists, because a host may send any length."""
    if size_of(status) <= _LARGEST_STATUS:
        return status
    return replace(status, message=status.message[:_LARGEST_STATUS], enforced=(), devices=())


def _note_load(
    state: MasterState, instance: Instance, before: InstanceState | None, now: float
) -> None:
    """Note from when on the readings show the load of an instance, or that they no longer do."""
    if instance.state is InstanceState.READY and before is not InstanceState.READY:
        instance.ready_at = now
    elif instance.state in _DOWN and instance.seen:
        instance.seen = {}
        settle_reservation(state, instance, now)


def _note_facts(instance: Instance, status: InstanceStatus, now: float) -> None:
    instance.state, instance.pid, instance.restarts = status.state, status.pid, status.restarts
    instance.message, instance.enforced = status.message, status.enforced
    if status.pid and not status.state.ended:
        instance.began = min(instance.began, now - status.run_time)


def take_status(state: MasterState, host: Host, status: InstanceStatus, now: float) -> None:
    """Apply the status of one instance."""
    instance = state.instances.get(status.instance.number)
    if instance is None or instance.host is not host or instance.id != status.instance:
        _handle_unknown_instance(state, host, status, now)
        return
    status = _bounded(status)
    before, pid = instance.state, instance.pid
    _note_facts(instance, status, now)
    _note_load(state, instance, before, now)
    state.note_held(instance, status.devices)
    if status.state.ended:
        _ended(state, instance, status, before, now)
    review_slots(state, host, now)
    if status.state.ended:
        return
    if status.state in _ALIVE:
        instance.recalled = False
    restarts.note_status(state, instance, status)
    process = state.owned_by(instance)
    if process is None:
        return
    if status.state in _ALIVE:
        _note_start(state, process, status, now)
    adoption.note_running(state, process, instance)
    _note_restarts(state, process, status, before, pid)
    if status.state is InstanceState.BACKOFF and failover.can_replace(state, process):
        _requeue_for_standby(state, process)
    if process.wanted is not DesiredState.RUN and not instance.stopping:
        stop_owner(state, process, instance, now)
        if not instance.stopping:
            return
    if process.name not in state.migrations:
        _follow(state, process, instance, status, now, repeated=before is status.state)


def _requeue_for_standby(state: MasterState, process: Process) -> None:
    """Request the stop of a primary in back-off: its standby is ready sooner, and has its state.

    The journal has this request, because a later master would take the ordered end for a failure.
    """
    if process.wanted is DesiredState.RUN:
        process.wanted = DesiredState.REQUEUE
        state.save(process)


def _note_start(
    state: MasterState, process: Process, status: InstanceStatus, now: float
) -> None:  # fmt: skip
    """Note the first start of a process since it left the queue, and for how long it has run."""
    if not process.began:
        process.started_at = now
    if status.pid:
        process.note_run_time(status.run_time, now)
    if process.began:
        return
    process.began = state.wall
    if process.spec.schedule and not process.next_run:
        process.next_run = process.spec.schedule.next_run(state.wall)
    state.save(process)


def _note_restarts(
    state: MasterState, process: Process, status: InstanceStatus, before: InstanceState | None,
    pid: int,
) -> None:  # fmt: skip
    """Note the restarts of a process; the arguments are those of `_is_another_run`."""
    if _is_another_run(process, status, before, pid):
        dependants.note_restart(state, process)
        if status.state is not InstanceState.BACKOFF:  # in back-off its standby takes over
            failover.note_restart(state, process)
    if process.restarts != status.restarts:
        process.phase_before_loss = None  # restarted while its host was silent
        if not status.pid:  # with a pid the reported time counts from the first run
            note_run(process, status)
    process.restarts = status.restarts


def _is_another_run(
    process: Process, status: InstanceStatus, before: InstanceState | None, pid: int
) -> bool:
    """Return True if a status shows that the owner of a process was restarted.

    `before`, `pid`: state and pid in its former status. A restart that a user ordered does not
    change the number of restarts.
    """
    if before is InstanceState.STOPPING:
        return status.state is not InstanceState.STOPPING
    ended = before in (InstanceState.RUNNING, InstanceState.READY) and status.state in _DOWN
    other_pid = pid and status.pid and pid != status.pid
    return bool(ended or other_pid or status.restarts > process.restarts)


def _follow(
    state: MasterState, process: Process, instance: Instance, status: InstanceStatus, now: float,
    *, repeated: bool,
) -> None:  # fmt: skip
    """Set the phase of a process by the status of its owning instance."""
    before, former = process.phase, process.phase_before_loss
    phase = _phase_of(process, instance)
    state.set_phase(process, phase, now, status.message)
    if phase is not before:
        # Nothing shows that a program without a node is ready: it may end at once. A job has no
        # ready state, because it runs to its end.
        shown = process.spec.awaits_graph and process.spec.kind is not Kind.JOB
        is_ready = phase is ProcessPhase.RUNNING and shown
        kind = EventKind.READY if is_ready else _EVENT[phase]
        kind = EventKind.REACHABLE if repeated else kind
        state.record(
            now, kind, f"{process.name} {standing(kind)} on {instance.host.name}"
            + (f": {status.message}" if status.message else ""),
            process=process.name, host=instance.host.name,
            facts={"number": instance.id.number, "pid": status.pid, "restarts": status.restarts},
        )  # fmt: skip
        # Do not save the phase before the loss of the host again: the journal has it, with its
        # start time.
        is_saved = former is not None and former[0] is phase
        if phase in (ProcessPhase.RUNNING, ProcessPhase.BACKOFF) and not is_saved:
            state.save(process)


def _phase_of(process: Process, owner: Instance) -> ProcessPhase:
    """Return the phase of a process by the state of the instance that owns its name."""
    if process.wanted is not DesiredState.RUN:
        return ProcessPhase.STOPPING
    return _PHASE.get(owner.state, ProcessPhase.STARTING)


def _handle_unknown_instance(
    state: MasterState, host: Host, status: InstanceStatus, now: float
) -> None:
    """Stop an instance that is not assigned to its host, because it may have a successor elsewhere.

    The master tracks it until it has ended, and repeats the order to stop. A process of its name
    waits for that end, but not for ever: `start_order.review`. Beyond `_MOST_STRAYS` of one host,
    the master only orders the stop at each report, so that no host fills the master's memory.
    """
    if readoption.readopt(state, host, status, now):
        take_status(state, host, status, now)
        return
    if status.state.ended or status.instance.number >= max(LARGEST_NUMBER, state.next_instance):
        return
    state.skip_numbers(status.instance.number)
    if status.instance.number in state.instances:  # desired, but on another host
        if status.state is not InstanceState.STOPPING:
            _stop_untracked(state, host, status.instance, now)
        return
    if sum(state.instances[number].stray for number in host.instances) >= _MOST_STRAYS:
        state.record_seldom(
            host, EventKind.UNASSIGNED_STOPPED, now,
            f"{host.name} reports more than {_MOST_STRAYS} instances that are not assigned to it",
        )  # fmt: skip
        _stop_untracked(state, host, status.instance, now)
        return
    followed = readoption.has_successor(state, status)
    how = "fences it: another instance owns its name" if followed else "stops it"
    state.record(
        now, EventKind.FENCED if followed else EventKind.UNASSIGNED_STOPPED,
        f"{status.instance} is not assigned to {host.name}: the master {how}",
        process=status.instance.process, host=host.name,
    )  # fmt: skip
    process = state.processes.get(status.instance.process)
    left = None if process is None else process.left_behind
    if process is not None and left is not None and left.number == status.instance.number:
        state.clear_left_behind(process)  # because its stop is ordered, it is not readopted
        state.save(process)
    spec = ProcessSpec(status.instance.process)
    unknown = adopt_to_stop(state, status.instance, spec, host, now, stray=True)
    state.note_held(unknown, status.devices)
    unknown.state, unknown.pid = status.state, status.pid
    unknown.at_once = followed
    stop_instance(state, unknown, now)
    state.start_orders.to_review[status.instance.process] = None


def _stop_untracked(state: MasterState, host: Host, instance: InstanceId, now: float) -> None:
    """Order the stop of an instance that the master does not track; its next report repeats it."""
    state.send(host, StopInstance(instance))
    later = Backoff(until=now + state.settings.order_retry)
    state.reports_awaited.setdefault(host.column, later)


def adopt_to_stop(
    state: MasterState, instance: InstanceId, spec: ProcessSpec, host: Host, now: float, *,
    stray: bool = False,
) -> Instance:  # fmt: skip
    """Track an instance until it has stopped; reserve nothing, because readings show its usage."""
    adopted = state.add_instance(instance, spec, host, now, NO_NEEDS, stray=stray)
    adopted.stopping = True
    return adopted


def stop_owner(state: MasterState, process: Process, owner: Instance, now: float) -> None:
    """Order the owner of a process to stop, unless other processes must end before."""
    if not dependants.waits_for_ends(state, process, now):
        stop_instance(state, owner, now)


def stop_instance(state: MasterState, instance: Instance, now: float) -> None:
    """Order an instance to stop for good; `tick` repeats the order until the instance has ended."""
    instance.stopping = True
    process = state.processes.get(instance.id.process)
    is_killed = process is not None and process.killed
    at_once = instance.at_once or (is_killed and not instance.stray)
    order: Order = FenceInstance(instance.id) if at_once else StopInstance(instance.id)
    state.send(instance.host, order)
    instance.order_at = now


# --- ends -------------------------------------------------------------------------------------


def _ended(
    state: MasterState, instance: Instance, status: InstanceStatus, before: InstanceState | None,
    now: float,
) -> None:  # fmt: skip
    process = state.processes.get(instance.id.process)
    state.drop_instance(instance)
    if process is None or instance.stray:
        return
    learn_from(state, instance, status)
    learn_run_time(state, instance.spec, status)
    if status.run_time > 0.0:
        state.gangs.leave(process)
    end = _end(process, instance, status, before)
    migration = _note_end(state, instance, end)
    refused = status.state is InstanceState.REFUSED
    if migration is not None and refused and not _recalled(migration, instance):
        exclude(process, instance.host, status, now)
    if process.owner != instance.id.number:
        state.record(
            now, EventKind.INSTANCE_ENDED, f"{instance.id} ended on {instance.host.name}"
            + (f": {status.message}" if status.message else ""),
            process=process.name, host=instance.host.name,
        )  # fmt: skip
        requeue_if_clear(state, process, now)
        return
    if migration is not None:
        return  # the current plan handles this end
    if restarts.was_missed(instance, status, now):
        missed = replace(status, message="it ended before it was restarted")
        end = End(missed, gone=True)
    conclude(state, process, end, instance.host, now)


def _end(
    process: Process, instance: Instance, status: InstanceStatus, before: InstanceState | None
) -> End:
    """Return the end of an instance: completed, ordered, or unexpected."""
    completed = (
        instance.spec.kind is Kind.JOB
        and status.succeeded
        and before is not InstanceState.STOPPING
        and status.run_time > 0.0  # 0: stopped before its start
    )  # fmt: skip
    ordered = (
        instance.stopping
        or instance.recalled
        or process.wanted is DesiredState.REQUEUE
        or status.state is InstanceState.WITHDRAWN  # the slave stopped it without an order
    )
    return End(
        status, ordered=ordered and not completed, completed=completed,
        restarts_off=instance.restarts_off,
    )  # fmt: skip


def _note_end(state: MasterState, instance: Instance, end: End) -> Migration | None:
    """Note an end in the migration and the standby of its process; return the migration."""
    name, number = instance.id.process, instance.id.number
    standby, migration = state.standbys.get(name), state.migrations.get(name)
    if standby is not None and standby.destination == instance.id:
        standby.ended[number] = end
    if migration is not None:
        migration.ended[number] = end
        state.save_migration(migration)
    return migration


def conclude(state: MasterState, process: Process, end: End, host: Host, now: float) -> None:
    """Finish or requeue a process outside a migration, after its owning instance has ended."""
    if failover.take_over(state, process, end, now):
        return
    status, pending = end.status, adoption.is_pending(process)
    process.owner = 0
    has_run = status.run_time > 0.0 and status.known_exit is not None
    process.ran_on = host.name if has_run else ""
    process.exit_code = None if end.gone else status.known_exit
    if pending:
        adoption.end_adoption(state, process)
    if process.wanted is DesiredState.CANCEL and not (process.overdue and end.completed):
        phase, reason = cancelled_as(process)
        _finish(state, process, phase, host, now, reason)
    elif pending:
        _finish(state, process, ProcessPhase.FAILED, host, now, status.message)
    elif (returns := _why_it_returns(process, end, host)) is not None:
        if not (end.gone or end.ordered) and status.state is InstanceState.REFUSED:
            exclude(process, host, status, now)
        _requeue(state, process, host, now, returns)
    elif status.succeeded:
        _finish(state, process, ProcessPhase.FINISHED, host, now, status.message)
    else:
        reason = status.message or f"exit code {status.exit_code}"
        unreachable = state.hosts.why_unreachable(host)  # then `host_loss` has decided
        again = "" if unreachable else next_attempt(process, host, status, reason)
        if again:
            _requeue(state, process, host, now, again)
        else:
            _finish(state, process, ProcessPhase.FAILED, host, now, reason)


def _why_it_returns(process: Process, end: End, host: Host) -> str | None:
    """Return why a process returns to the queue after an end; None: the end itself decides."""
    status, policy = end.status, process.spec.restart
    if end.gone:
        return status.message
    if end.ordered:
        return f"its instance on {host.name} was stopped"
    if status.state is InstanceState.FENCED and process.spec.host_loss.then != "stop":
        return status.message
    if status.state is InstanceState.REFUSED:
        return f"{host.name} cannot run it: {status.message}"
    if end.restarts_off and restarts_after(policy, status):
        how = first_line(status.message) or ending_of(status.known_exit or 0)
        return f"restart by policy {policy.when!r}: {how}"
    return None


def cancelled_as(process: Process) -> tuple[ProcessPhase, str]:
    """Return the terminal phase of a process that is being cancelled, and the reason."""
    if process.overdue:
        why = f"it ran longer than its time limit of {process.spec.time_limit:g} s"
        return ProcessPhase.FAILED, why
    return ProcessPhase.CANCELLED, process.cancel_cause


def restarts_after(policy: RestartPolicy, status: InstanceStatus) -> bool:
    """Return True if the restart policy would have restarted an instance with this end."""
    if status.state in _NO_RESTART or policy.when == "never":
        return False
    if policy.when == "always" or status.state is InstanceState.FAILED:
        return True  # an unhealthy instance has failed, even if it exits with 0
    return bool(status.exit_code or status.exit_signal)


def exclude(process: Process, host: Host, status: InstanceStatus, now: float) -> None:
    """Exclude a host from the placement of a process, because the host cannot run it for now."""
    why = process.excluded[host.name] = status.message or "its slave refused it"
    process.refusals.note(host.name, why, now, FIRST_EXCLUSION)
    process.demand = None


def _recalled(migration: Migration, instance: Instance) -> bool:
    """Return True if a refusal may only mean that the stop arrived before the start."""
    return instance.stopping or (
        migration.undo is not None and instance.id == migration.destination
    )


def _finish(
    state: MasterState, process: Process, phase: ProcessPhase, host: Host, now: float, reason: str
) -> None:
    state.set_phase(process, phase, now, reason)
    process.ended_on = host.name
    state.record(
        now, _EVENT[phase],
        f"{process.name} {phase.value} on {host.name}" + (f": {reason}" if reason else ""),
        process=process.name, host=host.name, facts={"exit_code": process.exit_code},
    )  # fmt: skip
    state.save(process)


def _requeue(state: MasterState, process: Process, host: Host, now: float, reason: str) -> None:
    """Return a process to its place in the queue once no other instance of it may be active."""
    state.record(
        now, EventKind.QUEUED, f"{process.name} returns to the queue: {reason}",
        process=process.name, host=host.name,
    )  # fmt: skip
    process.wanted = DesiredState.REQUEUE
    for instance in state.instances_of(process):
        if not instance.stopping:
            stop_instance(state, instance, now)
    if not requeue_if_clear(state, process, now):
        _wait_for_ends(state, process, now)


def _wait_for_ends(state: MasterState, process: Process, now: float) -> None:
    """Return a process to its place in the queue as soon as none of its instances runs."""
    state.unqueue(process)
    process.wanted = DesiredState.REQUEUE
    note_awaited_ends(state, process, now)
    state.save(process)


def note_awaited_ends(state: MasterState, process: Process, now: float) -> None:
    """Set the phase of a process without owner: it waits until its last instances have ended."""
    left = ", ".join(f"{one.id} on {one.host.name}" for one in state.instances_of(process))
    state.set_phase(process, ProcessPhase.STOPPING, now, f"waits until {left} has ended")


def requeue_if_clear(state: MasterState, process: Process, now: float) -> bool:
    """Queue or cancel a process as desired, unless an instance of it may still run."""
    if process.owner or process.instances or process.phase.is_terminal:
        return False
    if process.name in state.migrations:
        return False
    if process.wanted is DesiredState.CANCEL:
        phase, reason = cancelled_as(process)
        state.set_phase(process, phase, now, reason)
        message = f"{process.name} {phase.value}" + (f": {reason}" if reason else "")
        state.record(now, _EVENT[phase], message, process=process.name)
    elif process.wanted is DesiredState.REQUEUE:
        state.enqueue(process, now)
        state.gangs.note_return(process)
    else:
        return False
    state.save(process)
    return True


def gone(
    state: MasterState, instance: Instance, now: float, reason: str, *, requeue: bool = True
) -> None:
    """Drop an instance that is missing or counts as lost; its end is unknown.

    `requeue`: False fails a process whose owner it was, instead of queueing it again.
    """
    process = state.processes.get(instance.id.process)
    state.drop_instance(instance)
    if process is None or instance.stray:
        return
    status = InstanceStatus(instance.id, InstanceState.FAILED, exit_code=1, message=reason)
    end = End(status, gone=requeue)
    if _note_end(state, instance, end) is not None:
        return  # the current plan handles this end
    if process.owner == instance.id.number:
        conclude(state, process, end, instance.host, now)
    else:
        requeue_if_clear(state, process, now)


def assignment_withdrawn(
    state: MasterState, event: happened.AssignmentWithdrawn, now: float
) -> None:
    """Return a process to its place in the queue: the slave never fetched its assignment.

    So the slave has no open request, and its host gets no work until the slave asks again.
    """
    instance = state.instances.get(event.instance.number)
    if instance is not None:
        state.hosts.withdraw_request(instance.host)
        gone(state, instance, now, f"{instance.host.name} did not accept the assignment in time")


def note_phase(state: MasterState, process: Process, owner: Instance, now: float) -> None:
    """Set the phase of a process outside a migration, by its owner and the owner's host."""
    host = owner.host
    unreachable = state.hosts.why_unreachable(host)
    if process.wanted is DesiredState.CANCEL:
        where = f"; it may still run on {host.name}, which {unreachable}" if unreachable else ""
        ends = f", and ends when {host.name} returns" if unreachable else ""
        if state.hosts.condition_of(host) is HostCondition.DETACHED:
            where, ends = f": waits for {host.name}, whose slave was stopped", ""
        what = "being stopped after its time limit" if process.overdue else "being cancelled"
        if not owner.stopping:
            ends += dependants.described_wait(state, process)
        state.set_phase(process, ProcessPhase.STOPPING, now, f"{what}{where}{ends}")
    elif unreachable:
        lost = state.hosts.condition_of(host) is HostCondition.LOST
        reason = f"{host.name} {unreachable}{_what_follows(process) if lost else ''}"
        if lost and process.awaits_gang:
            state.gangs.leave(process)
        state.set_phase(process, ProcessPhase.UNREACHABLE, now, reason)
    else:
        state.set_phase(process, _phase_of(process, owner), now)


def _what_follows(process: Process) -> str:
    policy = process.spec.host_loss
    if policy.then == "wait":
        return ""
    when = f" in {policy.delay:g} s" if policy.delay else ""
    what = "is started on another host" if policy.then == "elsewhere" else "fails"
    return f"; the process {what}{when}"
