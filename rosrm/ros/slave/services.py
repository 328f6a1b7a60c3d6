"""Services of a slave for the master and clients: orders become core events, logs are read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from rosrm.core.slave import events
from rosrm.errors import Refused
from rosrm.model.values import InstanceId, InstanceStatus, KeptState, RestartPolicy
from rosrm.ros import convert, names
from rosrm.ros.control import ControlServer, Gate, accepted, refused, version_refusal
from rosrm.ros.participant import OpenRequest, Participant
from rosrm_msgs import srv


@dataclass(frozen=True, slots=True)
class LogQuery:
    """Requested part of a log; the fields are those of `ReadLog`."""

    process: str
    number: int = 0
    offset: int = 0
    tail: int = 0
    since: float = 0.0
    max_bytes: int = 0


@dataclass(frozen=True, slots=True)
class LogSlice:
    """A part of a log as in the answer of `ReadLog`; a mark is (time, offset, pid)."""

    number: int
    numbers: Sequence[int]
    content: bytes
    offset: int
    next_offset: int
    ended: bool
    marks: Sequence[tuple[float, int, int]]


class Host(Protocol):
    """Interface of the slave's runtime for its endpoint."""

    def take(self, event: events.Event) -> None:
        """Handle an event."""

    def statuses(self) -> Sequence[InstanceStatus]:
        """Return the statuses of all instances on this host."""

    def kept_states(self) -> Sequence[KeptState]:
        """Return all snapshots that this host holds."""

    def read_log(self, query: LogQuery) -> LogSlice:
        """Return a part of a log; raises `Refused`."""

    def set_restart(
        self, instance: InstanceId, restart: RestartPolicy, settled: Callable[[str], None]
    ) -> None:
        """Replace the restart policy of an instance.

        Args:
            settled: called in the loop's thread; with "" when the policy is durable, whichever
                process is killed, else with the reason why there is no such instance.
        """

    def execute(
        self, executor: str, arguments: dict[str, Any], timeout: float,
        done: Callable[[str, str, str], None],
    ) -> None:  # fmt: skip
        """Run an executor; `done(code, message, result)` is called in the loop's thread.

        The code is "" after a success. If the executor takes longer than `timeout` seconds, its
        strategy counts as failing.
        """

    def keep(self, instance: InstanceId, hosts: Sequence[str], every: float) -> None:
        """Replicate an instance's snapshot to these hosts from now on, every `every` seconds."""

    def drop_kept(self, instance: InstanceId) -> None:
        """Delete the snapshots of a process, of instances up to this one."""

    def say(self, message: str) -> None:
        """Show a message to the user."""


class SlaveServices:
    """The services of one slave.

    Args:
        participant: offers the services.
        host: carries out the requests.
        name: of the host.
        gate: admits or refuses every order.
        epoch: newest known epoch of the master; older orders are refused.
    """

    def __init__(
        self, participant: Participant, host: Host, name: str, gate: Gate, epoch: Callable[[], int]
    ) -> None:
        self._host = host
        path = names.Names(participant.settings.namespace)
        server = ControlServer(participant, gate, epoch)
        server.offer(srv.ControlHost, path.of_host(name, names.CONTROL), self._take_order)
        participant.serve(srv.ReadLog, path.of_host(name, names.READ_LOG), self._take_log)

    def _take_order(self, request: srv.ControlHost.Request, respond: Callable[[Any], None]) -> None:
        kind = srv.ControlHost.Request
        try:
            if request.action == kind.EXECUTE:
                self._execute(request, respond)
                return
            if request.action == kind.SET_RESTART:
                self._set_restart(request, respond)
                return
            if request.action in (kind.KEEP, kind.DROP_KEPT):
                self._keep_or_drop(request)
            else:
                self._host.take(_ordered(request))
        except Refused as refusal:
            respond(srv.ControlHost.Response(answer=refused(refusal.code, str(refusal))))
            return
        respond(srv.ControlHost.Response(answer=accepted()))

    def _keep_or_drop(self, request: srv.ControlHost.Request) -> None:
        instance = convert.instance_from_msg(request.instance)
        if request.action == request.KEEP:
            self._host.keep(instance, tuple(request.keep_on), request.keep_every)
        else:
            self._host.drop_kept(instance)

    def _set_restart(
        self, request: srv.ControlHost.Request, respond: Callable[[Any], None]
    ) -> None:
        def settled(refusal: str) -> None:
            answer = refused("unknown", refusal) if refusal else accepted()
            respond(srv.ControlHost.Response(answer=answer))

        restart = convert.restart_from_msg(request.restart)
        self._host.set_restart(convert.instance_from_msg(request.instance), restart, settled)

    def _execute(self, request: srv.ControlHost.Request, respond: Callable[[Any], None]) -> None:
        def done(code: str, message: str, result: str) -> None:
            answer = refused(code, message) if code else accepted()
            respond(srv.ControlHost.Response(answer=answer, result=result))

        arguments = convert.json_object(request.arguments, "the arguments of an executor")
        self._host.execute(request.executor, arguments, request.timeout, done)

    def _take_log(self, request: srv.ReadLog.Request, open_request: OpenRequest) -> None:
        fault = version_refusal(request.protocol_version, "a reader of logs")
        if fault:
            open_request.answer(srv.ReadLog.Response(answer=refused("version", fault)))
            return
        try:
            part = self._host.read_log(
                LogQuery(
                    request.process, request.number, request.offset, request.tail, request.since,
                    request.max_bytes,
                )
            )  # fmt: skip
        except Refused as refusal:
            answer = refused(refusal.code, str(refusal))
            open_request.answer(srv.ReadLog.Response(answer=answer))
            return
        open_request.answer(
            srv.ReadLog.Response(
                answer=accepted(), number=part.number, numbers=list(part.numbers),
                content=part.content, offset=part.offset, next_offset=part.next_offset,
                ended=part.ended, mark_times=[mark[0] for mark in part.marks],
                mark_offsets=[mark[1] for mark in part.marks],
                mark_pids=[mark[2] for mark in part.marks],
            )
        )  # fmt: skip


def _ordered(request: srv.ControlHost.Request) -> events.Event:
    """Return the core event of an order; raises `Refused`."""
    kind = srv.ControlHost.Request
    if request.action == kind.START:
        given_at = request.envelope.receiver_beat / 1e9
        return events.AssignmentsReceived(
            (convert.assignment_from_msg(request.assignment),), given_at
        )
    instance = convert.instance_from_msg(request.instance)
    orders: dict[int, events.Event] = {
        kind.STOP: events.StopOrdered(instance),
        kind.FENCE: events.FenceOrdered(instance),
        kind.RESTART: events.RestartOrdered(instance),
        kind.REPORT: events.ReportRequested(),
    }
    if request.action not in orders:
        raise Refused(f"unknown action {request.action}")
    return orders[request.action]
