"""Foreign, late and invalid messages of principals to a real cluster: refused and reported."""

from __future__ import annotations

import contextlib
import itertools
from dataclasses import replace

import numpy as np
import pytest

from rosrm import clocks
from rosrm.config.settings import ControlSettings
from rosrm.errors import NoMaster
from rosrm.keys.finding import master_security
from rosrm.keys.security import Authority
from rosrm.keys.tickets import ticket_of
from rosrm.model.values import (
    RESOURCE_SLOTS,
    HostDescription,
    ProcessSpec,
    ResourceDescription,
)
from rosrm.ros import convert, names, qos
from rosrm.ros.control import ControlClient
from rosrm.ros.introductions import introduction_of, introduction_request
from rosrm.ros.master_connection import MasterClient, wait_for_service
from rosrm.ros.participant import Participant
from rosrm.ros.reading_codec import Reading, encode
from rosrm.ros.sealed import SealedEndpoints
from rosrm.ros.sealed_readings import reading_channel, seal_reading
from rosrm.testing.local_cluster import claim_domain
from rosrm.testing.loopback import settings_on_this_machine
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg, srv
from tests.ros.calls import answer_to
from tests.ros.clusters import host, job, service
from tests.ros.members import PlayedMember, path, play_host, play_master, play_user
from tests.waiting import PATIENCE, wait_until

#: Maximum age of a request in seconds; longer than the default, because a machine may be busy.
MAX_AGE = 20.0


@pytest.fixture(scope="module")
def cluster(make_shared):
    return make_shared(host("h0"), control=ControlSettings(max_age=MAX_AGE))


#: Incarnation of played hosts.
RUN = 4242


def submit(user: PlayedMember, *specs: ProcessSpec, envelope=None) -> msg.Answer:
    """Submit processes; return the answer."""
    request = srv.Submit.Request(
        envelope=envelope or user.envelope(),
        processes=[convert.spec_to_msg(spec) for spec in specs],
    )
    return user.ask(srv.Submit, path(names.SUBMIT), request).answer


class PlayedHost:
    """A host of one resource that consists of its registration, and of what a test sends.

    Attributes:
        number: of the host.
        slave: its slave.
    """

    def __init__(self, participant: Participant, name: str, capacity: float, **labels: str) -> None:
        self.slave = play_host(participant, name)
        description = HostDescription(
            name, RUN, labels=labels, period=0.1,
            resources=(ResourceDescription("memory", "B", capacity),),
        )  # fmt: skip
        request = srv.RegisterHost.Request(
            envelope=self.slave.envelope(), host=convert.host_to_msg(description)
        )
        answer = self.slave.ask(srv.RegisterHost, path(names.REGISTER_HOST), request)
        assert answer.answer.accepted, answer.answer.message
        self.number = answer.host_id
        topic = path(names.RESOURCE_INFO)
        self._channel = reading_channel(topic)
        self._readings = participant.node.create_publisher(
            msg.SealedReading, topic, qos.READING_OUT
        )
        self.slave.await_reader(self._readings)

    def read(self, **changes: object) -> None:
        """Publish a reading, with some fields changed."""
        record = Reading(
            host_id=self.number, incarnation=RUN, beat=clocks.boot_time_ns(), present=0b1, flags=1,
            limit=RESOURCE_SLOTS * (1.0,),
        )  # fmt: skip
        master = self.slave.endpoints.security.master
        self._readings.publish(
            seal_reading(master, self._channel, encode(replace(record, **changes)))
        )

    def leave(self) -> None:
        """Leave the cluster."""
        request = srv.Leave.Request(
            envelope=self.slave.envelope(), host_id=self.number, incarnation=RUN
        )
        assert self.slave.ask(srv.Leave, path(names.LEAVE), request).answer.accepted


@pytest.fixture
def played(cluster, participant):
    """Return a function that registers a host; all of them leave after the test."""
    with contextlib.ExitStack() as ends:

        def register(name: str, capacity: float = 1000.0, **labels: str) -> PlayedHost:
            host = PlayedHost(participant, name, capacity, **labels)
            ends.callback(host.leave)
            return host

        yield register


@pytest.fixture(scope="module")
def participant(cluster):
    with Participant(cluster.ros, "rosrm_test_members") as participant:
        yield participant


@pytest.fixture(scope="module")
def user(participant):
    return play_user(participant)


# --- versions ---------------------------------------------------------------------------------


def test_a_client_of_another_version_is_refused(cluster, user) -> None:
    """The master refuses the client with a reason, and records an event."""
    answer = user.hello(protocol_version=99, name="from-the-future")
    assert not answer.accepted
    assert "version 99" in answer.message
    assert str(PROTOCOL_VERSION) in answer.message
    cluster.wait_for_event("peer_refused", "from-the-future")


def test_a_request_of_another_version_is_refused(cluster, user) -> None:
    """The services without a handshake also refuse the request, without effect."""
    envelope = user.envelope(protocol_version=99)
    answers = [submit(user, job("futuristic", "true"), envelope=envelope)]
    for kind, name in (
        (srv.List, names.LIST), (srv.Explain, names.EXPLAIN), (srv.Introduce, names.INTRODUCE),
    ):  # fmt: skip
        answers.append(user.ask(kind, path(name), kind.Request(protocol_version=99)).answer)
    ticket = user.ask(
        srv.Introduce, path(names.INTRODUCE), introduction_request("h0", names.READ_LOG, "p")
    )
    security = user.endpoints.security
    bearer = PlayedMember(
        user.participant, security, introduction_of(ticket, security, 0.0).slave
    )  # fmt: skip
    log = path.of_host("h0", names.READ_LOG)
    answers.append(bearer.ask(srv.ReadLog, log, srv.ReadLog.Request(protocol_version=99)).answer)
    for answer in answers:
        assert (answer.accepted, answer.code) == (False, "version")
        assert "99" in answer.message
    assert "futuristic" not in {row.name for row in cluster.client.list(processes=True).processes}


def serve_as_master(participant: Participant, answer) -> SealedEndpoints[Authority]:
    """Offer handshakes as another master of the cluster; return its endpoints."""
    endpoints = SealedEndpoints(participant, master_security("keys"))
    endpoints.serve(srv.Handshake, path(names.HANDSHAKE), answer, first_contact=True)
    return endpoints


def test_a_slave_refuses_a_master_of_another_version(make_cluster) -> None:
    """The slave logs both versions, ends with 1, and leaves nothing behind."""
    cluster = make_cluster(started=False)
    asked = []

    def answer(request, open_request) -> None:
        asked.append(request)
        open_request.answer(
            srv.Handshake.Response(
                protocol_version=99, accepted=True, master="other", hostname="robot-9", epoch=1,
                beat=clocks.boot_time_ns(),
            )
        )  # fmt: skip

    with Participant(cluster.ros, "rosrm_test_master") as other:
        serve_as_master(other, answer)
        slave = cluster.start_slave(host("lonely")).process
        wait_until(lambda: slave.poll() is not None, "the end of the slave", pause=other.spin)
    assert slave.returncode == 1
    said = cluster.log_of("lonely")
    assert "version 99" in said
    assert "robot-9" in said
    assert asked[0].role == "slave"


# --- age and repetition -----------------------------------------------------------------------


def test_a_late_request_is_refused(cluster, user) -> None:
    """The master refuses a beat that is too old by its own clock, or not its own."""
    beat = user.hello().beat
    for receiver_beat in (beat - int((MAX_AGE + 1.0) * 1e9), beat + 10**12, 0):
        envelope = user.envelope(receiver_beat=receiver_beat)
        answer = submit(user, job("late", "true"), envelope=envelope)
        assert (answer.accepted, answer.code) == (False, "stale")
    assert "late" not in {row.name for row in cluster.client.list(processes=True).processes}


def test_a_repeated_request_is_done_once_and_answered_again(cluster, user) -> None:
    """Two requests with one ID get the same answer, and start one process."""
    envelope = user.envelope()
    answers = [submit(user, job("once", "true"), envelope=envelope) for _ in range(2)]
    assert all(answer.accepted for answer in answers)
    assert answers[0] == answers[1]
    cluster.ended("once")
    assert cluster.kinds("once").count("submitted") == 1


def test_a_slave_judges_its_orders(cluster, user) -> None:
    """A slave refuses late, outdated, foreign and unknown orders, and its process keeps running."""
    cluster.submit(service("target"))
    row = cluster.wait("target", "running")
    control = path.of_host("h0", names.CONTROL)
    epoch = user.hello().epoch
    master = play_master(user.participant, "h0")

    def order(**changes):
        now = clocks.boot_time_ns()  # this machine's clock, and so the slave's own
        envelope = master.control.envelope(now, epoch)
        action = changes.pop("action", srv.ControlHost.Request.STOP)
        for name, value in changes.items():
            setattr(envelope, name, value)
        request = srv.ControlHost.Request(
            envelope=envelope, action=action,
            instance=msg.InstanceId(process="target", number=row.number),
        )  # fmt: skip
        return master.ask(srv.ControlHost, control, request).answer

    assert order(receiver_beat=clocks.boot_time_ns() - 10**10).code == "stale"
    assert order(receiver_beat=0).code == "stale"
    assert order(epoch=epoch - 1).code == "stale"
    assert order(protocol_version=99).code == "version"
    for action in (99, srv.ControlHost.Request.START, srv.ControlHost.Request.EXECUTE):
        answer = order(action=action)
        assert (answer.accepted, answer.code in ("stale", "version")) == (False, False)
    assert cluster.process("target").pid == row.pid
    cluster.cancel("target")


# --- many at once -----------------------------------------------------------------------------


def test_three_hundred_requests_at_once_are_all_answered(cluster, user) -> None:
    """The default queue depth of a service would silently drop most of them."""
    envelopes = [user.envelope() for _ in range(3)]
    client = user.client(srv.Submit, path(names.SUBMIT))
    futures = []
    for number in range(300):
        envelope = user.control.envelope(envelopes[-1].receiver_beat, envelopes[-1].epoch)
        spec = convert.spec_to_msg(job(f"burst-{number:03}", "true"))
        futures.append(client.call_async(srv.Submit.Request(envelope=envelope, processes=[spec])))
    deadline = clocks.boot_time() + PATIENCE
    for number, future in enumerate(futures):
        response = answer_to(user.participant, future, deadline)
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


def test_an_invalid_submission_is_refused(cluster, user) -> None:
    """The refusal of the whole batch has the reason, and the master keeps running."""
    processes = [convert.spec_to_msg(job(name, "true")) for name in ("fine", "mad")]
    processes[1].parameters = [msg.KeyValue(key="deep", value="[" * 50_000)]
    request = srv.Submit.Request(envelope=user.envelope(), processes=processes)
    answer = user.ask(srv.Submit, path(names.SUBMIT), request).answer
    assert not answer.accepted
    assert "deep" in answer.message
    assert "fine" not in {row.name for row in cluster.client.list(processes=True).processes}


def test_an_invalid_host_is_refused(cluster, user) -> None:
    """The host is not registered."""
    resources = (ResourceDescription("memory", "B", 1.0),)
    description = convert.host_to_msg(HostDescription("mad", 77, resources=resources, period=0.1))
    description.resources[0].capacity = float("nan")
    slave = play_host(user.participant, "mad")
    request = srv.RegisterHost.Request(envelope=slave.envelope(), host=description)
    answer = slave.ask(srv.RegisterHost, path(names.REGISTER_HOST), request).answer
    assert not answer.accepted
    assert answer.code != "denied"
    assert "mad" not in {row.description.name for row in cluster.client.list(hosts=True).hosts}


def test_an_invalid_reading_is_refused(cluster, played) -> None:
    """The reading is refused with an event and without effect; the next valid reading counts."""
    mad = played("mad")

    def told(at: int, value: float, until) -> None:
        """Publish best-effort readings until one arrives; sequences grow from `at` on."""
        values = np.zeros(16, np.float32)
        values[0] = value
        sequences = itertools.count(at)

        def publish(_: float) -> None:
            mad.read(sequence=next(sequences), usage=values)
            cluster.client.spin(0.05)

        wait_until(until, f"a reading of {value}", pause=publish)

    def memory():
        return cluster.host("mad").resources[0]

    told(1, 0.25, lambda: memory().usage == 0.25)
    told(500, float("nan"), lambda: cluster.events("reading_refused", host="mad"))
    assert memory().usage == 0.25
    told(1000, 0.5, lambda: memory().usage == 0.5)
    cluster.run(job("after-the-reading", "true"))


def test_a_reading_of_another_version_is_refused(cluster, played) -> None:
    """The master reports readings of another version once, not ten times a second."""
    old = played("old")

    def told() -> list:
        return [e for e in cluster.events("peer_refused") if "resource_info" in e.message]

    def publish(_: float) -> None:
        old.read(protocol_version=99)
        cluster.client.spin(0.05)

    wait_until(told, "the refusal", pause=publish)
    for _ in range(20):
        publish(0.0)
    assert "version 99" in told()[0].message
    assert all(b.elapsed - a.elapsed >= 10.0 for a, b in itertools.pairwise(told()))


def test_one_message_silences_no_host(cluster, played) -> None:
    """After numbers that no slave reaches, the next valid reading and status of a host count."""
    loud = played("loud")
    batches = loud.slave.publisher(msg.ProcessStatusBatch, names.PROCESS_STATUS, qos.STATUSES)
    sequences = itertools.count(1)

    def counts(value: float, name: str) -> None:
        """Publish valid readings, and a failing plugin of this name, until both count."""

        def publish(_: float) -> None:
            usage = np.full(16, value, np.float32)
            loud.read(sequence=next(sequences), usage=usage)
            cluster.client.spin(0.05)

        wait_until(
            lambda: cluster.host("loud").resources[0].usage == value, f"{value}", pause=publish
        )
        batches.publish(status_batch(loud, next(sequences), name))
        wait_until(
            lambda: name in {row.name for row in cluster.client.list(plugins="failing").plugins},
            f"the status {name}", pause=publish,
        )  # fmt: skip

    counts(0.25, "early")
    for _ in range(20):  # the readings are best effort
        loud.read(sequence=2**64 - 1, beat=2**64 - 1)
        cluster.client.spin(0.02)
    batches.publish(status_batch(loud, 2**63))
    cluster.wait_for_event("reading_refused", "far ahead", host="loud")
    cluster.wait_for_event("peer_refused", "far ahead", host="loud")
    counts(0.5, "late")


def status_batch(host: PlayedHost, sequence: int, *failing: str) -> msg.ProcessStatusBatch:
    """Return statuses of a host without processes."""
    return msg.ProcessStatusBatch(
        protocol_version=PROTOCOL_VERSION, host_id=host.number, incarnation=RUN,
        sequence=sequence,
        failing=[msg.PluginState(kind="probe", name=name, reason="-") for name in failing],
    )  # fmt: skip


def test_a_slave_reports_only_its_own_host(cluster, user) -> None:
    """Another host may not register under its name, report its processes or take its work."""
    slave, row = play_host(user.participant, "other"), cluster.host("h0")
    description = convert.host_to_msg(row.description)
    request = srv.RegisterHost.Request(envelope=slave.envelope(), host=description)
    answer = slave.ask(srv.RegisterHost, path(names.REGISTER_HOST), request).answer
    assert (answer.accepted, answer.code) == (False, "denied")
    assert "host:other may not register as 'h0'" in answer.message
    named = {"host_id": row.host_id, "incarnation": row.description.incarnation}
    for kind, name in ((srv.RequestProcess, names.REQUEST_PROCESS), (srv.Leave, names.LEAVE)):
        response = slave.ask(kind, path(name), kind.Request(envelope=slave.envelope(), **named))
        assert (response.answer.accepted, response.answer.code) == (False, "unknown")
    batches = slave.publisher(msg.ProcessStatusBatch, names.PROCESS_STATUS, qos.STATUSES)
    batches.publish(
        msg.ProcessStatusBatch(
            protocol_version=PROTOCOL_VERSION, sequence=10**6, complete=True, **named
        )
    )
    cluster.wait_for_event("peer_refused", f"host:other is not the slave of host {row.host_id}")
    cluster.run(job("after-the-other", "true"))


def test_a_beat_ends_no_master(cluster, user) -> None:
    """A beat of a much older master, without an answer to a handshake; slaves stay, too."""
    epoch = user.hello().epoch
    other = SealedEndpoints(user.participant, master_security("keys"))
    beats = other.announcer(msg.MasterBeat, path(names.MASTER_BEAT), qos.BEAT)
    user.await_reader(beats._publisher)
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


def test_huge_messages_are_refused(cluster, user) -> None:
    """A text of 10 MB enters neither the journal nor the memory for long; 50 MB are not opened."""
    long, huge = (
        srv.Cancel.Request(envelope=user.envelope(), processes=[letters * "x"])
        for letters in (10_000_000, 50_000_000)
    )
    answer = user.ask(srv.Cancel, path(names.CANCEL), long).answer
    assert (answer.accepted, answer.code) == (False, "failed")
    assert "Cancel_Request.processes has 10000000 characters" in answer.message
    cluster.is_attacked = True
    future = user.client(srv.Cancel, path(names.CANCEL)).call_async(huge)
    wait_until(
        lambda: path(names.CANCEL) in cluster.client.list().strangers, "the refusal",
        pause=user.participant.spin,
    )  # fmt: skip
    assert not future.done()
    hello = user.hello(protocol_version=99, name=1000 * "n")
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
                hostname="robot-9", pid=7, epoch=1, beat=clocks.boot_time_ns(),
            )
        )  # fmt: skip

    with Participant(cluster.ros, "rosrm_test_master") as other:
        older = serve_as_master(other, answer)
        beats = older.announcer(msg.MasterBeat, path(names.MASTER_BEAT), qos.BEAT)

        def beat(_: float) -> None:
            beats.publish(
                msg.MasterBeat(
                    protocol_version=PROTOCOL_VERSION, name="older", hostname="robot-9", pid=7,
                    epoch=1, incarnation=incarnation, beat=clocks.boot_time_ns(), uptime=1000.0,
                )
            )  # fmt: skip
            other.spin(0.1)

        master = cluster.master.process
        wait_until(lambda: master.poll() is not None, "the end of the master", pause=beat)
    assert master.returncode == 1
    assert "a master runs already: 'older', pid 7 on robot-9" in cluster.log_of("master")


def test_an_invalid_status_is_refused(cluster, user) -> None:
    """A status with an unknown state is refused, even from a registered host."""
    slave = play_host(user.participant, "h0")
    slave.hello()
    publisher = slave.publisher(msg.ProcessStatusBatch, names.PROCESS_STATUS, qos.STATUSES)
    row = cluster.host("h0")
    batch = msg.ProcessStatusBatch(
        protocol_version=PROTOCOL_VERSION, host_id=row.host_id, sequence=10**9,
        incarnation=row.description.incarnation, statuses=[msg.ProcessStatus(state="flying")],
    )  # fmt: skip
    publisher.publish(batch)
    cluster.wait_for_event("peer_refused", "flying")
    cluster.run(job("after-the-flight", "true"))


def test_a_host_without_limits_gets_no_work(cluster, played) -> None:
    """A host that asks before its first reading waits until its limits are known."""
    fake = played("fake", who="fake")
    slave = fake.slave
    cluster.submit(
        *(job(f"fake-{n}", "true", required_labels={"who": "fake"}, needs={"memory": 300.0})
          for n in range(3))
    )  # fmt: skip
    poll = slave.client(srv.RequestProcess, path(names.REQUEST_PROCESS)).call_async(
        srv.RequestProcess.Request(envelope=slave.envelope(), host_id=fake.number, incarnation=RUN)
    )
    assert answer_to(slave.participant, poll, clocks.boot_time() + 0.5) is None
    assert cluster.process("fake-0").state == "queued"

    limits = np.ones(16, np.float32)
    limits[0] = 0.65  # two of 300 B fit, not three
    for sequence in range(1, 300):
        fake.read(sequence=sequence, limit=limits)
        work = answer_to(slave.participant, poll, clocks.boot_time() + 0.1)
        if work is not None:
            break
    assert [one.instance.process for one in work.assignments] == ["fake-0", "fake-1"]
    assert cluster.process("fake-2").state == "queued"
    cluster.client.cancel([f"fake-{n}" for n in range(3)])


def test_a_ticket_needs_the_clock_of_its_slave(cluster, played, user) -> None:
    """The master waits a moment for the first reading of a slave that has just registered."""
    quiet = played("quiet")
    request = introduction_request("quiet", names.READ_LOG, "p")
    introduce = user.client(srv.Introduce, path(names.INTRODUCE))
    answer = user.ask(srv.Introduce, path(names.INTRODUCE), request).answer
    assert (answer.accepted, answer.code) == (False, "silent")
    asked = introduce.call_async(request)
    assert answer_to(user.participant, asked, clocks.boot_time() + 0.2) is None
    for sequence in range(1, 50):  # the readings are best effort
        quiet.read(sequence=sequence)
        if answer_to(user.participant, asked, clocks.boot_time() + 0.1) is not None:
            break
    answer = user.ask(srv.Introduce, path(names.INTRODUCE), request)
    assert answer.answer.accepted, answer.answer.message
    assert clocks.boot_time_ns() < ticket_of(answer.ticket).until


# --- absent parts -----------------------------------------------------------------------------


def test_clusters_of_different_namespaces_do_not_meet(cluster) -> None:
    """Two masters may share a domain in different namespaces."""
    settings = replace(cluster.ros, namespace="/elsewhere")
    with pytest.raises(NoMaster):
        MasterClient.connect(settings, name="test", timeout=1.0)


def test_a_request_to_an_absent_slave_fails(cluster) -> None:
    """A request for a log of an absent host fails at once, with what to look for."""
    with (
        MasterClient.connect(cluster.ros, name="test", timeout=PATIENCE) as client,
        pytest.raises(NoMaster, match=r"slave of nowhere does not report .* Is `rosrm slave`"),
    ):
        client.read_log("nowhere", "p", 0, 0, 0)


def test_callbacks_that_raise_end_nothing() -> None:
    """Exceptions in callbacks (topic, request, answer) end no process, unlike in bare rclpy."""
    domain, claim = claim_domain()
    settings = settings_on_this_machine(domain)
    ends: list[object] = []

    def fails(*arguments) -> None:
        ends.extend(arguments[:1])
        raise SystemExit(3)

    def answers_and_fails(request, open_request) -> None:
        open_request.answer(srv.List.Response())
        fails(request)

    with claim, Participant(settings, "one") as server, Participant(settings, "other") as asker:
        server.serve(srv.List, path(names.LIST), answers_and_fails)
        server.node.create_subscription(
            msg.MasterBeat, path(names.MASTER_BEAT), server.counted(fails), qos.BEAT
        )
        beats = asker.node.create_publisher(msg.MasterBeat, path(names.MASTER_BEAT), qos.BEAT)
        beats.publish(msg.MasterBeat())
        client = asker.node.create_client(srv.List, path(names.LIST), qos_profile=qos.SERVICE)
        control = ControlClient(asker, "test")
        deadline = clocks.boot_time() + PATIENCE
        assert wait_for_service(asker, client, deadline)
        control.call(client, srv.List.Request(), deadline, fails)
        wait_until(
            lambda: len(ends) == 4, "two failures each", seen=lambda: ends,
            pause=lambda _: (server.spin(0.02), asker.spin(0.02)),
        )  # fmt: skip
        control.expire(deadline)
    kinds = [type(one).__name__ for one in ends]
    assert sorted(kinds) == ["List_Request", "List_Response", "MasterBeat", "NoneType"]
