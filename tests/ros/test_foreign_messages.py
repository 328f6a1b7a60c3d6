"""Foreign, late and invalid messages to a real cluster: refused and reported."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from rosrm.config.settings import ControlSettings
from rosrm.errors import NoMaster, Refused
from rosrm.model.values import HostDescription, ResourceDescription
from rosrm.ros import convert, names, qos
from rosrm.ros.control import ControlClient
from rosrm.ros.master_connection import MasterClient, find_master, wait_for_service
from rosrm.ros.participant import Participant
from rosrm.ros.reading_codec import LAYOUT, encode
from rosrm.testing.local_cluster import claim_domain
from rosrm.testing.loopback import settings_on_this_machine
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg, srv
from tests.ros.calls import answer_to
from tests.ros.clusters import host, job, service
from tests.waiting import PATIENCE, wait_until

path = names.Names("/rosrm")


#: Maximum age of a request in seconds; longer than the default, because a machine may be busy.
MAX_AGE = 20.0


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"), control=ControlSettings(max_age=MAX_AGE))


class Stranger:
    """A participant that sends messages which rosrm's own parts never send."""

    RUN = 4242  # the incarnation of its hosts

    def __init__(self, participant: Participant):
        self.participant = participant
        self.control = ControlClient(participant, "stranger test")
        self.clients = {}

    def client(self, kind, name: str):
        if name not in self.clients:
            client = self.participant.node.create_client(kind, name, qos_profile=qos.SERVICE)
            assert wait_for_service(self.participant, client, time.monotonic() + PATIENCE), name
            self.clients[name] = client
        return self.clients[name]

    def ask(self, kind, name: str, request):
        """Call a service; repeat requests that are lost before discovery is complete."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            future = self.client(kind, name).call_async(request)
            response = answer_to(self.participant, future, time.monotonic() + 2.0)
            if response is not None:
                return response
        raise AssertionError(f"no answer of {name}")

    def hello(self, **changes):
        fields = {
            "protocol_version": PROTOCOL_VERSION, "software_version": "x", "role": "client",
            "name": "stranger",
        }  # fmt: skip
        request = srv.Handshake.Request(**{**fields, **changes})
        return self.ask(srv.Handshake, path(names.HANDSHAKE), request)

    def envelope(self, **changes):
        hello = self.hello()
        envelope = self.control.envelope(hello.beat, hello.epoch)
        for name, value in changes.items():
            setattr(envelope, name, value)
        return envelope

    def submit(self, *specs, envelope=None):
        request = srv.Submit.Request(
            envelope=envelope or self.envelope(),
            processes=[convert.spec_to_msg(spec) for spec in specs],
        )
        return self.ask(srv.Submit, path(names.SUBMIT), request).answer

    @contextlib.contextmanager
    def registered(self, name: str, capacity: float, **labels: str) -> Iterator[int]:
        """Register a host of one resource that consists of this registration; yield its number."""
        description = HostDescription(
            name, self.RUN, labels=labels, period=0.1,
            resources=(ResourceDescription("memory", "B", capacity),),
        )  # fmt: skip
        request = srv.RegisterHost.Request(
            envelope=self.envelope(), host=convert.host_to_msg(description)
        )
        answer = self.ask(srv.RegisterHost, path(names.REGISTER_HOST), request)
        assert answer.answer.accepted
        yield answer.host_id
        self.ask(
            srv.Leave, path(names.LEAVE),
            srv.Leave.Request(
                envelope=self.envelope(), host_id=answer.host_id, incarnation=self.RUN
            ),
        )  # fmt: skip

    def publisher(self, kind, name: str, profile):
        publisher = self.participant.node.create_publisher(kind, path(name), profile)
        wait_until(
            publisher.get_subscription_count, f"a subscription to {name}",
            pause=self.participant.spin,
        )  # fmt: skip
        return publisher


@pytest.fixture(scope="module")
def stranger(cluster):
    with Participant(cluster.ros, "rosrm_test_stranger") as participant:
        yield Stranger(participant)


# --- versions ---------------------------------------------------------------------------------


def test_a_client_of_another_version_is_refused(cluster, stranger) -> None:
    """The master refuses the client with a reason, and records an event."""
    answer = stranger.hello(protocol_version=99, name="from-the-future")
    assert not answer.accepted
    assert "version 99" in answer.message
    assert str(PROTOCOL_VERSION) in answer.message
    cluster.wait_for_event("peer_refused", "from-the-future")


def test_a_request_of_another_version_is_refused(cluster, stranger) -> None:
    """The services without a handshake also refuse the request, without effect."""
    envelope = stranger.envelope(protocol_version=99)
    answers = [stranger.submit(job("futuristic", "true"), envelope=envelope)]
    for kind, service_name in (
        (srv.List, path(names.LIST)), (srv.Explain, path(names.EXPLAIN)),
        (srv.ReadLog, path.of_host("h0", names.READ_LOG)),
    ):  # fmt: skip
        answers.append(stranger.ask(kind, service_name, kind.Request(protocol_version=99)).answer)
    for answer in answers:
        assert (answer.accepted, answer.code) == (False, "version")
        assert "99" in answer.message
    assert "futuristic" not in {row.name for row in cluster.client.list(processes=True).processes}


def test_a_slave_refuses_a_master_of_another_version(make_cluster) -> None:
    """The slave logs both versions, ends with 1, and leaves nothing behind."""
    cluster = make_cluster(started=False)
    asked = []

    def answer(request, open_request) -> None:
        asked.append(request)
        open_request.answer(
            srv.Handshake.Response(
                protocol_version=99, accepted=True, master="other", hostname="robot-9", epoch=1,
                beat=time.monotonic_ns(),
            )
        )  # fmt: skip

    with Participant(cluster.ros, "rosrm_test_master") as other:
        other.serve(srv.Handshake, path(names.HANDSHAKE), answer)
        slave = cluster.start_slave(host("lonely")).process
        wait_until(lambda: slave.poll() is not None, "the end of the slave", pause=other.spin)
    assert slave.returncode == 1
    said = cluster.log_of("lonely")
    assert "version 99" in said
    assert "robot-9" in said
    assert asked[0].role == "slave"


# --- age and repetition -----------------------------------------------------------------------


def test_a_late_request_is_refused(cluster, stranger) -> None:
    """The master refuses a beat that is too old by its own clock, or not its own."""
    beat = stranger.hello().beat
    for receiver_beat in (beat - int((MAX_AGE + 1.0) * 1e9), beat + 10**12, 0):
        envelope = stranger.envelope(receiver_beat=receiver_beat)
        answer = stranger.submit(job("late", "true"), envelope=envelope)
        assert (answer.accepted, answer.code) == (False, "stale")
    assert "late" not in {row.name for row in cluster.client.list(processes=True).processes}


def test_a_repeated_request_is_done_once_and_answered_again(cluster, stranger) -> None:
    """Two requests with one ID get the same answer, and start one process."""
    envelope = stranger.envelope()
    answers = [stranger.submit(job("once", "true"), envelope=envelope) for _ in range(2)]
    assert all(answer.accepted for answer in answers)
    assert answers[0] == answers[1]
    cluster.ended("once")
    assert cluster.kinds("once").count("submitted") == 1


def test_a_slave_judges_its_orders(cluster, stranger) -> None:
    """A slave refuses late, outdated, foreign and unknown orders, and its process keeps running."""
    cluster.submit(service("target"))
    row = cluster.wait("target", "running")
    control = path.of_host("h0", names.CONTROL)
    epoch = stranger.hello().epoch

    def order(**changes):
        now = time.monotonic_ns()  # this machine's clock, and so the slave's own
        envelope = stranger.control.envelope(now, epoch)
        action = changes.pop("action", srv.ControlHost.Request.STOP)
        for name, value in changes.items():
            setattr(envelope, name, value)
        request = srv.ControlHost.Request(
            envelope=envelope, action=action,
            instance=msg.InstanceId(process="target", number=row.number),
        )  # fmt: skip
        return stranger.ask(srv.ControlHost, control, request).answer

    assert order(receiver_beat=time.monotonic_ns() - 10**10).code == "stale"
    assert order(receiver_beat=0).code == "stale"
    assert order(epoch=epoch - 1).code == "stale"
    assert order(protocol_version=99).code == "version"
    for action in (99, srv.ControlHost.Request.START, srv.ControlHost.Request.EXECUTE):
        answer = order(action=action)
        assert (answer.accepted, answer.code in ("stale", "version")) == (False, False)
    assert cluster.process("target").pid == row.pid
    cluster.cancel("target")


# --- many at once -----------------------------------------------------------------------------


def test_three_hundred_requests_at_once_are_all_answered(cluster, stranger) -> None:
    """The default queue depth of a service would silently drop most of them."""
    envelopes = [stranger.envelope() for _ in range(3)]
    client = stranger.client(srv.Submit, path(names.SUBMIT))
    futures = []
    for number in range(300):
        envelope = stranger.control.envelope(envelopes[-1].receiver_beat, envelopes[-1].epoch)
        spec = convert.spec_to_msg(job(f"burst-{number:03}", "true"))
        futures.append(client.call_async(srv.Submit.Request(envelope=envelope, processes=[spec])))
    deadline = time.monotonic() + PATIENCE
    for number, future in enumerate(futures):
        response = answer_to(stranger.participant, future, deadline)
        assert response is not None, f"request {number} of 300 was not answered"
        assert response.answer.accepted, response.answer.message
    cluster.wait_until(
        "300 finished",
        lambda v: sum(
            r.state == "finished" for r in v.processes if r.name.startswith("burst")
        ) == 300,
        timeout=60.0,
    )  # fmt: skip
    order = [e.process for e in cluster.events("assigned", newest=5000) if "burst" in e.process]
    assert order == [f"burst-{number:03}" for number in range(300)]


# --- invalid ----------------------------------------------------------------------------------


def test_an_invalid_submission_is_refused(cluster, stranger) -> None:
    """The refusal of the whole batch has the reason, and the master keeps running."""
    processes = [convert.spec_to_msg(job(name, "true")) for name in ("fine", "mad")]
    processes[1].parameters = [msg.KeyValue(key="deep", value="[" * 50_000)]
    request = srv.Submit.Request(envelope=stranger.envelope(), processes=processes)
    answer = stranger.ask(srv.Submit, path(names.SUBMIT), request).answer
    assert not answer.accepted
    assert "deep" in answer.message
    assert "fine" not in {row.name for row in cluster.client.list(processes=True).processes}


def test_an_invalid_host_is_refused(cluster, stranger) -> None:
    """The host is not registered."""
    resources = (ResourceDescription("memory", "B", 1.0),)
    description = convert.host_to_msg(HostDescription("mad", 77, resources=resources, period=0.1))
    description.resources[0].capacity = float("nan")
    request = srv.RegisterHost.Request(envelope=stranger.envelope(), host=description)
    answer = stranger.ask(srv.RegisterHost, path(names.REGISTER_HOST), request).answer
    assert not answer.accepted
    assert "mad" not in {row.description.name for row in cluster.client.list(hosts=True).hosts}


def reading(cluster, **changes):
    row = cluster.host("h0")
    record = np.zeros((), LAYOUT)
    record["protocol_version"] = PROTOCOL_VERSION
    record["host_id"], record["incarnation"] = row.host_id, row.description.incarnation
    record["sequence"], record["beat"] = 2**40, time.monotonic_ns()
    record["present"], record["flags"] = 0b11, 1
    record["limit"] = 1.0
    for name, value in changes.items():
        record[name] = value
    return encode(record)


def test_an_invalid_reading_is_refused(cluster, stranger) -> None:
    """The reading is refused with an event and without effect; the next valid reading counts."""
    name = "mad"
    with stranger.registered(name, capacity=1000.0) as number:
        publisher = stranger.publisher(msg.ResourceInfo, names.RESOURCE_INFO, qos.READING_OUT)

        def told(at: int, value: float, until) -> None:
            """Publish best-effort readings until one arrives; sequences grow from `at` on."""
            values = np.zeros(16, np.float32)
            values[0] = value
            row = {"host_id": number, "incarnation": Stranger.RUN, "present": 1, "usage": values}
            sequences = itertools.count(at)

            def publish(_: float) -> None:
                publisher.publish(reading(cluster, sequence=next(sequences), **row))
                cluster.client.spin(0.05)

            wait_until(until, f"a reading of {value}", pause=publish)

        def memory():
            return cluster.host(name).resources[0]

        told(1, 0.25, lambda: memory().usage == 0.25)
        told(500, float("nan"), lambda: cluster.events("reading_refused", host=name))
        assert memory().usage == 0.25
        told(1000, 0.5, lambda: memory().usage == 0.5)
    for resource in cluster.host("h0").resources:
        assert 0.0 <= resource.usage <= 2.0
    cluster.run(job("after-the-reading", "true"))


def test_a_reading_of_another_version_is_refused(cluster, stranger) -> None:
    """The master reports readings of another version once, not ten times a second."""
    publisher = stranger.publisher(msg.ResourceInfo, names.RESOURCE_INFO, qos.READING_OUT)

    def told() -> list:
        return [e for e in cluster.events("peer_refused") if "resource_info" in e.message]

    def publish(_: float) -> None:
        publisher.publish(reading(cluster, protocol_version=99))
        cluster.client.spin(0.05)

    wait_until(told, "the refusal", pause=publish)
    for _ in range(20):
        publish(0.0)
    assert "version 99" in told()[0].message
    assert all(b.elapsed - a.elapsed >= 10.0 for a, b in itertools.pairwise(told()))


def test_one_message_silences_no_host(cluster, stranger) -> None:
    """Numbers that no slave reaches, in the name of a host: the next job is placed and finishes."""
    row = cluster.host("h0")
    ours = {"host_id": row.host_id, "incarnation": row.description.incarnation}
    readings = stranger.publisher(msg.ResourceInfo, names.RESOURCE_INFO, qos.READING_OUT)
    batches = stranger.publisher(msg.ProcessStatusBatch, names.PROCESS_STATUS, qos.STATUSES)
    for _ in range(20):  # the readings are best effort
        readings.publish(reading(cluster, sequence=2**64 - 1, beat=2**64 - 1))
        cluster.client.spin(0.02)
    batches.publish(
        msg.ProcessStatusBatch(protocol_version=PROTOCOL_VERSION, sequence=2**63, **ours)
    )
    cluster.wait_for_event("reading_refused", "far ahead")
    cluster.wait_for_event("peer_refused", "far ahead")
    cluster.run(job("after-the-numbers", "true"))
    assert not cluster.events("host_lost", host="h0")


def test_a_beat_ends_no_master(cluster, stranger) -> None:
    """A beat of a much older master, without an answer to a handshake; slaves stay, too."""
    beats = stranger.publisher(msg.MasterBeat, names.MASTER_BEAT, qos.BEAT)
    epoch = stranger.hello().epoch
    for uptime in (1e8, float("nan"), float("inf")):
        for _ in range(5):
            beats.publish(
                msg.MasterBeat(
                    protocol_version=PROTOCOL_VERSION, name="false", hostname="nowhere", pid=1,
                    epoch=epoch + 1, incarnation=99, beat=2**62, uptime=uptime,
                )
            )  # fmt: skip
            cluster.client.spin(0.1)
    cluster.wait_for_event("peer_refused", "uptime")
    cluster.run(job("after-the-beat", "true"))
    assert cluster.log_of("h0").count("registered with master") == 1


def test_huge_messages_are_refused(cluster, stranger) -> None:
    """A text of 50 MB enters neither the journal nor the memory for long."""
    huge = 50_000_000 * "x"
    request = srv.Cancel.Request(envelope=stranger.envelope(), processes=[huge])
    answer = stranger.ask(srv.Cancel, path(names.CANCEL), request).answer
    assert (answer.accepted, answer.code) == (False, "failed")
    assert "Cancel_Request.processes has 50000000 letters" in answer.message
    hello = stranger.hello(protocol_version=99, name=1000 * "n")
    assert not hello.accepted
    cluster.run(job("after-the-flood", "true"))


def test_the_younger_of_two_masters_stops(make_cluster) -> None:
    """The older one proves itself by its answer to a handshake."""
    cluster = make_cluster()
    cluster.client.list()  # from here on it runs, and has looked for another master
    incarnation = 99

    def answer(request, open_request) -> None:
        open_request.answer(
            srv.Handshake.Response(
                protocol_version=PROTOCOL_VERSION, accepted=True, master="older",
                hostname="robot-9", pid=7, epoch=1, beat=time.monotonic_ns(),
            )
        )  # fmt: skip

    with Participant(cluster.ros, "rosrm_test_master") as other:
        other.serve(srv.Handshake, path(names.HANDSHAKE), answer)
        beats = other.node.create_publisher(msg.MasterBeat, path(names.MASTER_BEAT), qos.BEAT)

        def beat(_: float) -> None:
            beats.publish(
                msg.MasterBeat(
                    protocol_version=PROTOCOL_VERSION, name="older", hostname="robot-9", pid=7,
                    epoch=1, incarnation=incarnation, beat=time.monotonic_ns(), uptime=1000.0,
                )
            )  # fmt: skip
            other.spin(0.1)

        master = cluster.master.process
        wait_until(lambda: master.poll() is not None, "the end of the master", pause=beat)
    assert master.returncode == 1
    assert "a master runs already: 'older', pid 7 on robot-9" in cluster.log_of("master")


def test_an_invalid_status_is_refused(cluster, stranger) -> None:
    """A status with an unknown state is refused, even from a registered host."""
    publisher = stranger.publisher(msg.ProcessStatusBatch, names.PROCESS_STATUS, qos.STATUSES)
    row = cluster.host("h0")
    batch = msg.ProcessStatusBatch(
        protocol_version=PROTOCOL_VERSION, host_id=row.host_id, sequence=10**9,
        incarnation=row.description.incarnation, statuses=[msg.ProcessStatus(state="flying")],
    )  # fmt: skip
    publisher.publish(batch)
    cluster.wait_for_event("peer_refused", "flying")
    cluster.run(job("after-the-flight", "true"))


def test_a_host_without_limits_gets_no_work(cluster, stranger) -> None:
    """A host that asks before its first reading waits until its limits are known."""
    with stranger.registered("fake", capacity=1000.0, who="fake") as number:
        cluster.submit(
            *(job(f"fake-{n}", "true", required_labels={"who": "fake"}, needs={"memory": 300.0})
              for n in range(3))
        )  # fmt: skip
        poll = stranger.client(srv.RequestProcess, path(names.REQUEST_PROCESS)).call_async(
            srv.RequestProcess.Request(
                envelope=stranger.envelope(), host_id=number, incarnation=Stranger.RUN
            )
        )
        assert answer_to(stranger.participant, poll, time.monotonic() + 0.5) is None
        assert cluster.process("fake-0").state == "queued"

        publisher = stranger.publisher(msg.ResourceInfo, names.RESOURCE_INFO, qos.READING_OUT)
        limits = np.ones(16, np.float32)
        limits[0] = 0.65  # two of 300 B fit, not three
        row = {"host_id": number, "incarnation": Stranger.RUN, "present": 1, "limit": limits}
        for sequence in range(1, 300):
            publisher.publish(reading(cluster, sequence=sequence, **row))
            work = answer_to(stranger.participant, poll, time.monotonic() + 0.1)
            if work is not None:
                break
        assert [one.instance.process for one in work.assignments] == ["fake-0", "fake-1"]
        assert cluster.process("fake-2").state == "queued"
    cluster.client.cancel([f"fake-{n}" for n in range(3)])


# --- absent parts -----------------------------------------------------------------------------


def test_clusters_of_different_namespaces_do_not_meet(cluster) -> None:
    """Two masters may share a domain in different namespaces."""
    settings = replace(cluster.ros, namespace="/elsewhere")
    with Participant(settings, "rosrm_test_elsewhere") as participant:
        assert find_master(participant, "client test", 1.0) is None


def test_a_request_to_an_absent_slave_fails(cluster) -> None:
    """A request for a log of an absent host fails in time."""
    client = MasterClient.connect(cluster.ros, name="test", timeout=PATIENCE)
    with client:
        client._timeout = 1.0
        with pytest.raises((NoMaster, Refused), match="nowhere"):
            client.read_log("nowhere", "p", 0, 0, 0)


def test_callbacks_that_raise_end_nothing() -> None:
    """Exceptions in callbacks (topic, request, answer) end no process, unlike in bare rclpy."""
    domain, claim = claim_domain()
    settings = settings_on_this_machine(domain)
    ends: list[object] = []

    def fails(*arguments) -> None:
        ends.extend(arguments[:1])
        raise SystemExit(3)

    with claim, Participant(settings, "one") as server, Participant(settings, "other") as asker:
        server.serve(srv.List, path(names.LIST), fails)
        server.node.create_subscription(
            msg.MasterBeat, path(names.MASTER_BEAT), server.counted(fails), qos.BEAT
        )
        beats = asker.node.create_publisher(msg.MasterBeat, path(names.MASTER_BEAT), qos.BEAT)
        beats.publish(msg.MasterBeat())
        client = asker.node.create_client(srv.List, path(names.LIST), qos_profile=qos.SERVICE)
        control = ControlClient(asker, "test")
        deadline = time.monotonic() + PATIENCE
        assert wait_for_service(asker, client, deadline)
        control.call(client, srv.List.Request(), deadline, fails)
        wait_until(
            lambda: len(ends) == 4, "two failures each", seen=lambda: ends,
            pause=lambda _: (server.spin(0.02), asker.spin(0.02)),
        )  # fmt: skip
        control.expire(deadline)
    kinds = [type(one).__name__ for one in ends]
    assert sorted(kinds) == ["List_Request", "List_Response", "MasterBeat", "NoneType"]
