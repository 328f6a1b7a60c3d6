"""Forged messages of handoffs: to nodes with keys, and to a cluster with `security: none`."""

from __future__ import annotations

import os

import pytest
from rclpy.serialization import serialize_message
from std_msgs.msg import Int64, String

from rosrm.keys.handoffs import HandoffKeys, new_link
from rosrm.keys.names import handoff_name
from rosrm.keys.sealing import Direction
from rosrm.node.handoff.channel import STATE
from rosrm.node.managed_node import Mode
from rosrm.ros.qos import HANDOFF
from rosrm.ros.sealed_codec import decode, encode
from rosrm.ros.sealed_topic import SealedTopic
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport, Sealed, StateConfig, StateMark
from tests.ros.clusters import host
from tests.ros.nodes import KEYS, TOPIC, Conductor, Counter, Stage, pair_of
from tests.ros.test_handoffs import counter, migrate
from tests.waiting import holds_for, wait_until

R, C = HandoffReport, StateConfig


PARTS = ("/counter/state", "/counter/total", "/counter/_rosrm/parameters")
MARK = "/counter/_rosrm/mark"
OTHER_KEYS = HandoffKeys(lambda: bytes(32), lambda _process, _number: bytes(32))
SECRET = "what only the two nodes may know"


def gapless(heard) -> bool:
    numbers = [one.data for one in heard]
    return numbers == list(range(numbers[0], numbers[0] + len(numbers)))


# --- with keys --------------------------------------------------------------------------------


class Eavesdropper:
    """A stranger that records all messages of a handoff, and sends forged ones."""

    def __init__(self, locked: Stage, conductor: Conductor, *more: str) -> None:
        self.node = Stage(beside=locked).plain
        self.heard: dict[str, list[bytes]] = {}
        self._publishers = {}
        channel = conductor.config.channel
        for topic in (TOPIC, channel, MARK, *PARTS, *more):
            heard = self.heard[topic] = []
            profile = STATE if topic in (*PARTS, *more) else HANDOFF
            self.node.create_subscription(Sealed, topic, heard.append, profile, raw=True)
            self._publishers[topic] = self.node.create_publisher(Sealed, topic, profile)

    def repeat_all(self) -> None:
        """Send all messages again: unchanged, and as newer messages of another run."""
        for topic, heard in self.heard.items():
            for data in list(heard):
                self.send(topic, data)
                newer = decode(data)._replace(counter=2**40)
                self.send(topic, encode(newer))
                self.send(topic, encode(newer._replace(run=os.urandom(16))))

    def forge(self, topic: str, message, conductor: Conductor) -> None:
        """Send a message that is not sealed, or not sealed with a key of this handoff."""
        config = conductor.config
        principal = handoff_name(config.process, config.destination)
        for key in (None, bytes(32)):
            link = new_link(key, Direction.TO_PEER, Direction.TO_PEER)
            sealed = SealedTopic(link, principal, type(message), topic)
            self.send(topic, sealed.seal(serialize_message(message)))

    def send(self, topic: str, data: bytes) -> None:
        self._publishers[topic].publish(data)


@pytest.fixture
def locked():
    """Yield a stage of nodes with keys."""
    stage = Stage(keys=KEYS)
    yield stage
    stage.close()


@pytest.mark.parametrize("keys", [None, OTHER_KEYS], ids=["open", "other keys"])
def test_messages_without_the_keys_do_not_change_the_mode_of_a_node(locked, keys) -> None:
    """The messages of a whole handoff have no effect; the genuine master moves the node."""
    counts = locked.listen(Int64, "count")
    pair = pair_of(locked, Counter)
    counts_on(locked, counts)
    stranger = Stage(beside=locked)
    stranger.keys = keys
    forged = Conductor(stranger, source=1, destination=2)
    for phase in (C.SHADOW, C.SWITCH, C.TAKE_OVER, C.ABORT, C.RESUME):
        forged.say(phase)
    forged.report_as(2, R.SHADOWING, R.SWITCHING)
    forged.report_as(1, R.ATTACHED, R.SILENT)
    counts_on(locked, counts, 50)
    assert (pair.first._rosrm._source._channel, pair.second._rosrm._destination._channel) == (
        None, None,
    )  # fmt: skip
    pair.conductor.hand_over()
    counts_on(locked, counts)
    assert gapless(counts)


def test_forged_and_repeated_messages_change_no_handoff(locked) -> None:
    """Neither a report, nor a mark, nor a part of the state, in any phase."""
    counts = locked.listen(Int64, "count")
    pair = pair_of(locked, Counter)
    stranger = Eavesdropper(locked, pair.conductor)
    counts_on(locked, counts)
    pair.conductor.prepare()
    locked.spin_until(lambda: all(stranger.heard.values()), "a message of each topic")
    run = pair.first._rosrm._source._run
    config = pair.conductor.config

    def attack() -> None:
        stranger.repeat_all()
        for instance, phase in ((1, R.SILENT), (1, R.FAILED), (2, R.SWITCHING), (2, R.ACTIVE)):
            report = R(
                protocol_version=PROTOCOL_VERSION, destination=2, instance=instance, phase=phase
            )
            stranger.forge(config.channel, report, pair.conductor)
        for sequence in (2**63, 5):
            mark = StateMark(
                protocol_version=PROTOCOL_VERSION, run=run, sequence=sequence, last=True
            )
            stranger.forge(MARK, mark, pair.conductor)
        for part in PARTS[:2]:
            stranger.forge(part, Int64(data=10**9), pair.conductor)
        counts_on(locked, counts, 20)

    attack()
    assert R.SILENT not in pair.conductor.of(1)
    pair.conductor.say(C.SWITCH)
    pair.conductor.wait(2, R.ACTIVE)
    attack()
    pair.conductor.wait(1, R.RELEASED)
    assert {R.FAILED, R.ABORTED}.isdisjoint({*pair.conductor.of(1), *pair.conductor.of(2)})
    assert gapless(counts)


def test_messages_of_a_stranger_do_not_hold_up_a_successor_whose_source_has_ended(locked) -> None:
    """The successor waits until the topics are quiet; only the source's messages count."""
    pair = pair_of(locked, Counter)
    stranger = Eavesdropper(locked, pair.conductor)
    pair.conductor.prepare()
    locked.remove(pair.first)

    def send() -> None:
        stranger.forge(PARTS[0], Int64(data=10**9), pair.conductor)
        stranger.send(MARK, os.urandom(100))

    stranger.node.create_timer(0.02, send)
    pair.conductor.say(C.TAKE_OVER)
    pair.conductor.wait(2, R.ACTIVE)
    assert pair.second.count < 10**9


def restarted(locked: Stage, pair, heard: list[Int64]) -> Counter:
    """Return the source of a pair in a new process, after the destination has ended."""
    locked.remove(pair.first)
    locked.remove(pair.second)
    again = locked.instance(Counter, 1)
    heard.clear()
    counts_on(locked, heard)
    return again


def test_recorded_messages_do_not_silence_a_node_that_was_restarted(locked) -> None:
    """All of them open, because its key is the same; they have the number of its earlier run."""
    counts = locked.listen(Int64, "count")
    pair = pair_of(locked, Counter)
    stranger = Eavesdropper(locked, pair.conductor)
    pair.conductor.silence(pair.second)
    channel = pair.conductor.config.channel
    locked.spin_until(lambda: len(stranger.heard[TOPIC]) >= 4, "both phases for both nodes")
    configs, reports = list(stranger.heard[TOPIC]), list(stranger.heard[channel])
    pair.conductor.resume()
    again = restarted(locked, pair, counts)
    for data in configs:
        stranger.send(TOPIC, data)
    locked.spin_until(lambda: again._rosrm._source._channel, "the channel")
    counts_on(locked, counts)
    for data in reports:
        stranger.send(channel, data)
    locked.spin_until(lambda: again._rosrm._source._asked, "the report of the destination")
    counts_on(locked, counts, 50)
    assert again._rosrm.entities.mode is Mode.ACTIVE


def test_a_recorded_message_does_not_end_the_silence_of_a_node_that_was_restarted(locked) -> None:
    """Its successor may be active by then."""
    counts = locked.listen(Int64, "count")
    pair = pair_of(locked, Counter)
    stranger = Eavesdropper(locked, pair.conductor)
    pair.conductor.silence(pair.second)
    pair.conductor.resume()
    locked.spin_until(lambda: len(stranger.heard[TOPIC]) >= 8, "all phases for both nodes")
    recorded = list(stranger.heard[TOPIC])
    again = restarted(locked, pair, counts)
    Conductor(locked, source=1, destination=3).silence_alone()
    for data in recorded:
        stranger.send(TOPIC, data)
    for _ in range(20):
        locked.spin(0.05)
    assert again._rosrm.entities.mode is Mode.SILENT


@pytest.mark.parametrize("keys", [KEYS, None], ids=["keys", "open"])
def test_a_state_can_be_read_only_with_security_none(keys) -> None:
    """No message has the state, nor the key of the handoff."""

    class Knowing(Counter):
        def __init__(self, **named):
            super().__init__(**named)
            self.keep_state("~/known", String, lambda: String(data=SECRET), lambda _: None)

    stage = Stage(keys=keys)
    try:
        pair = pair_of(stage, Knowing)
        stranger = Eavesdropper(stage, pair.conductor, "/counter/known")
        pair.conductor.hand_over()
        stage.spin_until(lambda: all(stranger.heard.values()), "a message of each topic")
    finally:
        stage.close()
    heard = b"".join(data for topic in stranger.heard.values() for data in topic)
    assert (SECRET.encode() in heard) is (keys is None)
    assert keys is None or keys.of_handoff("counter", 2) not in heard


# --- without security -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cluster(make_shared):
    """Return a cluster without security: its nodes accept forged messages, and recover."""
    return make_shared(host("h0"), host("h1"), security="none")


@pytest.fixture
def stage(cluster):
    stage = Stage(domain=cluster.domain)
    yield stage
    stage.close()


def counts_on(stage, heard, more: int = 10) -> None:
    before = len(heard)
    stage.spin_until(lambda: len(heard) >= before + more, "further counts")


def conductor(cluster, stage, row, destination: int) -> Conductor:
    """Return a stranger that sends messages of the master and of the destination of a handoff."""
    forged = Conductor(stage, source=row.number, destination=destination, name=row.name)
    forged.config.cluster, forged.config.epoch = cluster.cluster.name, 1
    return forged


def test_a_node_that_a_stranger_silenced_counts_on_and_can_be_moved(cluster, stage) -> None:
    """The node asks the real master, which lets it resume after 10 s, without a gap."""
    cluster.submit(counter("victim"))
    row = cluster.wait("victim", "running")
    heard = stage.listen(Int64, "/victim/count")
    counts_on(stage, heard)
    forged = conductor(cluster, stage, row, 10**6)
    forged.silence_alone()
    stage.spin_until(lambda: "source_stranded" in cluster.kinds("victim"), "the question")
    counts_on(stage, heard)
    assert gapless(heard)
    _, event = migrate(cluster, "victim")
    assert event.kind == "migrated", event.message
    counts_on(stage, heard)
    assert gapless(heard)
    cluster.cancel("victim")


def test_a_forged_epoch_makes_no_node_deaf(cluster, stage) -> None:
    """The node believes no epoch that its slave does not know, and follows its master."""
    cluster.submit(counter("listener"))
    row = cluster.wait("listener", "running")
    for epoch in (2, 1000, 2**64 - 1):
        forged = conductor(cluster, stage, row, 10**6 + 1)
        forged.say(C.SHADOW, epoch=epoch)
    stage.spin(0.5)
    _, event = migrate(cluster, "listener")
    assert event.kind == "migrated", event.message
    cluster.cancel("listener")


def test_a_handoff_after_a_restart_of_the_master_is_not_refused(cluster, stage) -> None:
    """The slave notes the new epoch when it registers again."""
    cluster.submit(counter("patient"))
    cluster.wait("patient", "running")
    cluster.restart_master()
    cluster.wait_for_hosts()
    wait_until(lambda: cluster.process("patient").state == "running", "the process")
    holds_for(0.5, lambda: cluster.process("patient").state == "running", "the process")
    _, event = migrate(cluster, "patient")
    assert event.kind == "migrated", event.message
    cluster.cancel("patient")
