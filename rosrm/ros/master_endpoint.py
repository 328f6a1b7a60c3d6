"""The master's side of the wire: messages become events, commands become messages."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

import numpy as np

from rosrm.config.settings import ControlSettings
from rosrm.core import events as happened
from rosrm.core.commands import Assign, Order, Reply, Withdraw
from rosrm.core.model import Assignment, HostDescription
from rosrm.core.views import Snapshot
from rosrm.errors import Refused
from rosrm.ros import convert, names, qos
from rosrm.ros.control import (
    ControlClient,
    ControlServer,
    Gate,
    accepted,
    refused,
    version_refusal,
)
from rosrm.ros.handoff_endpoint import HandoffEndpoint
from rosrm.ros.participant import OpenRequest, Participant
from rosrm.ros.readings import decode
from rosrm.version import PROTOCOL_VERSION, __version__
from rosrm_msgs import msg, srv

_ACTIONS = {
    "stop": srv.ControlHost.Request.STOP,
    "restart": srv.ControlHost.Request.RESTART,
    "start": srv.ControlHost.Request.START,
    "execute": srv.ControlHost.Request.EXECUTE,
    "report": srv.ControlHost.Request.REPORT,
    "set_restart": srv.ControlHost.Request.SET_RESTART,
}

#: Seconds between two records of the same refusal, and refusals that are told apart.
_REFUSED_EVERY: Final = 10.0
_REFUSED_KEPT: Final = 1000


@dataclass(frozen=True, slots=True)
class Identity:
    """Which master this is."""

    name: str
    hostname: str
    pid: int
    epoch: int
    incarnation: int


class Queries(Protocol):
    """What may be read of the master at any time."""

    def snapshot(self, request: srv.List.Request) -> Snapshot:
        """The listings that were asked for."""

    def explain(self, name: str) -> str | None:
        """The story of a process as JSON; None: there is none of that name."""


@dataclass(frozen=True, slots=True)
class _Unheard:
    """An order for a slave, or a request of one, whose first reading has not come.

    Attributes:
        deadline: monotonic seconds.
        send: carries it out.
        done: called with None when the deadline has passed.
    """

    deadline: float
    send: Callable[[], None]
    done: Callable[[None], None] = lambda _: None


@dataclass(slots=True)
class _HostLink:
    """What the endpoint keeps of one slave.

    Attributes:
        incarnation: of the run that registered last; what a former run says is not heard.
        beat: its newest; 0: none was heard yet, so that it would refuse every order.
        unheard: what waits for its first beat.
    """

    name: str
    control: Any
    incarnation: int
    beat: int = 0
    unheard: list[_Unheard] = field(default_factory=list)
    outbox: list[Assignment] = field(default_factory=list)
    poll: Callable[[Any], None] | None = None
    poll_token: int = 0


class MasterEndpoint:
    """Everything that the master says and hears.

    Attributes:
        events: what happened since the runtime took them last.
        handoffs: what is said and heard of handoffs.
        incarnation: random number of this run of the master.
    """

    def __init__(
        self,
        participant: Participant,
        identity: Identity,
        queries: Queries,
        beat: Callable[[], int],
        control: ControlSettings,
    ) -> None:
        self._participant = participant
        self._identity = identity
        self._queries = queries
        self._beat = beat
        self._order_timeout = control.order_retry
        self._beat_period = control.beat_period
        self.events: list[happened.Event] = []
        self.rival: msg.MasterBeat | None = None
        self.incarnation = identity.incarnation
        self._names = names.Names(participant.settings.namespace)
        self._links: dict[int, _HostLink] = {}
        self._open: dict[int, Callable[[Reply], None]] = {}
        self._next_request = 1
        self._refused: dict[tuple[str, str], float] = {}
        self._client = ControlClient(participant, f"master {identity.name}")
        self._server = ControlServer(participant, Gate(beat, control.max_age))
        self.handoffs = HandoffEndpoint(
            participant, identity.name, identity.epoch, self._take_event, self._refuse_peer
        )
        self._subscribe()
        self._offer()

    # --- what is heard -------------------------------------------------------------------

    def _subscribe(self) -> None:
        node, path = self._participant.node, self._names
        # Readings come by the thousand: they are taken raw, in batches, past the executor.
        intake = self._participant.unwatched_node(f"{node.get_name()}_intake")
        self._readings = intake.create_subscription(
            msg.ResourceInfo, path(names.RESOURCE_INFO), _never_called, qos.READINGS, raw=True
        )
        for kind, topic, take in (
            (msg.ProcessStatusBatch, names.PROCESS_STATUS, self._take_statuses),
            (msg.ProcessUsage, names.PROCESS_USAGE, self._take_usage),
        ):
            node.create_subscription(
                kind, path(topic), self._participant.counted(take), qos.STATUSES
            )
        node.create_subscription(
            msg.MasterBeat, path(names.MASTER_BEAT),
            self._participant.counted(self._take_beat), qos.BEAT,
        )  # fmt: skip
        self._beats = node.create_publisher(msg.MasterBeat, path(names.MASTER_BEAT), qos.BEAT)

    def _take_event(self, event: happened.Event) -> None:
        self.events.append(event)

    def poll_readings(self) -> None:
        """Take all readings that have come."""
        handle, kind = self._readings.handle, self._readings.msg_type
        taken = []
        with handle:
            while (message := handle.take_message(kind, True)) is not None:
                taken.append(bytes(message[0]))
        if not taken:
            return
        batch = decode(taken)
        for (host_id, incarnation), beat in batch.beats.items():
            link = self._link(host_id, incarnation)
            if link is not None:
                link.beat = beat
                if link.unheard:
                    self._send_unheard(link)
        for stranger in batch.strangers:
            self._refuse_peer("resource_info", stranger)
        if batch.readings is not None:
            # Before all else: a usage must not be judged by readings that are older than it.
            self.events.insert(0, batch.readings)

    def _send_unheard(self, link: _HostLink) -> None:
        waiting, link.unheard = link.unheard, []
        for order in waiting:
            order.send()

    def _link(self, host_id: int, incarnation: int) -> _HostLink | None:
        """The link of a host, if this is the run of it that registered last."""
        link = self._links.get(host_id)
        return link if link is not None and link.incarnation == incarnation else None

    def _refuse_peer(self, who: str, reason: str) -> None:
        """Record it, but not ten times a second."""
        now = time.monotonic()
        if now - self._refused.get((who, reason), -_REFUSED_EVERY) < _REFUSED_EVERY:
            return
        if len(self._refused) >= _REFUSED_KEPT:
            self._refused.clear()
        self._refused[who, reason] = now
        self.events.append(happened.PeerRefused(who, reason))

    def _take_statuses(self, message: msg.ProcessStatusBatch) -> None:
        who = f"process_status of host {message.host_id}"
        fault = version_refusal(message.protocol_version, who)
        if fault:
            self._refuse_peer(who, fault)
            return
        try:
            statuses = tuple(convert.status_from_msg(status) for status in message.statuses)
        except Refused as refusal:
            self._refuse_peer(who, str(refusal))
            return
        self.events.append(
            happened.StatusesReceived(
                message.host_id, message.incarnation, message.sequence, message.complete, statuses
            )
        )

    def _take_usage(self, message: msg.ProcessUsage) -> None:
        sizes = {len(message.numbers), len(message.cpu), len(message.memory)}
        who = f"process_usage of host {message.host_id}"
        fault = version_refusal(message.protocol_version, who)
        if fault or len(sizes) > 1:
            self._refuse_peer(who, fault or "arrays of different lengths")
            return
        self.events.append(
            happened.UsagesReceived(
                message.host_id, message.incarnation, np.asarray(message.numbers, np.uint64),
                np.asarray(message.cpu, np.float64), np.asarray(message.memory, np.float64),
            )
        )  # fmt: skip

    def _take_beat(self, message: msg.MasterBeat) -> None:
        if message.incarnation != self._identity.incarnation:
            self.rival = message

    # --- what is asked -------------------------------------------------------------------

    def _offer(self) -> None:
        self._participant.serve(srv.List, self._names(names.LIST), self._take_list)
        self._participant.serve(srv.Explain, self._names(names.EXPLAIN), self._take_explain)
        self._server.offer(
            srv.RequestProcess, self._names(names.REQUEST_PROCESS), self._take_poll, remember=False
        )
        self._server.offer(
            srv.RegisterHost, self._names(names.REGISTER_HOST), self._take_registration
        )
        for kind, name, event in (
            (srv.Leave, names.LEAVE, self._left),
            (srv.Submit, names.SUBMIT, self._submitted),
            (srv.Cancel, names.CANCEL, self._cancelled),
            (srv.Restart, names.RESTART, self._restarted),
            (srv.Migrate, names.MIGRATE, self._migrated),
            (srv.SetHostState, names.SET_HOST_STATE, self._host_set),
        ):
            self._server.offer(kind, self._names(name), self._as_event(kind, event))
        # Last, as DDS tells of them in this order: who can shake hands can ask for all the others.
        self._participant.serve(srv.Handshake, self._names(names.HANDSHAKE), self._take_handshake)

    def _as_event(
        self, kind: Any, make: Callable[[Any, int], happened.Event]
    ) -> Callable[[Any, Callable[[Any], None]], None]:
        """A handler that turns a request into an event and keeps the way to answer it."""

        def take(request: Any, respond: Callable[[Any], None]) -> None:
            token = self._new_token()
            try:
                event = make(request, token)
            except Refused as refusal:
                respond(kind.Response(answer=refused(refusal.code, str(refusal))))
                return
            self._open[token] = lambda reply: respond(self._response(kind, reply))
            self.events.append(event)

        return take

    def _new_token(self) -> int:
        self._next_request += 1
        return self._next_request - 1

    def _response(self, kind: Any, reply: Reply) -> Any:
        epoch = self._identity.epoch
        answer = (
            accepted(reply.message, epoch)
            if reply.accepted
            else refused(reply.code, reply.message, epoch)
        )
        response = kind.Response(answer=answer)
        if kind is srv.Migrate:
            response.host = reply.host
        return response

    def _take_registration(
        self, request: srv.RegisterHost.Request, respond: Callable[[Any], None]
    ) -> None:
        try:
            description = convert.host_from_msg(request.host)
            statuses = tuple(convert.status_from_msg(status) for status in request.instances)
        except Refused as refusal:
            respond(srv.RegisterHost.Response(answer=refused(refusal.code, str(refusal))))
            return

        def answer(reply: Reply) -> None:
            response = self._response(srv.RegisterHost, reply)
            if reply.accepted:
                response.host_id, response.beat_period = reply.host_id, self._beat_period
                self._renew_link(reply.host_id, description)
            respond(response)

        token = self._new_token()
        self._open[token] = answer
        self.events.append(happened.HostRegistered(token, description, statuses))

    def _left(self, request: srv.Leave.Request, token: int) -> happened.Event:
        link = self._link(request.host_id, request.incarnation)
        if link is not None:
            self._close_poll(link)
        return happened.HostLeft(token, request.host_id, request.incarnation)

    def _submitted(self, request: srv.Submit.Request, token: int) -> happened.Event:
        specs = tuple(convert.spec_from_msg(spec) for spec in request.processes)
        return happened.SubmissionReceived(token, specs)

    def _cancelled(self, request: srv.Cancel.Request, token: int) -> happened.Event:
        return happened.CancelRequested(token, tuple(request.processes))

    def _restarted(self, request: srv.Restart.Request, token: int) -> happened.Event:
        return happened.RestartRequested(token, tuple(request.processes))

    def _migrated(self, request: srv.Migrate.Request, token: int) -> happened.Event:
        return happened.MigrationRequested(token, request.process, request.host or None)

    def _host_set(self, request: srv.SetHostState.Request, token: int) -> happened.Event:
        return happened.HostStateRequested(token, request.host, request.action)

    def _take_handshake(self, request: srv.Handshake.Request, open_request: OpenRequest) -> None:
        who = f"{request.role} {request.name}"
        fault = version_refusal(request.protocol_version, who)
        if fault:
            self._refuse_peer(who, fault)
        open_request.answer(
            srv.Handshake.Response(
                protocol_version=PROTOCOL_VERSION, software_version=__version__,
                accepted=not fault, message=fault, master=self._identity.name,
                hostname=self._identity.hostname, pid=self._identity.pid,
                epoch=self._identity.epoch, beat=self._beat(),
            )
        )  # fmt: skip

    def _take_list(self, request: srv.List.Request, open_request: OpenRequest) -> None:
        fault = version_refusal(request.protocol_version, "a listing")
        if fault:
            open_request.answer(srv.List.Response(answer=refused("version", fault)))
            return
        view = self._queries.snapshot(request)
        open_request.answer(
            srv.List.Response(
                answer=accepted(epoch=self._identity.epoch), master=view.master,
                uptime=view.uptime, last_sequence=view.last_sequence,
                host_list=[convert.host_row_to_msg(row) for row in view.hosts],
                process_list=[convert.process_row_to_msg(row) for row in view.processes],
                plugin_list=[convert.plugin_row_to_msg(row) for row in view.plugins],
                event_list=[convert.event_to_msg(row) for row in view.events],
            )
        )  # fmt: skip

    def _take_explain(self, request: srv.Explain.Request, open_request: OpenRequest) -> None:
        fault = version_refusal(request.protocol_version, "explain")
        text = None if fault else self._queries.explain(request.process)
        if text is None:
            reason = fault or f"no such process: {request.process}; see `rosrm ps`"
            answer = refused("version" if fault else "unknown", reason)
            open_request.answer(srv.Explain.Response(answer=answer))
            return
        open_request.answer(srv.Explain.Response(answer=accepted(), explanation=text))

    # --- long polls ----------------------------------------------------------------------

    def _take_poll(
        self, request: srv.RequestProcess.Request, respond: Callable[[Any], None]
    ) -> None:
        link = self._link(request.host_id, request.incarnation)
        if link is None:
            answer = refused("unknown", "register first", self._identity.epoch)
            respond(srv.RequestProcess.Response(answer=answer))
            return
        if not link.beat:  # its limits are not known yet, and so not what it may be given
            link.unheard.append(_Unheard(math.inf, lambda: self._open_poll(link, request, respond)))
            return
        self._open_poll(link, request, respond)

    def _open_poll(
        self,
        link: _HostLink,
        request: srv.RequestProcess.Request,
        respond: Callable[[Any], None],
    ) -> None:
        token = self._new_token()
        self._close_poll(link)  # a newer request replaces one whose answer can reach nobody
        link.poll, link.poll_token = respond, token

        def turn_away(reply: Reply) -> None:
            self._close_poll(link)
            respond(self._response(srv.RequestProcess, reply))

        self._open[token] = turn_away
        self.events.append(happened.ProcessRequested(token, request.host_id, request.incarnation))

    def _close_poll(self, link: _HostLink) -> None:
        self._open.pop(link.poll_token, None)
        link.poll, link.poll_token = None, 0

    def flush(self) -> None:
        """Answer the open requests of hosts for which there are assignments."""
        for link in self._links.values():
            if link.outbox and link.poll is not None:
                respond = link.poll
                self._close_poll(link)
                batch, link.outbox = link.outbox, []
                respond(
                    srv.RequestProcess.Response(
                        answer=accepted(epoch=self._identity.epoch),
                        assignments=[convert.assignment_to_msg(one) for one in batch],
                    )
                )

    # --- commands ------------------------------------------------------------------------

    def assign(self, command: Assign) -> None:
        """Keep an assignment for the answer to the host's request."""
        self._links[command.host_id].outbox.append(command.assignment)

    def withdraw(self, command: Withdraw, now: float) -> None:
        """Take an assignment back, or order its end."""
        link = self._links.get(command.host_id)
        waiting = link.outbox if link is not None else []
        kept = [one for one in waiting if one.instance != command.instance]
        if link is not None and len(kept) < len(waiting):
            link.outbox = kept
            self.events.append(happened.AssignmentWithdrawn(command.instance))
            return
        self.order(Order(command.order, command.host_id, "stop", command.instance), now)

    def reply(self, command: Reply) -> None:
        """Answer a request."""
        answer = self._open.pop(command.request, None)
        if answer is not None:
            answer(command)

    def _renew_link(self, host_id: int, description: HostDescription) -> None:
        """A slave registered: what waited for its former run is void."""
        link = self._links.get(host_id)
        if link is None:
            path = self._names.of_host(description.name, names.CONTROL)
            control = self._participant.node.create_client(
                srv.ControlHost, path, qos_profile=qos.SERVICE
            )
            link = self._links[host_id] = _HostLink(description.name, control, 0)
        self._close_poll(link)
        if link.incarnation == description.incarnation:
            return  # the same run once more: what it has not fetched is still meant for it
        link.incarnation, link.beat = description.incarnation, 0
        link.outbox.clear()
        waiting, link.unheard = link.unheard, []
        for order in waiting:
            order.done(None)

    def order(self, command: Order, now: float) -> None:
        """Ask a slave for something; the answer, or none in time, comes back as an event."""
        link = self._links.get(command.host_id)
        if link is None:  # expected from the journal, not heard yet
            self.events.append(
                happened.OrderAnswered(command.order, False, "timeout", "the host is not heard")
            )
            return
        request = srv.ControlHost.Request(
            action=_ACTIONS[command.action], executor=command.executor,
            timeout=float(command.timeout),
        )  # fmt: skip
        if command.instance is not None:
            request.instance = convert.instance_to_msg(command.instance)
        if command.assignment is not None:
            request.assignment = convert.assignment_to_msg(command.assignment)
        if command.restart is not None:
            request.restart = convert.restart_to_msg(command.restart)
        if command.executor:
            request.arguments = json.dumps(dict(command.arguments))

        def done(response: srv.ControlHost.Response | None) -> None:
            self.events.append(_order_answered(command.order, response))

        deadline = now + command.timeout + self._order_timeout

        def send() -> None:
            request.envelope = self._client.envelope(link.beat, self._identity.epoch)
            self._client.call(link.control, request, deadline, done)

        if link.beat:
            send()
        else:
            link.unheard.append(_Unheard(deadline, send, done))

    # --- with time -----------------------------------------------------------------------

    def expire(self, now: float) -> None:
        """End what was not answered in time."""
        self._client.expire(now)
        for link in self._links.values():
            if link.unheard:
                late = [order for order in link.unheard if now >= order.deadline]
                link.unheard = [order for order in link.unheard if now < order.deadline]
                for order in late:
                    order.done(None)

    def beat(self, uptime: float) -> None:
        """Say that the master lives."""
        identity = self._identity
        self._beats.publish(
            msg.MasterBeat(
                protocol_version=PROTOCOL_VERSION, name=identity.name, hostname=identity.hostname,
                pid=identity.pid, epoch=identity.epoch, incarnation=identity.incarnation,
                beat=self._beat(), uptime=uptime,
            )
        )  # fmt: skip

    def take_events(self) -> list[happened.Event]:
        """What happened since the last call, in order."""
        events, self.events = self.events, []
        return events


def _never_called(_message: object) -> None:
    raise AssertionError("readings are polled, never called back")


def _order_answered(order: int, response: srv.ControlHost.Response | None) -> happened.Event:
    if response is None:
        return happened.OrderAnswered(order, False, "timeout", "no answer in time")
    answer = response.answer
    fault = version_refusal(answer.protocol_version, "a slave")
    if fault:
        return happened.OrderAnswered(order, False, "version", fault)
    result = convert.json_object(response.result, "a result") if response.result else None
    return happened.OrderAnswered(order, answer.accepted, answer.code, answer.message, result)
