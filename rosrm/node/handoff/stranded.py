"""Question of a silent source to the master: may it resume?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rosrm.node.handoff.channel import NO_PUBLISHER_EVENTS, Channel
from rosrm.node.managed_node import Mode, NodeEntities
from rosrm.node.steady_timer import steady_timer
from rosrm.ros.qos import HANDOFF
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport

if TYPE_CHECKING:
    from rosrm.ros.sealed_topic import SealedWriter

#: Seconds of silence until the source asks, and asks again.
ASK_EVERY: Final = 10.0


class StrandedSource:
    """Asks the master every `ASK_EVERY` seconds, as long as the node is silent.

    A source may be silent without a handoff: the master was replaced by one that does not know of
    it, or messages were forged in a cluster with `security: none`. A master that knows of the
    handoff does not answer.

    Args:
        channel: of the handoff for which the source is silent.
    """

    def __init__(self, entities: NodeEntities, channel: Channel) -> None:
        self._entities = entities
        self._questions = channel.links.questions
        self._destination = channel.destination
        self._run = channel.run
        self._publisher: SealedWriter | None = None
        self._timer: Any = steady_timer(entities.plain, ASK_EVERY, self._ask)

    def _ask(self) -> None:
        entities = self._entities
        with entities.turn:
            if self._timer is None or entities.mode is not Mode.SILENT:
                return
            if self._publisher is None:
                self._publisher = self._questions.publisher(
                    entities.plain, HANDOFF, event_callbacks=NO_PUBLISHER_EVENTS
                )
            self._publisher.publish(
                HandoffReport(
                    protocol_version=PROTOCOL_VERSION, destination=self._destination,
                    instance=entities.identity.instance, run=self._run,
                    phase=HandoffReport.SILENT, sequence=entities.sequence,
                )
            )  # fmt: skip

    def close(self) -> None:
        """Ask no more."""
        if self._timer is not None:
            self._entities.plain.destroy_timer(self._timer)
            self._timer = None
        if self._publisher is not None:
            self._entities.plain.destroy_publisher(self._publisher.entity)
            self._publisher = None
