"""The topics of a handoff, and their qualities of service."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import QoSProfile

from rosrm.ros.qos import HANDOFF, latched
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport, StateConfig

if TYPE_CHECKING:
    from rosrm.node.handoff.links import NodeLinks
    from rosrm.ros.sealed_topic import SealedTopic, SealedWriter

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
    """The topics of one handoff: the reports of its nodes, and the state of the source.

    Args:
        plain: gives access to rclpy's own methods of the node.
        links: of this node.
        config: message of the master with the channel and key of the handoff.
        instance: this node's own number.
        run: random number of a source's run.
        peer: instance number of the other side.
        take_report: receives each report of the other side.

    Attributes:
        links: as given.
        name: topic of the reports.
        destination: instance number of the destination, which identifies the handoff.
        run: as given.
        topic: returns a topic under the key of the handoff, from message type and name.
    """

    def __init__(
        self, plain: Any, links: NodeLinks, config: StateConfig, *, instance: int, peer: int,
        take_report: Callable[[HandoffReport], None], run: int = 0,
    ) -> None:  # fmt: skip
        self._plain = plain
        self.links = links
        self.name: str = config.channel
        self.destination: int = config.destination
        self.run = run
        self.topic: Callable[[Any, str], SealedTopic] = links.of_handoff(config)
        self._instance = instance
        self._peer = peer
        self._take_report = take_report
        self._last: HandoffReport | None = None
        self._publishers: list[Any] = []
        self._reports = self.topic(HandoffReport, self.name)
        self._publisher = self._publisher_of(self._reports, HANDOFF)
        self._subscription = self._reports.subscription(
            plain, HANDOFF, self._take, event_callbacks=NO_SUBSCRIPTION_EVENTS
        )

    def publisher(self, message_type: Any, topic: str, profile: QoSProfile) -> SealedWriter:
        """Return a publisher of a part of the state, or of its marks, only for this handoff."""
        return self._publisher_of(self.topic(message_type, topic), profile)

    def _publisher_of(self, topic: SealedTopic, profile: QoSProfile) -> SealedWriter:
        made = topic.publisher(self._plain, profile, event_callbacks=NO_PUBLISHER_EVENTS)
        self._publishers.append(made.entity)
        return made

    def _take(self, data: bytes) -> None:
        report = self._reports.read(data)
        if report is None:
            return
        theirs = report.instance == self._peer and report.destination == self.destination
        if theirs and report.protocol_version == PROTOCOL_VERSION:
            self._take_report(report)

    def report(self, phase: int, sequence: int = 0, message: str = "") -> None:
        """Publish a report, unless it repeats the last one."""
        last = self._last
        if last is not None and (last.phase, last.message) == (phase, message):
            return
        self._last = HandoffReport(
            protocol_version=PROTOCOL_VERSION, destination=self.destination,
            instance=self._instance, run=self.run, phase=phase, sequence=sequence,
            message=message,
        )  # fmt: skip
        self.repeat()

    def repeat(self) -> None:
        """Publish the last report again."""
        if self._last is not None:
            self._publisher.publish(self._last)

    def close(self) -> None:
        """Destroy the publishers of the handoff, and the subscription of its reports."""
        self._plain.destroy_subscription(self._subscription)
        for publisher in self._publishers:
            self._plain.destroy_publisher(publisher)
