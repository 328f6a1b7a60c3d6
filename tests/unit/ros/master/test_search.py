"""Search of a starting master: it ends early only if all hosts of the journal wait for it."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from rosrm.config.settings import ControlSettings
from rosrm.core.master.events import HostRegistered, TimePassed
from rosrm.keys.roles import Principal
from rosrm.keys.security import NoSecurity
from rosrm.model.values import HostDescription
from rosrm.ros.master.rivals import RivalWatch
from rosrm.ros.master.search import MasterSearch
from rosrm.ros.master.services import MasterIdentity, MasterServices
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg, srv
from tests.unit.ros.wire import Wire

IDENTITY = MasterIdentity("m", "r", 8, 3, 11)


class ServingWire(Wire):
    """Endpoints that store the handlers of services."""

    def __init__(self) -> None:
        super().__init__()
        self.handlers = {}

    def serve(self, kind, _name, handle, **_named) -> None:
        self.handlers[kind] = handle

    def post(self, callback) -> None:
        callback()


class FakeRequest:
    """A genuine request, with its answers."""

    def __init__(self, principal: Principal) -> None:
        self.peer, self.run = NoSecurity(principal).master, b""
        self.answers = []

    @property
    def answered(self) -> bool:
        return bool(self.answers)

    def answer(self, response) -> None:
        self.answers.append(response)


class StartingMaster:
    """A starting master without ROS."""

    def __init__(self) -> None:
        self.wire, self.events = ServingWire(), []
        self.services = MasterServices(
            self.wire, None, IDENTITY, None, control=ControlSettings(), handle=self.events.append,
            refuse=lambda *_: None, strangers=lambda: "",
        )  # fmt: skip
        rivals = RivalWatch(self.wire, IDENTITY, lambda *_: None)
        endpoint = SimpleNamespace(
            events=self.events, services=self.services, rivals=rivals,
            take_events=lambda: list(self.events),
        )  # fmt: skip
        self.search = MasterSearch(self.wire, endpoint)

    def send_handshake(self, role: str, name: str) -> FakeRequest:
        request = FakeRequest(Principal("host" if role == "slave" else "user", name))
        handshake = srv.Handshake.Request(
            protocol_version=PROTOCOL_VERSION, role=role, name=name
        )  # fmt: skip
        self.wire.handlers[srv.Handshake](handshake, request)
        return request

    def register(self, name: str, beat: int) -> FakeRequest:
        request = FakeRequest(Principal("host", name))
        envelope = msg.Envelope(
            protocol_version=PROTOCOL_VERSION, request_id=name, receiver_beat=beat
        )
        host = msg.HostDescription(name=name, incarnation=5, period=0.1)
        self.wire.handlers[srv.RegisterHost](
            srv.RegisterHost.Request(envelope=envelope, host=host), request
        )
        return request


@pytest.fixture
def start() -> StartingMaster:
    return StartingMaster()


def test_a_slave_can_register_and_waits_for_the_decision(start) -> None:
    """The slave's handshake is answered; the registration waits as an event for the core."""
    (handshake,) = start.send_handshake("slave", "h0").answers
    registration = start.register("h0", handshake.beat)
    assert [event.description.name for event in start.events] == ["h0"]
    assert not registration.answered


@pytest.mark.parametrize("role", ["client", "master"])
def test_handshakes_of_clients_and_masters_are_answered_after_the_search(start, role) -> None:
    """A client must not find a master that may end at once."""
    request = start.send_handshake(role, "ada")
    assert not request.answered
    start.search.end()
    assert [answer.pid for answer in request.answers] == [IDENTITY.pid]
    assert start.send_handshake(role, "ada").answered


@pytest.mark.parametrize(
    ("hosts", "registering", "ends"),
    [
        (["a", "b"], ["a", "b"], True), (["a", "b"], ["b", "b", "c"], False),
        (["a"], ["c", "a"], True), ([], ["a"], False),
    ],
)  # fmt: skip
def test_the_search_ends_when_all_hosts_of_the_journal_register(
    start, hosts, registering, ends
) -> None:
    """Without a host in the journal, nothing shows that there is no other master."""
    start.events.append(TimePassed())
    start.events += [HostRegistered(1, HostDescription(name, 5), ()) for name in registering]
    assert start.search.has_ended(hosts) is ends


def test_a_master_that_answers_ends_the_search(start) -> None:
    """The waiting slaves are refused, so that they find that master."""
    (handshake,) = start.send_handshake("slave", "h0").answers
    registration = start.register("h0", handshake.beat)
    start.search.ask(100.0)
    (asked,) = start.wire.to[srv.Handshake].sent
    assert (asked.request.role, asked.request.name) == ("master", IDENTITY.as_client)
    asked.answer(srv.Handshake.Response(protocol_version=PROTOCOL_VERSION, pid=9))
    assert start.search.has_ended(["h0", "h1"])
    assert start.search.found.pid == 9
    start.search.refuse_registrations("a master runs already")
    assert [answer.answer.code for answer in registration.answers] == ["journal"]
