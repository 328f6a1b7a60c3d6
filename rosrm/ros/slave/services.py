"""Services of a slave for the master and clients: orders become core events, logs are read."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from rosrm import clocks
from rosrm.core.slave.events import Event
from rosrm.core.slave.orders import event_of, why_stale
from rosrm.errors import Refused
from rosrm.keys.security import Member
from rosrm.model.links import LinkReport
from rosrm.model.orders import (
    STALE,
    AmendInstance,
    DropReplica,
    MeasureLinks,
    ReloadSettings,
    ReplicateSnapshot,
    RestartInstance,
    RunExecutor,
    SetLifecycleState,
    StartInstance,
)
from rosrm.model.rows import LogPart
from rosrm.model.traced_values import stamped_assignment
from rosrm.model.values import Assignment, InstanceId
from rosrm.ros import names
from rosrm.ros.control import ControlServer, accepted, refused, version_refusal
from rosrm.ros.orders import journal_of, order_from_msg
from rosrm.ros.sealed import SealedEndpoints, SealedRequest
from rosrm.ros.slave.endpoint import SlaveEndpoint
from rosrm_msgs import srv


@dataclass(frozen=True, slots=True)
class LogQuery:
    """Requested part of a log; the fields are those of `ReadLog`.

    Attributes:
        first: lowest number of an instance whose log the sender may read.
    """

    process: str
    number: int = 0
    offset: int = 0
    tail: int = 0
    since: float = 0.0
    max_bytes: int = 0
    first: int = 0


class ExecutorOutcome(NamedTuple):
    """Outcome of an executor.

    Attributes:
        code: "" after a success; "unable": the executor reported a failure by a `ValueError` or an
            error of rosrm, which is a valid answer; "bad_result": it answered no JSON object;
            "failed": it raised another exception.
        message: of a failure.
        result: as JSON; "" after a failure.
    """

    code: Literal["", "unable", "bad_result", "failed"]
    message: str = ""
    result: str = ""


@dataclass(frozen=True, slots=True)
class Duties:
    """Functions of a slave that execute requests; each is called in the loop's thread.

    Attributes:
        take: takes an event for the core.
        restart: restarts an instance from the beginning; raises `Refused` if that is impossible.
        amend: changes an instance that runs on. It calls its last argument with "" when the change
            is durable, whichever process is killed, else with the reason why nothing has changed,
            and its code.
        set_lifecycle: changes the goal of a lifecycle node. It calls its last argument with "" when
            the node has reached the goal, else with the reason why it does not, and its code.
        keep: replicates an instance's snapshots to these hosts from now on, every so many seconds.
        drop_snapshots: deletes the snapshots of a process, of instances up to this one.
        execute: runs an executor, and calls its last argument with the outcome. If that takes
            longer than the order allows, the executor's strategy counts as failing.
        read_log: reads a part of a log, and calls its last argument with it, or why there is none.
        measure_links: measures links, and calls its last argument with the report.
        reload: reads the settings file, and calls its argument with a summary and the fault, of
            which one is "".
    """

    take: Callable[[Event], None]
    restart: Callable[[RestartInstance], None]
    amend: Callable[[AmendInstance, Callable[[str, str], None]], None]
    set_lifecycle: Callable[[SetLifecycleState, Callable[[str, str], None]], None]
    keep: Callable[[InstanceId, Sequence[str], float], None]
    drop_snapshots: Callable[[InstanceId], None]
    execute: Callable[[RunExecutor, Callable[[ExecutorOutcome], None]], None]
    read_log: Callable[[LogQuery, Callable[[LogPart | Refused], None]], None]
    measure_links: Callable[[MeasureLinks, Callable[[LinkReport], None]], None]
    reload: Callable[[Callable[[str, str], None]], None]


class SlaveServices:
    """The services of one slave.

    Args:
        max_age: seconds after which an order is stale.
        endpoint: has the newest epoch of the master; older orders are refused.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Member], duties: Duties, host: str, max_age: float,
        endpoint: SlaveEndpoint,
    ) -> None:  # fmt: skip
        self._duties = duties
        self._endpoint = endpoint
        self._started: deque[Callable[[Any], None]] = deque()
        # One for all: the answers to thousands of requests are remembered.
        self._start_accepted = srv.ControlHost.Response(answer=accepted())
        path = names.Names(endpoints.participant.settings.namespace)
        server = ControlServer(endpoints, max_age, lambda: endpoint.epoch)
        server.offer(srv.ControlHost, path.of_host(host, names.CONTROL), self._take_order)
        endpoints.serve(srv.ReadLog, path.of_host(host, names.READ_LOG), self._take_log)

    def _take_order(
        self, request: srv.ControlHost.Request, _sealed: SealedRequest,
        respond: Callable[[Any], None],
    ) -> None:  # fmt: skip
        """Carry out an order; some outcomes, such as those of executors, come later."""
        try:
            order = order_from_msg(request)
            stale = why_stale(order, registered=self._endpoint.is_registered)
            if stale:
                respond(srv.ControlHost.Response(answer=refused(STALE, stale)))
                return
            match order:
                case StartInstance(assignment):
                    self._start(assignment, request)
                    self._started.append(respond)
                    return
                case RunExecutor():
                    self._execute(order, respond)
                    return
                case RestartInstance():
                    self._duties.restart(order)
                case AmendInstance():
                    self._duties.amend(order, _settled(respond))
                    return
                case SetLifecycleState():
                    self._duties.set_lifecycle(order, _settled(respond))
                    return
                case MeasureLinks():
                    self._measure_links(order, respond)
                    return
                case ReloadSettings():
                    self._reload(respond)
                    return
                case ReplicateSnapshot(instance, hosts, every):
                    self._duties.keep(instance, hosts, every)
                case DropReplica(instance):
                    self._duties.drop_snapshots(instance)
                case _:
                    self._duties.take(event_of(order))
        except Refused as refusal:
            respond(srv.ControlHost.Response(answer=refused(refusal.code, str(refusal))))
            return
        respond(srv.ControlHost.Response(answer=accepted()))

    def acknowledge_starts(self) -> None:
        """Answer the orders to start. Call this after the launches; before, it would delay them."""
        while self._started:
            self._started.popleft()(self._start_accepted)

    def _start(self, assignment: Assignment, request: srv.ControlHost.Request) -> None:
        self._endpoint.note_journal(journal_of(request), request.envelope.epoch)
        assignment = stamped_assignment(assignment, slave_received=clocks.wall_time_ns())
        given_at = request.envelope.receiver_beat / 1e9
        self._duties.take(event_of(StartInstance(assignment), given_at))

    def _measure_links(self, order: MeasureLinks, respond: Callable[[Any], None]) -> None:
        def done(report: LinkReport) -> None:
            result = json.dumps(report.to_json())
            respond(srv.ControlHost.Response(answer=accepted(), result=result))

        self._duties.measure_links(order, done)

    def _reload(self, respond: Callable[[Any], None]) -> None:
        def done(summary: str, fault: str) -> None:
            answer = refused("invalid", fault) if fault else accepted(summary)
            respond(srv.ControlHost.Response(answer=answer))

        self._duties.reload(done)

    def _execute(self, order: RunExecutor, respond: Callable[[Any], None]) -> None:
        def done(outcome: ExecutorOutcome) -> None:
            answer = refused(outcome.code, outcome.message) if outcome.code else accepted()
            respond(srv.ControlHost.Response(answer=answer, result=outcome.result))

        self._duties.execute(order, done)

    def _take_log(self, request: srv.ReadLog.Request, open_request: SealedRequest) -> None:
        fault = version_refusal(request.protocol_version, "a reader of logs")
        if fault:
            open_request.answer(srv.ReadLog.Response(answer=refused("version", fault)))
            return

        def done(part: LogPart | Refused) -> None:
            open_request.answer(_log_response(part))

        try:
            ticket = open_request.ticket_for(request.process)
        except Refused as refusal:
            done(refusal)
            return
        query = LogQuery(
            request.process, request.number, request.offset, request.tail, request.since,
            request.max_bytes, ticket.first,
        )  # fmt: skip
        self._duties.read_log(query, done)


def _log_response(part: LogPart | Refused) -> srv.ReadLog.Response:
    if isinstance(part, Refused):
        return srv.ReadLog.Response(answer=refused(part.code, str(part)))
    return srv.ReadLog.Response(
        answer=accepted(), number=part.number, numbers=list(part.numbers),
        content=part.content, offset=part.offset, next_offset=part.next_offset,
        ended=part.ended, mark_times=[mark[0] for mark in part.marks],
        mark_offsets=[mark[1] for mark in part.marks],
        mark_pids=[mark[2] for mark in part.marks],
    )  # fmt: skip


def _settled(respond: Callable[[Any], None]) -> Callable[[str, str], None]:
    """Return a function that answers an order with its refusal and code; "": it was executed."""

    def settle(refusal: str, code: str) -> None:
        answer = refused(code, refusal) if refusal else accepted()
        respond(srv.ControlHost.Response(answer=answer))

    return settle
