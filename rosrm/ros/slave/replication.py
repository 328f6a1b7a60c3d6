"""Snapshot replication between slaves: two services of each, and clients for those of others."""

from __future__ import annotations

import logging
import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple, Protocol

from rosrm.errors import Refused
from rosrm.keys.security import Member
from rosrm.ros import names
from rosrm.ros.control import ControlClient, accepted, refused, version_refusal
from rosrm.ros.introductions import Introduction, introduction_of, introduction_request
from rosrm.ros.sealed import SealedClient, SealedEndpoints, SealedRequest
from rosrm.snapshots.format import TransferPart
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import srv

_log = logging.getLogger("rosrm.slave")

#: Seconds without use after which a client is destroyed.
_IDLE: Final = 60.0
#: Time-out of a request for a ticket, and time until the next request, in seconds.
_ASK_AGAIN: Final = 1.0
#: Most bytes of one part.
MOST: Final = 256 << 10


class NotStored(NamedTuple):
    """Reason why a slave has not stored a part of a snapshot.

    Attributes:
        code: "newer": it has this snapshot or a newer one; "order": the parts before are missing;
            "full": no room; "damaged": the digest differs; "timeout": no answer; "stale": the slave
            has restarted, or keys have changed, so that the next request needs another ticket.
        message: as text for the user.
    """

    code: Literal["newer", "order", "full", "damaged", "timeout", "stale", "version", "denied"]
    message: str


class NotSent(NamedTuple):
    """Reason why another slave has not sent a part of a snapshot.

    Attributes:
        message: as text for the user.
        is_stale: the slave has restarted, or keys have changed, so that the same request needs
            another ticket.
    """

    message: str
    is_stale: bool = False


class ReplicationHost(Protocol):
    """Interface of the slave for its replication endpoint."""

    def take_part(self, part: TransferPart, answer: Callable[[NotStored | None], None]) -> None:
        """Store a part of a replica; `answer` with None, or with the reason of a refusal."""

    def read_part(
        self, process: str, age: tuple[int, int], offset: int, size: int,
        answer: Callable[[TransferPart | None], None],
    ) -> None:  # fmt: skip
        """Read a part of a snapshot; `answer` with it, or with None."""


class _Service(NamedTuple):
    """Service of the slave of another host, for one process."""

    kind: Any
    name: str
    host: str
    process: str


@dataclass(slots=True)
class _Client:
    """Client of such a service.

    Attributes:
        introduction: with a ticket; None: the master has not sent one yet.
        client: of the service; None until the first introduction.
        asked_at: monotonic seconds of the last request for a ticket.
        used: monotonic seconds of the last use.
    """

    introduction: Introduction | None = None
    client: SealedClient | None = None
    asked_at: float = -math.inf
    used: float = 0.0


class ReplicationEndpoint:
    """The replication services of the slave of one host, and its clients."""

    def __init__(self, endpoints: SealedEndpoints[Member], name: str) -> None:
        self._endpoints = endpoints
        self._name = name
        self._names = names.Names(endpoints.participant.settings.namespace)
        self._client = ControlClient(endpoints.participant, f"slave {name}")
        path = self._names(names.INTRODUCE)
        self._master = endpoints.client(srv.Introduce, path, endpoints.security.master)
        self._clients: dict[_Service, _Client] = {}

    def serve(self, host: ReplicationHost) -> None:
        """Offer the services."""

        def take(request: srv.StoreReplica.Request, open_request: SealedRequest) -> None:
            fault = version_refusal(request.protocol_version, f"the slave of {request.sender}")

            def answer(refusal: NotStored | None) -> None:
                answer = accepted() if refusal is None else refused(*refusal)
                open_request.answer(srv.StoreReplica.Response(answer=answer))

            if fault:
                answer(NotStored("version", fault))
                return
            try:
                open_request.ticket_for(request.process)
            except Refused as refusal:
                answer(NotStored("denied", str(refusal)))
                return
            if len(request.data) > MOST:
                answer(NotStored("damaged", f"it has more than {MOST} bytes"))
                return
            part = TransferPart(
                request.process, request.number, request.sequence, request.offset, request.total,
                request.digest, bytes(request.data),
            )  # fmt: skip
            host.take_part(part, answer)

        def read(request: srv.ReadSnapshot.Request, open_request: SealedRequest) -> None:
            fault = version_refusal(request.protocol_version, "a reader of snapshots")

            def answer(part: TransferPart | None) -> None:
                open_request.answer(_read_answer(part))

            if fault:
                open_request.answer(srv.ReadSnapshot.Response(answer=refused("version", fault)))
                return
            open_request.ticket_for(request.process)
            age = (request.number, request.sequence)
            size = min(request.max_bytes or MOST, MOST)
            host.read_part(request.process, age, request.offset, size, answer)

        own = self._names.of_host
        self._endpoints.serve(srv.StoreReplica, own(self._name, names.STORE_REPLICA), take)
        self._endpoints.serve(srv.ReadSnapshot, own(self._name, names.READ_SNAPSHOT), read)

    # --- requests to other slaves --------------------------------------------------------

    def finds_receiver(self, host: str, process: str, now: float) -> bool:
        """Return True if a host's slave is known and discovered, and can receive a replica."""
        return self._finds(_Service(srv.StoreReplica, names.STORE_REPLICA, host, process), now)

    def finds_source(self, host: str, process: str, now: float) -> bool:
        """Return True if a host's slave is known and discovered, and can send a snapshot."""
        return self._finds(_Service(srv.ReadSnapshot, names.READ_SNAPSHOT, host, process), now)

    def _finds(self, service: _Service, now: float) -> bool:
        known = self._clients.setdefault(service, _Client())
        known.used = now
        if known.introduction is None or now >= known.introduction.until:
            self._introduce(service, known, now)
        if known.introduction is None or known.client is None:
            return False
        return bool(known.client.service_is_ready())

    def _introduce(self, service: _Service, known: _Client, now: float) -> None:
        """Request a ticket from the master, unless a request is open."""
        if now - known.asked_at < _ASK_AGAIN or not self._master.service_is_ready():
            return
        known.asked_at = now

        def answered(response: srv.Introduce.Response | None) -> None:
            if response is None or self._clients.get(service) is not known:
                return
            try:
                introduction = introduction_of(response, self._endpoints.security, now)
            except Refused as refusal:
                _log.debug("no ticket for %s of %s: %s", service.name, service.host, refusal)
                return
            known.introduction = introduction
            if known.client is None:
                path = self._names.of_host(service.host, service.name)
                known.client = self._endpoints.client(service.kind, path, introduction.slave)
            known.client.peer = introduction.slave

        request = introduction_request(service.host, service.name, service.process)
        self._client.call(self._master, request, now + _ASK_AGAIN, answered)

    def _found(self, service: _Service, now: float) -> SealedClient:
        """Return the client of a service that was found; renew its ticket before it expires."""
        self._finds(service, now)
        client = self._clients[service].client
        if client is None:
            raise RuntimeError(f"{service} was not found before")
        return client

    def give(
        self, host: str, part: TransferPart, now: float, timeout: float,
        done: Callable[[NotStored | None], None],
    ) -> None:  # fmt: skip
        """Send a part to a slave; `done` gets None when it was stored, else the reason."""
        request = srv.StoreReplica.Request(
            protocol_version=PROTOCOL_VERSION, sender=self._name, process=part.process,
            number=part.number, sequence=part.sequence, offset=part.offset, total=part.total,
            digest=part.digest, data=array("B", part.data),
        )  # fmt: skip

        def answered(response: srv.StoreReplica.Response | None) -> None:
            if response is None:
                done(NotStored("timeout", f"no answer within {timeout:g} s"))
            else:
                answer = response.answer
                self._forget_ticket(service, answer)
                done(None if answer.accepted else NotStored(answer.code, answer.message))

        service = _Service(srv.StoreReplica, names.STORE_REPLICA, host, part.process)
        client = self._found(service, now)
        self._client.call(client, request, now + timeout, answered)

    def ask(
        self, host: str, wanted: TransferPart, now: float, timeout: float,
        done: Callable[[TransferPart | NotSent], None],
    ) -> None:  # fmt: skip
        """Request a part from another slave; `done` gets it, or the reason why there is none.

        `wanted` has no data; number 0 means the newest snapshot.
        """
        request = srv.ReadSnapshot.Request(
            protocol_version=PROTOCOL_VERSION, process=wanted.process, number=wanted.number,
            sequence=wanted.sequence, offset=wanted.offset, max_bytes=MOST,
        )  # fmt: skip

        def answered(response: srv.ReadSnapshot.Response | None) -> None:
            if response is None:
                done(NotSent(f"no answer within {timeout:g} s"))
            else:
                self._forget_ticket(service, response.answer)
                done(_part_of(response, wanted))

        service = _Service(srv.ReadSnapshot, names.READ_SNAPSHOT, host, wanted.process)
        client = self._found(service, now)
        self._client.call(client, request, now + timeout, answered)

    def _forget_ticket(self, service: _Service, answer: Any) -> None:
        """Let the next use request a new ticket, if a slave has refused the one of a request."""
        if answer.code == "stale" and service in self._clients:
            self._clients[service].introduction = None

    def expire(self, now: float) -> None:
        """End requests without an answer in time, and destroy idle clients."""
        self._client.expire(now)
        for service in [one for one, known in self._clients.items() if now - known.used >= _IDLE]:
            client = self._clients.pop(service).client
            if client is not None:
                client.destroy()


def _part_of(response: srv.ReadSnapshot.Response, wanted: TransferPart) -> TransferPart | NotSent:
    answer = response.answer
    if not answer.accepted:
        return NotSent(str(answer.message), is_stale=answer.code == "stale")
    return TransferPart(
        wanted.process, response.number, response.sequence, wanted.offset, response.total,
        response.digest, bytes(response.data),
    )  # fmt: skip


def _read_answer(part: TransferPart | None) -> srv.ReadSnapshot.Response:
    if part is None:
        return srv.ReadSnapshot.Response(
            answer=refused("unknown", "there is no such snapshot here")
        )
    return srv.ReadSnapshot.Response(
        answer=accepted(), number=part.number, sequence=part.sequence, total=part.total,
        digest=part.digest, data=array("B", part.data),
    )  # fmt: skip
