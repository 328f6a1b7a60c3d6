"""Rates of the topics that the nodes of this host receive, sampled one at a time.

A sample subscribes to a topic until two messages have come: their numbers and time stamps give the
rate, their sizes the bytes. So a topic of 30 MB/s costs a few messages, once in `_RENEWED` seconds.
After a sample the next one waits until the CPU time of the slave in it is a hundredth of the time.
A topic without a message in its newest sample has no rate, and neither has a topic to which the
node does not subscribe any more.

Left out are services, topics with several publishers, and types that are not installed here.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from rclpy.node import Node

from rosrm import clocks
from rosrm.model.links import MOST_FLOWS
from rosrm.model.values import LARGEST_RATE
from rosrm.ros import qos
from rosrm.ros.polling import message_type, polled_subscription, waiting

_log = logging.getLogger("rosrm.slave")

#: Largest part of a core that the slave uses for samples.
SHARE: Final = 0.01
#: Seconds of a sample at most, between two samples at least, and until a topic is sampled again.
_WINDOW: Final = 3.0
_PAUSE: Final = 5.0
_RENEWED: Final = 300.0
#: Seconds until a topic without a publisher is looked at again: its discovery may take a while.
_DISCOVERY: Final = 10.0
#: Messages that DDS keeps between two looks: their number bounds the memory of a sample.
_DEPTH: Final = 2
#: Significant digits of a rate, so that a steady flow stays the same.
_DIGITS: Final = 2
#: Topics that every node has, and that of simulated time.
_OF_EVERY_NODE: Final = ("/parameter_events", "/rosout", "/clock")

#: Number of an instance and a topic.
_Key = tuple[int, str]


@dataclass(slots=True)
class _Sample:
    """One topic that is being sampled.

    Attributes:
        seen: number of the publisher, time stamp in seconds and size of each message.
    """

    key: _Key
    publisher: str
    subscription: Any
    began: float
    cpu: float
    seen: list[tuple[int, float, int]] = field(default_factory=list)

    def rate(self, now: float) -> float:
        """Return the bytes a second; of a single message, its size over the time of the sample."""
        if not self.seen:
            return 0.0
        size = sum(size for *_, size in self.seen) / len(self.seen)
        (first, began, _), (last, ended, _) = self.seen[0], self.seen[-1]
        if last > first and ended > began:
            return size * (last - first) / (ended - began)
        return size * len(self.seen) / max(now - self.began, _WINDOW)


class FlowSampler:
    """Samples the topics that nodes of this host subscribe to.

    Args:
        node: returns a node outside the executor; called once, when the first topic is sampled.
        clock: monotonic seconds.
        cpu: CPU seconds of this process.
    """

    def __init__(
        self, node: Callable[[], Node], clock: Callable[[], float] = clocks.boot_time,
        cpu: Callable[[], float] = time.process_time,
    ) -> None:  # fmt: skip
        self._make_node, self._clock, self._cpu = node, clock, cpu
        self._node: Node | None = None
        self._sample: _Sample | None = None
        self._next_at = 0.0
        self._rates: dict[_Key, tuple[str, float]] = {}
        self._sampled_at: dict[_Key, float] = {}
        self._has_logged = False

    def rates(self) -> dict[int, dict[str, float]]:
        """Return what each instance receives, bytes a second by the full name of the publisher.

        The master accepts MOST_FLOWS flows of at most LARGEST_RATE: smaller flows beyond are left
        out, and a greater rate, as of a publisher with wrong time stamps, is reported as that.
        """
        flows: dict[tuple[int, str], float] = {}
        for (number, _), (publisher, rate) in self._rates.items():
            flows[number, publisher] = flows.get((number, publisher), 0.0) + rate
        largest = sorted(flows, key=lambda flow: -flows[flow])
        if len(largest) > MOST_FLOWS or any(rate > LARGEST_RATE for rate in flows.values()):
            self._log_bounds(largest, flows)
        found: dict[int, dict[str, float]] = {}
        for number, publisher in largest[:MOST_FLOWS]:
            rate = min(flows[number, publisher], LARGEST_RATE)
            found.setdefault(number, {})[publisher] = float(f"{rate:.{_DIGITS}g}")
        return found

    def _log_bounds(self, largest: list[tuple[int, str]], flows: Mapping[Any, float]) -> None:
        """Log once that flows are left out, or that a rate is too great."""
        if not self._has_logged:
            self._has_logged = True
            _log.info(
                "flows: of %d only the %d largest are reported, and no rate above %g B/s; the "
                "largest one is of %s: %g B/s",
                len(flows), MOST_FLOWS, LARGEST_RATE, largest[0][1], flows[largest[0]],
            )  # fmt: skip

    def look(self, nodes: Mapping[int, str]) -> None:
        """Take the next step of a sample, or begin the next one.

        Args:
            nodes: number of each instance to the full name of its node.
        """
        self._forget(key for key in self._sampled_at if key[0] not in nodes)
        if self._sample is not None:
            self._go_on(self._sample)
        elif self._clock() >= self._next_at and nodes:
            # The node is made once. Its CPU time, as much as that of many samples, counts for none.
            self._node = self._node or self._make_node()
            began, cpu = self._clock(), self._cpu()
            try:
                self._begin(self._node, nodes, began, cpu)
            finally:  # an error of the middleware must not let the next sample begin at once
                if self._sample is None:
                    self._wait(cpu)

    def close(self) -> None:
        """End the sample."""
        if self._sample is not None and self._node is not None:
            self._node.destroy_subscription(self._sample.subscription)
            self._sample = None

    def _wait(self, cpu: float) -> None:
        """Let the next sample begin when the CPU time since `cpu` is a small part of the time."""
        self._next_at = self._clock() + max(_PAUSE, (self._cpu() - cpu) / SHARE)

    def _forget(self, keys: Iterable[_Key]) -> None:
        for key in list(keys):
            self._rates.pop(key, None)
            del self._sampled_at[key]

    def _begin(self, node: Node, nodes: Mapping[int, str], now: float, cpu: float) -> None:
        """Begin a sample of the topic that was sampled longest ago, if it is due."""
        due = [
            (self._sampled_at.get((number, topic), -_RENEWED), number, topic, kind)
            for number, name in nodes.items()
            for topic, kind in _subscribed(node, name)
        ]
        self._forget(self._sampled_at.keys() - {(number, topic) for _, number, topic, _ in due})
        at, number, topic, kind = min(due, default=(now, 0, "", ""))
        if now - at < _RENEWED:
            return
        key = (number, topic)
        self._sampled_at[key] = now
        publishers = node.get_publishers_info_by_topic(topic)
        if not publishers:
            self._sampled_at[key] = now - _RENEWED + _DISCOVERY
        if len(publishers) != 1:
            self._rates.pop(key, None)
            return
        publisher = f"{publishers[0].node_namespace.rstrip('/')}/{publishers[0].node_name}"
        try:
            profile = qos.best_effort(depth=_DEPTH)
            subscription = polled_subscription(node, message_type(kind), topic, profile)
        except Exception:  # noqa: BLE001 - whatever a package or the middleware raises
            return  # the type is not installed on this host
        self._sample = _Sample(key, publisher, subscription, now, cpu)

    def _go_on(self, sample: _Sample) -> None:
        for content, info in waiting(sample.subscription, _DEPTH):
            number, stamp = info["publication_sequence_number"], info["source_timestamp"]
            sample.seen.append((int(number), stamp * 1e-9, len(content)))
        now = self._clock()
        if len(sample.seen) >= _DEPTH or now - sample.began >= _WINDOW:
            assert self._node is not None
            self._node.destroy_subscription(sample.subscription)
            self._sample = None
            rate = sample.rate(now)
            if not rate:
                self._rates.pop(sample.key, None)
            elif sample.key in self._sampled_at:  # the instance has not ended since
                self._rates[sample.key] = (sample.publisher, rate)
            self._wait(sample.cpu)


def _subscribed(node: Node, full_name: str) -> Iterator[tuple[str, str]]:
    """Yield the topics to which a node subscribes, with their types."""
    namespace, _, name = full_name.rpartition("/")
    try:
        found = node.get_subscriber_names_and_types_by_node(name, namespace or "/")
    except Exception:  # noqa: BLE001 - rclpy's error for a node that is not in the graph
        return
    for topic, kinds in found:
        if topic not in _OF_EVERY_NODE and len(kinds) == 1:
            yield topic, kinds[0]
