"""Wrappers of the author's publishers, inputs, timers and services in a migratable node."""

from __future__ import annotations

import inspect
from array import array
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.publisher import Publisher
from rclpy.qos import HistoryPolicy, ReliabilityPolicy

from rosrm.node.handoff.buffer import HISTORY

#: Source time stamps in a mark that is not whole: those of the newest messages of each input.
NEWEST: Final = 256
#: Bytes assumed for a field without a size of its own.
_SMALL: Final = 32


@dataclass(slots=True)
class PublisherGate:
    """Switch of the author's publishers: messages are sent while it is open."""

    is_open: bool


class GatedPublisher(Publisher):  # type: ignore[misc]  # rclpy brings no types
    """A publisher that sends nothing while its node is a shadow or silent."""

    gate: PublisherGate

    def publish(self, msg: Any) -> None:
        """Send a message if this node is active; otherwise drop it."""
        if self.gate.is_open:
            super().publish(msg)


@dataclass(slots=True)
class Input:
    """One buffered subscription.

    Attributes:
        topic: its fully qualified name.
        key: the topic, or `/topic#2` for a second subscription of it.
        callback: the author's function.
        with_info: the callback takes the message's information too.
        buffered: messages are stored during a handoff.
        wants_all: every message counts, not only the newest.
        depth: most messages that the reader keeps; 0: unlimited.
        covered: source time stamps of the newest processed messages, ns.
        processed: position of the last one.
        subscription: rclpy's object.
    """

    callback: Callable[..., Any]
    with_info: bool
    buffered: bool
    wants_all: bool
    depth: int = 0
    topic: str = ""
    key: str = ""
    covered: deque[int] = field(default_factory=lambda: deque(maxlen=HISTORY))
    processed: int = 0
    subscription: Any = None

    def is_ordered(self) -> bool:
        """Return True if the callback receives messages in the order of their publisher."""
        return isinstance(self.subscription.callback_group, MutuallyExclusiveCallbackGroup)

    def serve(self, message: Any, info: Any) -> None:
        """Let the author's callback process a message."""
        if self.with_info:
            self.callback(message, info)
        else:
            self.callback(message)
        self.note([info["source_timestamp"]])

    def note(self, stamps: Sequence[int]) -> None:
        """Note processed messages by their source time stamps."""
        self.covered.extend(stamps)
        self.processed += len(stamps)

    def newest(self, *, whole: bool) -> array[int]:
        """Return the time stamps for a mark, oldest first."""
        if whole:
            return array("q", self.covered)
        newest_first = array("q", islice(reversed(self.covered), NEWEST))
        newest_first.reverse()
        return newest_first


def size_of(message: Any) -> int:
    """Return the approximate bytes of a message: a list counts as copies of its first item."""
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
    """Return True if an input needs every message, and not only the newest."""
    if isinstance(qos, int):
        return qos > 1
    if qos.reliability is ReliabilityPolicy.BEST_EFFORT:
        return False
    return qos.history is HistoryPolicy.KEEP_ALL or qos.depth > 1


def depth_of(qos: Any) -> int:
    """Return the most messages that a reader keeps; 0: unlimited."""
    if isinstance(qos, int):
        return qos
    return 0 if qos.history is HistoryPolicy.KEEP_ALL else int(qos.depth)


def wants_info(callback: Callable[..., Any]) -> bool:
    """Return True if a callback takes (message, information), by rclpy's rule."""
    signature = inspect.signature(callback)
    try:
        signature.bind(object())
    except TypeError:
        return True
    return False


def refuse_coroutine(callback: Callable[..., Any], what: str) -> None:
    """Refuse a coroutine function, because each callback is a cycle and cycles do not overlap.

    Raises:
        TypeError: the callback is a coroutine function.
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
        timer: rclpy's object.
        started: the timer runs, or will run when its node becomes active.
        period_ns: the author's period, while the timer has another one for its first run.
        taken: due runs that threads of an executor have taken but not begun.
    """

    timer: Any
    started: bool
    period_ns: int = 0
    taken: int = 0

    def due_ns(self) -> int:
        """Return the nanoseconds until the timer is due; -1: it is cancelled."""
        if self.taken:
            return 0
        due = None if self.timer.is_canceled() else self.timer.time_until_next_call()
        return -1 if due is None else max(0, due)

    def follows_ros_time(self) -> bool:
        """Return True if the timer's clock is simulated (`use_sim_time`)."""
        return bool(getattr(self.timer.clock, "ros_time_is_active", False))

    def start_in(self, seconds: float) -> None:
        """Start the timer: first run after `seconds`, at most a period, then with that period."""
        self.period_ns = self.timer.timer_period_ns
        self.timer.timer_period_ns = min(max(1, int(seconds * 1e9)), self.period_ns)
        self.timer.reset()

    def back_in_step(self) -> None:
        """Restore the author's period after the first run that `start_in` set."""
        if self.period_ns:
            self.timer.timer_period_ns, self.period_ns = self.period_ns, 0
            self.timer.reset()

    def stop(self) -> None:
        """Stop the timer until its next start."""
        self.back_in_step()
        self.timer.cancel()


@dataclass(frozen=True, slots=True)
class DeferredAnswer:
    """Placeholder for an answer, because the request reached a node that is not active."""

    request: Any
    response: Any


class ServiceOf:
    """One service of the author, whose server exists from the node's first activation on.

    A silent node executes nothing. Its requests are held, with all that is needed to answer them,
    until the node becomes active again, or forever. No executor thread waits for them.

    The author gets this object from `create_service` in place of rclpy's `Service`.

    Args:
        create: creates the server with a callback.
        destroy: destroys the server.
        name: name given by the author.
        serve: answers a request, or returns it as `DeferredAnswer`.
    """

    def __init__(
        self, create: Callable[[Callable[[Any, Any], Any]], Any], destroy: Callable[[Any], Any],
        name: str, serve: Callable[[Any, Any], Any],
    ) -> None:  # fmt: skip
        self._create = create
        self._destroy = destroy
        self._serve = serve
        self._service: Any = None
        self._send: Callable[[Any, Any], None] = lambda *_: None
        self._held: deque[tuple[Any, DeferredAnswer]] = deque()
        self.srv_name = name

    def open(self) -> None:
        """Create the server, if it does not exist yet."""
        if self._service is None:
            self._service = self._create(self._serve)
            self._send, self._service.send_response = self._service.send_response, self._answer

    def _answer(self, answer: Any, header: Any) -> None:
        """Send an answer of `serve`, or hold the request; called by rclpy."""
        if isinstance(answer, DeferredAnswer):
            self._held.append((header, answer))
        else:
            self._send(answer, header)

    def serve_held(self) -> bool:
        """Answer the oldest held request; return False if there is none."""
        if not self._held:
            return False
        header, held = self._held.popleft()
        self._answer(self._serve(held.request, held.response), header)
        return True

    def close(self) -> None:
        """Drop held requests and destroy the server."""
        self._held.clear()
        if self._service is not None:
            self._destroy(self._service)
            self._service = None

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of rclpy's service while that exists."""
        if self._service is None:
            raise AttributeError(f"{name}: the service {self.srv_name} is not open in a shadow")
        return getattr(self._service, name)


class OpeningOf:
    """Object that the author creates when the node becomes active.

    Args:
        create: the author's function; if its result has a `destroy`, that is called when the node
            falls silent.
    """

    def __init__(self, create: Callable[[], Any]) -> None:
        self._create = create
        self._made: Any = None
        self._is_open = False

    def open(self) -> None:
        """Create the object, if it does not exist yet."""
        if not self._is_open:
            self._is_open = True
            self._made = self._create()

    def close(self) -> None:
        """Destroy the object, if it has a `destroy`."""
        self._is_open = False
        made, self._made = self._made, None
        destroy = getattr(made, "destroy", None)
        if destroy is not None:
            destroy()
