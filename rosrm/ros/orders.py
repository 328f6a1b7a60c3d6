"""Conversion of orders to requests of a slave's control service and back."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from copy import copy
from typing import Final, get_args

from rosrm.errors import Refused
from rosrm.model.description_checks import name_fault
from rosrm.model.durations import LONGEST
from rosrm.model.links import peer_to_json, peers_from_json
from rosrm.model.orders import (
    AmendInstance,
    DropReplica,
    FenceInstance,
    MeasureLinks,
    Order,
    ReloadSettings,
    ReplicateSnapshot,
    ReportInstances,
    RestartInstance,
    RunExecutor,
    SetLifecycleState,
    StartInstance,
    StopInstance,
)
from rosrm.model.values import Amendment, InstanceId, LifecycleGoal, Run
from rosrm.ros import convert
from rosrm_msgs import srv

_Request = srv.ControlHost.Request
#: Copied for each order, because the constructor also makes a spec with 18 policies. The copies
#: share its nested messages, so these are replaced and never changed.
_EMPTY: Final = _Request()
_ACTIONS: Final[Mapping[type[Order], int]] = {
    StopInstance: _Request.STOP,
    RestartInstance: _Request.RESTART,
    StartInstance: _Request.START,
    RunExecutor: _Request.EXECUTE,
    ReportInstances: _Request.REPORT,
    AmendInstance: _Request.AMEND,
    SetLifecycleState: _Request.SET_LIFECYCLE,
    FenceInstance: _Request.FENCE,
    ReplicateSnapshot: _Request.REPLICATE,
    DropReplica: _Request.DROP_REPLICA,
    MeasureLinks: _Request.MEASURE_LINKS,
    ReloadSettings: _Request.RELOAD,
}


def order_to_msg(order: Order) -> srv.ControlHost.Request:
    """Return an order as a request without its envelope."""
    request = copy(_EMPTY)
    request.action = _ACTIONS[type(order)]
    match order:
        case RunExecutor(executor, arguments, timeout):
            request.executor, request.timeout = executor, float(timeout)
            request.arguments = json.dumps(dict(arguments))
            return request
        case ReportInstances() | ReloadSettings():
            return request
        case MeasureLinks(peers, learn):
            plain = [peer_to_json(peer) for peer in peers]
            request.arguments = json.dumps({"peers": plain, "learn": learn})
            return request
        case RestartInstance(_, Run(pid, restarts)):
            request.arguments = json.dumps({"pid": pid, "restarts": restarts})
        case StartInstance(assignment):
            request.assignment = convert.assignment_to_msg(assignment)
        case AmendInstance(_, amendment):
            request.restart = convert.restart_to_msg(amendment.restart)
            if amendment.limits is not None:
                request.limits = [convert.limits_to_msg(amendment.limits)]
        case SetLifecycleState(_, state):
            request.lifecycle = state
        case ReplicateSnapshot(_, hosts, every):
            request.replicate_to, request.replicate_every = list(hosts), float(every)
    request.instance = convert.instance_to_msg(order.instance)
    return request


def start_to_msg(order: StartInstance, journal: int) -> srv.ControlHost.Request:
    """Return the order of a START with the watermark of the journal that has the assignment."""
    request = order_to_msg(order)
    request.arguments = json.dumps({"journal": journal})
    return request


def journal_of(request: srv.ControlHost.Request) -> int:
    """Return the journal watermark of a START, 0 without one; raise `Refused` if it is invalid."""
    if not request.arguments:
        return 0
    journal = convert.json_object(request.arguments, "the arguments of a start").get("journal", 0)
    if type(journal) is not int or journal < 0:
        raise Refused(f"the journal of a start is {journal!r:.100}; allowed: a whole number from 0")
    return journal


def order_from_msg(request: srv.ControlHost.Request) -> Order:
    """Return the inverse of `order_to_msg`; raise `Refused` for an invalid request."""
    instance = convert.instance_from_msg(request.instance)
    fault = _fault(request)
    if fault:
        raise Refused(fault)
    reader = _READERS.get(request.action)
    if reader is None:
        raise Refused(f"unknown action {request.action}")
    return reader(request, instance)


def _execute(request: srv.ControlHost.Request) -> RunExecutor:
    arguments = convert.json_object(request.arguments, "the arguments of an executor")
    return RunExecutor(request.executor, arguments, request.timeout)


def _run(arguments: str) -> Run | None:
    if not arguments:
        return None
    plain = convert.json_object(arguments, "the run of a restart")
    pid, restarts = plain.get("pid"), plain.get("restarts")
    for value in (pid, restarts):
        if type(value) is not int or value < 0:
            raise Refused(f"a restart of the run {arguments!r:.100}; allowed: whole numbers from 0")
    assert isinstance(pid, int)
    assert isinstance(restarts, int)
    return Run(pid, restarts)


def _amendment(request: srv.ControlHost.Request) -> Amendment:
    (limits,) = map(convert.limits_from_msg, request.limits) if request.limits else (None,)
    return Amendment(convert.restart_from_msg(request.restart), limits)


def _set_lifecycle(instance: InstanceId, state: str) -> SetLifecycleState:
    for goal in get_args(LifecycleGoal):
        if state == goal:
            return SetLifecycleState(instance, goal)
    allowed = ", ".join(get_args(LifecycleGoal))
    raise Refused(f"a lifecycle state {state!r:.100}; allowed: {allowed}")


def _measure_links(arguments: str) -> MeasureLinks:
    plain = convert.json_object(arguments, "the arguments of a measurement")
    try:
        return MeasureLinks(peers_from_json(plain["peers"]), bool(plain["learn"]))
    except (LookupError, ValueError) as error:
        raise Refused(f"an order to measure links: {error}") from None


_READERS: Final[Mapping[int, Callable[[srv.ControlHost.Request, InstanceId], Order]]] = {
    _Request.STOP: lambda _, instance: StopInstance(instance),
    _Request.FENCE: lambda _, instance: FenceInstance(instance),
    _Request.RESTART: lambda one, instance: RestartInstance(instance, _run(one.arguments)),
    _Request.START: lambda one, _: StartInstance(convert.assignment_from_msg(one.assignment)),
    _Request.EXECUTE: lambda one, _: _execute(one),
    _Request.REPORT: lambda *_: ReportInstances(),
    _Request.RELOAD: lambda *_: ReloadSettings(),
    _Request.AMEND: lambda one, instance: AmendInstance(instance, _amendment(one)),
    _Request.SET_LIFECYCLE: lambda one, instance: _set_lifecycle(instance, one.lifecycle),
    _Request.REPLICATE: lambda one, instance: ReplicateSnapshot(
        instance, tuple(one.replicate_to), one.replicate_every
    ),
    _Request.DROP_REPLICA: lambda _, instance: DropReplica(instance),
    _Request.MEASURE_LINKS: lambda one, _: _measure_links(one.arguments),
}


def _fault(request: srv.ControlHost.Request) -> str:
    """Return an impossible name or time in an order; "" for none. Unused fields are empty."""
    for seconds in (request.timeout, request.replicate_every):
        if not 0.0 <= seconds <= LONGEST:
            return f"a time of {seconds} s; allowed: 0 to {LONGEST:g}"
    process = request.instance.process
    faults = [name_fault(host, "host") for host in request.replicate_to]
    return next(filter(None, faults), "") or (process and name_fault(process, "process"))
