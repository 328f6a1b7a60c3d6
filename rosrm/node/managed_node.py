"""Layer between the author's callbacks and ROS in a migratable node.

At any time the node is active (messages pass directly), a shadow (inputs are buffered, outputs
dropped), or silent (the same, for a source whose successor may be active). Each callback of the
author is one cycle, and cycles never overlap, so that a state always lies between two of them.
"""

from __future__ import annotations

import itertools
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import Enum
from functools import partial
from typing import Any, Final

from rclpy.executors import MultiThreadedExecutor

from rosrm import clocks
from rosrm.errors import describe_fault
from rosrm.node.entities import (
    DeferredAnswer,
    GatedPublisher,
    Input,
    OpeningOf,
    PublisherGate,
    ServiceOf,
    TimerOf,
    depth_of,
    refuse_coroutine,
    size_of,
    wants_all,
    wants_info,
)
from rosrm.node.handoff.buffer import InputBuffer, Known, Sent
from rosrm.node.handoff.reader_count import ReaderCount
from rosrm.node.handoff.replay import InputReplay
from rosrm.node.identity import NodeIdentity
from rosrm.ros.polling import waiting
from rosrm_msgs.msg import CoveredInput

#: Most messages of one input, and most bytes of all inputs, that are buffered for a successor: a
#: silent source with a stuck destination may have to buffer half a minute of a fast sensor.
BUFFER_LIMIT: Final = 100_000
BUFFER_BYTES: Final = 512 << 20
#: rclpy's own topics, which each node handles without rosrm.
_INTERNAL: Final = frozenset({"/parameter_events", "/clock", "/rosout"})
#: Seconds after activation in which a message may arrive that the source has processed. The time is
#: limited, because the clock of a publisher may be set back.
_LATE: Final = 10.0


class Mode(Enum):
    """State of a node in a handoff."""

    ACTIVE = "active"
    SHADOW = "shadow"
    SILENT = "silent"


class NodeEntities:
    """The author's entities of one node.

    Args:
        node: the author's node.
        plain: gives access to rclpy's own methods of the node.
        identity: given by rosrm to this process.
        resting: the node does not start active: a shadow, or a node that restores a snapshot first.

    Attributes:
        turn: lock that is held while a callback runs.
        sequence: number of cycles so far.
        in_cycle: a callback of the author has begun and not ended; also True after it raised.
        on_cycle: called after each cycle; set by the role in a handoff, as is the next.
        on_overflow: called with the topic of an input whose buffer is full.
    """

    def __init__(self, node: Any, plain: Any, identity: NodeIdentity, *, resting: bool) -> None:
        self.node = node
        self.plain = plain
        self.identity = identity
        self.turn = threading.RLock()
        self.mode = Mode.SHADOW if resting else Mode.ACTIVE
        self.sequence = 0
        self.in_cycle = False
        self._late_until = 0.0
        self.inputs: list[Input] = []
        self.outputs: list[Any] = []
        self.readers = ReaderCount(node)
        self.timers: list[TimerOf] = []
        self.on_cycle: Callable[[], None] = lambda: None
        self.on_overflow: Callable[[str], None] = lambda _: None
        self._gate = PublisherGate(self.mode is Mode.ACTIVE)
        self._openings: list[ServiceOf | OpeningOf] = []
        #: `timers_due` of a node that is active, but whose timers have not started yet.
        self._due_at_start: Sequence[int] | None = None
        #: Further work of a node that has become active.
        self._steps: deque[Callable[[], None]] = deque()
        self._replay = InputReplay(plain, self.turn, self._serve_next)
        self.buffer = self._new_buffer()

    @property
    def visible_node(self) -> str:
        """Return the fully qualified name by which peers know this node."""
        return self.identity.node or str(self.node.get_fully_qualified_name())

    def visible(self, name: str, resolve: Callable[[str], str]) -> str:
        """Return a name given by the author without the alias under which this node may run."""
        own = f"{self.node.get_fully_qualified_name()}/"
        resolved = resolve(name)
        if not resolved.startswith(own) or own == f"{self.visible_node}/":
            return name
        return f"{self.visible_node}/{resolved[len(own) :]}"

    @property
    def is_replaying(self) -> bool:
        """Return True while buffered messages may be left; new messages then queue behind them."""
        return self._replay.is_on

    def _new_buffer(self) -> InputBuffer:
        return InputBuffer(BUFFER_LIMIT, BUFFER_BYTES, clocks.boot_time())

    # --- entities of the author ------------------------------------------------------------

    def create_publisher(self, message_type: Any, topic: str, qos: Any, **rest: Any) -> Any:
        """Create a publisher that can fall silent."""
        wanted = rest.pop("publisher_class", GatedPublisher)
        if not issubclass(wanted, GatedPublisher):
            wanted = type(wanted.__name__, (GatedPublisher, wanted), {})
        topic = self.visible(topic, self.node.resolve_topic_name)
        publisher = self.plain.create_publisher(
            message_type, topic, qos, publisher_class=wanted, **rest
        )
        publisher.gate = self._gate
        if topic not in _INTERNAL:
            self.outputs.append(publisher)
        return publisher

    def create_subscription(
        self, message_type: Any, topic: str, callback: Callable[..., Any], qos: Any, *,
        buffer: bool, **rest: Any,
    ) -> Any:  # fmt: skip
        """Create an input, whose messages are buffered while this node is not active."""
        if topic in _INTERNAL:
            return self.plain.create_subscription(message_type, topic, callback, qos, **rest)
        refuse_coroutine(callback, topic)
        one = Input(callback, wants_info(callback), buffer, wants_all(qos), depth_of(qos))

        def take(message: Any, info: Any) -> None:
            self._received(one, message, info)

        topic = self.visible(topic, self.node.resolve_topic_name)
        one.subscription = self.plain.create_subscription(message_type, topic, take, qos, **rest)
        one.topic = one.subscription.topic_name
        one.key = self._new_key(one.topic)
        self.inputs.append(one)
        return one.subscription

    def _new_key(self, topic: str) -> str:
        """Return a unique key: a node may subscribe to a topic twice, and both get all messages."""
        taken = {one.key for one in self.inputs}
        numbered = (f"{topic}#{number}" for number in itertools.count(2))
        return next(key for key in itertools.chain([topic], numbered) if key not in taken)

    def create_timer(
        self, period: float, callback: Callable[..., Any] | None, *rest: Any, autostart: bool,
        **named: Any,
    ) -> Any:  # fmt: skip
        """Create a timer that runs while this node is active."""
        if callback is None:  # rclpy's Rate sets its own callback later, which is no cycle
            return self.plain.create_timer(period, None, *rest, autostart=autostart, **named)
        refuse_coroutine(callback, f"a timer of {period} s")

        def tick(*arguments: Any) -> None:
            one.taken += 1
            with self.turn:
                one.taken -= 1
                if self.mode is Mode.ACTIVE:
                    one.back_in_step()
                    self._cycle(callback, *arguments)

        active = self.mode is Mode.ACTIVE
        one = TimerOf(None, autostart)
        one.timer = self.plain.create_timer(
            period, tick, *rest, autostart=autostart and active, **named
        )
        self.timers.append(one)
        return one.timer

    def create_service(
        self, service_type: Any, name: str, callback: Callable[..., Any], **rest: Any
    ) -> ServiceOf:
        """Create a service that is open while this node is active."""
        refuse_coroutine(callback, f"the service {name}")
        name = self.visible(name, self.node.resolve_service_name)

        def serve(request: Any, response: Any) -> Any:
            with self.turn:
                if self.mode is not Mode.ACTIVE:
                    return DeferredAnswer(request, response)
                return self._cycle(callback, request, response)

        service = ServiceOf(
            lambda answer: self.plain.create_service(service_type, name, answer, **rest),
            self.plain.destroy_service, name, serve,
        )  # fmt: skip
        self._add_opening(service)
        return service

    def when_active(self, create: Callable[[], Any]) -> None:
        """Create an object that may exist only while this node is active."""
        self._add_opening(OpeningOf(create))

    def _add_opening(self, opening: ServiceOf | OpeningOf) -> None:
        self._openings.append(opening)
        if self.mode is Mode.ACTIVE:
            opening.open()

    def destroyed(self, entity: Any) -> None:
        """Remove a publisher, input, timer or service that the author destroyed."""
        self.outputs = [one for one in self.outputs if one is not entity]
        self.inputs = [one for one in self.inputs if one.subscription is not entity]
        self.timers = [one for one in self.timers if one.timer is not entity]
        self._openings = [one for one in self._openings if one is not entity]

    # --- cycles ----------------------------------------------------------------------------

    def _cycle(self, callback: Callable[..., Any], *arguments: Any) -> Any:
        self.in_cycle = True
        result = callback(*arguments)
        self.in_cycle = False
        self.sequence += 1
        try:
            self.on_cycle()
            self._replay.after_cycle()
        except Exception:  # a signal, or the author, may shut ROS down while a callback runs
            if self.node.context.ok():
                raise
        return result

    def _received(self, one: Input, message: Any, info: Any) -> None:
        with self.turn:
            if one.buffered and (self.mode is not Mode.ACTIVE or self.is_replaying):
                self._keep(one, message, info)
                if self._may_catch_up(one):
                    self._catch_up(one, taken=1)
            elif self.mode is Mode.ACTIVE and not self._is_late(one, info):
                self._cycle(one.serve, message, info)

    def _is_late(self, one: Input, info: Any) -> bool:
        """Return True if the source processed this message before the message arrived here."""
        if not self._late_until:
            return False
        if clocks.boot_time() >= self._late_until:
            self._late_until = 0.0
            return False
        return self.buffer.is_marked(one.key, info["source_timestamp"])

    # --- buffering -------------------------------------------------------------------------

    def _keep(self, one: Input, message: Any, info: Any) -> None:
        """Buffer a message for the next active node: this one, or a successor."""
        sent = Sent(info["source_timestamp"], info["publication_sequence_number"] or None)
        if not one.is_ordered():
            self.buffer.mix(one.key)
        item, now = (one, message, info), clocks.boot_time()
        if not self.buffer.add(one.key, sent, item, now, size_of(message)):
            self.on_overflow(one.topic)

    def _may_catch_up(self, one: Input) -> bool:
        """Return True if no other thread holds an older message, and this node is not busy."""
        busy = self.mode is Mode.ACTIVE and clocks.boot_time() >= self._late_until
        return not busy and (self._is_one_thread() or one.is_ordered())

    def _is_one_thread(self) -> bool:
        return not isinstance(self.node.executor, MultiThreadedExecutor)

    def _catch_up(self, one: Input, taken: int = 0) -> None:
        """Buffer received messages, because a DDS reader has less room and drops the oldest."""
        for message, info in waiting(one.subscription):
            self._keep(one, message, info)
            taken += 1
        if 0 < one.depth <= taken:
            self.buffer.overran(one.key)

    def catch_up(self) -> None:
        """Buffer received messages of all buffered inputs, unless several threads take them."""
        if self._is_one_thread():
            for one in self.inputs:
                if one.buffered:
                    self._catch_up(one)

    def input_with_gap(self) -> str:
        """Return an input that has lost a message and needs every one; "" if there is none."""
        wanting = (one for one in self.inputs if one.buffered and one.wants_all)
        return next((one.topic for one in wanting if self.buffer.misses_one(one.key)), "")

    def input_known(self, known: Known) -> str:
        """Return an input of which the buffer has this knowledge; "" if there is none."""
        buffered = (one for one in self.inputs if one.buffered)
        return next((one.topic for one in buffered if self.buffer.known(one.key) is known), "")

    def serve_what_has_come(self, then: Callable[[], None]) -> None:
        """Serve received messages, which a later shadow does not receive; then call `then`."""
        if not self.is_replaying:
            self.catch_up()
        if self.buffer:
            self._replay.serve(len(self.buffer), then)
        else:
            then()

    def _serve_next(self) -> bool:
        if self.mode is not Mode.ACTIVE:
            return False
        if clocks.boot_time() < self._late_until:
            self.catch_up()  # afterwards only the reader's depth bounds a busy node's backlog
        buffered = self.buffer.take()
        if buffered is not None:
            one, message, info = buffered.item
            self._cycle(one.serve, message, info)
            return True
        return any(one.serve_held() for one in self._openings if isinstance(one, ServiceOf))

    # --- changes of the mode ---------------------------------------------------------------

    def fall_silent(self) -> list[int]:
        """Stop publishing and all timers; return `timers_due` from before (ns)."""
        due = self.timers_due()
        self.mode = Mode.SILENT
        self._gate.is_open = False
        if not self.buffer:  # messages that came during the last cycle stay for the successor
            self.buffer = self._new_buffer()
        for timer in self.timers:
            if self._due_at_start is None:
                timer.started = not timer.timer.is_canceled()
            timer.stop()
        self._due_at_start = None
        for opening in self._openings:
            if isinstance(opening, OpeningOf):
                self._close(opening)
        return due

    def close_services_stepwise(self) -> Iterator[None]:
        """Close one service at each `next`, until all are closed or this node is active again.

        The successor serves the requests now; requests to this node would be lost. The author's
        services are closed first, and those of ROS for the parameters last.
        """
        for opening in reversed(self._openings):
            if self.mode is not Mode.SILENT:
                return
            if isinstance(opening, ServiceOf):
                self._close(opening)
                yield

    def _close(self, opening: ServiceOf | OpeningOf) -> None:
        try:
            opening.close()
        except Exception as error:  # noqa: BLE001 - the author's code may raise anything
            what = describe_fault(error)
            self.node.get_logger().error(f"falling silent, and closing raised {what}")

    def covered_inputs(
        self, publishers: Callable[[Input], int], *, whole: bool = False
    ) -> list[CoveredInput]:
        """Return the processed messages of each buffered input, for a mark of the state.

        A whole mark names all that this node remembers, other ones the newest.
        """
        return [
            CoveredInput(
                topic=one.key, publishers=publishers(one), processed=one.processed,
                covered=one.newest(whole=whole),
            )
            for one in self.inputs if one.buffered
        ]  # fmt: skip

    def cover(self, inputs: Iterable[CoveredInput]) -> None:
        """Drop messages that a state covers, now or when they arrive."""
        for one in inputs:
            self.buffer.cover(
                one.topic, one.covered, processed=one.processed, single=one.publishers <= 1,
                now=clocks.boot_time(),
            )  # fmt: skip

    def inherit(self, inputs: Iterable[CoveredInput]) -> None:
        """Treat messages that the source of the state processed as processed here."""
        own = {one.key: one for one in self.inputs}
        for covered in inputs:
            if covered.topic in own:
                own[covered.topic].note(covered.covered)

    def timers_due(self) -> list[int]:
        """Return the nanoseconds until each timer is due, in order of creation; -1: cancelled.

        Timers beyond the list are due now.
        """
        if self._due_at_start is not None:
            return list(self._due_at_start)
        return [timer.due_ns() for timer in self.timers]

    def become_active(
        self, timers_due: Sequence[int], since: float, announce: Callable[[], None],
        settle: Sequence[Callable[[], None]] = (),
    ) -> None:  # fmt: skip
        """Become active: first announce it, then serve buffered messages.

        Args:
            timers_due: as `timers_due` returned it; timers beyond the list start now.
            since: monotonic time at which it did.
            announce: called first, because serving may take long.
            settle: called after the first slices of buffered messages and the start of timers and
                services.
        """
        self.mode = Mode.ACTIVE
        self._gate.is_open = True
        self._late_until = clocks.boot_time() + _LATE
        self._due_at_start = timers_due
        announce()
        opens = (partial(self._open, one) for one in self._openings)
        self._steps = deque([partial(self._start_timers, timers_due, since), *opens, *settle])
        self._replay.begin(self._next_step)

    def _next_step(self) -> bool:
        """Do the next step of some ms, between new messages; return False if there is none.

        If a step of the author raises and the executor continues, the other steps follow.
        """
        if self.mode is not Mode.ACTIVE or not self._steps:
            return False
        self._steps.popleft()()
        return True

    def _open(self, opening: ServiceOf | OpeningOf) -> None:
        if opening in self._openings:
            opening.open()

    def _start_timers(self, timers_due: Sequence[int], since: float) -> None:
        passed = clocks.boot_time() - since
        self._due_at_start = None
        for timer, due in itertools.zip_longest(list(self.timers), timers_due):
            if timer is None:
                return
            if due is None:
                if timer.started:
                    timer.timer.reset()
            elif due < 0:
                timer.timer.cancel()
            elif timer.follows_ros_time():
                timer.timer.reset()  # simulated seconds differ from monotonic ones
            else:
                timer.start_in(due / 1e9 - passed)
