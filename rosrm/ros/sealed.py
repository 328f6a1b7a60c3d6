"""Sealed topics and services: the entities that carry the messages of rosrm's own parts.

Each message travels in a `rosrm_msgs/Sealed`, below the names that the channels of
`rosrm.keys.sealing` contain. A message that does not open is dropped, counted and answered by
nothing. So a stranger learns nothing, stores nothing, and uses no request up: an answer that does
not open leaves the request open for the true one.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any, Final
from weakref import WeakKeyDictionary

from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message

from rosrm.keys.links import SealedMessage
from rosrm.keys.sealing import FORMAT, channel_of
from rosrm.keys.security import Peer, Security
from rosrm.ros import qos
from rosrm.ros.participant import OpenRequest, Participant, failed_response
from rosrm.ros.sealed_topic import UNKNOWN_RUN, topic_channel, type_name
from rosrm_msgs import msg, srv

#: Refusal of a request that was meant for another run of the receiver.
_OTHER_RUN: Final = "the request is for another run of the receiver; nothing was done"


def request_channel(service_type: Any, name: str) -> bytes:
    """Return the channel of the requests of a service."""
    return channel_of(name, type_name(service_type, "_Request"))


def answer_channel(service_type: Any, name: str) -> bytes:
    """Return the channel of the answers of a service."""
    return channel_of(name, type_name(service_type, "_Response"))


def sealed(
    peer: Peer, channel: bytes, message: Any, receiver_run: bytes, context: bytes = b""
) -> tuple[msg.Sealed, SealedMessage]:
    """Return a message as it is sent, and what an answer to it refers to."""
    plain = serialize_message(message)
    done = peer.link.seal(channel, plain, context or receiver_run)
    return msg.Sealed(
        format=FORMAT, principal=peer.principal, generation=peer.generation,
        run=array("B", done.run), receiver_run=array("B", receiver_run), counter=done.counter,
        body=array("B", done.body),
    ), done  # fmt: skip


def received(message: msg.Sealed) -> SealedMessage:
    """Return the sealed part of a message as it arrived."""
    return SealedMessage(bytes(message.run), message.counter, bytes(message.body))


class SealedRequest:
    """A genuine request; `answer` may be called once, at any time.

    Attributes:
        peer: who sent it.
        run: of the sender.
        answered: the answer is sent.
    """

    def __init__(
        self, opened: OpenRequest, peer: Peer, channel: bytes, reference: SealedMessage
    ) -> None:
        self._opened = opened
        self._channel = channel
        self._reference = reference
        self.peer = peer
        self.run = reference.run

    @property
    def answered(self) -> bool:
        """Return True after the answer."""
        return self._opened.answered

    def answer(self, response: Any) -> None:
        """Send the response."""
        reference = self._reference
        message, _ = sealed(self.peer, self._channel, response, reference.run, reference.reference)
        self._opened.answer(srv.Sealed.Response(message=message))


class SealedEndpoints:
    """Creates the sealed entities of one part.

    Args:
        security: with whom this part speaks.
        refused: called with the name of a topic or service for each message that does not open.
    """

    def __init__(
        self, participant: Participant, security: Security, refused: Callable[[str], None]
    ) -> None:
        self._participant = participant
        self._security = security
        self._refused = refused

    def _open(self, channel: bytes, name: str, message: msg.Sealed) -> tuple[Peer, bytes] | None:
        """Return the sender and the plain message; None: it is refused."""
        if message.format == FORMAT:
            peer = self._security.peer(message.principal, message.generation)
            if peer is not None:
                plain = peer.link.open(channel, received(message), bytes(message.receiver_run))
                if plain is not None:
                    return peer, plain
        self._refused(name)
        return None

    # --- services ------------------------------------------------------------------------

    def serve(
        self, service_type: Any, name: str, handle: Callable[[Any, SealedRequest], None], *,
        first_contact: bool = False,
    ) -> None:  # fmt: skip
        """Offer a service.

        Args:
            handle: called with each genuine request and the means to answer it. If it raises before
                it has answered, the request is answered as failed.
            first_contact: accept requests of peers that do not know this run yet.
        """
        requests = request_channel(service_type, name)
        answers = answer_channel(service_type, name)
        guard = self._participant.guard

        def take(request: srv.Sealed.Request, opened: OpenRequest) -> None:
            found = self._open(requests, name, request.message)
            if found is None:
                return
            peer, plain = found
            genuine = SealedRequest(opened, peer, answers, received(request.message))
            if not first_contact and bytes(request.message.receiver_run) != self._security.run:
                genuine.answer(failed_response(service_type, _OTHER_RUN, "stale"))
                return
            fault = guard.call(
                lambda: handle(deserialize_message(plain, service_type.Request), genuine)
            )
            if fault and not genuine.answered:
                genuine.answer(failed_response(service_type, fault))

        self._participant.serve(srv.Sealed, name, take)

    def client(self, service_type: Any, name: str, peer: Peer) -> SealedClient:
        """Return a client of a service."""
        return SealedClient(
            self._participant, service_type, name, peer, lambda: self._refused(name)
        )

    # --- topics --------------------------------------------------------------------------

    def publisher(
        self, message_type: Any, name: str, profile: QoSProfile, peer: Peer
    ) -> SealedPublisher:
        """Return a publisher of messages for one peer."""
        publisher = self._participant.node.create_publisher(msg.Sealed, name, profile)
        return SealedPublisher(publisher, topic_channel(message_type, name), peer)

    def subscribe(
        self, message_type: Any, name: str, profile: QoSProfile,
        take: Callable[[Any, Peer], None],
    ) -> Any:  # fmt: skip
        """Subscribe to messages for this run; return the subscription."""
        channel = topic_channel(message_type, name)

        def open_and_take(message: msg.Sealed) -> None:
            found = self._open(channel, name, message)
            if found is not None and bytes(message.receiver_run) == self._security.run:
                take(deserialize_message(found[1], message_type), found[0])

        return self._participant.node.create_subscription(
            msg.Sealed, name, self._participant.counted(open_and_take), profile
        )


class SealedPublisher:
    """Publisher of messages for one peer.

    Attributes:
        receiver_run: run of the peer; `UNKNOWN_RUN` until it is known.
    """

    def __init__(self, publisher: Any, channel: bytes, peer: Peer) -> None:
        self.receiver_run = UNKNOWN_RUN
        self._publisher = publisher
        self._channel = channel
        self._peer = peer
        self.wait_for_all_acked = publisher.wait_for_all_acked

    def publish(self, message: Any) -> None:
        """Send a message."""
        self._publisher.publish(sealed(self._peer, self._channel, message, self.receiver_run)[0])


class SealedClient:
    """Client of a sealed service, with the methods of rclpy's that rosrm uses.

    Args:
        peer: the server.
        refused: called for each answer that does not open.

    Attributes:
        receiver_run: run of the server; `UNKNOWN_RUN` until it is known.
    """

    def __init__(
        self, participant: Participant, service_type: Any, name: str, peer: Peer,
        refused: Callable[[], None],
    ) -> None:  # fmt: skip
        self.receiver_run = UNKNOWN_RUN
        self._participant = participant
        self._peer = peer
        self._refused = refused
        self._response_type = service_type.Response
        self._requests = request_channel(service_type, name)
        self._answers = answer_channel(service_type, name)
        self._sent: WeakKeyDictionary[Any, SealedMessage] = WeakKeyDictionary()
        self._client = participant.node.create_client(srv.Sealed, name, qos_profile=qos.SERVICE)
        self._pending_of = self._client.get_pending_request
        # The executor completes the future that this method returns with any answer of its number.
        self._client.get_pending_request = self._answer_to
        self.guarded = participant.guard.call
        self.service_is_ready = self._client.service_is_ready
        self.remove_pending_request = self._client.remove_pending_request

    def call_async(self, request: Any) -> Any:
        """Send a request; return the future of its answer."""
        message, reference = sealed(self._peer, self._requests, request, self.receiver_run)
        future = self._client.call_async(srv.Sealed.Request(message=message))
        self._sent[future] = reference
        return future

    def _answer_to(self, sequence: int) -> _Answer:
        return _Answer(self, self._pending_of(sequence))

    def complete(self, future: Any, response: srv.Sealed.Response) -> None:
        """Complete a request by an answer, if the answer is the server's."""
        message = received(response.message)
        plain = self._peer.link.open(self._answers, message, self._sent[future].reference)
        if plain is None:
            self._refused()
            return
        future.set_result(deserialize_message(plain, self._response_type))

    def destroy(self) -> None:
        """Destroy the client."""
        self._participant.node.destroy_client(self._client)


class _Answer:
    """Stands for the future of a request until an answer opens."""

    def __init__(self, client: SealedClient, future: Any) -> None:
        self._client = client
        self._future = future
        self._set_executor = future._set_executor  # noqa: SLF001 - the executor calls it

    def set_result(self, response: srv.Sealed.Response) -> None:
        """Complete the request, if the answer is the server's."""
        self._client.guarded(self._client.complete, self._future, response)
