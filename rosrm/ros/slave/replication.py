"""Snapshot replication between slaves: two services of each, and clients for those of others."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple, Protocol

from rosrm.ros import names, qos
from rosrm.ros.control import ControlClient, accepted, refused, version_refusal
from rosrm.ros.participant import OpenRequest, Participant
from rosrm.snapshots.format import TransferPart
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import srv

#: Seconds without use after which a client is destroyed.
_IDLE: Final = 60.0
#: Most bytes of one part.
MOST: Final = 256 << 10


class NotStored(NamedTuple):
    """Reason why a slave has not stored a part of a snapshot.

    Attributes:
        code: "newer": it has this snapshot or a newer one; "order": the parts before are missing;
            "full": no room; "damaged": the digest differs; "timeout": no answer.
        message: as text for the user.
    """

    code: Literal["newer", "order", "full", "damaged", "timeout", "version"]
    message: str


class NotSent(NamedTuple):
    """Reason why another slave has not sent a part of a snapshot.

    Attributes:
        message: as text for the user.
    """

    message: str


class ReplicationHost(Protocol):
    """Interface of the slave for its replication endpoint."""

    def take_part(self, part: TransferPart, answer: Callable[[NotStored | None], None]) -> None:
        """Store a part of a replica; `answer` with None, or with the reason of a refusal."""

    def read_part(
        self, process: str, age: tuple[int, int], offset: int, size: int,
        answer: Callable[[TransferPart | None], None],
    ) -> None:  # fmt: skip
        """Read a part of a snapshot; `answer` with it, or with None."""


@dataclass(slots=True)
class _Peer:
    client: Any
    used: float


class ReplicationEndpoint:
    """The replication services of the slave of one host, and its clients."""

    def __init__(self, participant: Participant, name: str) -> None:
        self._participant = participant
        self._name = name
        self._names = names.Names(participant.settings.namespace)
        self._client = ControlClient(participant, f"slave {name}")
        self._peers: dict[tuple[Any, str], _Peer] = {}

    def serve(self, host: ReplicationHost) -> None:
        """Offer the services."""

        def take(request: srv.StoreReplica.Request, open_request: OpenRequest) -> None:
            fault = version_refusal(request.protocol_version, f"the slave of {request.sender}")

            def answer(refusal: NotStored | None) -> None:
                answer = accepted() if refusal is None else refused(*refusal)
                open_request.answer(srv.StoreReplica.Response(answer=answer))

            if fault:
                answer(NotStored("version", fault))
                return
            if len(request.data) > MOST:
                answer(NotStored("damaged", f"it has more than {MOST} bytes"))
                return
            part = TransferPart(
                request.process, request.number, request.sequence, request.offset, request.total,
                request.digest, bytes(request.data),
            )  # fmt: skip
            host.take_part(part, answer)

        def read(request: srv.ReadSnapshot.Request, open_request: OpenRequest) -> None:
            fault = version_refusal(request.protocol_version, "a reader of snapshots")

            def answer(part: TransferPart | None) -> None:
                open_request.answer(_read_answer(part))

            if fault:
                open_request.answer(srv.ReadSnapshot.Response(answer=refused("version", fault)))
                return
            age = (request.number, request.sequence)
            size = min(request.max_bytes or MOST, MOST)
            host.read_part(request.process, age, request.offset, size, answer)

        own = self._names.of_host
        self._participant.serve(srv.StoreReplica, own(self._name, names.STORE_REPLICA), take)
        self._participant.serve(srv.ReadSnapshot, own(self._name, names.READ_SNAPSHOT), read)

    # --- requests to other slaves --------------------------------------------------------

    def finds_receiver(self, host: str, now: float) -> bool:
        """Return True if a host's slave is discovered and can receive a replica."""
        return bool(self._peer(srv.StoreReplica, names.STORE_REPLICA, host, now).service_is_ready())

    def finds_source(self, host: str, now: float) -> bool:
        """Return True if a host's slave is discovered and can send a snapshot."""
        return bool(self._peer(srv.ReadSnapshot, names.READ_SNAPSHOT, host, now).service_is_ready())

    def _peer(self, kind: Any, name: str, host: str, now: float) -> Any:
        peer = self._peers.get((kind, host))
        if peer is None:
            client = self._participant.node.create_client(
                kind, self._names.of_host(host, name), qos_profile=qos.SERVICE
            )
            peer = self._peers[kind, host] = _Peer(client, now)
        peer.used = now
        return peer.client

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
                done(None if answer.accepted else NotStored(answer.code, answer.message))

        client = self._peer(srv.StoreReplica, names.STORE_REPLICA, host, now)
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
                done(_part_of(response, wanted))

        client = self._peer(srv.ReadSnapshot, names.READ_SNAPSHOT, host, now)
        self._client.call(client, request, now + timeout, answered)

    def expire(self, now: float) -> None:
        """End requests without an answer in time, and destroy idle clients."""
        self._client.expire(now)
        for key in [key for key, peer in self._peers.items() if now - peer.used >= _IDLE]:
            self._participant.node.destroy_client(self._peers.pop(key).client)


def _part_of(response: srv.ReadSnapshot.Response, wanted: TransferPart) -> TransferPart | NotSent:
    answer = response.answer
    if not answer.accepted:
        return NotSent(str(answer.message))
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
