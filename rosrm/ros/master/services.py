"""Master services for slaves and clients: requests become events, replies become answers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, Protocol

from rosrm import clocks
from rosrm.config.settings import ControlSettings
from rosrm.core.master import events as happened
from rosrm.core.master.commands import Reply
from rosrm.errors import JournalError, Refused
from rosrm.keys.roles import Principal, Role
from rosrm.keys.security import Authority, Peer
from rosrm.keys.tickets import TICKET_LIFE, Ticket
from rosrm.model.applications import Target
from rosrm.model.codec import to_plain
from rosrm.model.requester import Requester
from rosrm.model.rows import Listing
from rosrm.model.traced_values import stamped_spec
from rosrm.model.values import ProcessSpec
from rosrm.ros import convert, names
from rosrm.ros.bounds import fitted
from rosrm.ros.control import (
    ControlServer,
    Handle,
    accepted,
    refused,
    version_refusal,
)
from rosrm.ros.introductions import ticket_version
from rosrm.ros.master.known_specs import KnownSpecs
from rosrm.ros.master.reads import FairReads
from rosrm.ros.master.refusals import Refuse
from rosrm.ros.master.slave_links import HostLink, HostLinks
from rosrm.ros.sealed import SealedEndpoints, SealedRequest, failed_response
from rosrm.ros.spec_digests import UNKNOWN_DIGEST, digest_of, positions_to_text
from rosrm.runtime.local_zone import local_zone
from rosrm.version import PROTOCOL_VERSION, __version__
from rosrm.wording import sanitized
from rosrm_msgs import srv

_Respond = Callable[[Any], None]

#: Most letters of the name of a client or peer in records.
_LONGEST_PEER: Final = 200
#: Most held handshakes of clients and masters; more are dropped, because senders repeat them.
_MOST_HELD: Final = 2000
#: Seconds for which an introduction to a newly registered slave waits for its first reading.
_FIRST_READING: Final = 1.0


@dataclass(frozen=True, slots=True)
class MasterIdentity:
    """Identity of this master."""

    name: str
    hostname: str
    pid: int
    epoch: int
    incarnation: int

    @property
    def as_client(self) -> str:
        """Name under which this master asks another one for a handshake."""
        return f"{self.name} {self.incarnation}"


class Queries(Protocol):
    """Interface of the master for read-only requests."""

    def snapshot(self, request: srv.List.Request, by: Requester) -> Listing:
        """Return the requested listings, as far as the requester may read them."""

    def explain(self, name: str, by: Requester) -> str | None:
        """Return the explanation of a process as JSON; None: there is no process of that name."""

    def host_of(self, process: str, number: int) -> str | None:
        """Return the host of an instance; None: there is no such instance."""

    def first_readable_log(self, process: str, by: Requester) -> int | None:
        """Return the lowest number of an instance whose log a user may read; None: it may not."""

    def has_held(self, process: str, host: str) -> bool:
        """Return True if an instance of a process runs on a host, or ended there last."""

    def number_of(self, host: str) -> int | None:
        """Return the number of a host; None: there is no host of that name."""

    def has_artifact(self, digest: str, size: int, /) -> bool:
        """Return True if the contents with a digest and a size are stored."""


class MasterServices:
    """All services of the master; requests become events for `handle`.

    Args:
        control: greatest age of a request, and the beat period for slaves.
        refuse: receives refused peers, and reasons.
        strangers: returns a sentence about messages without a valid key.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Authority], links: HostLinks, identity: MasterIdentity,
        queries: Queries,
        *, control: ControlSettings,
        handle: Callable[[happened.Event], None], refuse: Refuse, strangers: Callable[[], str],
    ) -> None:  # fmt: skip
        self._endpoints = endpoints
        self._server = ControlServer(endpoints, control.max_age)
        self._identity = identity
        self._queries = queries
        self._beat_period = control.beat_period
        self._links = links
        self._handle = handle
        self._refuse = refuse
        self._strangers = strangers
        self._known = KnownSpecs()
        self._reads = FairReads(endpoints.participant.post)
        self._open: dict[int, Callable[[Reply], None]] = {}
        self._next_request = 1
        self._held: list[tuple[srv.Handshake.Request, SealedRequest]] | None = None
        self._offer(names.Names(endpoints.participant.settings.namespace))

    def _offer(self, path: names.Names) -> None:
        serve, offer = self._endpoints.serve, self._server.offer
        serve(srv.List, path(names.LIST), self._in_turn(srv.List, self._take_list))
        serve(srv.Explain, path(names.EXPLAIN), self._in_turn(srv.Explain, self._take_explain))
        serve(srv.Introduce, path(names.INTRODUCE), self._take_introduction)
        offer(srv.RequestProcess, path(names.REQUEST_PROCESS), self._take_poll, remember=False)
        offer(srv.RegisterHost, path(names.REGISTER_HOST), self._take_registration)
        for kind, name, event in (
            (srv.Leave, names.LEAVE, self._left),
            (srv.Submit, names.SUBMIT, self._submitted),
            (srv.Apply, names.APPLY, self._applied),
            (srv.LoadModes, names.LOAD_MODES, self._modes_loaded),
            (srv.SwitchMode, names.SWITCH_MODE, _mode_requested),
            (srv.Cancel, names.CANCEL, _cancelled),
            (srv.Cancel, names.KILL, _killed),
            (srv.Restart, names.RESTART, _restarted),
            (srv.Migrate, names.MIGRATE, _migrated),
            (srv.Checkpoint, names.CHECKPOINT, _checkpointed),
            (srv.Restore, names.RESTORE, _restored),
            (srv.SetHostState, names.SET_HOST_STATE, _host_set),
            (srv.Prune, names.PRUNE, _pruned),
            (srv.Rebalance, names.REBALANCE, _rebalanced),
            (srv.Reload, names.RELOAD, _reloaded),
        ):
            offer(kind, path(name), self._as_event(kind, event))
        # Offered last, and DDS announces in this order: after a handshake all others are usable.
        serve(srv.Handshake, path(names.HANDSHAKE), self._take_handshake, first_contact=True)

    # --- answers -------------------------------------------------------------------------

    def reply(self, command: Reply) -> None:
        """Answer a request, if it is still open."""
        answer = self._open.pop(command.request, None)
        if answer is not None:
            self._endpoints.participant.guard.call(answer, command)

    def _keep(self, answer: Callable[[Reply], None]) -> int:
        """Store the means to answer a request; return the request's number."""
        token = self._next_request
        self._next_request += 1
        self._open[token] = answer
        return token

    def _as_event(self, kind: Any, make: Callable[[Any, int, Peer], happened.Event]) -> Handle:
        """Return a handler that turns a request into an event and stores the means to answer it."""

        def take(request: Any, sealed: SealedRequest, respond: _Respond) -> None:
            token = self._keep(lambda reply: respond(self._response(kind, reply)))
            try:
                event = make(request, token, sealed.peer)
            except Refused as refusal:
                del self._open[token]
                respond(kind.Response(answer=refused(refusal.code, str(refusal))))
                return
            self._handle(event)

        return take

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
        elif kind in (srv.Apply, srv.SwitchMode):
            response.actions = json.dumps(to_plain(reply.actions))
        return response

    def _submitted(self, request: srv.Submit.Request, token: int, peer: Peer) -> happened.Event:
        received = clocks.wall_time_ns()
        specs = self._specs(request.processes)
        specs = tuple(stamped_spec(spec, master_received=received) for spec in specs)
        return happened.SubmissionReceived(token, specs, _requester(peer))

    def _applied(self, request: srv.Apply.Request, token: int, peer: Peer) -> happened.Event:
        by = _requester(peer)
        digests = [one.digest.split() for one in request.targets]
        self._refuse_unknown(request.targets, digests, by.name)
        specs = [
            self._specs_of(one, known, by.name)
            for one, known in zip(request.targets, digests, strict=True)
        ]
        for known, found in zip(digests, specs, strict=True):
            self._known.keep(by, known, found)
        targets = tuple(map(convert.target_from_msg, request.targets, specs))
        return happened.ApplicationsRequested(token, targets, bool(request.plan_only), by)

    def _modes_loaded(
        self, request: srv.LoadModes.Request, token: int, peer: Peer
    ) -> happened.Event:
        found = [convert.mode_from_msg(one, self._targets(one.targets)) for one in request.modes]
        modes = tuple(replace(mode, digest=digest_of(mode)) for mode in found)
        return happened.ModesLoaded(token, modes, _requester(peer))

    def _refuse_unknown(
        self, targets: Sequence[Any], digests: Sequence[Sequence[str]], user: str
    ) -> None:
        """Refuse targets that name processes of which this master has no specs."""
        lacking = [self._known.lacking(user, named) for named in digests]
        for one, named, unknown in zip(targets, digests, lacking, strict=True):
            if named and len(one.processes) not in (len(unknown), len(named)):
                raise Refused(positions_to_text(lacking), UNKNOWN_DIGEST)

    def _specs_of(self, target: Any, digests: Sequence[str], user: str) -> tuple[ProcessSpec, ...]:
        """Return the specs of a target of a request; it may name known ones by their digests."""
        sent = tuple(map(convert.spec_from_msg, target.processes))
        return self._checked(self._known.completed(user, digests, sent) if digests else sent)

    def _targets(self, messages: Iterable[Any]) -> tuple[Target, ...]:
        return tuple(convert.target_from_msg(one, self._specs(one.processes)) for one in messages)

    def _specs(self, messages: Iterable[Any]) -> tuple[ProcessSpec, ...]:
        return self._checked(tuple(convert.spec_from_msg(message) for message in messages))

    def _checked(self, specs: tuple[ProcessSpec, ...]) -> tuple[ProcessSpec, ...]:
        """Return the specs of a request, whose artifacts are stored; raises `Refused`."""
        for spec in specs:
            for one in spec.artifacts:
                if not self._queries.has_artifact(one.digest, one.size):
                    raise Refused(
                        f"process {spec.name!r}: the master does not have the contents of artifact "
                        f"{one.name!r}; nothing was queued: submit again",
                        "unknown",
                    )
        if any(spec.schedule.at for spec in specs):
            # Here, because the core knows no machine, and a replay on another one gives the same
            # runs.
            zone = local_zone()
            specs = tuple(replace(spec, schedule=spec.schedule.in_zone(zone)) for spec in specs)
        return specs

    # --- slaves --------------------------------------------------------------------------

    def _take_handshake(self, request: srv.Handshake.Request, open_request: SealedRequest) -> None:
        if request.role == "master" and request.name == self._identity.as_client:
            return
        if self._held is not None and request.role != "slave":
            if len(self._held) < _MOST_HELD:
                self._held.append((request, open_request))
            return
        who = sanitized(f"{request.role} {request.name}", _LONGEST_PEER)
        fault = version_refusal(request.protocol_version, who)
        if fault:
            self._refuse("handshake", who, fault)
        open_request.answer(
            srv.Handshake.Response(
                protocol_version=PROTOCOL_VERSION, software_version=__version__,
                accepted=not fault, message=fault, master=self._identity.name,
                hostname=self._identity.hostname, pid=self._identity.pid,
                epoch=self._identity.epoch, beat=clocks.boot_time_ns(),
            )
        )  # fmt: skip

    def hold_handshakes(self) -> None:
        """Leave the handshakes of clients and other masters open until `answer_held_handshakes`."""
        self._held = []

    def answer_held_handshakes(self) -> None:
        """Answer the held handshakes; answer later ones at once."""
        held, self._held = self._held or [], None
        for request, open_request in held:
            self._endpoints.participant.guard.call(self._take_handshake, request, open_request)

    def _take_registration(
        self, request: srv.RegisterHost.Request, sealed: SealedRequest, respond: _Respond
    ) -> None:
        slave, run = sealed.peer, sealed.run
        try:
            description = convert.host_from_msg(request.host)
            _check_name(slave, description.name)
            statuses = tuple(convert.status_from_msg(status) for status in request.instances)
            snapshots = tuple(convert.snapshot_from_msg(state) for state in request.snapshots)
        except Refused as refusal:
            respond(srv.RegisterHost.Response(answer=refused(refusal.code, str(refusal))))
            return

        def answer(reply: Reply) -> None:
            response = self._response(srv.RegisterHost, reply)
            if reply.accepted:
                response.host_id, response.beat_period = reply.host_id, self._beat_period
                self._links.renew(reply.host_id, description, slave, run)
            respond(response)

        token, seen = self._keep(answer), int(request.journal_seen)
        self._handle(happened.HostRegistered(token, description, statuses, seen, snapshots))

    def _left(self, request: srv.Leave.Request, token: int, slave: Peer) -> happened.Event:
        running = tuple(convert.status_from_msg(status) for status in request.left_running)
        link = self._links.find(request.host_id, request.incarnation, slave)
        if link is None:
            raise Refused("register first", "unknown")
        self._links.left(link)
        return happened.HostLeft(token, request.host_id, request.incarnation, running)

    def _take_poll(
        self, request: srv.RequestProcess.Request, sealed: SealedRequest, respond: _Respond
    ) -> None:
        link = self._links.find(request.host_id, request.incarnation, sealed.peer)
        if link is None:
            answer = refused("unknown", "register first", self._identity.epoch)
            respond(srv.RequestProcess.Response(answer=answer))
            return
        # Before its first reading the slave's limits, and so its possible load, are not known.
        self._links.after_first_reading(link, lambda: self._open_poll(link, request, respond))

    def _open_poll(
        self, link: HostLink, request: srv.RequestProcess.Request, respond: _Respond
    ) -> None:
        def turn_away(reply: Reply) -> None:
            link.close_poll()
            respond(self._response(srv.RequestProcess, reply))

        token = self._keep(turn_away)
        self._links.open_poll(link, respond, lambda: self._drop(token))
        self._handle(happened.ProcessRequested(token, request.host_id, request.incarnation))

    def _drop(self, token: int) -> None:
        self._open.pop(token, None)

    # --- introductions -------------------------------------------------------------------

    def _take_introduction(
        self, request: srv.Introduce.Request, open_request: SealedRequest
    ) -> None:
        def refuse(refusal: Refused) -> None:
            answer = refused(refusal.code, str(refusal))
            open_request.answer(srv.Introduce.Response(answer=answer))

        sender = open_request.peer
        silent = Refused(f"the slave of {request.host} does not report to the master", "silent")
        try:
            first = self._permitted_from(request, sender)
        except Refused as refusal:
            refuse(refusal)
            return
        number = self._queries.number_of(request.host)
        link = None if number is None else self._links.registered(number)
        if link is None:
            refuse(silent)
            return
        # The expiry of the ticket needs the slave's clock, which is in the first reading.
        self._links.introduce_after_first_reading(
            link, lambda: open_request.answer(self._introduction(request, sender, link, first)),
            clocks.boot_time() + _FIRST_READING, lambda _: refuse(silent),
        )  # fmt: skip

    def _introduction(
        self, request: srv.Introduce.Request, sender: Peer, link: HostLink, first: int
    ) -> srv.Introduce.Response:
        """Return a ticket for one service of one slave."""
        if link.slave is None:
            raise Refused(f"the key of host:{request.host} was revoked", "denied")
        until = int(self._links.reading_stats.beat[link.host_id]) + int(TICKET_LIFE * 1e9)
        security, whom = self._endpoints.security, sender.grant.principal
        version = ticket_version(self._identity.epoch, security)
        ticket = Ticket(until, version, request.service, first, request.process, whom)
        key = security.introduction(link.slave.peer, ticket)
        return srv.Introduce.Response(
            answer=accepted(epoch=self._identity.epoch), ticket=ticket.text(), key=key,
            run=link.slave.run,
        )  # fmt: skip

    def _permitted_from(self, request: srv.Introduce.Request, sender: Peer) -> int:
        """Return the lowest number of an instance for which the sender may get a ticket.

        Raises:
            Refused: the sender may get none.
        """
        fault = version_refusal(request.protocol_version, "a request for a ticket")
        if fault:
            raise Refused(fault, "version")
        process, who = request.process, sender.grant.principal
        if sender.grant.role is Role.HOST:
            is_allowed = request.service in (names.STORE_REPLICA, names.READ_SNAPSHOT)
            if not is_allowed or not self._queries.has_held(process, who.name):
                raise Refused(f"{who} has no instance of {process!r}", "denied")
            return 0
        if request.service != names.READ_LOG:
            raise Refused(f"users get no ticket for {request.service!r}", "denied")
        first = self._queries.first_readable_log(process, _requester(sender))
        if first is None:
            raise Refused(
                f"the logs of {process!r} are for its owner and operators, and {who} is neither: "
                f"ask one of them",
                "denied",
            )
        return first

    # --- read-only requests --------------------------------------------------------------

    def _in_turn(
        self, kind: Any, take: Callable[[Any, SealedRequest], None]
    ) -> Callable[[Any, SealedRequest], None]:
        """Return a handler that answers a request when it is the turn of its sender."""
        guard = self._endpoints.participant.guard

        def answer(request: Any, open_request: SealedRequest) -> None:
            fault = guard.call(take, request, open_request)
            if fault and not open_request.answered:
                open_request.answer(failed_response(kind, fault))

        def queue(request: Any, open_request: SealedRequest) -> None:
            sender = _requester(open_request.peer)
            self._reads.add(sender, partial(answer, request, open_request))

        return queue

    def _take_list(self, request: srv.List.Request, open_request: SealedRequest) -> None:
        fault = version_refusal(request.protocol_version, "a listing")
        if fault:
            open_request.answer(srv.List.Response(answer=refused("version", fault)))
            return
        try:
            view = self._queries.snapshot(request, _requester(open_request.peer))
        except JournalError as trouble:
            open_request.answer(srv.List.Response(answer=refused("journal", str(trouble))))
            return
        open_request.answer(
            srv.List.Response(
                answer=accepted(epoch=self._identity.epoch), master=view.master,
                uptime=view.uptime, last_sequence=view.last_sequence, trouble=view.trouble,
                security=self._endpoints.security.described, strangers=self._strangers(),
                host_list=[fitted(convert.host_row_to_msg(row)) for row in view.hosts],
                process_list=[fitted(convert.process_row_to_msg(row)) for row in view.processes],
                plugin_list=[fitted(convert.plugin_row_to_msg(row)) for row in view.plugins],
                application_list=json.dumps(to_plain(tuple(view.applications))),
                mode_list=json.dumps(to_plain(tuple(view.modes))),
                event_list=[fitted(convert.event_to_msg(row)) for row in view.events],
            )
        )  # fmt: skip

    def _take_explain(self, request: srv.Explain.Request, open_request: SealedRequest) -> None:
        fault = version_refusal(request.protocol_version, "explain")
        by = _requester(open_request.peer)
        text = None if fault else self._queries.explain(request.process, by)
        if text is None:
            reason = fault or f"no such process: {request.process}; see `rosrm ps`"
            answer = refused("version" if fault else "unknown", reason)
            open_request.answer(srv.Explain.Response(answer=answer))
            return
        open_request.answer(srv.Explain.Response(answer=accepted(), explanation=text))


def _check_name(slave: Peer, name: str) -> None:
    """Raise `Refused` for a slave that registers under the name of another host."""
    own = slave.grant.principal
    if own != Principal("host", name):
        raise Refused(
            f"{own} may not register as {name!r}: a slave registers only the host of its key",
            "denied",
        )


def _mode_requested(request: srv.SwitchMode.Request, token: int, peer: Peer) -> happened.Event:
    return happened.ModeRequested(token, request.mode, bool(request.plan_only), _requester(peer))


def _cancelled(request: srv.Cancel.Request, token: int, peer: Peer) -> happened.Event:
    return happened.CancelRequested(token, tuple(request.processes), _requester(peer))


def _killed(request: srv.Cancel.Request, token: int, peer: Peer) -> happened.Event:
    names = tuple(request.processes)
    return happened.CancelRequested(token, names, _requester(peer), at_once=True)


def _restarted(request: srv.Restart.Request, token: int, peer: Peer) -> happened.Event:
    return happened.RestartRequested(token, tuple(request.processes), _requester(peer))


def _migrated(request: srv.Migrate.Request, token: int, peer: Peer) -> happened.Event:
    host = request.host or None
    return happened.MigrationRequested(token, request.process, host, _requester(peer))


def _checkpointed(request: srv.Checkpoint.Request, token: int, peer: Peer) -> happened.Event:
    return happened.CheckpointRequested(token, request.process, _requester(peer))


def _restored(request: srv.Restore.Request, token: int, peer: Peer) -> happened.Event:
    return happened.RestoreRequested(token, request.process, _requester(peer))


def _host_set(request: srv.SetHostState.Request, token: int, peer: Peer) -> happened.Event:
    return happened.HostStateRequested(token, request.host, request.action, _requester(peer))


def _pruned(request: srv.Prune.Request, token: int, peer: Peer) -> happened.Event:
    names, hosts = tuple(request.processes), tuple(request.hosts)
    return happened.PruneRequested(token, names, hosts, _requester(peer))


def _rebalanced(request: srv.Rebalance.Request, token: int, peer: Peer) -> happened.Event:
    return happened.RebalanceRequested(token, bool(request.plan_only), _requester(peer))


def _reloaded(_request: srv.Reload.Request, token: int, peer: Peer) -> happened.Event:
    return happened.ReloadRequested(token, _requester(peer))


def _requester(peer: Peer) -> Requester:
    """Return the requester of a request."""
    return Requester(str(peer.grant.principal), is_operator=peer.grant.role is Role.OPERATOR)
