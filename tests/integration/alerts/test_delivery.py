"""Notices wait on disk until their sink has taken them."""

import threading
from contextlib import closing

import pytest

from rosrm import Notice
from rosrm.extensions.guarded_sink import GuardedSink
from rosrm_alerts.delivery import Delivery
from rosrm_alerts.outbox import Outbox, OutboxError
from rosrm_alerts.sinks.webhook import Webhook
from rosrm_alerts.sinks.webhook_options import WebhookOptions
from rosrm_alerts.watch import Subject
from tests.waiting import wait_until
from tests.webhook_kit import Receiver


def notice(number: int) -> Notice:
    return Notice(f"event-{number}", float(number), "failed", "p failed", "ERROR", "p", "h")


@pytest.fixture
def receiver():
    with Receiver() as receiver:
        yield receiver


@pytest.fixture
def outbox(tmp_path):
    with closing(Outbox(tmp_path / "outbox.sqlite", most=5)) as outbox:
        yield outbox


def deliver(receiver: Receiver, outbox: Outbox) -> Delivery:
    return Delivery(
        "hook",
        GuardedSink("hook", Webhook(WebhookOptions(receiver.url))),
        outbox,
        2,
        first_retry=0.01,
    )


def test_a_receiver_that_fails_gets_all_notices_later(receiver, outbox):
    """In order, and each once."""
    receiver.answer = 503
    delivery = deliver(receiver, outbox)
    for number in range(3):
        outbox.commit([("hook", notice(number))], number, {})
    delivery.notify()
    wait_until(lambda: receiver.requests >= 3, "three attempts")

    receiver.answer = 200
    wait_until(lambda: not outbox.waiting("hook", 1), "an empty outbox")
    delivery.close(10.0)

    assert [one["id"] for one in receiver.notices] == ["event-0", "event-1", "event-2"]


@pytest.mark.parametrize("status", [400, 404])
def test_what_the_receiver_refuses_is_dropped(receiver, outbox, caplog, status):
    """A notice that is never accepted must not hold up the next one."""
    receiver.answer = status
    outbox.commit([("hook", notice(1))], 1, {})
    delivery = deliver(receiver, outbox)
    wait_until(lambda: not outbox.waiting("hook", 1), "an empty outbox")
    delivery.close(10.0)

    assert receiver.requests == 1
    assert f"1 notice dropped: 127.0.0.1 answers {status}" in caplog.text


def test_a_redirect_is_a_failure(receiver, outbox, caplog):
    """A POST that becomes a GET would lose the notice."""
    receiver.answer = 302
    outbox.commit([("hook", notice(1))], 1, {})
    delivery = deliver(receiver, outbox)
    wait_until(lambda: receiver.requests >= 2, "a second attempt")
    delivery.close(10.0)

    assert [one.notice.id for one in outbox.waiting("hook", 9)] == ["event-1"]


def test_a_new_process_continues_where_the_last_one_was_killed(tmp_path):
    """Notices, position and active alerts are in the file once `commit` has returned."""
    path, active = tmp_path / "state" / "outbox.sqlite", {("hot", Subject(host="h")): 7.0}
    first = Outbox(path)
    first.commit([("hook", notice(1)), ("horn", notice(1))], 42, active)
    first.close()

    with closing(Outbox(path)) as again:
        assert (again.position(), again.active()) == (42, active)
        assert [one.notice for one in again.waiting("horn", 9)] == [notice(1)]


def test_the_oldest_notices_are_dropped_beyond_the_bound(outbox):
    """An unreachable receiver does not fill the disk; the other sinks lose nothing."""
    outbox.commit([("other", notice(0))], 0, {})

    dropped = outbox.commit([("hook", notice(number)) for number in range(8)], 8, {})

    assert dropped == 3
    assert [one.notice.id for one in outbox.waiting("hook", 9)] == [
        f"event-{n}" for n in range(3, 8)
    ]
    assert len(outbox.waiting("other", 9)) == 1


def test_a_second_process_is_refused(outbox, tmp_path):
    """Two would send each notice twice."""
    with pytest.raises(OutboxError, match="is another `rosrm alerts run` using it"):
        Outbox(tmp_path / "outbox.sqlite")


class Unconnected:
    """A sink whose methods are those of a connection that cannot be made at first."""

    def __init__(self):
        self.attempts, self.taken = 0, []

    def __getattr__(self, name):
        self.attempts += 1
        if self.attempts == 1:
            raise ConnectionError("no route")
        return self.taken.append


def test_a_sink_without_its_methods_for_a_moment_gets_its_notices_later(outbox, caplog):
    """The search for the method is a part of the call, so its failure ends no thread."""
    outbox.commit([("odd", notice(1))], 1, {})
    sink = Unconnected()
    delivery = Delivery("odd", GuardedSink("odd", sink), outbox, first_retry=0.01)
    wait_until(lambda: not outbox.waiting("odd", 1), "an empty outbox")
    delivery.close(10.0)
    assert sink.taken == [[notice(1)]]
    assert "ConnectionError: no route" in caplog.text


class Hanging:
    """A sink that takes nothing until it is released."""

    def __init__(self):
        self.asked, self.released = threading.Event(), threading.Event()

    def send(self, _notices):
        self.asked.set()
        self.released.wait()

    def close(self):
        pass


def test_a_sink_that_hangs_is_named_once(outbox, caplog):
    """A connection without a time-out would otherwise be silent until the end."""
    outbox.commit([("odd", notice(1))], 1, {})
    sink = Hanging()
    delivery = Delivery("odd", GuardedSink("odd", sink), outbox, patience=0.0)
    assert sink.asked.wait(10.0)
    delivery.look()
    delivery.look()
    sink.released.set()
    delivery.close(10.0)
    (said,) = [one for one in caplog.messages if "has not returned" in one]
    assert said.startswith("sink odd: send has not returned for ")


def test_a_notice_that_cannot_be_removed_is_not_sent_again(receiver, outbox, caplog, monkeypatch):
    """The receiver has taken the notice; a full disk must not cause further sends of it."""
    outbox.commit([("hook", notice(1)), ("hook", notice(2))], 2, {})
    attempts, is_full, delivered = [], [True], outbox.delivered

    def full(waiting):
        if waiting:
            attempts.append(waiting)
        if waiting and is_full[0]:
            raise OutboxError("notices cannot be removed: database or disk is full")
        delivered(waiting)

    monkeypatch.setattr(outbox, "delivered", full)
    delivery = deliver(receiver, outbox)
    wait_until(lambda: len(attempts) >= 3, "three attempts")
    is_full[0] = False
    wait_until(lambda: not outbox.waiting("hook", 1), "an empty outbox")
    delivery.close(10.0)
    assert [one["id"] for one in receiver.notices] == ["event-1", "event-2"]
    assert "sink hook: notices cannot be removed: database or disk is full" in caplog.text


def test_a_full_disk_is_an_error_of_the_outbox(outbox):
    """Both the commit and the removal name the file."""
    outbox.commit([("hook", notice(1))], 1, {})
    outbox._file.execute(
        "CREATE TRIGGER full BEFORE DELETE ON notices "
        "BEGIN SELECT RAISE(ABORT, 'disk is full'); END"
    )
    with pytest.raises(OutboxError, match=r"outbox.sqlite: .* disk is full"):
        outbox.delivered(outbox.waiting("hook", 1))
