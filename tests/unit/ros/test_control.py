"""Gate for requests: the receiver refuses stale and repeated ones."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm import clocks
from rosrm.keys.cluster import ClusterSecret
from rosrm.keys.security import MasterSecurity
from rosrm.model.ledger import Amount
from rosrm.ros import control
from rosrm.ros.callback_guard import CallbackGuard
from rosrm.ros.control import (
    ControlServer,
    RequestGate,
    accepted,
    check_answer,
    refused,
    version_refusal,
)
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import srv
from rosrm_msgs.msg import Envelope

S = 10**9


class Requested:
    """Fake request that waits for its answer."""

    def __init__(self) -> None:
        self.answers = []

    def answer(self, response) -> None:
        self.answers.append(response)


def envelope(beat: int, **changes) -> Envelope:
    fields = {
        "protocol_version": PROTOCOL_VERSION, "request_id": "a", "sender": "client test",
        "epoch": 3, "receiver_beat": beat,
    }  # fmt: skip
    return Envelope(**{**fields, **changes})


def gate(now: float = 100.0, max_age: float = 5.0) -> RequestGate:
    return RequestGate(lambda: int(now * S), max_age)


def test_a_fresh_request_passes() -> None:
    """The age is at most the limit, by the receiver's own clock."""
    for age in (0, 1, 5):
        assert gate().refusal(envelope((100 - age) * S)) is None


@pytest.mark.parametrize(
    ("changes", "code", "said"),
    [
        ({"receiver_beat": 94 * S}, "stale", ["6.0 s", "client test"]),  # late by DDS after a cut
        ({"receiver_beat": 0}, "stale", []),  # of another run, as a beat that is still to come
        ({"receiver_beat": 101 * S}, "stale", []),
        ({"receiver_beat": 2**63}, "stale", []),
        ({"request_id": ""}, "invalid", []),  # a repetition could not be recognised
        ({"request_id": "a" * 65}, "invalid", ["more than 64"]),
        # The other fields of another version are not used.
        ({"protocol_version": 99, "receiver_beat": 0}, "version", ["99", str(PROTOCOL_VERSION)]),
    ],
)
def test_what_is_stale_or_invalid_is_refused(changes, code, said) -> None:
    answer = gate().refusal(envelope(100 * S, **changes))
    assert (answer.accepted, answer.code) == (False, code)
    assert [text for text in said if text not in answer.message] == []


def test_an_older_epoch_is_refused() -> None:
    """A replaced master gives no orders; a sender that knows a newer epoch may send requests."""
    assert gate().refusal(envelope(100 * S, epoch=2), epoch=3).code == "stale"
    assert gate().refusal(envelope(100 * S, epoch=3), epoch=3) is None
    assert gate().refusal(envelope(100 * S, epoch=4), epoch=3) is None


def test_a_repeated_request_gets_the_same_answer_also_while_it_is_carried_out() -> None:
    """A repeated request is not carried out again; the answer goes to every sender of it."""
    judge, first, again, later = gate(), Requested(), Requested(), Requested()
    assert not judge.repeated(envelope(1), first)
    assert judge.repeated(envelope(1), again)
    assert again.answers == []
    judge.remember(envelope(1), "done")
    assert judge.repeated(envelope(1), later)
    assert again.answers == later.answers == ["done"]
    assert first.answers == []  # the code that carries out the first request answers it


class Clock:
    """The receiver's clock."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> int:
        return int(self.now * S)


def admit(judge: RequestGate, request: Envelope) -> bool:
    """Return True if a request is admitted, and was not before, as `ControlServer` decides."""
    if not judge.knows(request) and judge.refusal(request) is not None:
        return False
    return not judge.repeated(request, Requested())


def flood(judge: RequestGate, count: int, beat: int) -> None:
    for number in range(count):
        assert admit(judge, envelope(beat, request_id=f"other {number} at {beat}"))


def test_no_id_is_used_twice_within_the_greatest_age_of_a_request() -> None:
    """A flood of other requests does not make the gate forget one that may still be repeated."""
    clock = Clock()
    judge = RequestGate(clock, 5.0)
    once = envelope(100 * S, request_id="once")
    assert admit(judge, once)
    flood(judge, 20_000, 100 * S)
    clock.now += 5.0
    assert not admit(judge, once)
    clock.now += 0.1
    flood(judge, 20_000, 105 * S)
    assert not judge.knows(once)
    assert judge.refusal(once).code == "stale"


def test_an_old_id_is_remembered_while_there_is_room() -> None:
    """A late repetition gets its answer, and is not refused as stale."""
    clock = Clock()
    judge = RequestGate(clock, 5.0)
    assert admit(judge, envelope(100 * S))
    clock.now += 60.0
    flood(judge, control._REMEMBERED - 2, 160 * S)
    assert judge.knows(envelope(100 * S))


def test_the_memory_of_the_gate_is_bounded() -> None:
    """More requests than it can remember are refused, not executed without protection."""
    clock = Clock()
    judge = RequestGate(clock, 5.0)
    flood(judge, 50_000, 100 * S)
    refusal = judge.refusal(envelope(100 * S, request_id="one more"))
    assert (refusal.code, "more than 50000 requests came" in refusal.message) == ("stale", True)
    clock.now += 5.1
    assert judge.refusal(envelope(105 * S, request_id="one more")) is None
    assert not judge._answers.keys() ^ judge._admitted.keys()
    assert len(judge._answers) < control._REMEMBERED


def test_the_repetitions_that_wait_are_bounded() -> None:
    """The newest repetitions get the answer, and older ones get none."""
    judge = gate()
    assert not judge.repeated(envelope(1), Requested())
    waiting = [Requested() for _ in range(1000)]
    assert all(judge.repeated(envelope(1), one) for one in waiting)
    judge.remember(envelope(1), "done")
    assert [one.answers for one in waiting if one.answers] == [["done"]] * 16
    assert waiting[-1].answers


def test_check_answer_raises_the_refusal() -> None:
    """A client raises the master's message, or names the master's version."""
    import pytest

    from rosrm.errors import Refused

    with pytest.raises(Refused, match="no such host"):
        check_answer(refused("unknown", "no such host"), "the master")
    stranger = refused("unknown", "whatever")
    stranger.protocol_version = 99
    with pytest.raises(Refused, match="the master speaks version 99"):
        check_answer(stranger, "the master")
    assert version_refusal(PROTOCOL_VERSION, "x") == ""


class Served:
    """A control server of a master without ROS, and the requests that it admits."""

    def __init__(self) -> None:
        self.handled: list[str] = []
        self.endpoints = SimpleNamespace(
            participant=SimpleNamespace(guard=CallbackGuard()), serve=self._serve
        )
        self.server = server = ControlServer(self.endpoints, 5.0)
        server.offer(srv.Cancel, "/rosrm/cancel", self._handle)
        server.offer(srv.RequestProcess, "/rosrm/poll", lambda *_: None, remember=False)

    def _serve(self, kind, _name, take) -> None:
        setattr(self, kind.__name__, take)

    def _handle(self, request, _sealed, respond) -> None:
        self.handled.append(request.envelope.request_id)
        respond(srv.Cancel.Response(answer=accepted()))

    def cancel(self, sender, number: int) -> None:
        request = Requested()
        request.peer = sender
        self.Cancel(srv.Cancel.Request(envelope=self._fresh(f"{number}")), request)
        (response,) = request.answers
        self.refusal = response.answer.message

    def poll(self, sender, number: int) -> None:
        request = Requested()
        request.peer = sender
        self.RequestProcess(srv.RequestProcess.Request(envelope=self._fresh(f"{number}")), request)

    @staticmethod
    def _fresh(request_id: str) -> Envelope:
        return envelope(clocks.boot_time_ns(), request_id=request_id)


def test_a_member_that_floods_the_gate_is_refused_alone(monkeypatch) -> None:
    """The requests of others are admitted, and their repetitions are recognized."""
    monkeypatch.setattr(control, "_REMEMBERED", 10)
    monkeypatch.setattr(control, "_MOST_REMEMBERED", 100)
    security = MasterSecurity(ClusterSecret(bytes(32)))
    ada, eve = security.peer("user:ada", 0), security.peer("user:eve", 0)
    served = Served()
    served.cancel(ada, 1)
    for number in range(200):
        served.cancel(eve, number)
    assert "more than 100 requests came" in served.refusal
    served.cancel(ada, 1)
    served.cancel(ada, 2)
    assert served.handled == ["1", *(str(number) for number in range(100)), "2"]


def test_long_polls_take_little_memory_of_a_gate(monkeypatch) -> None:
    """A thousand slaves send them for months."""
    monkeypatch.setattr(control, "clocks", clock := Clock())
    clock.boot_time_ns = clock
    slave = MasterSecurity(ClusterSecret(bytes(32))).peer("host:a", 0)
    served = Served()
    served._fresh = lambda name: envelope(clock(), request_id=name)
    for number in range(1000):
        served.poll(slave, number)
        clock.now += 30.0
    (gate,) = served.server._gates.values()
    assert len(gate._answers) <= 16


def test_remembered_answers_of_a_sender_are_bounded_in_bytes() -> None:
    """The newest are repeated; of the oldest only the ids stay."""
    one = RequestGate(lambda: 100 * S, 5.0, bound=Amount(1000, 100_000))
    for number in range(50):
        sent = envelope(100 * S, request_id=f"r{number}")
        assert not one.repeated(sent, Requested())
        one.remember(sent, srv.Apply.Response(answer=accepted(), actions="x" * 20_000))
    kept = sum(len(answer.actions) for answer in one._answers.values())
    assert kept <= 100_000
    for number, (size, code) in {49: (20_000, ""), 0: (0, "stale")}.items():
        again = Requested()
        assert one.repeated(envelope(100 * S, request_id=f"r{number}"), again)
        (answer,) = again.answers
        assert (len(answer.actions), answer.answer.code) == (size, code)
