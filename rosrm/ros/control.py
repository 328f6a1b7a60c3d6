"""Envelope, age check and repetition of every control request, on both sides.

A request carries an id, the epoch, and the newest monotonic beat *of its receiver* that the sender
has received. Only the receiver judges its age, by its own clock, because robots' clocks differ and
DDS delivers requests seconds late after a network cut. A repeated id gets the same answer, and the
request is not carried out again.
"""

from __future__ import annotations

import math
import os
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rosrm import clocks
from rosrm.errors import Refused
from rosrm.keys.links import Link
from rosrm.keys.roles import Role
from rosrm.keys.security import Peer
from rosrm.model.ledger import Amount, Ledger, Store, bound_of
from rosrm.ros.bounds import MOST_LETTERS, check_bounds
from rosrm.ros.sealed import SealedEndpoints, SealedRequest, failed_response
from rosrm.version import PROTOCOL_VERSION
from rosrm.wording import sendable
from rosrm_msgs.msg import Answer, Envelope, MasterBeat
from rosrm_msgs.srv import Handshake

if TYPE_CHECKING:
    from rosrm.ros.participant import Participant

#: Ids of one sender that are remembered at least, for late repetitions, and at most. An id is never
#: forgotten while a copy of its request is young enough to be admitted.
_REMEMBERED: Final = 1_000
_MOST_REMEMBERED: Final = 50_000
#: The same for long polls: a late repetition of one has no use, and a thousand slaves send polls.
_REMEMBERED_POLLS: Final = 16
#: Most repetitions of one request that wait for its answer.
_MOST_WAITING: Final = 16
#: Most letters of an id.
_LONGEST_ID: Final = 64
_NS: Final = 1e-9


def version_refusal(version: int, who: str) -> str:
    """Return the reason to refuse a peer of another protocol version; "" for the same version."""
    if version == PROTOCOL_VERSION:
        return ""
    return (
        f"{who} speaks version {version} of rosrm's protocol and this side {PROTOCOL_VERSION}: "
        f"install the same version of rosrm on every host"
    )


def accepted(message: str = "", epoch: int = 0) -> Answer:
    """Return the answer to a request that was carried out."""
    return Answer(
        protocol_version=PROTOCOL_VERSION, accepted=True,
        message=sendable(message)[:MOST_LETTERS], epoch=epoch,
    )  # fmt: skip


def refused(code: str, message: str, epoch: int = 0) -> Answer:
    """Return the answer to a request that changed nothing."""
    return Answer(
        protocol_version=PROTOCOL_VERSION, accepted=False, code=code,
        message=sendable(message)[:MOST_LETTERS], epoch=epoch,
    )  # fmt: skip


def master_identity(message: MasterBeat | Handshake.Response) -> tuple[str, int, int]:
    """Return the identity of a master, as far as a greeting contains it, too."""
    return message.hostname, message.pid, message.epoch


def new_envelope(sender: str, receiver_beat: int, epoch: int) -> Envelope:
    """Return the envelope of a new request."""
    return Envelope(
        protocol_version=PROTOCOL_VERSION, request_id=os.urandom(16).hex(), sender=sender,
        epoch=epoch, receiver_beat=receiver_beat,
    )  # fmt: skip


def check_answer(answer: Answer, who: str) -> None:
    """Raise `Refused` for a refusal or an answer of another protocol version."""
    fault = version_refusal(answer.protocol_version, who)
    if fault:
        raise Refused(fault, "version")
    if not answer.accepted:
        raise Refused(answer.message, answer.code)


class RequestGate:
    """Admits or refuses requests of one sender at their receiver, and remembers answers.

    Args:
        beat: the receiver's boot clock, ns.
        max_age: seconds after which a request is stale.
        remembered: ids that are remembered at least.
        bound: of the remembered answers together. Beyond it, only the ids of the oldest stay.
    """

    def __init__(
        self, beat: Callable[[], int], max_age: float, remembered: int = _REMEMBERED,
        bound: Amount = bound_of(Store.ANSWERS, is_operator=True),  # noqa: B008 - immutable
    ) -> None:  # fmt: skip
        self._beat = beat
        self._max_age = max_age
        self._remembered = remembered
        self._answers: OrderedDict[str, Any] = OrderedDict()
        self._admitted: dict[str, int] = {}
        self._waiting: dict[str, deque[SealedRequest]] = {}
        self._bound = bound
        self._sizes = Ledger[str]()

    def refusal(self, envelope: Envelope, epoch: int | None = None) -> Answer | None:
        """Return the refusal of a request, or None.

        Epochs older than `epoch` are refused; None: the sender need not know it.
        """
        fault = version_refusal(envelope.protocol_version, envelope.sender or "the sender")
        if fault:
            return refused("version", fault)
        if not envelope.request_id:
            return refused("invalid", f"the request of {envelope.sender} has no id")
        if len(envelope.request_id) > _LONGEST_ID:
            return refused(
                "invalid",
                f"the id of a request of {envelope.sender} has more than {_LONGEST_ID} characters",
            )
        age = (self._beat() - envelope.receiver_beat) * _NS
        if envelope.receiver_beat == 0 or not 0.0 <= age <= self._max_age:
            return refused(
                "stale",
                f"the request of {envelope.sender} is {age:.1f} s old by this side's clock "
                f"(allowed: {self._max_age:g} s), or not meant for this run; nothing was done",
            )
        if epoch is not None and envelope.epoch < epoch:
            return refused(
                "stale", f"the request comes from epoch {envelope.epoch}, this is epoch {epoch}"
            )
        if not self._has_room():
            return refused(
                "stale",  # a sender of every version knows that it may send a new request
                f"more than {_MOST_REMEMBERED} requests came within {self._max_age:g} s; nothing "
                f"was done: send the request again later",
            )
        return None

    def _has_room(self) -> bool:
        """Return True if another id can be remembered; forget ids that are too old to be used."""
        while len(self._answers) >= self._remembered:
            oldest = next(iter(self._answers))
            if (self._beat() - self._admitted[oldest]) * _NS <= self._max_age:
                return len(self._answers) < _MOST_REMEMBERED
            del self._answers[oldest], self._admitted[oldest]
            self._sizes.remove("", oldest)
            self._waiting.pop(oldest, None)
        return True

    def knows(self, envelope: Envelope) -> bool:
        """Return True if a request of this id was admitted before; its age then does not matter."""
        return envelope.request_id in self._answers

    def repeated(self, envelope: Envelope, request: SealedRequest) -> bool:
        """Return True for a repeated request: it gets the same answer, once there is one."""
        known = self._answers.get(envelope.request_id)
        if known is None:
            self._answers[envelope.request_id] = _PENDING
            self._admitted[envelope.request_id] = self._beat()
            return False
        if known is _PENDING:
            waiting = self._waiting.setdefault(envelope.request_id, deque(maxlen=_MOST_WAITING))
            waiting.append(request)
        else:
            request.answer(known)
        return True

    def remember(self, envelope: Envelope, response: Any) -> None:
        """Store an answer, and send it to the repetitions of its request that already wait."""
        if envelope.request_id in self._answers:
            self._answers[envelope.request_id] = response
            self._sizes.put("", envelope.request_id, check_bounds(response))
            for oldest in self._sizes.beyond("", self._bound):
                self._sizes.remove("", oldest)
                self._answers[oldest] = type(self._answers[oldest])(answer=_NOT_KEPT)
        for request in self._waiting.pop(envelope.request_id, ()):
            request.answer(response)


_PENDING: Final = object()
#: Answer to the repetition of a request whose answer was too large to be kept.
_NOT_KEPT: Final = refused(
    "stale", "the request was carried out before, and its answer is not kept: look at the outcome"
)


#: Called with a request, its sealed form (with the sender), and the function that answers it.
Handle = Callable[[Any, SealedRequest, Callable[[Any], None]], None]


class ControlServer:
    """Offers services, behind a gate for each sender.

    Args:
        max_age: seconds after which a request is stale.
        epoch: returns the current one if older ones are to be refused.
    """

    def __init__(
        self, endpoints: SealedEndpoints[Any], max_age: float,
        epoch: Callable[[], int | None] = lambda: None,
    ) -> None:  # fmt: skip
        self._endpoints = endpoints
        self._max_age = max_age
        self._epoch = epoch
        self._gates: dict[tuple[Link, int], RequestGate] = {}

    def _gate_of(self, sender: Peer, remembered: int) -> RequestGate:
        """Return the gate of a sender, so that no member fills the gate of another one.

        With `security: none` all senders share one link, and so one gate: anyone can send under any
        number of names.
        """
        gate = self._gates.get((sender.link, remembered))
        if gate is None:
            is_operator = sender.grant.role is not Role.SUBMITTER
            bound = bound_of(Store.ANSWERS, is_operator=is_operator)
            gate = RequestGate(clocks.boot_time_ns, self._max_age, remembered, bound)
            self._gates[sender.link, remembered] = gate
        return gate

    def offer(self, service_type: Any, name: str, handle: Handle, *, remember: bool = True) -> None:
        """Offer a service.

        Args:
            handle: called with an admitted request, its sealed form with the sender, and the
                function that answers it.
            remember: keep the answer for repetitions (not for long polls).
        """
        remembered = _REMEMBERED if remember else _REMEMBERED_POLLS

        def take(request: Any, open_request: SealedRequest) -> None:
            gate = self._gate_of(open_request.peer, remembered)
            known = gate.knows(request.envelope)
            answer = None if known else gate.refusal(request.envelope, self._epoch())
            if answer is not None:
                open_request.answer(service_type.Response(answer=answer))
                return
            if gate.repeated(request.envelope, open_request):
                return

            def respond(response: Any) -> None:
                if remember:
                    gate.remember(request.envelope, response)
                open_request.answer(response)

            guard = self._endpoints.participant.guard
            fault = guard.call(handle, request, open_request, respond)
            if fault and not open_request.answered:
                respond(failed_response(service_type, fault))

        self._endpoints.serve(service_type, name, take)


@dataclass(slots=True)
class Call:
    """A request without an answer yet.

    Attributes:
        deadline: monotonic seconds; may be changed.
    """

    future: Any
    client: Any
    deadline: float
    done: Callable[[Any], None]


@dataclass(slots=True)
class ControlClient:
    """Sends requests; each ends by its answer or by its deadline.

    Attributes:
        sender: role and name, for messages.
    """

    participant: Participant
    sender: str
    _calls: list[Call] = field(default_factory=list)

    def envelope(self, receiver_beat: int, epoch: int = 0) -> Envelope:
        """Return the envelope of a new request."""
        return new_envelope(self.sender, receiver_beat, epoch)

    def call(self, client: Any, request: Any, deadline: float, done: Callable[[Any], None]) -> Call:
        """Send a request.

        Args:
            deadline: monotonic seconds, compared with `expire`'s argument.
            done: called with the response; with None when the deadline has passed, or when its call
                with the response raised.
        """
        call = Call(client.call_async(request), client, deadline, done)
        self._calls.append(call)
        call.future.add_done_callback(self.participant.counted(lambda _: self._finish(call)))
        return call

    def _finish(self, call: Call) -> None:
        if call in self._calls:
            self._calls.remove(call)
            guard = self.participant.guard
            if guard.call(lambda: call.done(call.future.result())):
                guard.call(call.done, None)  # an unusable response counts as none

    def expire(self, now: float) -> None:
        """End the calls whose deadline has passed."""
        if not self._calls:
            return
        for call in [call for call in self._calls if now >= call.deadline]:
            self._calls.remove(call)
            call.client.remove_pending_request(call.future)
            self.participant.guard.call(call.done, None)

    def forget(self) -> None:
        """End every call without an answer, because the peer is another run by now."""
        self.expire(math.inf)
