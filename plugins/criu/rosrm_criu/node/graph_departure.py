"""What a node takes through the time in which it has no part in the ROS graph."""

from __future__ import annotations

import inspect
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from rclpy.duration import Duration
from rclpy.parameter import Parameter

from rosrm.node.entities import TimerOf

#: Of every node; nobody's cycle depends on who listens there.
_INTERNAL: Final = frozenset({"/parameter_events", "/rosout", "/clock"})
#: Seconds between two looks at the counts of peers.
_LOOK: Final = 0.005


@dataclass(frozen=True)
class Declared:
    """A parameter as it stands, and as it was declared."""

    parameter: Parameter
    descriptor: Any

    def declare(self, node: Any) -> None:
        """Declare it in a node that does not have it."""
        name, value = self.parameter.name, self.parameter.value
        if value is None and not self.descriptor.dynamic_typing:
            value = Parameter.Type(self.descriptor.type)  # a type, and no value yet
        node.declare_parameter(name, value, self.descriptor)


@dataclass(frozen=True)
class Absence:
    """A node as it was when it left.

    Attributes:
        parameters: by name.
        timers: period and nanoseconds until due (-1: cancelled) of each, in order of creation.
        peers: how many each of its ends had, by what a user knows it by.
        others: ends of other nodes on its topics, and servers of its clients.
    """

    parameters: Mapping[str, Declared]
    timers: tuple[tuple[int, int], ...]
    peers: Mapping[str, int]
    others: Mapping[tuple[str, str], int]

    def overrides(self, given: Iterable[Parameter] | None) -> list[Parameter]:
        """What parameters begin with when they are declared anew.

        Args:
            given: that the author gave; what was set since then goes before it.
        """
        found = {one.name: one for one in given or ()}
        found |= {
            name: one.parameter
            for name, one in self.parameters.items()
            if one.parameter.type_ is not Parameter.Type.NOT_SET
        }
        return list(found.values())

    def declare_missing(self, node: Any, names: Iterable[str] | None = None) -> None:
        """Declare what the author declared elsewhere than in `join`.

        Args:
            node: that has joined.
            names: of these alone; None: of all.
        """
        for name in list(self.parameters if names is None else names):
            if name in self.parameters and not node.has_parameter(name):
                self.parameters[name].declare(node)

    def start_timers(self, node: Any) -> None:
        """Each timer goes on where it was in its period: the time away does not count.

        They are matched by the order of creation; one with another period is a new one.
        """
        for timer, (period, due) in zip(list(node.timers), self.timers, strict=False):
            one = TimerOf(timer, True)
            # A simulation's seconds are not ours; a coroutine cannot be stood before.
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


def absence_of(node: Any) -> Absence:
    """A node as it stands, between two of its callbacks."""
    parameters = {
        name: Declared(parameter, node.describe_parameter(name))
        for name, parameter in node.get_parameters_by_prefix("").items()
    }
    timers = tuple((one.timer_period_ns, TimerOf(one, True).due_ns()) for one in node.timers)
    return Absence(parameters, timers, peers_of(node), others_of(node))


def await_readers(node: Any, patience: float) -> None:
    """Wait until reliable readers have what was published: they forget a writer that goes.

    Args:
        node: that is about to leave.
        patience: seconds for all of them; a reader that is stopped holds nobody up.
    """
    deadline = time.monotonic() + patience
    for one in node.publishers:
        left = max(0.0, deadline - time.monotonic())
        one.wait_for_all_acked(Duration(seconds=left))


def others_of(node: Any) -> Counter[tuple[str, str]]:
    """How many ends of other nodes a node's topics and clients have, as the graph knows them."""
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
    """Whether a node that has entered the graph sees as many ends of others as before. Polled, too.

    Args:
        node: that has nothing of its own there yet.
        others: what `others_of` was.
        patience: seconds at most.
    """
    deadline = time.monotonic() + patience
    while any(_count(node, end) < count for end, count in others.items()):
        if time.monotonic() >= deadline or not node.context.ok():
            return False
        time.sleep(_LOOK)
    return True


def peers_of(node: Any) -> dict[str, int]:
    """How many peers each end of a node has matched."""
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
    """Wait until a node has matched as many peers as it had before it left.

    Polled: rclpy tells of a match by a callback in the executor, which has to rest just now; the
    author's own callbacks would go on with it.

    Args:
        node: that has joined anew.
        before: what `peers_of` was.
        patience: seconds at most.

    Returns:
        What is missing; nothing, or a sentence each.
    """
    deadline = time.monotonic() + patience
    while node.context.ok():
        now = peers_of(node)
        missing = tuple(
            f"{key}: {now[key]} of {count}"
            for key, count in before.items()
            if now.get(key, count) < count
        )
        if not missing or time.monotonic() >= deadline:
            return missing
        time.sleep(_LOOK)
    return ()
