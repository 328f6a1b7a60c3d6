"""Numbers of the readers that a successor must reach: those of the outputs, without slaves."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from rosrm import clocks
from rosrm.ros.names import is_slave_node

#: Seconds after which the slaves among the readers are counted again. Their names may arrive later
#: than the readers themselves.
_RENEWED: Final = 1.0


class _Counted(NamedTuple):
    """Number of matched readers, number of slaves among them, and time of the count in seconds."""

    matched: int
    slaves: int
    at: float


class ReaderCount:
    """Counts the readers of the outputs of one node.

    A slave reads topics for health checks and measured rates, and loses nothing in a handoff. A
    killed slave stays in the graph of its peers for `rosrm.ros.fast_dds.LEASE`, and a new shadow
    never discovers it.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._counted: dict[str, _Counted] = {}

    def of(self, output: Any) -> int:
        """Return the number of matched readers of an output that belong to no slave."""
        matched, now = int(output.get_subscription_count()), clocks.boot_time()
        if not matched:
            return 0
        counted = self._counted.get(output.topic_name)
        if counted is None or counted.matched != matched or now - counted.at >= _RENEWED:
            counted = _Counted(matched, self._slaves(output.topic_name), now)
            self._counted[output.topic_name] = counted
        return max(0, matched - counted.slaves)

    def _slaves(self, topic: str) -> int:
        readers = self._node.get_subscriptions_info_by_topic(topic)
        return sum(is_slave_node(reader.node_name) for reader in readers)
