"""State that a node keeps while it is out of the ROS graph."""

from __future__ import annotations

import inspect
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from rclpy.duration import Duration
from rclpy.parameter import Parameter

from rosrm import clocks
from rosrm.node.entities import TimerOf

#: Topics of every node, which no node's work depends on.
_INTERNAL: Final = frozenset({"/parameter_events", "/rosout", "/clock"})
#: Seconds between two reads of the numbers of peers.
_LOOK: Final = 0.005


@dataclass(frozen=True)
class DeclaredParameter:
    """A parameter with its current value and its descriptor."""

    parameter: Parameter
    descriptor: Any

    def declare(self, node: Any) -> None:
        """Declare the parameter in a node that does not have it."""
        name, value = self.parameter.name, self.parameter.value
        if value is None and not self.descriptor.dynamic_typing:
            value = Parameter.Type(self.descriptor.type)  # a type, and no value yet
        node.declare_parameter(name, value, self.descriptor)


@dataclass(frozen=True)
class Departure:
    """The state of a node at its graph departure.

    Attributes:
        parameters: by name.
        timers: period and nanoseconds until due (-1: cancelled) of each, in order of creation.
        peers: number of matched peers of each endpoint, by its description for users.
        others: numbers of other nodes' endpoints on its topics, and of servers of its clients.
    """

    parameters: Mapping[str, DeclaredParameter]
    timers: tuple[tuple[int, int], ...]
    peers: Mapping[str, int]
    others: Mapping[tuple[str, str], int]

    def overrides(self, given: Iterable[Parameter] | None) -> list[Parameter]:
        """Return the initial parameter values for the rejoin.

        Args:
            given: overrides by the author; values that were set later take precedence.
        """
        found = {one.name: one for one in given or ()}
        found |= {
            name: one.parameter
            for name, one in self.parameters.items()
            if one.parameter.type_ is not Parameter.Type.NOT_SET
        }
        return list(found.values())

    def declare_missing(self, node: Any, names: Iterable[str] | None = None) -> None:
        """Declare parameters that the author declared outside `join`.

        Args:
            node: the node, which has rejoined.
            names: only these parameters; None: all.
        """
        for name in list(self.parameters if names is None else names):
            if name in self.parameters and not node.has_parameter(name):
                self.parameters[name].declare(node)

    def start_timers(self, node: Any) -> None:
        """Resume each timer at its position in the period; the time away does not count.

        Timers are matched by order of creation; a timer with another period is a new one.
        """
        for timer, (period, due) in zip(list(node.timers), self.timers, strict=False):
            one = TimerOf(timer, True)
            # Simulated time is independent of the time away; coroutines cannot be wrapped below.
            if timer.timer_period_ns != period or one.follows_ros_time():
                continue
            if due < 0:
                timer.cancel()
            elif timer.callback and not inspect.iscoroutinefunction(timer.callback):
                _first_in(one, due)


def _first_in(one: TimerOf, due_ns: int) -> None:
    timer, callback = one.timer, one.timer.callback

    def first(*arguments: Any) -> Any:
        timer.callback = callback
        one.back_in_step()
        return callback(*arguments)

    timer.callback = first
    one.start_in(due_ns / 1e9)


def departure_of(node: Any) -> Departure:
    """Return the state of a node, between two of its callbacks."""
    parameters = {
        name: DeclaredParameter(parameter, node.describe_parameter(name))
        for name, parameter in node.get_parameters_by_prefix("").items()
    }
    timers = tuple((one.timer_period_ns, TimerOf(one, True).due_ns()) for one in node.timers)
    return Departure(parameters, timers, peers_of(node), others_of(node))


def await_readers(node: Any, patience: float) -> None:
    """Wait until reliable readers have all samples, because they drop a writer that leaves.

    Args:
        node: the node, which is about to leave.
        patience: seconds for all of them together, so that a stopped reader delays nothing more.
    """
    deadline = clocks.boot_time() + patience
    for one in node.publishers:
        left = max(0.0, deadline - clocks.boot_time())
        one.wait_for_all_acked(Duration(seconds=left))


def have_acknowledged(node: Any) -> bool:
    """Return True if all reliable readers have acknowledged all samples of a node's publishers."""
    return all(one.wait_for_all_acked(Duration()) for one in node.publishers)


def others_of(node: Any) -> Counter[tuple[str, str]]:
    """Return how many endpoints of other nodes the graph has on a node's topics and clients."""
    own = Counter(
        [
            *(("publishers", one.topic_name) for one in node.publishers),
            *(("subscribers", one.topic_name) for one in node.subscriptions),
            *(("services", node.resolve_service_name(one.srv_name)) for one in node.services),
        ]
    )
    wanted = {
        *(("subscribers", one.topic_name) for one in node.publishers),
        *(("publishers", one.topic_name) for one in node.subscriptions),
        *(("services", node.resolve_service_name(one.srv_name)) for one in node.clients),
    }
    return Counter({end: _count(node, end) - own[end] for end in wanted if end[1] not in _INTERNAL})


def _count(node: Any, end: tuple[str, str]) -> int:
    kind, name = end
    return int(getattr(node, f"count_{kind}")(name))


def sees_again(node: Any, others: Mapping[tuple[str, str], int], patience: float) -> bool:
    """Return True once a node that rejoins sees as many endpoints of others as before. Polls.

    Args:
        node: the node, which has no endpoints of its own in the graph yet.
        others: result of `others_of` before the departure.
        patience: most seconds to wait.
    """
    deadline = clocks.boot_time() + patience
    while any(_count(node, end) < count for end, count in others.items()):
        if clocks.boot_time() >= deadline or not node.context.ok():
            return False
        time.sleep(_LOOK)
    return True


def peers_of(node: Any) -> dict[str, int]:
    """Return the number of peers that each endpoint of a node has matched."""
    found = [
        *(("readers of", one.topic_name, one.get_subscription_count()) for one in node.publishers),
        *(("writers of", one.topic_name, one.get_publisher_count()) for one in node.subscriptions),
        *(("a server of", one.srv_name, int(one.service_is_ready())) for one in node.clients),
    ]
    counts: dict[str, int] = {}
    times: Counter[str] = Counter()
    for what, name, count in found:
        if name not in _INTERNAL:
            key = f"{what} {name}"
            times[key] += 1
            counts[key if times[key] == 1 else f"{key} ({times[key]})"] = count
    return counts


def await_peers(node: Any, before: Mapping[str, int], patience: float) -> tuple[str, ...]:
    """Wait until a node has matched as many peers as before its departure.

    This polls, because rclpy reports a match by a callback in the executor. The executor must not
    run yet, since it would also run the author's callbacks.

    Args:
        node: the node, which has rejoined.
        before: result of `peers_of` before the departure.
        patience: most seconds to wait.

    Returns:
        A description of each missing peer; empty if all are matched.
    """
    deadline = clocks.boot_time() + patience
    while node.context.ok():
        now = peers_of(node)
        missing = tuple(
            f"{key}: {now[key]} of {count}"
            for key, count in before.items()
            if now.get(key, count) < count
        )
        if not missing or clocks.boot_time() >= deadline:
            return missing
        time.sleep(_LOOK)
    return ()
