"""The topics of a handoff, and their qualities of service."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks

from rosrm.ros.qos import HANDOFF, latched
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport

STATE: Final = latched(depth=1)
#: For a follower of a state of several parts: a newer message of one part must not replace the one
#: that belongs to the other parts.
STATE_FOLLOWED: Final = latched(depth=10)
MARK: Final = latched(depth=100)

#: Entities that are created and destroyed with a handoff have no event handlers. Otherwise an rclpy
#: executor of several threads raises InvalidHandle if a handler is destroyed as the executor
#: collects the entities to wait for.
NO_SUBSCRIPTION_EVENTS: Final = SubscriptionEventCallbacks(use_default_callbacks=False)
NO_PUBLISHER_EVENTS: Final = PublisherEventCallbacks(use_default_callbacks=False)


class Channel:
    """Topic on which source, destination and master report the progress of a handoff.

    Args:
        plain: gives access to rclpy's own methods of the node.
        topic: name given by the master.
        destination: instance number that names the handoff.
        instance: this node's own number.
        peer: instance number of the other side.
        take_report: receives each report of the other side.
    """

    def __init__(
        self, plain: Any, topic: str, destination: int, instance: int, peer: int,
        take_report: Callable[[HandoffReport], None],
    ) -> None:  # fmt: skip
        self._plain = plain
        self._destination = destination
        self._instance = instance
        self._peer = peer
        self._take_report = take_report
        self._last: HandoffReport | None = None
        self.topic = topic
        self._publisher = plain.create_publisher(
            HandoffReport, topic, HANDOFF, event_callbacks=NO_PUBLISHER_EVENTS
        )
        self._subscription = plain.create_subscription(
            HandoffReport, topic, self._take, HANDOFF, event_callbacks=NO_SUBSCRIPTION_EVENTS
        )

    def _take(self, report: HandoffReport) -> None:
        theirs = report.instance == self._peer and report.destination == self._destination
        if theirs and report.protocol_version == PROTOCOL_VERSION:
            self._take_report(report)

    def report(self, phase: int, sequence: int = 0, message: str = "") -> None:
        """Publish a report, unless it repeats the last one."""
        last = self._last
        if last is not None and (last.phase, last.message) == (phase, message):
            return
        self._last = HandoffReport(
            protocol_version=PROTOCOL_VERSION, destination=self._destination,
            instance=self._instance, phase=phase, sequence=sequence, message=message,
        )  # fmt: skip
        self.repeat()

    def repeat(self) -> None:
        """Publish the last report again."""
        if self._last is not None:
            self._publisher.publish(self._last)

    def close(self) -> None:
        """Destroy publisher and subscription of the channel."""
        self._plain.destroy_subscription(self._subscription)
        self._plain.destroy_publisher(self._publisher)
