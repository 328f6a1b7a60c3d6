"""The topics of a handoff, and their qualities of service."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport


def _latched(depth: int) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )  # fmt: skip


STATE_CONFIG: Final = _latched(100)
CHANNEL: Final = _latched(20)
STATE: Final = _latched(1)
#: Of who follows a state of several parts: newer ones of one must not hide the one that belongs to
#: the others.
STATE_FOLLOWED: Final = _latched(10)
MARK: Final = _latched(100)


#: What comes and goes with a handoff has no events: an rclpy executor of several threads raises
#: InvalidHandle where an event handler is destroyed while it gathers what it waits for.
NO_SUBSCRIPTION_EVENTS: Final = SubscriptionEventCallbacks(use_default_callbacks=False)
NO_PUBLISHER_EVENTS: Final = PublisherEventCallbacks(use_default_callbacks=False)


class Channel:
    """Where source, destination and master tell one another how far a handoff is.

    Args:
        plain: rclpy's own methods of the node.
        topic: as the master named it.
        destination: instance number that names the handoff.
        instance: our own number.
        peer: instance number of the other side.
        heard: called with each report of the other side.
    """

    def __init__(
        self,
        plain: Any,
        topic: str,
        destination: int,
        instance: int,
        peer: int,
        heard: Callable[[HandoffReport], None],
    ) -> None:
        self._plain = plain
        self._destination = destination
        self._instance = instance
        self._peer = peer
        self._heard = heard
        self._last: HandoffReport | None = None
        self.topic = topic
        self._publisher = plain.create_publisher(
            HandoffReport, topic, CHANNEL, event_callbacks=NO_PUBLISHER_EVENTS
        )
        self._subscription = plain.create_subscription(
            HandoffReport, topic, self._take, CHANNEL, event_callbacks=NO_SUBSCRIPTION_EVENTS
        )

    def _take(self, report: HandoffReport) -> None:
        theirs = report.instance == self._peer and report.destination == self._destination
        if theirs and report.protocol_version == PROTOCOL_VERSION:
            self._heard(report)

    def say(self, phase: int, sequence: int = 0, message: str = "") -> None:
        """Tell the others, unless it is what they were told last."""
        last = self._last
        if last is not None and (last.phase, last.message) == (phase, message):
            return
        self._last = HandoffReport(
            protocol_version=PROTOCOL_VERSION, destination=self._destination,
            instance=self._instance, phase=phase, sequence=sequence, message=message,
        )  # fmt: skip
        self.repeat()

    def repeat(self) -> None:
        """Say again what was said last."""
        if self._last is not None:
            self._publisher.publish(self._last)

    def close(self) -> None:
        """Leave the channel."""
        self._plain.destroy_subscription(self._subscription)
        self._plain.destroy_publisher(self._publisher)
