"""Destination of a handoff: follows the source's state until it takes over."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, Final

from rclpy.qos import QoSProfile

from rosrm import clocks
from rosrm.node.handoff import channel as topics
from rosrm.node.handoff.buffer import HISTORY, Known
from rosrm.node.handoff.channel import Channel
from rosrm.node.handoff.snapshot_assembler import Cut, CutAssembler
from rosrm.node.handoff.state_parts import (
    LARGEST_PART,
    StateError,
    StateTopic,
    differing_part,
    size_fault,
)
from rosrm.node.managed_node import NodeEntities
from rosrm.node.steady_timer import steady_timer
from rosrm.ros.polling import waiting
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport, StateConfig, StateMark

if TYPE_CHECKING:
    from rosrm.node.handoff.links import NodeLinks
    from rosrm.ros.sealed_topic import SealedTopic

#: Seconds without a message after which an input counts as idle.
_IDLE: Final = 1.0
#: Seconds, from the matching of all peers, for which an input must not be behind the state. A
#: reliable reader that misses a message receives nothing until the next heartbeat of the writer,
#: every 3 s by default. The time is limited, because on a slow link an input may always be behind.
_BEHIND: Final = 5.0
#: Seconds without a part or mark after which an ended source counts as drained.
_QUIET: Final = 0.2
#: Seconds for which all readers have to be matched. A reader discovers a writer later than the
#: writer discovers the reader: 0.4 s on a busy machine. After a lost announcement it waits until
#: Fast DDS repeats the announcement. (With 0.5 s here, outputs came 1.3 to 1.9 s late in 5 of 200
#: migrations beside other load.) No event can replace this time (docs/decisions/0011).
_MATCHED: Final = 1.5
#: Seconds between two checks of the conditions that a shadow waits for.
_REVIEW: Final = 0.1
#: Seconds between two requests for a whole mark.
_ASKED: Final = 0.5
#: Most bytes of a message on the source's topics: a part of the state, sealed.
_LARGEST_MESSAGE: Final = LARGEST_PART + 1024


class Destination:
    """Role of a shadow until it is active; then `activated` is called."""

    def __init__(
        self, entities: NodeEntities, parts: list[StateTopic], mark_topic: str,
        activated: Callable[[], None],
    ) -> None:  # fmt: skip
        self._entities = entities
        self._parts = parts
        self._mark_topic = mark_topic
        self._activated = activated
        self._channel: Channel | None = None
        self._assembler: CutAssembler | None = None
        self._followed: list[tuple[Any, Callable[[bytes], bool]]] = []
        self._timer: Any = None
        self._cut: Cut | None = None
        self._run = 0
        self._attached = False
        self._silent_at: int | None = None
        self._alone = False
        self._active = False
        self._last_report = 0.0
        self._asked_at = -inf
        self._matched_at = inf
        self._was_ready = False
        self._may_switch = False
        self._ended = False
        self._fault = ""
        entities.on_overflow = self._overflowed

    # --- messages of the master ------------------------------------------------------------

    def configure(self, config: StateConfig, links: NodeLinks) -> None:
        """Handle a message of the master about the handoff to this node."""
        channel = self._channel
        if channel is None:
            channel = self._open(config, links)
        else:
            channel.repeat()  # the request may come from a new master, after the first was lost
        if config.phase == StateConfig.DONE:
            self.close()
        elif self._ended:
            if config.phase == StateConfig.ABORT and not self._active:
                channel.report(HandoffReport.ABORTED, self._sequence(), self._fault)
        elif config.phase == StateConfig.SWITCH:
            self._may_switch = True
            self._review()
        elif config.phase == StateConfig.TAKE_OVER:
            self._alone = True
            self._review()
        elif config.phase in (StateConfig.ABORT, StateConfig.RESUME):
            self._end(HandoffReport.ABORTED, "the master called it off")

    def _open(self, config: StateConfig, links: NodeLinks) -> Channel:
        entities = self._entities
        channel = self._channel = Channel(
            entities.plain, links, config, instance=entities.identity.instance,
            peer=config.source, take_report=self._take_report,
        )  # fmt: skip
        if self._ended:
            channel.report(HandoffReport.FAILED, 0, self._fault)
            return channel
        self._assembler = CutAssembler()
        # Marks first, also in `_catch_up`, because they name the parts to store.
        marks = channel.topic(StateMark, self._mark_topic)
        self._follow(marks, topics.MARK, marks.read, self._take_mark)
        for part in self._parts:
            self.follow_part(part)
        if not self._ended:
            self._timer = steady_timer(entities.plain, _REVIEW, self._look)
            self._review()
        return channel

    def follow_part(self, part: StateTopic) -> None:
        """Subscribe to a part of the state; the author may name parts later."""
        if self._assembler is not None and self._channel is not None:
            states = self._channel.topic(part.message_type, part.topic)
            take = partial(self._take_part, part.topic)
            self._assembler.expect(part.topic)
            self._follow(states, topics.STATE_FOLLOWED, states.open, take)

    def _follow(
        self, topic: SealedTopic, profile: QoSProfile, opened: Callable[[bytes], Any],
        take: Callable[[Any], None],
    ) -> None:  # fmt: skip
        """Subscribe to a topic of the source; `opened` returns None for a forged message."""
        if self._ended:
            return

        def take_genuine(data: bytes) -> bool:
            message = opened(data) if len(data) <= _LARGEST_MESSAGE else None
            if message is not None:
                take(message)
            return message is not None

        try:
            subscription = topic.subscription(
                self._entities.plain, profile, partial(self._came, take_genuine),
                event_callbacks=topics.NO_SUBSCRIPTION_EVENTS,
            )  # fmt: skip
            self._followed.append((subscription, take_genuine))
        except Exception as error:  # noqa: BLE001 - rclpy passes on any error of the middleware
            # An entity of the author may have another type on that topic.
            self._end(HandoffReport.FAILED, f"{topic.name} cannot be followed: {error}")

    # --- messages of the source ------------------------------------------------------------

    def _take_report(self, report: HandoffReport) -> None:
        with self._entities.turn:
            if self._ended:
                return
            if report.phase == HandoffReport.ATTACHED:
                self._attached = True
            elif report.phase == HandoffReport.SILENT:
                self._silent_at = report.sequence
            elif report.phase == HandoffReport.FAILED:
                self._end(HandoffReport.FAILED, f"the source failed: {report.message}")
            self._go_on()

    def _came(self, take: Callable[[bytes], bool], data: bytes) -> None:
        with self._entities.turn:
            if self._ended:
                return
            is_genuine = take(data)
            if self._catch_up() or is_genuine:
                self._last_report = clocks.boot_time()
                self._go_on()

    def _catch_up(self) -> bool:
        """Process all received messages; return True if one of them is genuine.

        With one message a round, a shadow would lag behind a fast source.
        """
        any_genuine = False
        for subscription, take in self._followed:
            # At the end the subscriptions are destroyed.
            for data, _ in () if self._ended else waiting(subscription):
                if self._ended:
                    return any_genuine
                any_genuine = take(data) or any_genuine
        return any_genuine

    def _take_part(self, topic: str, data: bytes) -> None:
        if self._assembler is not None:
            self._assembler.add_part(topic, data)

    def _take_mark(self, mark: StateMark) -> None:
        fault = self._fault_of(mark)
        if fault:
            self._end(HandoffReport.FAILED, fault)
        elif self._assembler is not None:
            self._run = mark.run
            if not self._assembler.add_mark(mark, clocks.boot_time()):
                self._end(HandoffReport.FAILED, "too many marks came without the state they name")

    def _fault_of(self, mark: StateMark) -> str:
        """Return the reason why this node cannot use the source's state; "" if it can."""
        if mark.protocol_version != PROTOCOL_VERSION:
            return (
                f"the source speaks protocol version {mark.protocol_version}, this node "
                f"{PROTOCOL_VERSION}: both need the same version of rosrm"
            )
        if self._run and mark.run != self._run:
            return "the source was started again, and its state is a new one"
        fault = size_fault(mark)
        if fault:
            return fault
        differing = differing_part(self._parts, mark)
        if differing is None:
            return ""
        return (
            f"the state on {differing.topic} is {differing.theirs} at the source, and "
            f"{differing.ours} here: both must be the same program"
        )

    # --- following -------------------------------------------------------------------------

    def _look(self) -> None:
        with self._entities.turn:
            if not self._ended and not self._was_ready:
                self._entities.catch_up()  # messages that wait in a reader have arrived, too
            if not self._ended:
                self._review()
            if not self._ended and self._cut is not None:
                self._ask_for_history()

    def _go_on(self) -> None:
        """Restore the newest state, if there is a new one, then check the next step."""
        if self._ended or self._assembler is None:
            return
        cut = self._assembler.take()
        if cut is not None and not self._restore(cut):
            return
        self._review()

    def _restore(self, cut: Cut) -> bool:
        try:
            for part in self._parts:
                part.restore_changed(cut.parts[part.topic])
        except StateError as error:
            self._end(HandoffReport.FAILED, str(error))
            return False
        self._cut = cut
        for mark in (*cut.passed, cut.mark):
            self._entities.cover(mark.inputs)
        return not self._has_lost_history()

    def _has_lost_history(self) -> bool:
        """Fail if it is unknown which messages of an input the source has processed."""
        topic = self._entities.input_known(Known.LOST)
        if topic:
            self._end(
                HandoffReport.FAILED,
                f"more than {HISTORY} messages came on {topic}, which has several publishers, "
                f"while no mark of the source came, so it is not known which of them the source "
                f"has processed",
            )
        return bool(topic)

    def _ask_for_history(self) -> None:
        """Repeat the last report if marks are missing: the source answers with a whole one."""
        now = clocks.boot_time()
        if self._channel is None or now - self._asked_at < _ASKED:
            return
        if self._entities.input_known(Known.GAP):
            self._asked_at = now
            self._channel.repeat()

    def _review(self) -> None:
        """Report progress, request silence when allowed, and become active after it."""
        if self._channel is None or self._ended:
            return
        if self._alone:
            self._take_over_when_quiet()
            return
        if not self._was_ready:
            missing = self._still_missing()
            if missing:
                self._channel.report(HandoffReport.SHADOWING, self._sequence(), f"waits {missing}")
                return
            self._was_ready = True
            self._channel.report(HandoffReport.READY, self._sequence())
        if not self._may_switch:
            return
        if self._cut is not None and self._is_last(self._cut):
            self._activate_if_complete()
        else:
            self._entities.buffer.is_last = True
            self._channel.report(HandoffReport.SWITCHING, self._sequence())

    def _is_last(self, cut: Cut) -> bool:
        """Return True for the last state of this handoff; an earlier one may be latched too."""
        return bool(cut.mark.last) and cut.mark.sequence == self._silent_at

    def _sequence(self) -> int:
        return int(self._cut.mark.sequence) if self._cut is not None else 0

    def _still_missing(self) -> str:
        """Return the condition that this node waits for before it is ready; "" if it is ready."""
        if not self._attached:
            return "for the source to answer: is it up, and does it use rosrm.node?"
        if self._cut is None:
            return self._missing_state()
        now = clocks.boot_time()
        missing = self._missing_peers(self._cut.mark)
        if missing:
            self._matched_at = inf
            return missing
        self._matched_at = min(self._matched_at, now)
        if now - self._matched_at < _MATCHED:
            return "a moment: its peers may not know it yet"
        for covered in self._cut.mark.inputs:
            missing = self._missing_input(covered.topic, now)
            if missing:
                return missing
        lossy = self._entities.input_with_gap()
        if lossy:
            return f"until the state covers a message on {lossy} that did not arrive here"
        unknown = self._entities.input_known(Known.GAP)
        if unknown:
            return f"for a mark that names all messages on {unknown} that the source has processed"
        return ""

    def _missing_peers(self, mark: StateMark) -> str:
        """Return the topic and number of peers matched with the source but not with this node."""
        entities = self._entities
        readers = {one.topic_name: entities.readers.of(one) for one in entities.outputs}
        for output in mark.outputs:
            if readers.get(output.topic, output.subscriptions) < output.subscriptions:
                return (
                    f"for the readers of {output.topic}: {readers[output.topic]} of "
                    f"{output.subscriptions} matched"
                )
        writers = {one.key: one.subscription.get_publisher_count() for one in entities.inputs}
        for covered in mark.inputs:
            if writers.get(covered.topic, covered.publishers) < covered.publishers:
                return (
                    f"for the publishers of {covered.topic}: {writers[covered.topic]} of "
                    f"{covered.publishers} matched"
                )
        return ""

    def _missing_state(self) -> str:
        missing = self._assembler.missing() if self._assembler is not None else []
        if missing:
            return f"for the state on {', '.join(missing)}"
        return f"for the first state, marked on {self._mark_topic}"

    def _missing_input(self, topic: str, now: float) -> str:
        """Return the condition of an input that this node waits for; "" if there is none.

        Each message must be in the buffer or covered by the state, and the newest covered one must
        have arrived.
        """
        buffer = self._entities.buffer
        is_own = any(one.key == topic for one in self._entities.inputs)
        if not is_own or buffer.is_idle(topic, now, self._matched_at, _IDLE):
            return ""
        if not buffer.overlaps(topic):
            return f"until a message on {topic} has been here and in the state"
        if buffer.is_behind(topic) and now - self._matched_at < _BEHIND:
            return f"until the newest message on {topic} in the state has been here"
        return ""

    # --- the end ---------------------------------------------------------------------------

    def _take_over_when_quiet(self) -> None:
        """Become active after the source's end, when its last messages have arrived."""
        if clocks.boot_time() - self._last_report < _QUIET:
            return
        if self._cut is None:
            self._end(HandoffReport.FAILED, "the source ended before a state of it was here")
        elif not self._is_unsure():
            self._activate()

    def _is_unsure(self) -> bool:
        """Fail if marks are missing that may cover a message in the buffer."""
        topic = self._entities.input_known(Known.GAP)
        if topic:
            self._end(
                HandoffReport.FAILED,
                f"marks of the source are missing, so it is not known which messages on {topic} "
                f"the source has processed",
            )
        return bool(topic)

    def _activate_if_complete(self) -> None:
        self._entities.catch_up()
        lossy = self._entities.input_with_gap()
        if lossy:
            self._end(
                HandoffReport.FAILED,
                f"a message on {lossy} did not arrive here, and the source has not processed it: "
                f"its subscription needs a greater depth, or this host is too busy",
            )
        elif not self._ended and not self._is_unsure():
            self._activate()

    def _activate(self) -> None:
        entities, cut = self._entities, self._cut
        if cut is None:
            return
        self._ended = self._active = True
        entities.sequence = self._sequence()
        entities.inherit(cut.mark.inputs)
        # Buffered messages are served first, because `_unfollow` and `_activated` take time.
        entities.become_active(
            cut.mark.timers_due, cut.arrived, self._report_active, (self._unfollow, self._activated)
        )

    def _report_active(self) -> None:
        if self._channel is not None:
            self._channel.report(HandoffReport.ACTIVE, self._sequence())

    def _end(self, phase: int, message: str) -> None:
        """Abandon the handoff for good; this process then runs until its slave stops it."""
        self._ended, self._fault = True, message
        self._entities.node.get_logger().warning(f"this instance will not take over: {message}")
        if self._channel is not None:
            self._channel.report(phase, self._sequence(), message)
        self._unfollow()

    def _overflowed(self, topic: str) -> None:
        if not self._ended:
            self._end(
                HandoffReport.FAILED,
                f"more came on {topic} than can be kept until the source's state covers it",
            )

    def _unfollow(self) -> None:
        destroy = self._entities.plain.destroy_subscription
        for subscription, _ in self._followed:
            destroy(subscription)
        self._followed = []
        if self._timer is not None:
            self._entities.plain.destroy_timer(self._timer)
            self._timer = None
        self._assembler = None
        self._cut = None

    def close(self) -> None:
        """Leave the channel of a finished handoff."""
        if self._channel is not None:
            self._channel.close()
            self._channel = None
