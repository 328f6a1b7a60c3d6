"""Health checks of nodes: publication of a topic, and lifecycle state.

Both are polled from a node outside the executor, a few times a second. So messages of a topic cost
the slave no callback each, and DDS keeps only the newest of messages faster than the required rate.
The publisher's sequence numbers count messages that DDS drops or, as with large messages over best
effort, loses.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any, Final

from rclpy.exceptions import NameValidationException
from rclpy.node import Node
from rclpy.qos import qos_profile_services_default

from rosrm.core.slave.watches import NoState, Watch
from rosrm.ros import qos
from rosrm.ros.polling import message_type, polled_subscription, waiting
from rosrm.ros.slave.graph import GraphWatch

#: Seconds between two checks of the graph while a topic is subscribed.
_GRAPH_PERIOD: Final = 1.0
#: Seconds between two requests for a lifecycle state, and until no answer counts as silence.
_ASK_PERIOD: Final = 1.0
_PATIENCE: Final = 1.0
#: Least number of requests within the time for which the state may be wrong.
_ASKS: Final = 4
#: Seconds' worth of messages that are kept between two checks, and the most messages.
_KEPT: Final = 1.0
_MOST_KEPT: Final = 1000


class HealthMonitor:
    """Checks the health of one run of one instance; the node is outside every executor."""

    def __init__(
        self, node: Node, graph: GraphWatch, watch: Watch, now: float,
        clock: SimulatedClock | None = None,
    ) -> None:  # fmt: skip
        clock = SimulatedClock(node) if clock is None else clock
        self._time = _TimeMonitor(node, clock, watch.parameters) if watch.topics else None
        self._topic = _TopicMonitor(node, graph, watch) if watch.topics else None
        self._state = _StateMonitor(node, watch, now) if watch.services else None

    def topic(self, pids: Iterable[int], now: float) -> tuple[int | None, str]:
        """Return the messages since the last check, or None and why the topic cannot be checked."""
        return (None, "") if self._topic is None else self._topic.look(pids, now)

    def state(self, now: float) -> str | NoState:
        """Return the lifecycle state, or why it is not known."""
        return NoState.NOT_YET if self._state is None else self._state.look(now)

    def clock(self, now: float) -> float | None:
        """Return the simulated time of the node; None: it counts by the machine's clock."""
        return None if self._time is None else self._time.look(now)

    def close(self) -> None:
        """Destroy the subscription and the clients."""
        for ear in (self._time, self._topic, self._state):
            if ear is not None:
                ear.close()


class SimulatedClock:
    """Newest time of `/clock`, shared by the monitors of a slave; subscribed at its first use."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscription: Any = None
        self._newest = 0.0

    def now(self) -> float:
        """Return the simulated time in seconds; 0.0: no simulator has published it."""
        if self._subscription is None:
            kind = import_module("rosgraph_msgs.msg").Clock
            self._subscription = self._node.create_subscription(
                kind, "/clock", lambda _: None, qos.best_effort(depth=1)
            )
        for message, _ in waiting(self._subscription):
            self._newest = message.clock.sec + 1e-9 * message.clock.nanosec
        return self._newest


class _Clients:
    """Clients of a node's services; an invalid name has none, and so counts as no answer.

    Attributes:
        created: the clients.
    """

    def __init__(self, node: Node, kind: Any, names: Sequence[str], **options: Any) -> None:
        self._node, self._kind, self._options = node, kind, options
        self._missing = list(names)
        self.created: list[Any] = []

    def create(self) -> None:
        """Create the missing clients.

        An error of the middleware, as for want of memory, is raised, so that there is no
        observation. Otherwise it would count as the silence of a node, which ends the node.
        """
        while self._missing:
            with contextlib.suppress(NameValidationException):
                client = self._node.create_client(self._kind, self._missing[0], **self._options)
                self.created.append(client)
            del self._missing[0]

    def close(self) -> None:
        """Destroy the clients."""
        for client in self.created:
            self._node.destroy_client(client)
        self.created.clear()


class _TimeMonitor:
    """Finds out whether a node has `use_sim_time`, from the node itself: files may set it too."""

    def __init__(self, node: Node, clock: SimulatedClock, names: Sequence[str]) -> None:
        self._clock = clock
        self._services = import_module("rcl_interfaces.srv")
        self._clients = _Clients(node, self._services.GetParameters, names)
        self._asked = -math.inf
        self._is_simulated: bool | None = None  # None: the node has not answered yet

    def look(self, now: float) -> float | None:
        """Return the simulated time of the node; None: it has none, or has not answered yet."""
        if self._is_simulated is None:
            self._ask(now)
        return self._clock.now() if self._is_simulated else None

    def _ask(self, now: float) -> None:
        self._clients.create()
        for client in self._clients.created:
            with client.handle:
                header, answer = client.handle.take_response(self._services.GetParameters.Response)
            if header is not None:
                self._is_simulated = bool(answer.values and answer.values[0].bool_value)
                self.close()
                return
        if now - self._asked >= _ASK_PERIOD:
            self._asked = now
            for client in self._clients.created:
                request = self._services.GetParameters.Request(names=["use_sim_time"])
                with client.handle:
                    client.handle.send_request(request)

    def close(self) -> None:
        self._clients.close()


class _TopicMonitor:
    def __init__(self, node: Node, graph: GraphWatch, watch: Watch) -> None:
        self._node, self._graph = node, graph
        self._names = watch.topics
        kept = math.ceil(_KEPT * watch.checks.rate) + 1
        self._depth = min(kept, _MOST_KEPT)
        self._subscription: Any = None
        self._source = ("", "")  # subscribed topic and its type
        self._last = 0
        self._looked_at_graph = -math.inf
        self._trouble = ""

    def look(self, pids: Iterable[int], now: float) -> tuple[int | None, str]:
        if not self._is_matched() or now - self._looked_at_graph >= _GRAPH_PERIOD:
            self._looked_at_graph = now
            self._trouble = self._follow_graph(pids)
        if self._trouble or not self._is_matched():
            return None, self._trouble or "not found by discovery yet"
        return self._take(), ""

    def _is_matched(self) -> bool:
        return self._subscription is not None and self._subscription.get_publisher_count() > 0

    def _follow_graph(self, pids: Iterable[int]) -> str:
        """Subscribe to the instance's topic in the graph; return an obstacle, or ""."""
        try:
            name, types = self._published(pids)
            if len(types) == 1:
                self._listen(name, types[0])
                return ""
        except Exception as error:  # noqa: BLE001 - whatever a package or the middleware raises
            return f"cannot be listened to on this host ({type(error).__name__}: {error})"
        self.close()
        if types:
            return f"published as {' and '.join(types)}"
        return f"not published as {' or '.join(self._names)}"

    def _listen(self, name: str, type_name: str) -> None:
        if (name, type_name) == self._source:
            return
        self.close()
        self._subscription = polled_subscription(
            self._node, message_type(type_name), name, qos.best_effort(depth=self._depth)
        )
        self._source = (name, type_name)

    def _published(self, pids: Iterable[int]) -> tuple[str, Sequence[str]]:
        """Return the first published name and its types; those of other nodes if it has none."""
        for name in self._names:
            found: list[Any] = self._node.get_publishers_info_by_topic(name)
            own = [info for info in found if self._graph.is_of(bytes(info.endpoint_gid), pids)]
            if found:
                return name, sorted({str(info.topic_type) for info in own or found})
        return "", ()

    def _take(self) -> int:
        """Return the messages since the last check, with lost ones as far as numbers show them."""
        alone = self._subscription.get_publisher_count() == 1
        return sum(
            self._since_last(int(info["publication_sequence_number"]), alone)
            for _, info in waiting(self._subscription, self._depth)
        )

    def _since_last(self, number: int, alone: bool) -> int:
        """Return 1 and the gap in the publisher's numbers; those of several have no order."""
        lost = number - self._last - 1 if alone and 0 < self._last < number else 0
        self._last = number if alone else 0
        return 1 + lost

    def close(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription, self._source, self._last = None, ("", ""), 0


class _StateMonitor:
    def __init__(self, node: Node, watch: Watch, now: float) -> None:
        self._state: str | NoState = NoState.NOT_YET
        self._period = min(_ASK_PERIOD, watch.checks.timeout / _ASKS)
        self._asked = -math.inf
        self._answered = now
        self._kind = import_module("lifecycle_msgs.srv").GetState
        self._clients = _Clients(
            node, self._kind, watch.services, qos_profile=qos_profile_services_default
        )

    def look(self, now: float) -> str | NoState:
        try:
            self._clients.create()
        except Exception:
            self._answered = now  # the node could not be asked
            raise
        for client in self._clients.created:
            self._take_answer(client, now)
        if now - self._answered > self._period + _PATIENCE:
            self._state = NoState.NO_ANSWER
        if now - self._asked >= self._period:
            self._asked = now
            for client in self._clients.created:
                with client.handle:
                    client.handle.send_request(self._kind.Request())
        return self._state

    def _take_answer(self, client: Any, now: float) -> None:
        """Take every received answer; the newest counts, to whichever request."""
        while True:
            with client.handle:
                header, response = client.handle.take_response(self._kind.Response)
            if header is None:
                return
            self._state, self._answered = str(response.current_state.label), now

    def close(self) -> None:
        self._clients.close()
