"""The author's publishers, inputs, timers and services, as a node that can be moved holds them."""

from __future__ import annotations

import inspect
from array import array
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, ReliabilityPolicy

#: Source time stamps of the newest messages of each input that go with every mark.
COVERED_KEPT: Final = 256
#: Most messages that are taken from one reader at a time.
_AT_A_TIME: Final = 1000
#: Bytes that a part of a message is taken for that has no size of its own.
_SMALL: Final = 32


@dataclass(slots=True)
class Gate:
    """Whether what the author publishes goes out."""

    is_open: bool


class GatedPublisher(Publisher):  # type: ignore[misc]  # rclpy brings no types
    """A publisher that is silent while its node is a shadow, or has fallen silent."""

    gate: Gate

    def publish(self, msg: Any) -> None:
        """Send a message, if this node is the active one; else it is dropped."""
        if self.gate.is_open:
            super().publish(msg)


@dataclass(slots=True)
class Input:
    """One buffered subscription.

    Attributes:
        topic: fully qualified.
        key: the topic, or `/topic#2` for a second subscription of it.
        callback: the author's.
        with_info: it wants the message's information too.
        buffered: in a handoff its messages are kept.
        wants_all: every message counts, not only the newest.
        covered: source time stamps of the newest messages that were processed, ns.
        subscription: rclpy's.
    """

    callback: Callable[..., Any]
    with_info: bool
    buffered: bool
    wants_all: bool
    topic: str = ""
    key: str = ""
    covered: deque[int] = field(default_factory=lambda: deque(maxlen=COVERED_KEPT))
    subscription: Any = None

    def is_ordered(self) -> bool:
        """Its messages come to the callback in the order of their publisher."""
        return isinstance(self.subscription.callback_group, MutuallyExclusiveCallbackGroup)

    def serve(self, message: Any, info: Any) -> None:
        """Have the author's callback process a message."""
        if self.with_info:
            self.callback(message, info)
        else:
            self.callback(message)
        self.covered.append(info["source_timestamp"])


def size_of(message: Any) -> int:
    """Bytes of a message, about: the first of a list stands for all."""
    if isinstance(message, bytes | bytearray | str):
        return len(message)
    if isinstance(message, list | tuple):
        return len(message) * (size_of(message[0]) if message else 0)
    if isinstance(message, array):
        return len(message) * message.itemsize
    if hasattr(message, "nbytes"):
        return int(message.nbytes)
    if hasattr(message, "get_fields_and_field_types"):
        return sum(size_of(getattr(message, one)) for one in message.get_fields_and_field_types())
    return _SMALL


def wants_all(qos: Any) -> bool:
    """Whether an input is to have every message, and not only the newest."""
    if isinstance(qos, int):
        return qos > 1
    if qos.reliability is ReliabilityPolicy.BEST_EFFORT:
        return False
    return qos.history is HistoryPolicy.KEEP_ALL or qos.depth > 1


def waiting(subscription: Any) -> Iterator[tuple[Any, Any]]:
    """Messages that have come and that the executor has not served yet, with their information.

    They are taken, as the executor would have taken them; there is an end, even where they come
    faster than they are taken.
    """
    handle = subscription.handle
    with handle:
        for _ in range(_AT_A_TIME):
            taken = handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            yield taken


def wants_info(callback: Callable[..., Any]) -> bool:
    """Whether an input's callback takes (message, information), as rclpy tells it."""
    signature = inspect.signature(callback)
    try:
        signature.bind(object())
    except TypeError:
        return True
    return False


def refuse_coroutine(callback: Callable[..., Any], what: str) -> None:
    """A callback is a cycle, and cycles do not overlap.

    Raises:
        TypeError: it is a coroutine function.
    """
    if inspect.iscoroutinefunction(callback):
        raise TypeError(
            f"rosrm.node: the callback of {what} is `async`, but a state is saved between two "
            f"callbacks: use an ordinary function"
        )


@dataclass(slots=True)
class TimerOf:
    """One timer of the author.

    Attributes:
        timer: rclpy's.
        started: it runs, or is to run when its node becomes active.
        period_ns: its own, while the timer was given another for one time.
        taken: ticks that an executor's threads have taken, and that have not begun.
    """

    timer: Any
    started: bool
    period_ns: int = 0
    taken: int = 0

    def due_ns(self) -> int:
        """Nanoseconds until it is due; -1: it is cancelled."""
        if self.taken:
            return 0
        due = None if self.timer.is_canceled() else self.timer.time_until_next_call()
        return -1 if due is None else max(0, due)

    def follows_ros_time(self) -> bool:
        """Whether its clock is a simulation's (`use_sim_time`)."""
        return bool(getattr(self.timer.clock, "ros_time_is_active", False))

    def start_in(self, seconds: float) -> None:
        """Run first after so long, and in its own period from then on."""
        self.period_ns = self.timer.timer_period_ns
        self.timer.timer_period_ns = max(1, int(seconds * 1e9))
        self.timer.reset()

    def back_in_step(self) -> None:
        """It ran for the first time after `start_in`."""
        if self.period_ns:
            self.timer.timer_period_ns, self.period_ns = self.period_ns, 0
            self.timer.reset()

    def stop(self) -> None:
        """Run no more, until it is started again."""
        if self.period_ns:
            self.timer.timer_period_ns, self.period_ns = self.period_ns, 0
        self.timer.cancel()


@dataclass(frozen=True, slots=True)
class Held:
    """In place of an answer: the request came to a node that is not active."""

    request: Any
    response: Any


class ServiceOf:
    """One service of the author: a server that exists from when its node is active first.

    A silent node executes nothing: its requests are held, with what it takes to answer them, until
    it goes on, or for ever. No thread of an executor waits with them.

    It stands for rclpy's `Service` where the author keeps what `create_service` returned.

    Args:
        create: makes the server, for a callback.
        destroy: takes it down.
        name: as the author gave it.
        serve: answers a request, or returns it as `Held`.
    """

    def __init__(
        self,
        create: Callable[[Callable[[Any, Any], Any]], Any],
        destroy: Callable[[Any], Any],
        name: str,
        serve: Callable[[Any, Any], Any],
    ) -> None:
        self._create = create
        self._destroy = destroy
        self._serve = serve
        self._service: Any = None
        self._send: Callable[[Any, Any], None] = _drop
        self._held: deque[tuple[Any, Held]] = deque()
        self.srv_name = name

    def open(self) -> None:
        """Serve from now on."""
        if self._service is None:
            self._service = self._create(self._serve)
            self._send, self._service.send_response = self._service.send_response, self._answer

    def _answer(self, answer: Any, header: Any) -> None:
        """What rclpy calls with what `serve` returned."""
        if isinstance(answer, Held):
            self._held.append((header, answer))
        else:
            self._send(answer, header)

    def serve_held(self) -> bool:
        """Answer the oldest request that is held; False: there is none."""
        if not self._held:
            return False
        header, held = self._held.popleft()
        self._answer(self._serve(held.request, held.response), header)
        return True

    def close(self) -> None:
        """Take the server down."""
        self._held.clear()
        if self._service is not None:
            self._destroy(self._service)
            self._service = None

    def __getattr__(self, name: str) -> Any:
        """What rclpy's object has, while there is one."""
        if self._service is None:
            raise AttributeError(f"{name}: the service {self.srv_name} is not open in a shadow")
        return getattr(self._service, name)


def _drop(_answer: Any, _header: Any) -> None:
    """There is no server yet."""


class OpeningOf:
    """What the author has made when the node becomes active.

    Args:
        create: the author's function; what it returns is destroyed when the node falls silent,
            where that has a `destroy`.
    """

    def __init__(self, create: Callable[[], Any]) -> None:
        self._create = create
        self._made: Any = None
        self._is_open = False

    def open(self) -> None:
        """Make it."""
        if not self._is_open:
            self._is_open = True
            self._made = self._create()

    def close(self) -> None:
        """Destroy it, where it can be."""
        self._is_open = False
        made, self._made = self._made, None
        destroy = getattr(made, "destroy", None)
        if destroy is not None:
            destroy()
