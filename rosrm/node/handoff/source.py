"""Active node: publishes its state to followers, and falls silent on request."""

from __future__ import annotations

import random
from array import array
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Final

from rclpy.duration import Duration

from rosrm import clocks
from rosrm.node.handoff import channel as topics
from rosrm.node.handoff.channel import Channel
from rosrm.node.handoff.state_parts import StateError, StateTopic
from rosrm.node.handoff.stranded import StrandedSource
from rosrm.node.managed_node import Mode, NodeEntities
from rosrm.node.snapshots.writer import SnapshotSaver
from rosrm.node.steady_timer import steady_timer
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs.msg import HandoffReport, MatchedOutput, StateConfig, StateMark

if TYPE_CHECKING:
    from rosrm.node.handoff.links import NodeLinks
    from rosrm.ros.sealed_topic import SealedWriter

#: Seconds that a silent source waits until its last outputs are acknowledged; by default Fast DDS
#: sends its readers a heartbeat every 3 s.
_ACK_PATIENCE: Final = 4.0
#: Seconds between two checks for acknowledgements.
_LOOK: Final = 0.05
#: Seconds between the closing of two services. DDS announces each closing to every participant of
#: the domain. Closing all seven of a node at once kept two cores busy for 10 ms, which delayed the
#: first outputs of the successor.
_CLOSE_EVERY: Final = 0.02
#: Most seconds that a source waits for the end of a cycle before it becomes silent. Right after a
#: cycle, the time until the next periodic input is longest.
_CYCLE_PATIENCE: Final = 0.1
_AT_ONCE: Final = Duration(nanoseconds=0)
#: Returned by `next` after the last service is closed.
_END: Final = object()


class HandoffSource:
    """Role of the active node towards a successor."""

    def __init__(self, entities: NodeEntities, parts: list[StateTopic], mark_topic: str) -> None:
        self._entities = entities
        self._parts = parts
        self._run = random.getrandbits(63) | 1
        self._channel: Channel | None = None
        self._attached = False
        self._may_switch = False
        self._asked = False
        self._finishing = False
        self._cycle_timer: Any = None
        self._fault = ""
        self._timers_due: list[int] = []
        self._silent_since = 0.0
        self._release_timer: Any = None
        self._closing: Iterator[None] | None = None
        self._closing_timer: Any = None
        self._stranded: StrandedSource | None = None
        self._mark_topic = mark_topic
        self._marks: SealedWriter | None = None
        self._keeper = SnapshotSaver(entities, parts, self._run) if entities.identity.keep else None
        entities.on_cycle = self._after_cycle
        entities.on_overflow = self._overflowed

    def add_part(self, part: StateTopic) -> None:
        """Add another part of the state that the author names."""
        if self._channel is not None:
            self._show_part(self._channel, part)

    def _show_part(self, channel: Channel, part: StateTopic) -> None:
        try:
            part.show_to(channel.publisher(part.message_type, part.topic, topics.STATE).publish)
        except Exception as error:  # noqa: BLE001 - rclpy passes on any error of the middleware
            # An entity of the author may have another type on that topic.
            self._failed(f"{part.topic} cannot be published: {error}")

    # --- the state -------------------------------------------------------------------------

    def _after_cycle(self) -> None:
        if self._attached and not self._fault:
            self._show()
        if self._keeper is not None:
            self._keeper.after_cycle()
        if not self._entities.is_replaying:  # a replay counts its messages between two cycles
            self._finish()

    def _show(self, *, whole: bool = False, last: bool = False) -> bool:
        """Publish the state between two cycles, and the mark that lists the covered inputs.

        Return False on a failure, which has been reported to the master.
        """
        try:
            for part in self._parts:
                part.publish()
        except StateError as error:
            self._failed(str(error))
            return False
        if self._marks is not None:
            self._marks.publish(self._mark(whole=whole, last=last))
        return True

    def _show_history(self) -> None:
        """Publish a whole mark of the newest published state, for a follower that missed marks."""
        ready = self._attached and not self._fault and self._entities.mode is Mode.ACTIVE
        if ready and self._marks is not None and not self._entities.in_cycle:
            for part in self._parts:
                part.show()
            self._marks.publish(self._mark(whole=True, last=False))

    def _failed(self, fault: str) -> None:
        """Report that the state cannot be published; the handoff fails, the node stays active."""
        if not self._fault:
            self._entities.node.get_logger().error(f"{fault}. This node stays where it is")
        self._fault = fault
        if self._channel is not None:
            self._channel.report(HandoffReport.FAILED, self._entities.sequence, fault)

    def _mark(self, *, whole: bool, last: bool) -> StateMark:
        entities = self._entities
        due = self._still_due() if last else entities.timers_due()
        return StateMark(
            protocol_version=PROTOCOL_VERSION, run=self._run, sequence=entities.sequence, last=last,
            parts=[part.described() for part in self._parts],
            inputs=entities.covered_inputs(
                lambda one: one.subscription.get_publisher_count(), whole=whole
            ),
            outputs=[
                MatchedOutput(topic=one.topic_name, subscriptions=entities.readers.of(one))
                for one in entities.outputs
            ],
            timers_due=array("q", due),
        )  # fmt: skip

    def _still_due(self) -> list[int]:
        """Return the timers' due times less the time that saving a large state has taken."""
        passed = int((clocks.boot_time() - self._silent_since) * 1e9)
        return [due if due < 0 else max(0, due - passed) for due in self._timers_due]

    # --- a handoff -------------------------------------------------------------------------

    def configure(self, config: StateConfig, links: NodeLinks) -> None:
        """Handle a message of the master about a handoff away from this node.

        Anyone may have recorded messages for an earlier run of this node, and they still open. So
        only messages with the number of this run make the node silent, and a silent node ignores
        all others.
        """
        is_of_this_run = config.source_run == self._run
        is_silent = self._finishing or self._entities.mode is Mode.SILENT
        if is_silent and not is_of_this_run:
            return
        if self._channel is None or self._channel.name != config.channel:
            if config.phase not in (StateConfig.SHADOW, StateConfig.SWITCH, StateConfig.RESUME):
                return
            self._open(config, links)
        else:
            self._channel.repeat()
        if config.phase == StateConfig.SWITCH and is_of_this_run:
            self._may_switch = True
            self._switch()
        elif config.phase == StateConfig.RESUME:
            self._resume()
        elif config.phase == StateConfig.DONE:
            self.close()

    def _open(self, config: StateConfig, links: NodeLinks) -> None:
        self.close()
        channel = self._channel = Channel(
            self._entities.plain, links, config, instance=self._entities.identity.instance,
            peer=config.destination, take_report=self._take_report, run=self._run,
        )  # fmt: skip
        self._marks = channel.publisher(StateMark, self._mark_topic, topics.MARK)
        for part in self._parts:
            self._show_part(channel, part)

    def _take_report(self, report: HandoffReport) -> None:
        with self._entities.turn:
            if report.phase in (HandoffReport.SHADOWING, HandoffReport.READY):
                self._show_history()
                self._attach()
            elif report.phase == HandoffReport.SWITCHING:
                self._asked = True
                self._switch()
            elif report.phase == HandoffReport.ACTIVE and self._entities.mode is Mode.SILENT:
                self._close_services()

    def _close_services(self) -> None:
        """Close one service now, and the others one by one."""
        if self._closing is None:
            self._closing = self._entities.close_services_stepwise()
            self._closing_timer = steady_timer(
                self._entities.plain, _CLOSE_EVERY, self._close_next_service
            )
            self._close_next_service()

    def _close_next_service(self) -> None:
        with self._entities.turn:
            if self._closing is not None and next(self._closing, _END) is _END:
                self._entities.plain.destroy_timer(self._closing_timer)
                self._closing = None

    def _attach(self) -> None:
        if self._channel is None or self._attached or self._fault:
            return
        if self._entities.mode is not Mode.ACTIVE:
            return
        self._attached = True
        if self._show(whole=True):
            self._channel.report(HandoffReport.ATTACHED, self._entities.sequence)

    def _switch(self) -> None:
        """Fall silent after the next cycle, once master and destination have requested it."""
        if self._channel is None or not (self._may_switch and self._asked) or self._fault:
            return
        if self._entities.mode is Mode.ACTIVE and not self._finishing:
            self._finishing = True
            self._cycle_timer = steady_timer(self._entities.plain, _CYCLE_PATIENCE, self._finish)

    def _finish(self) -> None:
        """Serve received messages and fall silent, if this node waits for the end of a cycle."""
        with self._entities.turn:
            if self._cycle_timer is not None:
                self._stop_cycle_timer()
                self._entities.serve_what_has_come(self._fall_silent)

    def _stop_cycle_timer(self) -> None:
        if self._cycle_timer is not None:
            self._entities.plain.destroy_timer(self._cycle_timer)
            self._cycle_timer = None

    def _fall_silent(self) -> None:
        entities, wanted = self._entities, self._finishing
        self._finishing = False
        if self._channel is None or not wanted or self._fault:
            return  # the handoff was aborted
        self._timers_due = entities.fall_silent()
        self._silent_since = clocks.boot_time()
        if not self._show(whole=True, last=True):
            self._reactivate(lambda: None)  # the failure has been reported
            return
        self._stranded = StrandedSource(entities, self._channel)
        self._channel.report(HandoffReport.SILENT, entities.sequence)
        self._release_timer = steady_timer(entities.plain, _LOOK, self._release)

    def _release(self) -> None:
        """Report RELEASED when all outputs are acknowledged, or after the time-out.

        An output without an acknowledgement is lost when the process stops.
        """
        with self._entities.turn:
            received = all(one.wait_for_all_acked(_AT_ONCE) for one in self._entities.outputs)
            if received or clocks.boot_time() - self._silent_since >= _ACK_PATIENCE:
                self._stop_release()
                if self._channel is not None:
                    self._channel.report(HandoffReport.RELEASED, self._entities.sequence)

    def _stop_release(self) -> None:
        if self._release_timer is not None:
            self._entities.plain.destroy_timer(self._release_timer)
            self._release_timer = None

    def _call_off(self) -> None:
        self._may_switch = self._asked = self._attached = self._finishing = False
        self._stop_cycle_timer()
        self._stop_release()

    def _resume(self) -> None:
        self._call_off()
        if self._entities.mode is Mode.SILENT:
            self._reactivate(self._report_resumed)
        else:
            self._report_resumed()

    def _report_resumed(self) -> None:
        if self._channel is not None:
            self._channel.report(HandoffReport.RESUMED, self._entities.sequence)

    def _reactivate(self, announce: Callable[[], None]) -> None:
        self._ask_no_more()
        self._entities.become_active(self._timers_due, self._silent_since, announce)

    def _ask_no_more(self) -> None:
        if self._stranded is not None:
            self._stranded.close()
            self._stranded = None

    def _overflowed(self, topic: str) -> None:
        self._entities.node.get_logger().error(
            f"silent for its successor, and the buffer of {topic} is full: a message is lost",
            throttle_duration_sec=1.0,
        )

    def close(self) -> None:
        """Leave the channel of a finished handoff."""
        self._fault = ""
        self._call_off()
        if self._channel is not None:
            self._channel.close()
            self._channel = self._marks = None

    def end(self) -> None:
        """Store the last snapshot, because the node is destroyed."""
        self._ask_no_more()
        if self._keeper is not None:
            self._keeper.close()
