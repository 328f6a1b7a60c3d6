"""Orders to a slave: each carries a recent beat of that slave."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from rosrm import clocks
from rosrm.core.master.commands import Assign, SendOrder
from rosrm.core.master.events import BAD_RESULT
from rosrm.keys.cluster import ClusterSecret
from rosrm.keys.security import MasterSecurity
from rosrm.model.orders import (
    FenceInstance,
    ReloadSettings,
    ReportInstances,
    StartInstance,
    StopInstance,
)
from rosrm.model.values import Assignment, HostDescription, InstanceId, ProcessSpec
from rosrm.ros.control import accepted
from rosrm.ros.master.reading_decoder import Runs
from rosrm.ros.master.slave_links import HostLinks, _order_answered
from rosrm.ros.orders import journal_of, order_from_msg
from rosrm_msgs import srv
from rosrm_msgs.msg import Envelope

HOST, RUN = 1, 500
SECURITY = MasterSecurity(ClusterSecret(bytes(32)))
SLAVE, SLAVE_RUN = SECURITY.peer("host:shelf", 0), b"r" * 16
DESCRIPTION = HostDescription("shelf", RUN)


class FakeClient:
    """Fake client that stores the requests instead of sending them."""

    def __init__(self) -> None:
        self.beats: list[int] = []
        self.requests: list = []

    def envelope(self, beat, epoch):
        self.beats.append(beat)
        return Envelope(epoch=epoch, receiver_beat=beat)

    def call(self, control, request, *arguments):
        self.requests.append(request)


def receive_reading(links: HostLinks, beat: int, sequence: int) -> None:
    column = np.array([HOST], np.int64)
    one = np.ones(1, np.int64)
    links.reading_stats.take(
        Runs(column, np.array([RUN], np.uint64), one, one * sequence, np.array([beat], np.uint64),
             one), 0.0,
    )  # fmt: skip
    links.reading_received([HOST])


class Control:
    """Fake client of the slave's service."""

    ready = True

    def service_is_ready(self) -> bool:
        return self.ready


@pytest.fixture
def control() -> Control:
    return Control()


@pytest.fixture
def links(monkeypatch, control) -> HostLinks:
    endpoints = SimpleNamespace(
        participant=SimpleNamespace(settings=SimpleNamespace(namespace="/rosrm")),
        security=SECURITY, client=lambda *_: control,
    )  # fmt: skip
    links = HostLinks(endpoints, "master test", 1, 5.0, lambda event: None)
    links._client = FakeClient()
    monkeypatch.setattr(
        "rosrm.ros.master.slave_links.order_to_msg",
        lambda order: SimpleNamespace(envelope=None, order=order),
    )
    return links


def test_an_order_waits_until_discovery_finds_the_service_of_the_slave(links, control):
    """An earlier order would be lost, and repeated only after `control.order_retry`."""
    control.ready = False
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    receive_reading(links, beat=100, sequence=1)
    links.order(SendOrder(1, HOST, ReportInstances()), now=0.0)
    receive_reading(links, beat=200, sequence=2)
    assert links._client.beats == []
    control.ready = True
    receive_reading(links, beat=300, sequence=3)
    assert links._client.beats == [300]


def test_an_order_does_not_overtake_one_that_waits_for_discovery(links, control):
    """The later order is the newer decision, for example another restart policy."""
    control.ready = False
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    receive_reading(links, beat=100, sequence=1)
    links.order(SendOrder(1, HOST, ReportInstances()), now=0.0)
    control.ready = True
    links.order(SendOrder(2, HOST, ReloadSettings()), now=0.0)
    receive_reading(links, beat=200, sequence=2)
    sent = [request.order for request in links._client.requests]
    assert sent == [ReportInstances(), ReloadSettings()]


@pytest.mark.parametrize("end", [StopInstance, FenceInstance])
def test_a_stop_replaces_the_start_that_waits(links, end):
    """Otherwise a job that is withdrawn from a silent slave begins there, and again elsewhere."""
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    one, other = assignment("one", 0), assignment("other", 0)
    for number, started in enumerate((one, other)):
        links.order(SendOrder(number, HOST, StartInstance(started)), now=0.0)
    links.order(SendOrder(2, HOST, end(one.instance)), now=0.0)
    receive_reading(links, beat=100, sequence=1)
    sent = [request.order for request in links._client.requests]
    assert sent == [StartInstance(other), end(one.instance)]


def test_discovery_is_asked_once_for_each_registration(links, control):
    """The question searches the endpoints of all hosts, so that its cost grows with the cluster."""
    order = SendOrder(1, HOST, ReportInstances())
    for sequence, ready in enumerate((True, False), start=1):
        control.ready = ready
        links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
        receive_reading(links, beat=100 * sequence, sequence=sequence)
        links.order(order, now=0.0)
        control.ready = False
        links.order(order, now=0.0)
    assert links._client.beats == [100, 100]


def test_discovery_is_asked_again_after_a_silence(links, control):
    """DDS may have removed the slave, which still receives beats and does not register again."""
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    receive_reading(links, beat=100, sequence=1)
    links.order(SendOrder(1, HOST, ReportInstances()), now=0.0)
    links.note_silent([HOST, HOST + 1])
    control.ready = False
    links.order(SendOrder(2, HOST, ReportInstances()), now=0.0)
    assert links._client.beats == [100]
    control.ready = True
    receive_reading(links, beat=200, sequence=2)
    assert links._client.beats == [100, 200]


def test_an_order_long_after_the_registration_does_not_ask_discovery(links, control):
    """The check takes milliseconds with a thousand hosts, and the order is sent in any case."""
    control.ready = False
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    receive_reading(links, beat=100, sequence=1)
    links.registered(HOST).searched_from -= 60.0
    links.order(SendOrder(1, HOST, ReportInstances()), now=0.0)
    assert links._client.beats == [100]


def test_an_order_to_a_slave_that_registers_again_waits_for_a_new_beat(links):
    """A host that was cut off has only old readings; an order with their beat would be stale."""
    client = links._client
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    receive_reading(links, beat=100, sequence=1)
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    links.order(SendOrder(1, HOST, ReportInstances()), now=0.0)
    assert client.beats == []
    receive_reading(links, beat=900, sequence=2)
    assert client.beats == [900]


def test_waiting_requests_of_one_slave_are_bounded(links):
    """A sender repeats requests for a host that sends no reading; the oldest get no answer."""
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    link, sent = links.find(HOST, RUN, SLAVE), []
    for number in range(1200):
        links.after_first_reading(link, partial(sent.append, number))
    receive_reading(links, beat=100, sequence=1)
    assert sent == list(range(200, 1200))


def test_readings_are_polled_for_a_slave_only_a_moment_after_its_registration(links, monkeypatch):
    """A request of a slave that has died since waits for ever, and must not occupy the master."""
    now = clocks.boot_time()
    monkeypatch.setattr("rosrm.clocks.boot_time", lambda: now)
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    before = links.awaits_first_readings
    links.after_first_reading(links.registered(HOST), lambda: None)
    during = links.awaits_first_readings
    now += 1.0
    assert (before, during, links.awaits_first_readings) == (False, True, False)


def test_introductions_take_no_place_of_an_order(links):
    """Users can request any number of introductions; beyond the bound each gets no answer."""
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    link, sent = links.find(HOST, RUN, SLAVE), []
    links.after_first_reading(link, partial(sent.append, "order"))
    for _ in range(1200):
        links.introduce_after_first_reading(
            link, partial(sent.append, "introduction"), 5.0, lambda _: sent.append("refused")
        )
    assert sent == 1100 * ["refused"]
    receive_reading(links, beat=100, sequence=1)
    assert sent[1100:] == ["order", *100 * ["introduction"]]


def test_an_introduction_ends_at_its_deadline(links):
    """An order that waits beside it stays."""
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    link, ended = links.find(HOST, RUN, SLAVE), []
    links._client.expire = lambda now: None
    links.after_first_reading(link, lambda: ended.append("sent"))
    links.introduce_after_first_reading(link, lambda: None, 5.0, ended.append)
    links.expire(4.9)
    assert ended == []
    links.expire(5.0)
    links.expire(6.0)
    assert ended == [None]
    receive_reading(links, beat=100, sequence=1)
    assert ended == [None, "sent"]


def test_the_link_of_a_slave_with_a_revoked_key_is_closed(links) -> None:
    """Orders and requests that wait for it end without an answer."""
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    link, ended = links.find(HOST, RUN, SLAVE), []
    links.after_first_reading(link, lambda: None, done=ended.append)
    links.shut_revoked(lambda _: True)
    assert links.find(HOST, RUN, SLAVE) is link
    links.shut_revoked(lambda _: False)
    assert ended == [None]
    assert links.find(HOST, RUN, SLAVE) is None
    assert links.slave_of(HOST) is None
    links.order(SendOrder(1, HOST, ReportInstances()), now=0.0)
    assert links._client.requests == []


def test_a_slave_reports_only_its_own_host(links) -> None:
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    other = SECURITY.peer("host:other", 0)
    assert links.is_slave_of(HOST, SLAVE)
    assert not links.is_slave_of(HOST, other)
    assert links.find(HOST, RUN, other) is None


def assignment(process: str, snapshots_from: int) -> Assignment:
    spec = ProcessSpec(process, command=("true",))
    return Assignment(InstanceId(process, 7), spec, 1, process, snapshots_from=snapshots_from)


def test_only_the_messages_have_the_key_and_only_for_a_process_with_snapshots(links):
    """The core derives, stores and journals no key."""
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    link, answers = links.find(HOST, RUN, SLAVE), []
    kept = [assignment("stateful", 1), assignment("stateless", 0)]
    for one in kept:
        links.assign(Assign(HOST, one))
    assert link.outbox == kept
    links.open_poll(link, answers.append, lambda: None)
    links.flush(0)
    keys = [bytes(one.state_key) for one in answers[0].assignments]
    assert keys == [SECURITY.snapshot_key("stateful", 1), b""]
    receive_reading(links, beat=100, sequence=1)
    for number, one in enumerate(kept):
        links.order(SendOrder(number, HOST, StartInstance(one)), now=0.0)
    started = [request.order.assignment.state_key for request in links._client.requests]
    assert started == keys


@pytest.fixture
def poll(links) -> list:
    """Open a request for work of the slave; return the answers to it."""
    answers: list = []
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    receive_reading(links, beat=100, sequence=1)
    links.open_poll(links.find(HOST, RUN, SLAVE), answers.append, lambda: None)
    return answers


def test_a_single_assignment_is_an_order_with_beat_and_journal(links, poll):
    """The answer to a request would reach the readers of all slaves; the request stays open."""
    one = assignment("one", 0)
    for journal in (41, 42):
        links.assign(Assign(HOST, one))
        links.flush(journal)
    assert [journal_of(request) for request in links._client.requests] == [41, 42]
    assert [order_from_msg(request) for request in links._client.requests] == 2 * [
        StartInstance(one)
    ]
    assert links._client.beats == [100, 100]
    assert poll == []


def test_several_assignments_are_one_answer(links, poll):
    """A burst of orders would overflow the slave's socket; lost orders are repeated after 2 s."""
    for name in ("one", "two"):
        links.assign(Assign(HOST, assignment(name, 0)))
    links.flush(41)
    links.flush(42)
    (answer,) = poll
    assert [one.instance.process for one in answer.assignments] == ["one", "two"]
    assert (answer.journal, answer.slave_beat) == (41, 100)
    assert links._client.requests == []


def test_an_assignment_waits_for_no_discovery(links, poll, control):
    """An order to a service that DDS has not discovered is lost; the answer is not."""
    control.ready = False
    links.assign(Assign(HOST, assignment("one", 0)))
    links.flush(41)
    assert [len(answer.assignments) for answer in poll] == [1]
    assert links._client.requests == []


def test_an_assignment_waits_for_a_request_for_work(links):
    """A slave without an open request may be leaving, or not yet be under its limits."""
    links.renew(HOST, DESCRIPTION, SLAVE, SLAVE_RUN)
    receive_reading(links, beat=100, sequence=1)
    links.assign(Assign(HOST, assignment("one", 0)))
    links.flush(41)
    assert links._client.requests == []
    links.open_poll(links.find(HOST, RUN, SLAVE), lambda _: None, lambda: None)
    links.flush(42)
    assert len(links._client.requests) == 1


@pytest.mark.parametrize("text", ["null", "[1]", "3", "{"])
def test_a_result_that_is_no_object_fails_the_order(text):
    """The step fails with that message; the callback of the answer raises nothing."""
    response = srv.ControlHost.Response(answer=accepted(), result=text)
    event = _order_answered(7, response)
    assert (event.order, event.accepted, event.code) == (7, False, BAD_RESULT)
    assert "a result is" in event.message
