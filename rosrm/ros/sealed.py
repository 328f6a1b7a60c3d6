"""Sealed topics and services: the ROS entities of master, slaves and clients.

Each message is in the body of a `rosrm_msgs/Sealed`. A message that does not open is dropped and
counted, without an answer. So a stranger learns nothing, and nothing is stored for it. If an answer
does not open, its request stays open for the genuine answer. Messages of the master to all
receivers are signed, in a `rosrm_msgs/Signed`, and not encrypted.

rclpy is imported only with a participant: requests to a master on this machine need none.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar
from weakref import WeakKeyDictionary

from rosrm.errors import Refused
from rosrm.keys.links import SealedMessage
from rosrm.keys.roles import action_of, may_send
from rosrm.keys.sealing import FORMAT, RUN_BYTES, channel_of
from rosrm.keys.security import SIGNATURE_BYTES, Peer, Security
from rosrm.keys.tickets import Ticket
from rosrm.ros import cdr, signed_codec
from rosrm.ros.bounds import check_bounds
from rosrm.ros.sealed_codec import (
    MOST_LETTERS,
    Envelope,
    decode,
    encode,
    topic_channel,
    type_name,
)
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg, srv

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

    from rosrm.ros.participant import OpenRequest, Participant

#: Refusal of a request that was meant for another run of the receiver.
_OTHER_RUN: Final = "the request is for another run of the receiver; nothing was done"
#: Refusal of a request whose sender may have lost its key since it got the ticket.
_OLD_TICKET: Final = (
    "the ticket has expired, or keys have changed since it was made; ask the master for a new one"
)

#: Runs of masters whose newest signed message is remembered.
_MOST_RUNS: Final = 64
#: Most bytes of the body of a sealed message.
_LARGEST: Final = 1 << 24

#: Called with an envelope, None for a malformed message, and the function that sends its answer.
SealedHandler = Callable[[Envelope | None, Callable[[Envelope], None]], None]

SecurityT = TypeVar("SecurityT", bound=Security)


def request_channel(service_type: Any, name: str) -> bytes:
    """Return the channel of the requests of a service."""
    return channel_of(name, type_name(service_type, "_Request"))


def answer_channel(service_type: Any, name: str) -> bytes:
    """Return the channel of the answers of a service."""
    return channel_of(name, type_name(service_type, "_Response"))


def sealed(
    peer: Peer, channel: bytes, message: Any, answered: SealedMessage | None = None
) -> Envelope:
    """Return a sealed message.

    Args:
        peer: receiver of the message.
        channel: see `rosrm.keys.sealing.channel_of`.
        message: ROS message to seal.
        answered: the request that the message answers; None: the message is no answer.
    """
    run = peer.run if answered is None else answered.run
    context = run if answered is None else answered.reference
    done = peer.link.seal(channel, cdr.form_of(message), context)
    return Envelope(FORMAT, peer.name, peer.generation, done.run, run, done.counter, done.body)


def envelope_to_msg(envelope: Envelope) -> msg.Sealed:
    """Return the ROS message of an envelope, for services."""
    return cdr.made(
        msg.Sealed,
        format=envelope.format, principal=envelope.principal, generation=envelope.generation,
        run=array("B", envelope.run), receiver_run=array("B", envelope.receiver_run),
        counter=envelope.counter, body=bytes(envelope.body),
    )  # fmt: skip


def envelope_from_msg(message: msg.Sealed) -> Envelope | None:
    """Return the envelope in a ROS message; None: a run is not `RUN_BYTES` long."""
    run, receiver_run = bytes(message.run), bytes(message.receiver_run)
    if not len(run) == len(receiver_run) == RUN_BYTES:
        return None
    return Envelope(
        message.format, message.principal, message.generation, run, receiver_run, message.counter,
        bytes(message.body),
    )  # fmt: skip


def _sealed_part(envelope: Envelope) -> SealedMessage:
    return SealedMessage(envelope.run, envelope.counter, bytes(envelope.body))


def _plain(kind: Any, content: bytes) -> Any:
    """Return a message from its CDR form; raise `Refused` if it is malformed or too large."""
    try:
        message = cdr.read(kind, content)
    except ValueError as fault:
        raise Refused(f"a malformed {kind.__name__}: {fault}") from None
    check_bounds(message)
    return message


class SealedCalls:
    """Seals requests to one service, and opens their answers.

    Args:
        first_contact: store the run in each answer as the run of the server.
    """

    def __init__(self, service_type: Any, name: str, *, first_contact: bool) -> None:
        self._first_contact = first_contact
        self._response_type = service_type.Response
        self._requests = request_channel(service_type, name)
        self._answers = answer_channel(service_type, name)

    def seal(self, peer: Peer, request: Any) -> Envelope:
        """Return a request to `peer`."""
        return sealed(peer, self._requests, request)

    def open(self, peer: Peer, sent: Envelope, answer: Envelope | None) -> Any:
        """Return the response of `peer` to a request; None: the answer is not genuine."""
        reference = _sealed_part(sent).reference
        content = answer and peer.link.open(self._answers, _sealed_part(answer), reference)
        if answer is None or content is None:
            return None
        if self._first_contact:
            peer.run = answer.run
        return _plain(self._response_type, content)


class SealedRequest:
    """A genuine request; `answer` may be called once, at any time.

    Attributes:
        peer: sender of the request.
        run: of the sender.
        answered: True if the request was answered.
    """

    def __init__(
        self, send: Callable[[Envelope], None], peer: Peer, channel: bytes, request: SealedMessage
    ) -> None:
        self._send = send
        self.answered = False
        self._channel = channel
        self._request = request
        self.peer = peer
        self.run = request.run

    def ticket_for(self, process: str) -> Ticket:
        """Return the sender's ticket for a process; raise `Refused` if it has none."""
        ticket = self.peer.ticket
        if ticket is None or ticket.process != process:
            raise Refused(
                f"{self.peer.grant.principal} has no ticket of the master for {process!r}",
                "denied",
            )
        return ticket

    def answer(self, response: Any) -> None:
        """Send the response."""
        self._send(sealed(self.peer, self._channel, response, self._request))
        self.answered = True


class SealedEndpoints(Generic[SecurityT]):
    """Creates the sealed entities of a master, slave or client.

    Args:
        refused: called with the name of a topic or service for each message that does not open.

    Attributes:
        participant: owner of the entities.
        security: keys and peers of this master, slave or client.
        handlers: of the requests of each offered service, by its name.
        refuses_other_runs: if True, answer requests for other runs of the receiver with `stale`; if
            False, do not answer them.
    """

    def __init__(
        self, participant: Participant, security: SecurityT,
        refused: Callable[[str], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self.participant = participant
        self.security = security
        self.refused = refused
        self.refuses_other_runs = True
        self.handlers: dict[str, SealedHandler] = {}
        _load_service()

    def _open(
        self, channel: bytes, name: str, envelope: Envelope | None
    ) -> tuple[Peer, bytes] | None:
        """Return the sender and the plain message; None: the message does not open."""
        peer = None
        if envelope is not None and _is_possible(envelope):
            peer = self.security.peer(envelope.principal, envelope.generation)
        if envelope is not None and peer is not None:
            run = envelope.receiver_run
            plain = peer.link.open(
                channel, _sealed_part(envelope), run, is_bound=run == self.security.run
            )
            if plain is not None:
                self.security.remember(peer)
                return peer, plain
        self.refused(name)
        return None

    # --- services ------------------------------------------------------------------------

    def serve(
        self, service_type: Any, name: str, handle: Callable[[Any, SealedRequest], None], *,
        first_contact: bool = False,
    ) -> None:  # fmt: skip
        """Offer a service to all peers whose role allows its requests.

        Args:
            handle: called with each genuine request and the means to answer it. If it raises before
                it has answered, the request is answered as failed.
            first_contact: accept requests of peers that do not know this master or slave's run.
        """
        requests, answers = request_channel(service_type, name), answer_channel(service_type, name)
        service = name.rpartition("/")[2]
        guard = self.participant.guard

        def take(envelope: Envelope | None, send: Callable[[Envelope], None]) -> None:
            found = self._open(requests, name, envelope)
            if envelope is None or found is None:
                return
            peer, plain = found
            is_for_other_run = not first_contact and envelope.receiver_run != self.security.run
            if is_for_other_run and not self.refuses_other_runs:
                return
            genuine = SealedRequest(send, peer, answers, _sealed_part(envelope))
            refusal = _denial(peer, service)
            if refusal:
                genuine.answer(failed_response(service_type, refusal, "denied"))
            elif is_for_other_run:
                genuine.answer(failed_response(service_type, _OTHER_RUN, "stale"))
            elif peer.ticket is not None and not self.security.accepts(peer.ticket):
                genuine.answer(failed_response(service_type, _OLD_TICKET, "stale"))
            else:
                fault = guard.call(lambda: handle(_plain(service_type.Request, plain), genuine))
                if fault and not genuine.answered:
                    genuine.answer(failed_response(service_type, fault))

        def take_message(request: srv.Sealed.Request, opened: OpenRequest) -> None:
            def send(envelope: Envelope) -> None:
                opened.answer(cdr.made(srv.Sealed.Response, message=envelope_to_msg(envelope)))

            take(envelope_from_msg(request.message), send)

        self.handlers[name] = take
        self.participant.serve(srv.Sealed, name, take_message)

    def client(
        self, service_type: Any, name: str, peer: Peer, *, first_contact: bool = False
    ) -> SealedClient:
        """Return a client of a service of `peer`.

        Args:
            first_contact: store the run in each answer as the run of `peer`.
        """
        calls = SealedCalls(service_type, name, first_contact=first_contact)
        return SealedClient(self.participant, name, peer, calls, lambda: self.refused(name))

    # --- topics --------------------------------------------------------------------------

    def publisher(
        self, message_type: Any, name: str, profile: QoSProfile, peer: Peer
    ) -> SealedPublisher:
        """Return a publisher of messages for `peer`."""
        publisher = self.participant.node.create_publisher(msg.Sealed, name, profile)
        return SealedPublisher(publisher, topic_channel(message_type, name), peer)

    def subscribe(
        self, message_type: Any, name: str, profile: QoSProfile, take: Callable[[Any, Peer], None]
    ) -> Any:
        """Subscribe to messages for this run; return the subscription."""
        channel = topic_channel(message_type, name)

        def open_and_take(data: bytes) -> None:
            envelope = decode(data)
            found = self._open(channel, name, envelope)
            if envelope and found and envelope.receiver_run == self.security.run:
                take(_plain(message_type, found[1]), found[0])

        return self.participant.node.create_subscription(
            msg.Sealed, name, self.participant.counted(open_and_take), profile, raw=True
        )

    # --- signed topics of the master -------------------------------------------------------

    def announcer(self, message_type: Any, name: str, profile: QoSProfile) -> SignedPublisher:
        """Return a publisher of signed messages."""
        publisher = self.participant.node.create_publisher(msg.Signed, name, profile)
        return SignedPublisher(publisher, topic_channel(message_type, name), self.security)

    def follow(
        self, message_type: Any, name: str, profile: QoSProfile, take: Callable[[Any, bytes], None]
    ) -> Any:
        """Subscribe to signed messages; `take` is called with each message and the master's run."""
        channel = topic_channel(message_type, name)
        newest: dict[bytes, int] = {}

        def check_and_take(data: bytes) -> None:
            message = signed_codec.decode(data)
            if message is not None and message.counter <= newest.get(message.run, 0):
                return  # before the signature, whose check takes longer than all else
            if message is None or not self.security.is_signed(
                message.content(channel), message.signature
            ):
                self.refused(name)
                return
            newest.pop(message.run, None)  # so that the run that sends is forgotten last
            newest[message.run] = message.counter
            if len(newest) > _MOST_RUNS:
                del newest[next(iter(newest))]
            take(_plain(message_type, message.body), message.run)

        return self.participant.node.create_subscription(
            msg.Signed, name, self.participant.counted(check_and_take), profile, raw=True
        )


def _load_service() -> None:
    """Load the type of the sealed services without numpy.

    rclpy also loads the type of a service's introspection events, which rosrm does not use. An
    event contains an array of fixed length, for which the generated Python code imports numpy.
    """
    from rosidl_generator_py import import_type_support  # noqa: PLC0415 - see the top

    event: Any = type(srv.Sealed.Event)
    if event._TYPE_SUPPORT is None:  # noqa: SLF001 - rclpy loads the type if it is None
        types = import_type_support("rosrm_msgs")
        event._TYPE_SUPPORT = types.type_support_msg__srv__sealed__event  # noqa: SLF001


def _is_possible(envelope: Envelope) -> bool:
    """Return True for a message of this format within its bounds."""
    return (
        envelope.format == FORMAT
        and len(envelope.principal) <= MOST_LETTERS
        and len(envelope.body) <= _LARGEST
    )


def _denial(peer: Peer, service: str) -> str:
    """Return the reason why a peer may not send a request; "": it may."""
    if peer.ticket is not None and peer.ticket.service != service:
        return f"the ticket is for {peer.ticket.service!r}, not for {service!r}"
    role = peer.grant.role
    if may_send(role, service):
        return ""
    return (
        f"{peer.grant.principal} has the role {role.value}, which may not {action_of(service)}; "
        f"ask an operator"
    )


class SealedPublisher:
    """Publisher of messages for one peer."""

    def __init__(self, publisher: Any, channel: bytes, peer: Peer) -> None:
        self._publisher = publisher
        self._channel = channel
        self._peer = peer
        self.wait_for_all_acked = publisher.wait_for_all_acked

    def publish(self, message: Any) -> None:
        """Send a message."""
        self._publisher.publish(encode(sealed(self._peer, self._channel, message)))


class SignedPublisher:
    """Publisher of signed messages of the master."""

    def __init__(self, publisher: Any, channel: bytes, security: Security) -> None:
        self._publisher = publisher
        self._channel = channel
        self._security = security
        self._counter = 0

    def publish(self, message: Any) -> None:
        """Send a message."""
        from rclpy.serialization import serialize_message  # noqa: PLC0415 - see the top

        self._counter += 1
        run, body = self._security.run, serialize_message(message)
        content = signed_codec.signed_content(self._channel, run, self._counter, body)
        signature = self._security.signature(content).ljust(SIGNATURE_BYTES, b"\0")
        self._publisher.publish(
            msg.Signed(
                format=FORMAT, run=array("B", run), counter=self._counter,
                signature=array("B", signature), body=array("B", body),
            )
        )  # fmt: skip


class SealedClient:
    """Client of a sealed service, with those methods of rclpy's client that rosrm uses.

    Args:
        calls: seals the requests, and opens the answers.
        refused: called for each answer that does not open.

    Attributes:
        peer: the server; replaced when this client gets a new ticket.
    """

    def __init__(
        self, participant: Participant, name: str, peer: Peer, calls: SealedCalls,
        refused: Callable[[], None],
    ) -> None:  # fmt: skip
        from rosrm.ros import qos  # noqa: PLC0415 - see the top

        self._participant = participant
        self._name = name
        self.peer = peer
        self._calls = calls
        self._refused = refused
        self._sent: WeakKeyDictionary[Any, tuple[Peer, Envelope]] = WeakKeyDictionary()
        self._client = participant.node.create_client(srv.Sealed, name, qos_profile=qos.SERVICE)
        self._pending_of = self._client.get_pending_request
        # The executor completes the future that this method returns with the first answer of its
        # number, which may be forged. So the method returns an object that checks the answer.
        self._client.get_pending_request = self._answer_to
        self.guarded = participant.guard.call
        self.service_is_ready = self._client.service_is_ready
        self.remove_pending_request = self._client.remove_pending_request

    def call_async(self, request: Any) -> Any:
        """Send a request; return the future of its answer."""
        envelope = self._calls.seal(self.peer, request)
        message = envelope_to_msg(envelope)
        future = self._client.call_async(cdr.made(srv.Sealed.Request, message=message))
        self._sent[future] = self.peer, envelope
        return future

    def _answer_to(self, sequence: int) -> _Answer:
        return _Answer(self, self._pending_of(sequence))

    def complete(self, future: Any, response: srv.Sealed.Response) -> None:
        """Complete a request by an answer, if the answer is genuine."""
        answer = self._calls.open(*self._sent[future], envelope_from_msg(response.message))
        if answer is None:
            self._refused()
        else:
            future.set_result(answer)

    def servers(self) -> int:
        """Return the number of discovered servers, also of those that were killed a moment ago."""
        return int(self._participant.node.count_services(self._name))

    def destroy(self) -> None:
        """Destroy the client."""
        self._participant.node.destroy_client(self._client)


class _Answer:
    """Stand-in for the future of a request, which accepts only a genuine answer."""

    def __init__(self, client: SealedClient, future: Any) -> None:
        self._client = client
        self._future = future

    def _set_executor(self, executor: Any) -> None:
        """Do nothing: with an executor, the future would call back in a later turn of it."""

    def set_result(self, response: srv.Sealed.Response) -> None:
        """Complete the request, if the answer is genuine."""
        self._client.guarded(self._client.complete, self._future, response)


def failed_response(service_type: Any, reason: str, code: str = "failed") -> Any:
    """Return the response to a request whose handler raised, or that cannot be handled."""
    response = service_type.Response()
    answer = getattr(response, "answer", response)  # a handshake's response is itself the answer
    answer.protocol_version, answer.accepted = PROTOCOL_VERSION, False
    answer.message = f"an error of the receiver: {reason}" if code == "failed" else reason
    if hasattr(answer, "code"):
        answer.code = code
    return response
