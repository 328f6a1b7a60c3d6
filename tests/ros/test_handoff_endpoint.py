"""The master's handoff topics against a node of plain rclpy, with keys and without security."""

from __future__ import annotations

from array import array

import pytest

from rosrm.core.master.commands import PublishStateConfig
from rosrm.core.master.events import HandoffReported, SourceStranded
from rosrm.keys.handoffs import HandoffKeys, new_link
from rosrm.keys.sealing import Direction
from rosrm.model.plan import HandoffPhase, ReportPhase
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import qos
from rosrm.ros.master.handoff import HandoffEndpoint
from rosrm.ros.participant import Participant
from rosrm.ros.sealed_codec import decode, encode
from rosrm.ros.sealed_topic import SealedTopic, SealedWriter
from rosrm.testing.local_cluster import claim_domain
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport, Sealed, StateConfig
from tests.ros.nodes import KEYS
from tests.waiting import holds_for, wait_until

CHANNEL = "/rosrm/handoff/p_2"


STRANDED = "/rosrm/handoff/stranded"


def question(instance: int, **fields: object) -> HandoffReport:
    """Return the question of a silent source."""
    named = {"protocol_version": PROTOCOL_VERSION, "destination": 9, "phase": 2, **fields}
    return HandoffReport(instance=instance, **named)


class Stage:
    """A handoff endpoint of the master, and the node of a destination.

    Args:
        keys: of the cluster; None: it has no security.
    """

    def __init__(self, keys: HandoffKeys | None) -> None:
        self.keys = keys
        domain, self.claim = claim_domain()
        settings = RosSettings(domain=domain)
        self.master = Participant(settings, "rosrm_master")
        self.nodes = Participant(settings, "p_1700000000")
        self.events: list[object] = []
        self.refused: list[tuple[str, str, str]] = []
        self.endpoint = HandoffEndpoint(
            self.master, "ours", 5, self.events.append, lambda *why: self.refused.append(why),
            keys=keys,
        )  # fmt: skip
        key = None if keys is None else keys.of_handoff("p", 2)
        link = new_link(key, Direction.TO_PEER, Direction.TO_PEER)
        reports = SealedTopic(link, "handoff:p#2", HandoffReport, CHANNEL)
        self.channel = reports.publisher(self.nodes.node, qos.HANDOFF)

    def topic_of(self, number: int, message_type, name: str) -> SealedTopic:
        """Return a topic between an instance of the process and the master."""
        key = None if self.keys is None else self.keys.of_instance("p", number)
        link = new_link(key, Direction.TO_MASTER, Direction.FROM_MASTER)
        return SealedTopic(link, f"instance:p#{number}", message_type, name)

    def listen(self, number: int) -> list[StateConfig]:
        """Return a list of the messages that an instance can open."""
        topic = self.topic_of(number, StateConfig, "/rosrm/state_config")
        configs: list[StateConfig] = []

        def take(data: bytes) -> None:
            config = topic.read(data)
            if config is not None:
                configs.append(config)

        topic.subscription(self.nodes.node, qos.STATE_CONFIG, self.nodes.counted(take))
        return configs

    def asker(self, number: int) -> SealedWriter:
        """Return a publisher of an instance's questions."""
        topic = self.topic_of(number, HandoffReport, STRANDED)
        return topic.publisher(self.nodes.node, qos.HANDOFF)

    def say(self, phase: HandoffPhase) -> None:
        self.endpoint.publish(PublishStateConfig("p", phase, 1, 2, "/p", "/p_1700000000"))

    def report(self, phase: int, **fields: object) -> None:
        named = {"protocol_version": PROTOCOL_VERSION, "destination": 2, "instance": 2, **fields}
        self.channel.publish(HandoffReport(phase=phase, **named))

    def spin(self, seconds: float) -> None:
        self.master.spin(seconds)
        self.nodes.spin(seconds)

    def wait(self, condition, what: str) -> None:
        wait_until(condition, what, seen=lambda: self.events, pause=self.spin)

    def close(self) -> None:
        self.nodes.close()
        self.master.close()
        self.claim.close()


@pytest.fixture(params=[KEYS, None], ids=["keys", "open"])
def stage(request):
    one = Stage(request.param)
    yield one
    one.close()


def test_the_state_config_reaches_late_subscribers(stage):
    """Both instances get cluster, epoch, channel and the handoff's key, although they are late."""
    stage.say(HandoffPhase.SHADOW)
    source, destination = stage.listen(1), stage.listen(2)
    stage.wait(lambda: source and destination, "the message")
    key = b"" if stage.keys is None else stage.keys.of_handoff("p", 2)
    expected = StateConfig(
        protocol_version=PROTOCOL_VERSION, cluster="ours", epoch=5, phase=1, process="p",
        source=1, destination=2, source_node="/p", destination_node="/p_1700000000",
        channel=CHANNEL, key=array("B", key),
    )  # fmt: skip
    assert (source, destination) == ([expected], [expected])


def test_a_late_subscriber_receives_only_the_newest_messages(stage):
    """Older ones, with a heartbeat each to every node, would overflow the sockets of the nodes."""
    for _ in range(50):
        stage.say(HandoffPhase.SHADOW)
    stage.say(HandoffPhase.SWITCH)
    source = stage.listen(1)
    stage.wait(lambda: source and source[-1].phase == HandoffPhase.SWITCH, "the last message")
    assert len(source) <= 10


def test_an_instance_without_a_key_gets_no_message():
    """The grant of its host was revoked; the other one still learns of the end of the handoff."""
    keys = HandoffKeys(
        lambda: bytes(32), lambda process, number: None if number == 2 else bytes(32)
    )
    stage = Stage(keys)
    try:
        sent: list[bytes] = []
        stage.nodes.node.create_subscription(
            Sealed, "/rosrm/state_config", sent.append, qos.STATE_CONFIG, raw=True
        )
        stage.say(HandoffPhase.SHADOW)
        stage.say(HandoffPhase.DONE)
        stage.wait(lambda: len(sent) >= 2, "both phases")
        holds_for(0.3, lambda: len(sent) == 2, "no more", pause=stage.spin)
        assert {decode(data).principal for data in sent} == {"instance:p#1"}
    finally:
        stage.close()


def test_forged_reports_and_questions_have_no_effect():
    """Forged and repeated messages cause no event, and nothing is stored for them."""
    stage = Stage(KEYS)
    try:
        stage.say(HandoffPhase.SHADOW)
        heard: dict[str, list[bytes]] = {CHANNEL: [], STRANDED: []}
        for topic, data in heard.items():
            stage.nodes.node.create_subscription(Sealed, topic, data.append, qos.HANDOFF, raw=True)
        stage.report(14)
        stage.asker(1).publish(question(1))
        stage.wait(lambda: len(stage.events) == 2 and all(heard.values()), "both messages")
        link = new_link(bytes(32), Direction.TO_MASTER, Direction.FROM_MASTER)
        other = SealedTopic(link, "instance:p#1", HandoffReport, STRANDED)
        forged = other.publisher(stage.nodes.node, qos.HANDOFF)
        for _ in range(50):
            forged.publish(question(1))
        repeated = {
            topic: stage.nodes.node.create_publisher(Sealed, topic, qos.HANDOFF) for topic in heard
        }
        for topic, (data, *_) in heard.items():
            repeated[topic].publish(data)
            repeated[topic].publish(encode(decode(data)._replace(counter=9)))
            repeated[topic].publish(data[:50])
        stage.asker(2).publish(question(3))  # a node asks for another one
        holds_for(0.5, lambda: len(stage.events) == 2, "no more events", pause=stage.spin)
        stage.asker(3).publish(question(3))
        stage.wait(lambda: len(stage.events) == 3, "the question of another source")
        assert stage.refused == []
    finally:
        stage.close()


def test_the_messages_have_the_run_of_the_source(stage):
    """As in its reports in this handoff, or, after the handoff, as in its question."""
    configs = stage.listen(1)

    def run_in(phase: HandoffPhase) -> int:
        stage.say(phase)
        stage.wait(lambda: configs and configs[-1].phase == phase, "the message")
        return configs[-1].source_run

    assert run_in(HandoffPhase.SHADOW) == 0
    stage.report(11, run=5)
    stage.report(1, instance=1, run=77)
    stage.wait(lambda: len(stage.events) == 2, "both reports")
    assert run_in(HandoffPhase.SWITCH) == 77
    assert run_in(HandoffPhase.DONE) == 77
    stage.asker(1).publish(question(1, run=78))
    stage.wait(lambda: len(stage.events) == 3, "the question")
    assert run_in(HandoffPhase.RESUME) == 78


def test_earlier_reports_reach_the_master(stage):
    """Reports from before the subscription arrive, as after a restart of the master."""
    stage.report(11, message="waits for /scan")
    stage.report(14, sequence=7)
    stage.say(HandoffPhase.SWITCH)
    stage.wait(lambda: len(stage.events) == 2, "both reports")
    assert stage.events == [
        HandoffReported("p", 2, 2, ReportPhase.SHADOWING, 0, "waits for /scan"),
        HandoffReported("p", 2, 2, ReportPhase.ACTIVE, 7, ""),
    ]


def test_invalid_reports_and_other_handoffs_have_no_effect(stage):
    """Foreign versions and unknown phases are refused with a reason; other handoffs are ignored."""
    stage.say(HandoffPhase.SHADOW)
    stage.report(14, destination=9)
    stage.report(14, protocol_version=PROTOCOL_VERSION + 1)
    stage.report(99)
    stage.report(12)
    stage.wait(lambda: stage.events, "a report")
    assert stage.events == [HandoffReported("p", 2, 2, ReportPhase.READY, 0, "")]
    assert [one[:2] for one in stage.refused] == [("handoff", "p#2 in a handoff")] * 2
    assert stage.refused[1][2] == "unknown phase 99"


def test_after_done_the_master_does_not_listen(stage):
    """After DONE the master has no reader on the channel."""
    stage.say(HandoffPhase.SHADOW)
    readers = stage.channel.entity.get_subscription_count
    stage.wait(lambda: readers() == 1, "a reader")
    stage.say(HandoffPhase.DONE)
    stage.wait(lambda: readers() == 0, "no reader")
    stage.report(12)
    holds_for(0.5, lambda: not stage.events, "no event", pause=stage.spin)


def test_the_question_of_a_silent_source_reaches_the_master(stage):
    """A question that came before the master started arrives too, and a flood is bounded."""
    asks = stage.asker(1)
    asks.publish(question(1))
    stage.wait(lambda: stage.events == [SourceStranded(1, 9)], "the question")
    asks.publish(question(1, phase=14))
    asks.publish(question(1, protocol_version=99))
    for _ in range(2000):
        asks.publish(question(1))
        stage.spin(0.0)
    stage.wait(lambda: len(stage.events) > 10, "some of the flood")
    assert len(stage.events) < 100
