"""Services of a slave for the master and clients: orders become core events, logs are read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from rosrm.core.slave import reducer as core
from rosrm.core.slave.orders import event_of
from rosrm.errors import Refused
from rosrm.model.orders import DropReplica, ReplicateSnapshot, RunExecutor, SetRestartPolicy
from rosrm.model.values import InstanceId, InstanceStatus, KeptState
from rosrm.ros import names
from rosrm.ros.control import ControlServer, Gate, accepted, refused, version_refusal
from rosrm.ros.orders import order_from_msg
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

    def take(self, event: core.Event) -> None:
        """Handle an event."""

    def statuses(self) -> Sequence[InstanceStatus]:
        """Return the statuses of all instances on this host."""

    def kept_states(self) -> Sequence[KeptState]:
        """Return all snapshots that this host holds."""

    def read_log(self, query: LogQuery) -> LogSlice:
        """Return a part of a log; raises `Refused`."""

    def set_restart(self, order: SetRestartPolicy, settled: Callable[[str], None]) -> None:
        """Replace the restart policy of an instance.

        Args:
            settled: called in the loop's thread; with "" when the policy is durable, whichever
                process is killed, else with the reason why there is no such instance.
        """

    def execute(self, order: RunExecutor, done: Callable[[str, str, str], None]) -> None:
        """Run an executor; `done(code, message, result)` is called in the loop's thread.

        The code is "" after a success. If the executor takes longer than the order allows, its
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
        """Carry out an order; the outcomes of executors and restart policies come later."""
        try:
            order = order_from_msg(request)
            match order:
                case RunExecutor():
                    self._execute(order, respond)
                    return
                case SetRestartPolicy():
                    self._set_restart(order, respond)
                    return
                case ReplicateSnapshot(instance, hosts, every):
                    self._host.keep(instance, hosts, every)
                case DropReplica(instance):
                    self._host.drop_kept(instance)
                case _:
                    self._host.take(event_of(order, request.envelope.receiver_beat / 1e9))
        except Refused as refusal:
            respond(srv.ControlHost.Response(answer=refused(refusal.code, str(refusal))))
            return
        respond(srv.ControlHost.Response(answer=accepted()))

    def _set_restart(self, order: SetRestartPolicy, respond: Callable[[Any], None]) -> None:
        def settled(refusal: str) -> None:
            answer = refused("unknown", refusal) if refusal else accepted()
            respond(srv.ControlHost.Response(answer=answer))

        self._host.set_restart(order, settled)

    def _execute(self, order: RunExecutor, respond: Callable[[Any], None]) -> None:
        def done(code: str, message: str, result: str) -> None:
            answer = refused(code, message) if code else accepted()
            respond(srv.ControlHost.Response(answer=answer, result=result))

        self._host.execute(order, done)

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
