"""The master's handoff topics against a node of plain rclpy."""

from __future__ import annotations

import pytest

from rosrm.core.master.commands import PublishStateConfig
from rosrm.core.master.events import HandoffReported, SourceStranded
from rosrm.model.plan import HandoffPhase, ReportPhase
from rosrm.model.ros_settings import RosSettings
from rosrm.ros import qos
from rosrm.ros.master.handoff import HandoffEndpoint
from rosrm.ros.participant import Participant
from rosrm.testing.local_cluster import claim_domain
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport, StateConfig
from tests.waiting import holds_for, wait_until

CHANNEL = "/rosrm/handoff/p_2"


class Stage:
    """A handoff endpoint of the master, and the node of a destination."""

    def __init__(self) -> None:
        domain, self.claim = claim_domain()
        settings = RosSettings(domain=domain)
        self.master = Participant(settings, "rosrm_master")
        self.nodes = Participant(settings, "p_1700000000")
        self.events: list[object] = []
        self.refused: list[tuple[str, str, str]] = []
        self.configs: list[StateConfig] = []
        self.endpoint = HandoffEndpoint(
            self.master, "ours", 5, self.events.append, lambda *why: self.refused.append(why)
        )
        self.channel = self.nodes.node.create_publisher(HandoffReport, CHANNEL, qos.HANDOFF)

    def listen(self) -> None:
        self.nodes.node.create_subscription(
            StateConfig, "/rosrm/state_config", self.nodes.counted(self.configs.append),
            qos.STATE_CONFIG,
        )  # fmt: skip

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


@pytest.fixture
def stage():
    one = Stage()
    yield one
    one.close()


def test_the_state_config_reaches_late_subscribers(stage):
    """The message has cluster, epoch and channel, and reaches late subscribers."""
    stage.say(HandoffPhase.SHADOW)
    stage.listen()
    stage.wait(lambda: stage.configs, "the message")
    assert stage.configs == [
        StateConfig(
            protocol_version=PROTOCOL_VERSION, cluster="ours", epoch=5, phase=1, process="p",
            source=1, destination=2, source_node="/p", destination_node="/p_1700000000",
            channel=CHANNEL,
        )
    ]  # fmt: skip


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
    stage.wait(lambda: stage.channel.get_subscription_count() == 1, "a reader")
    stage.say(HandoffPhase.DONE)
    stage.wait(lambda: stage.channel.get_subscription_count() == 0, "no reader")
    stage.report(12)
    holds_for(0.5, lambda: not stage.events, "no event", pause=stage.spin)


def test_the_question_of_a_silent_source_reaches_the_master(stage):
    """A question that came before the master started arrives too, and a flood is bounded."""
    asks = stage.nodes.node.create_publisher(HandoffReport, "/rosrm/handoff/stranded", qos.HANDOFF)
    question = {"protocol_version": PROTOCOL_VERSION, "destination": 9, "phase": 2}
    asks.publish(HandoffReport(instance=1, **question))
    stage.wait(lambda: stage.events == [SourceStranded(1, 9)], "the question")
    asks.publish(HandoffReport(instance=2, **{**question, "phase": 14}))
    asks.publish(HandoffReport(instance=3, **{**question, "protocol_version": 99}))
    for number in range(2000):
        asks.publish(HandoffReport(instance=number, **question))
        stage.spin(0.0)
    stage.wait(lambda: len(stage.events) > 10, "some of the flood")
    assert len(stage.events) < 100
    assert {2, 3}.isdisjoint({one.source for one in stage.events[:2]})
