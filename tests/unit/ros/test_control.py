"""Gate for requests: the receiver refuses stale and repeated ones."""

from __future__ import annotations

import pytest

from rosrm.ros.control import RequestGate, check_answer, refused, version_refusal
from rosrm.version import PROTOCOL_VERSION
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


def test_the_gate_forgets_only_the_oldest() -> None:
    """The gate's memory is bounded.

    It holds far more requests than can arrive within the greatest age.
    """
    judge = gate()
    for number in range(10_001):
        assert not judge.repeated(envelope(1, request_id=str(number)), Requested())
    assert judge.repeated(envelope(1, request_id="1"), Requested())
    assert judge.repeated(envelope(1, request_id="10000"), Requested())
    assert not judge.repeated(envelope(1, request_id="0"), Requested())


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
