"""Handlers of the slave's events."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import islice
from types import MappingProxyType
from typing import Any, Final

from rosrm.core.slave import commands, components, events, fencing, lifecycle_nodes
from rosrm.core.slave.health import InstanceHealth, watch_of
from rosrm.core.slave.state import HeldInstance, SlaveState
from rosrm.core.slave.steps import Step
from rosrm.core.slave.watches import FIRST_RUN, Awaited, Memo
from rosrm.model.adoption import NO_ADOPTION
from rosrm.model.devices import title_of
from rosrm.model.orders import ENDED, UNKNOWN
from rosrm.model.values import (
    Assignment,
    InstanceId,
    InstanceState,
    InstanceStatus,
    Kind,
    RestartPolicy,
    qualified_name,
)

#: Seconds for which an end is remembered for a master that may not have received its report.
REMEMBER_END: Final = 60.0

#: Seconds after which a wait is reported, because most waits for other starts are shorter, and a
#: report of one costs the master as much as that of a start. Far below `delivery_timeout`;
#: otherwise the master would withdraw the assignment.
REPORT_WAIT: Final = 0.5

#: States in which an instance has a process.
_RUNS: Final = (InstanceState.RUNNING, InstanceState.READY)

_Commands = list[commands.Command]
_Handler = Callable[[SlaveState, Any, float], _Commands]


def _registered(state: SlaveState, event: events.Registered, now: float) -> _Commands:
    # Not the highest epoch so far: a master whose journal was lost begins at 1 again.
    state.epoch = event.epoch
    state.registered = True
    if event.renumbers:
        state.tombstones.clear()
    for held in state.held.values():
        held.ended_at = max(held.ended_at, now)  # the registration is the first report of the end
    if not state.report_unconfirmed:
        return []
    state.report_unconfirmed = False
    # Not complete, because a complete report would deny assignments made since the registration.
    return [commands.Report(state.statuses())]


def _master_lost(state: SlaveState, event: events.MasterLost, now: float) -> _Commands:
    state.registered = False
    return []


def _assigned(state: SlaveState, event: events.AssignmentsReceived, now: float) -> _Commands:
    refusals = []
    for assignment in event.assignments:
        instance = assignment.instance
        if instance in state.held:  # the order arrived twice: the master has no status yet
            if instance in state.unreported:
                state.unreported[instance] = now
            continue
        status = _refused(state, assignment, event.given_at, now)
        if status is not None:
            state.hold(instance, HeldInstance(status, ended_at=now))
            _bury(state, instance)
            refusals.append(status)
            continue
        state.waiting[instance] = assignment
        state.hold(instance, _waiting(assignment))
    launches = _start_waiting(state, now)
    known = [state.held[one.instance] for one in event.assignments]
    held = [one for one in known if one.status.state is InstanceState.HELD]
    why = state.why_wait() if held else ""
    for one in held:
        one.status = replace(one.status, message=why)
        state.unreported.setdefault(one.status.instance, now + REPORT_WAIT)
    reports = [commands.Report(tuple(refusals))] if refusals else []
    return [*launches, *reports, *_report_waits(state, now)]


def _report_waits(state: SlaveState, now: float) -> _Commands:
    """Report the held instances that have waited for `REPORT_WAIT`."""
    waits = []
    for instance, due in list(state.unreported.items()):
        held = state.held.get(instance)
        if held is None or held.status.state is not InstanceState.HELD:
            del state.unreported[instance]
        elif now >= due:
            del state.unreported[instance]
            waits.append(held.status)
    return [commands.Report(tuple(waits))] if waits else []


def _refused(
    state: SlaveState, assignment: Assignment, given_at: float | None, now: float
) -> InstanceStatus | None:
    """Return the status of an assignment that is not accepted; None: it is accepted."""
    reason = _why_not(state, assignment)
    if reason:
        return InstanceStatus(assignment.instance, InstanceState.REFUSED, message=reason)
    age = 0.0 if given_at is None else now - given_at
    late = fencing.too_old(state, assignment, age)
    if late:
        return InstanceStatus(assignment.instance, InstanceState.FENCED, message=late)
    return None


def _waiting(assignment: Assignment) -> HeldInstance:
    spec = assignment.spec
    lifecycle, loads = lifecycle_nodes.managed(assignment), components.loads_of(assignment)
    awaited = None
    if spec.awaits_graph and (not assignment.restored or lifecycle or loads):
        name = assignment.node_name
        name = qualified_name(spec.namespace, name) if name else ""
        # A restored node rejoins the graph later. A later run does not begin from that image.
        seen = FIRST_RUN if assignment.restored else 0
        awaited = Awaited(name, spec.readiness.timeout, seen)
    status = InstanceStatus(assignment.instance, InstanceState.HELD)
    watch, fenced = watch_of(assignment), assignment.fence is not None
    return HeldInstance(
        status, spec, awaited, watch=watch, fenced=fenced, devices=assignment.devices,
        artifacts=spec.artifacts, lifecycle=lifecycle, loads=loads,
    )  # fmt: skip


def _start_waiting(state: SlaveState, now: float) -> _Commands:
    """Launch waiting instances within the bounds."""
    refused = _refuse_late(state, now)
    started = tuple(islice(state.waiting, state.startable()))
    launches = [state.waiting.pop(instance) for instance in started]
    for instance in started:
        state.held[instance].status = InstanceStatus(instance, InstanceState.STARTING)
    held_launch = _launch_held(state)
    return [*([commands.Launch(tuple(launches))] if launches else []), *held_launch, *refused]


def _launch_held(state: SlaveState) -> _Commands:
    """Return the launch of the next job, which the supervisor holds until a slot is free.

    A job that was handed over counts as running, so there is at most one. All other instances must
    be ready; otherwise the supervisor might not know one of them yet, and count its slot as free.
    """
    following = next(iter(state.waiting.values()), None)
    if following is None or not (state.holds_starts and state.max_processes and state.slots() == 0):
        return []
    ready = all(
        held.status.state is InstanceState.READY
        for one, held in state.alive.items()
        if one not in state.waiting
    )
    if not ready or not _is_plain_job(following):
        return []
    del state.waiting[following.instance]
    return [commands.Launch((following,), state.max_processes)]


def _is_plain_job(assignment: Assignment) -> bool:
    """Return True if nothing has to be fetched, awaited or restored to start an instance."""
    spec = assignment.spec
    needs_slave = (
        spec.awaits_graph, spec.artifacts, spec.container.image, spec.adoption != NO_ADOPTION,
        assignment.has_snapshots, assignment.restored,
    )  # fmt: skip
    return spec.kind is Kind.JOB and not any(needs_slave)


def _refuse_late(state: SlaveState, now: float) -> _Commands:
    """Refuse waiting instances whose fence has expired, because successors may run elsewhere."""
    late = fencing.late(state, now)
    for instance, why in late.items():
        del state.waiting[instance]
        status = InstanceStatus(instance, InstanceState.FENCED, message=why)
        state.hold(instance, HeldInstance(status, ended_at=now))
        _bury(state, instance)
    return [commands.Report(tuple(state.held[one].status for one in late))] if late else []


def _why_not(state: SlaveState, assignment: Assignment) -> str:
    if assignment.epoch < state.epoch:
        return f"assigned in epoch {assignment.epoch}, this is epoch {state.epoch}"
    if assignment.instance in state.tombstones:
        return "it was stopped or refused here before this order arrived"
    return ""


def _launch_refused(state: SlaveState, event: events.LaunchRefused, now: float) -> _Commands:
    held = state.held.get(event.instance)
    if held is None:  # it ended with a supervisor that was killed
        return []
    held.status = InstanceStatus(event.instance, InstanceState.REFUSED, message=event.reason)
    held.ready_by, held.ended_at = None, now
    state.hold(event.instance, held)
    _bury(state, event.instance)
    return [*_start_waiting(state, now), commands.Report((held.status,))]


def _start_delayed(state: SlaveState, event: events.StartDelayed, now: float) -> _Commands:
    held = state.held.get(event.instance)
    if held is None or held.status.state is not InstanceState.STARTING:
        return []
    held.status = replace(held.status, message=event.reason)
    return [commands.Report((held.status,))]


def _end_ordered(
    state: SlaveState, event: events.StopOrdered | events.FenceOrdered, now: float
) -> _Commands:
    instance = event.instance
    held = state.held.get(instance)
    if held is not None and held.status.state.ended:
        return [commands.Report((held.status,))]
    if held is not None and instance not in state.waiting:
        return [
            commands.Fence(instance)
            if isinstance(event, events.FenceOrdered)
            else commands.Stop(instance)
        ]
    state.waiting.pop(instance, None)
    _bury(state, instance)
    status = InstanceStatus(
        instance, InstanceState.REFUSED, message="it was stopped before it was started"
    )
    state.hold(instance, HeldInstance(status, ended_at=now))
    return [commands.Report((status,))]


def _bury(state: SlaveState, instance: InstanceId) -> None:
    state.tombstones.put(instance, None)


def restarts(state: SlaveState, event: events.RestartOrdered) -> bool:
    """Return True if an order would restart an instance now."""
    held = state.held.get(event.instance)
    if held is None or held.status.state.ended or event.instance in state.waiting:
        return False
    return event.run is None or event.run.is_that_of(held.status.pid, held.status.restarts)


def _restart_ordered(state: SlaveState, event: events.RestartOrdered, now: float) -> _Commands:
    held = state.held.get(event.instance)
    if held is None or held.status.state.ended:
        return [] if held is None else [commands.Report((held.status,))]
    if event.instance in state.waiting:
        return []  # the start itself still waits
    if not restarts(state, event):
        return [commands.Report((held.status,))]  # a late copy: its run has ended
    held.ready_by = None
    return [commands.Restart(event.instance, event.run)]


def _amendment_ordered(state: SlaveState, event: events.AmendmentOrdered, now: float) -> _Commands:
    instance, amendment = event.instance, event.amendment
    held = state.held.get(instance)
    if held is None:
        return [_unknown(event)]
    report = commands.Report((held.status,))
    if held.status.state.ended:
        return [report, _ended(event)]
    held.amended = amendment.after(held.amended)
    news = _pause_or_watch(held, amendment.restart)
    waiting = state.waiting.get(instance)
    if waiting is not None:  # the supervisor does not know the instance yet
        limits = waiting.spec.limits if amendment.limits is None else amendment.limits
        spec = replace(waiting.spec, restart=amendment.restart, limits=limits)
        state.waiting[instance] = replace(waiting, spec=spec, shadow=False)
        return [report, commands.Settle(instance, amendment)]
    held.unsettled += (amendment,)
    remember = [commands.Remember(instance, held.memo)] if news else []
    return [commands.Amend(instance, amendment), *remember]


def _pause_or_watch(held: HeldInstance, restart: RestartPolicy) -> bool:
    """Pause or resume the health checks by the restart policy; return True if that changed.

    A migration turns restarts off and on again. The checks of an instance without restarts cannot
    follow that change, so they are never paused.
    """
    watch = held.watch
    if watch is None:
        return False
    paused = watch.restarts and restart.when == "never"
    held.watch = replace(watch, paused=paused)
    held.judgement = None
    return paused != watch.paused


def _unknown(order: events.AmendmentOrdered) -> commands.Settle:
    never = f"{order.instance} is not known here: it never ran on this host, or ended long ago"
    return commands.Settle(order.instance, order.amendment, never, UNKNOWN)


def _ended(order: events.AmendmentOrdered) -> commands.Settle:
    """Return the answer to an order that has no effect any more."""
    return commands.Settle(order.instance, order.amendment, f"{order.instance} has ended", ENDED)


def _amendment_recorded(
    state: SlaveState, event: events.AmendmentRecorded, now: float
) -> _Commands:
    settled = commands.Settle(event.instance, event.amendment, event.refusal)
    held = state.held.get(event.instance)
    if held is None:
        return [settled]
    if held.status.state.ended and not event.refusal:
        # The status of an end before the change precedes this event.
        settled = _ended(events.AmendmentOrdered(event.instance, event.amendment))
    if event.amendment in held.unsettled:
        at = held.unsettled.index(event.amendment)
        held.unsettled = held.unsettled[:at] + held.unsettled[at + 1 :]
    return [commands.Report((held.status,)), settled]


def _report_requested(state: SlaveState, event: events.ReportRequested, now: float) -> _Commands:
    return [commands.Report(state.statuses(), complete=True)]


def _supervisor_reported(
    state: SlaveState, event: events.SupervisorReported, now: float
) -> _Commands:
    changed = [
        status
        for reported in event.statuses
        if (status := _follow(state, reported, now)) is not None
    ]
    # Launches first, because the report of an end is less urgent.
    return [*_start_waiting(state, now), *([commands.Report(tuple(changed))] if changed else [])]


def _supervisor_replaced(
    state: SlaveState, event: events.SupervisorReplaced, now: float
) -> _Commands:
    known = {status.instance for status in event.statuses}
    state.holds_starts = event.holds_starts
    again: _Commands = []
    for instance, held in list(state.held.items()):
        lost = instance not in known and instance not in state.waiting
        if lost and not held.status.state.ended:
            state.drop(instance)
            _bury(state, instance)
        held.judgement = None  # judge again, because the order to fail the run may be lost
        again += [
            _amend_again(events.AmendmentOrdered(instance, amendment), held, lost=lost)
            for amendment in held.unsettled
        ]
    for status in event.statuses:
        _follow(state, status, now, event.memos.get(status.instance))
    for instance in event.fenced & state.held.keys():
        state.held[instance].fenced = True
    again += [
        commands.Remember(instance, held.memo)
        for instance, held in state.alive.items()
        if instance in known and held.memo != event.memos.get(instance, Memo())
    ]
    return [
        *fencing.renew(state, now), *again, *_start_waiting(state, now),
        commands.Report(state.statuses(), complete=True),
    ]  # fmt: skip


def _amend_again(
    order: events.AmendmentOrdered, held: HeldInstance, *, lost: bool
) -> commands.Command:
    """Return the command that repeats an order, because the former supervisor may have lost it."""
    if held.status.state.ended:
        return _ended(order)
    return _unknown(order) if lost else commands.Amend(order.instance, order.amendment)


def _follow(
    state: SlaveState, reported: InstanceStatus, now: float, memo: Memo | None = None
) -> InstanceStatus | None:
    """Apply a status of the supervisor; return the new status, None: already known."""
    held = state.held.get(reported.instance)
    if held is None:
        known = memo or Memo()
        held = HeldInstance(
            reported, awaited=known.awaited, watch=known.watch, devices=known.devices,
            artifacts=known.artifacts, lifecycle=known.lifecycle, loads=known.loads,
        )  # fmt: skip
        if reported.state is InstanceState.RUNNING:
            held.status = _running(held, reported, now)
    elif reported.state is InstanceState.RUNNING:
        ready = held.status.state is InstanceState.READY
        arrived = ready or held.steering is not None or held.loading is not None
        if arrived and held.status.pid == reported.pid:
            if held.status.enforced == reported.enforced:
                return None
            held.status = replace(held.status, enforced=reported.enforced)
        else:
            held.status = _running(held, reported, now)
    elif reported.state is held.status.state is InstanceState.HELD:
        return None  # the slave set this state when it received the assignment
    else:
        held.ready_by = held.steering = held.loading = None
        held.status = _with_unready(held, reported)
    _note_begin(held, reported, now)
    state.hold(reported.instance, held)
    if held.status.state.ended:
        held.ended_at = now
        _bury(state, reported.instance)
    return held.status


def _note_begin(held: HeldInstance, reported: InstanceStatus, now: float) -> None:
    """Note the start of the first run, which an earlier run of this slave may have seen."""
    if reported.pid and not reported.state.ended:
        began = now - reported.run_time
        held.began = began if held.began is None else min(held.began, began)


def _running(held: HeldInstance, reported: InstanceStatus, now: float) -> InstanceStatus:
    """Return the status of a new run: ready at once, or after its node appears in the graph."""
    held.steering = held.loading = None
    held.unready = ""  # the order to stop it may be lost
    awaited = held.awaited
    if awaited is not None and awaited.seen == FIRST_RUN:
        first = reported.pid if reported.restarts == 0 else 0
        held.awaited = awaited = replace(awaited, seen=first)
    if awaited is None or awaited.seen == reported.pid:
        return replace(reported, state=InstanceState.READY)
    held.ready_by = now + awaited.timeout
    return reported


def _with_unready(held: HeldInstance, reported: InstanceStatus) -> InstanceStatus:
    if not held.unready or not reported.state.ended:
        return reported
    return replace(reported, state=InstanceState.FAILED, message=held.unready)


def _seen(state: SlaveState, event: events.SeenInGraph, now: float) -> _Commands:
    held = state.held.get(event.instance)
    if held is None or held.ready_by is None or held.awaited is None or held.loading is not None:
        return []
    if held.loads is not None:  # until the same deadline
        return list(components.begin(held, held.loads, now).commands)
    held.ready_by = None
    if held.lifecycle is not None:
        return list(lifecycle_nodes.begin(held, held.lifecycle, now).commands)
    return _ready(state, held, held.awaited, now)


def _ready(state: SlaveState, held: HeldInstance, awaited: Awaited, now: float) -> _Commands:
    held.status = replace(held.status, state=InstanceState.READY)
    held.awaited = replace(awaited, seen=held.status.pid)
    return [
        *_start_waiting(state, now), commands.Remember(held.status.instance, held.memo),
        commands.Report((held.status,)),
    ]  # fmt: skip


def _answered(advance: Callable[[HeldInstance, Any, float], Step]) -> _Handler:
    """Return the handler of an answer of a node, which counts only for the run that was asked."""

    def handler(state: SlaveState, event: Any, now: float) -> _Commands:
        held = state.held.get(event.instance)
        if held is None or held.status.pid != event.pid:
            return []
        return _after(state, held, advance(held, event, now), now)

    return handler


def _after(state: SlaveState, held: HeldInstance, step: Step, now: float) -> _Commands:
    """Return the commands that follow from a step of an instance on the way to readiness."""
    if step.commands:
        return list(step.commands)
    if not step.reached and not step.fault:
        return []
    held.ready_by = held.steering = held.loading = None
    answers = lifecycle_nodes.settled(held, step.fault)
    status, lifecycle = held.status, held.lifecycle
    ready = status.state is InstanceState.READY
    if step.fault:
        # A source that cannot be deactivated keeps running, because its move is undone.
        if not ready or (lifecycle is not None and lifecycle.goal == "active"):
            fault = f"not {'active' if ready else 'ready'}: {step.fault}"
            answers.append(commands.Fail(status.instance, status.pid, fault, kill=False))
        return answers
    if ready or held.awaited is None:
        return answers
    return [*answers, *_ready(state, held, held.awaited, now)]


def _lifecycle_ordered(state: SlaveState, event: events.LifecycleOrdered, now: float) -> _Commands:
    held, waits = state.held.get(event.instance), event.instance in state.waiting
    return lifecycle_nodes.ordered(held, event, now, waits=waits)


def _looked_at(state: SlaveState, event: events.LookedAt, now: float) -> _Commands:
    held = state.held.get(event.instance)
    watch = None if held is None else held.watched
    if held is None or watch is None or held.status.pid != event.pid:
        return []
    if held.judgement is None or held.judgement.pid != event.pid:
        held.judgement = InstanceHealth(watch, event.pid, now)
    reason = held.judgement.look(event.look, now)
    if not reason:
        return []
    held.judgement = None  # judge again, because the order may be lost
    return [commands.Fail(event.instance, event.pid, reason, kill=event.look.stopped)]


def _devices_missed(state: SlaveState, event: events.DevicesMissed, now: float) -> _Commands:
    """Fail each run that holds a missing device."""
    commands_: _Commands = []
    for instance, held in state.held.items():
        reasons = [
            f"{title_of(one.kind, one.unit)} is missing: {event.missing[one.kind, one.unit]}"
            for one in held.devices
            if (one.kind, one.unit) in event.missing
        ]
        if reasons and held.status.state in _RUNS:
            reason = f"unhealthy: {'; '.join(reasons)}"
            commands_.append(commands.Fail(instance, held.status.pid, reason, kill=False))
    return commands_


def _may_be_discarded(state: SlaveState, held: HeldInstance, now: float) -> bool:
    return state.registered and now - held.ended_at >= REMEMBER_END


def _time_passed(state: SlaveState, event: events.TimePassed, now: float) -> _Commands:
    # Without an instance nothing runs or waits. This early return matters because an idle slave
    # handles ten of these events a second.
    if not state.held:
        return []
    orders: _Commands = [*fencing.renew_in_time(state, now), *_refuse_late(state, now)]
    orders += _report_waits(state, now)
    forgotten = []
    for instance, held in state.held.items():
        awaited = held.awaited
        if held.ready_by is not None and now >= held.ready_by and awaited is not None:
            held.ready_by = None
            node = " ".join(filter(None, ("no node", awaited.node_name)))
            unseen = f"{node} of this instance was seen in the ROS graph"
            why = components.lateness(held) or unseen
            held.unready = f"not ready within {awaited.timeout:g} s: {why}"
            held.loading = None  # because an instance that is being stopped must not become ready
            orders.append(commands.Stop(instance))
        elif held.loading is not None:
            orders += _after(state, held, components.time_passed(held, now), now)
        elif held.steering is not None:
            orders += _after(state, held, lifecycle_nodes.time_passed(held, now), now)
        elif held.ordered is not None and held.status.state.ended:
            orders += lifecycle_nodes.settled(held, "it has ended", ENDED)
        elif held.status.state.ended and _may_be_discarded(state, held, now):
            forgotten.append(instance)
    if forgotten:
        for instance in forgotten:
            held = state.drop(instance)
            orders += [_ended(events.AmendmentOrdered(instance, one)) for one in held.unsettled]
        orders.append(commands.Forget(tuple(forgotten)))
    return orders


def _leave_out(state: SlaveState, event: events.Slept, _now: float) -> _Commands:
    """Prolong the time limits of processes by a suspend; fences and leases count the suspend."""
    for held in state.held.values():
        if held.ready_by is not None:
            held.ready_by += event.seconds
        if held.steering is not None:
            held.steering.deadline += event.seconds
    return []


#: Handler of each event.
HANDLERS: Final[Mapping[type, _Handler]] = MappingProxyType(
    {
        events.Registered: _registered,
        events.MasterLost: _master_lost,
        events.AssignmentsReceived: _assigned,
        events.LaunchRefused: _launch_refused,
        events.StartDelayed: _start_delayed,
        events.StopOrdered: _end_ordered,
        events.FenceOrdered: _end_ordered,
        events.ContactConfirmed: fencing.contact_confirmed,
        events.RestartOrdered: _restart_ordered,
        events.AmendmentOrdered: _amendment_ordered,
        events.AmendmentRecorded: _amendment_recorded,
        events.ReportRequested: _report_requested,
        events.SupervisorReported: _supervisor_reported,
        events.SupervisorReplaced: _supervisor_replaced,
        events.SeenInGraph: _seen,
        events.LifecycleOrdered: _lifecycle_ordered,
        events.LifecycleStateRead: _answered(lifecycle_nodes.state_read),
        events.TransitionAnswered: _answered(lifecycle_nodes.transition_answered),
        events.ComponentsListed: _answered(components.listed),
        events.ComponentLoaded: _answered(components.loaded),
        events.LookedAt: _looked_at,
        events.DevicesMissed: _devices_missed,
        events.TimePassed: _time_passed,
        events.Slept: _leave_out,
    }
)
