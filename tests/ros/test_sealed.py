"""Sealed topics and services over real DDS, with a stranger in the same domain."""

from __future__ import annotations

import os
from array import array

import pytest

from rosrm.keys.cluster import ClusterSecret, own_grant
from rosrm.keys.roles import principal_of
from rosrm.keys.sealing import FORMAT
from rosrm.keys.security import MasterSecurity, MemberSecurity
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import qos
from rosrm.ros.control import accepted
from rosrm.ros.participant import Participant
from rosrm.ros.sealed import SealedEndpoints
from rosrm.testing.local_cluster import claim_domain
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg, srv
from tests.waiting import holds_for, wait_until

SERVICE, TOPIC = "/rosrm/explain", "/rosrm/process_usage"
SECRET = ClusterSecret(bytes(range(32)))
ADA = SECRET.key_of(own_grant(principal_of("user:ada")))


class Stage:
    """A master, a user, and a stranger that receives and sends all messages without a key."""

    def __init__(self) -> None:
        domain, self.claim = claim_domain()
        names = ("rosrm_master", "rosrm_client", "stranger")
        self.parts = [Participant(RosSettings(domain=domain), name) for name in names]
        self.master, self.command, self.stranger = self.parts
        self.refused: list[str] = []  # by the master
        self.refused_answers: list[str] = []  # by the user
        self.ada = MemberSecurity(ADA)
        self.cluster = MasterSecurity(SECRET)
        self.server = SealedEndpoints(self.master, self.cluster, self.refused.append)
        self.user = SealedEndpoints(self.command, self.ada, self.refused_answers.append)
        self.asked: list[tuple[str, str]] = []
        self.raises = False

    def serve(self, *, first_contact: bool = True) -> None:
        def take(request, opened) -> None:
            self.asked.append((str(opened.peer.grant.principal), request.process))
            if self.raises:
                raise ValueError("broken handler")
            opened.answer(srv.Explain.Response(answer=accepted(), explanation=request.process))

        self.server.serve(srv.Explain, SERVICE, take, first_contact=first_contact)

    def client(self):
        client = self.user.client(srv.Explain, SERVICE, self.ada.master)
        wait_until(client.service_is_ready, "the service to be discovered", pause=self.spin)
        return client

    def ask(self, client, process: str):
        future = client.call_async(
            srv.Explain.Request(protocol_version=PROTOCOL_VERSION, process=process)
        )
        wait_until(future.done, f"an answer about {process}", pause=self.spin)
        return future.result()

    def record_requests(self) -> list[msg.Sealed]:
        """Let the stranger offer the same service, so that it receives every request, too."""
        recorded: list[msg.Sealed] = []

        def take(request, opened) -> None:
            recorded.append(request.message)
            for body in (b"", request.message.body, os.urandom(60)):
                opened.answer(
                    srv.Sealed.Response(message=self.forged(body, request.message.counter))
                )

        self.stranger.serve(srv.Sealed, SERVICE, take)
        return recorded

    def forged(self, body: bytes, counter: int = 1) -> msg.Sealed:
        return msg.Sealed(
            format=FORMAT, principal="user:ada", generation=0,
            run=array("B", self.cluster.run), receiver_run=array("B", self.cluster.run),
            counter=counter, body=array("B", body),
        )  # fmt: skip

    def spin(self, seconds: float) -> None:
        for part in self.parts:
            part.spin(seconds / len(self.parts))

    def close(self) -> None:
        for part in self.parts:
            part.close()
        self.claim.close()


@pytest.fixture
def stage():
    """Yield a stage in a domain of its own."""
    stage = Stage()
    yield stage
    stage.close()


def test_a_forged_answer_of_a_second_server_is_dropped(stage: Stage) -> None:
    """The stranger answers first, and cannot read the request."""
    stage.parts.reverse()  # so that the stranger's turn is before the master's
    stage.serve()
    client = stage.client()
    recorded = stage.record_requests()
    names = [f"patrol_{number}" for number in range(20)]
    while not recorded:
        names.append(f"patrol_{len(names)}")
        stage.ask(client, names[-1])
    for name in names[:20]:
        assert stage.ask(client, name).explanation == name
    assert {principal for principal, _ in stage.asked} == {"user:ada"}
    wait_until(lambda: len(recorded) > 20, "the stranger to see the requests", pause=stage.spin)
    # A shorter word is in random bytes by chance.
    assert not any(b"patrol_" in bytes(message.body) for message in recorded)
    assert SERVICE in stage.refused_answers


def test_a_stranger_is_not_answered(stage: Stage) -> None:
    """Neither a forged request nor a recorded one nor one of an unknown principal."""
    stage.serve()
    client = stage.client()
    recorded = stage.record_requests()
    while not recorded:
        stage.ask(client, "p")
    stage.asked.clear()
    unknown = stage.forged(os.urandom(50))
    unknown.principal = "host:\x1b[2J"
    changed = stage.forged(bytes(recorded[0].body), recorded[0].counter + 1)
    stranger, master = stage.stranger.node, stage.master.node
    client = stranger.create_client(srv.Sealed, SERVICE, qos_profile=qos.SERVICE)
    wait_until(
        lambda: (stranger.count_services(SERVICE), master.count_clients(SERVICE)) == (2, 2),
        "stranger and master to discover each other", pause=stage.spin,
    )  # fmt: skip
    for message in (recorded[0], stage.forged(b""), stage.forged(os.urandom(50)), unknown, changed):
        client.call_async(srv.Sealed.Request(message=message))
    wait_until(
        lambda: len(stage.refused) == 5, "five refusals",
        seen=lambda: stage.refused, pause=stage.spin,
    )  # fmt: skip
    assert stage.asked == []


def test_a_request_for_a_former_run_is_answered_as_stale(stage: Stage) -> None:
    """The request of a genuine sender has no effect; the sender needs a new handshake."""
    stage.serve(first_contact=False)
    client = stage.client()
    client.peer.run = bytes(16)
    answer = stage.ask(client, "p").answer
    assert (answer.accepted, answer.code) == (False, "stale")
    client.peer.run = stage.cluster.run
    assert stage.ask(client, "p").explanation == "p"
    assert stage.asked == [("user:ada", "p")]


def test_a_handler_that_raises_answers_as_failed(stage: Stage) -> None:
    """The user gets the kind of the error, and the service answers the next request."""
    stage.serve()
    stage.raises = True
    client = stage.client()
    answer = stage.ask(client, "p").answer
    assert (answer.accepted, answer.code) == (False, "failed")
    assert "ValueError" in answer.message
    stage.raises = False
    assert stage.ask(client, "q").answer.accepted


def test_messages_of_a_topic_arrive_once_and_only_from_principals(stage: Stage) -> None:
    """Repeated and forged messages of a stranger are refused, messages for a former run dropped."""
    taken: list[tuple[int, str]] = []
    stage.server.subscribe(
        msg.ProcessUsage, TOPIC, qos.STATUSES,
        lambda message, peer: taken.append((message.host_id, str(peer.grant.principal))),
    )  # fmt: skip
    publisher = stage.user.publisher(msg.ProcessUsage, TOPIC, qos.STATUSES, stage.ada.master)
    seen: list[msg.Sealed] = []
    stage.stranger.node.create_subscription(msg.Sealed, TOPIC, seen.append, qos.STATUSES)
    forger = stage.stranger.node.create_publisher(msg.Sealed, TOPIC, qos.STATUSES)
    counts = [one.get_subscription_count for one in (publisher._publisher, forger)]
    wait_until(lambda: all(count() == 2 for count in counts), "both readers", pause=stage.spin)
    publisher.publish(msg.ProcessUsage(host_id=1))  # for a run that the user does not know yet
    stage.ada.master.run = stage.cluster.run
    publisher.publish(msg.ProcessUsage(host_id=2))
    wait_until(lambda: len(seen) == 2 and taken, "the messages of the user", pause=stage.spin)
    for message in (*seen, stage.forged(b""), stage.forged(os.urandom(40))):
        forger.publish(message)
    wait_until(lambda: len(stage.refused) == 4, "the stranger's messages", pause=stage.spin)
    holds_for(0.2, lambda: taken == [(2, "user:ada")], "one message", pause=stage.spin)
