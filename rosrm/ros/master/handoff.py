"""Handoffs in the master's endpoint: `state_config`, and the nodes' reports about it."""

from __future__ import annotations

from array import array
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from rclpy.serialization import serialize_message

from rosrm import clocks
from rosrm.core.master.commands import PublishStateConfig
from rosrm.core.master.events import Event, HandoffReported, SourceStranded
from rosrm.keys.handoffs import HandoffKeys, new_link
from rosrm.keys.names import handoff_name, instance_name, named_instance
from rosrm.keys.sealing import Direction
from rosrm.model.plan import HandoffPhase, ReportPhase
from rosrm.ros import names, qos
from rosrm.ros.bounds import check_bounds
from rosrm.ros.control import version_refusal
from rosrm.ros.master.refusals import Refuse
from rosrm.ros.participant import Participant
from rosrm.ros.sealed_codec import decode
from rosrm.ros.sealed_topic import SealedTopic
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg

#: Most questions of silent sources that are answered at once, and a second. Each asks again.
_QUESTIONS: Final = 20
_QUESTIONS_PER_SECOND: Final = 5.0
#: Most sources for which the counter of the newest question is stored.
_MOST_ASKERS: Final = 256


@dataclass(slots=True)
class _Handoff:
    """One handoff.

    Attributes:
        source: instance number of the source.
        key: of the handoff; b"" with `security: none`.
        receivers: topic `state_config` for each instance of the handoff that has a key.
        subscription: to the reports of the handoff.
        source_run: number of the source's run, from its newest report; 0: there was none.
    """

    source: int
    key: bytes = field(repr=False)
    receivers: Sequence[SealedTopic]
    subscription: Any
    source_run: int = 0


@dataclass(slots=True)
class _Asker:
    """A silent source that has asked.

    Attributes:
        topic: of its questions, with the counter of the newest: otherwise a recorded question could
            be repeated.
        run: number of its run.
    """

    topic: SealedTopic
    run: int = 0


class HandoffEndpoint:
    """Sends messages to the nodes of a handoff, and receives theirs until it is done.

    Args:
        cluster: the master's name.
        take: called with each event.
        refuse: called with the kind of message, its refused sender and the reason.
        keys: of instances and handoffs; None: with `security: none`.
    """

    def __init__(
        self, participant: Participant, cluster: str, epoch: int, take: Callable[[Event], None],
        refuse: Refuse, *, keys: HandoffKeys | None = None,
    ) -> None:  # fmt: skip
        self._participant = participant
        self._names = names.Names(participant.settings.namespace)
        self._cluster = cluster
        self._epoch = epoch
        self._take = take
        self._refuse = refuse
        self._keys = keys
        self._configs = participant.node.create_publisher(
            msg.Sealed, self._names(names.STATE_CONFIG), qos.STATE_CONFIG_OUT
        )
        self._handoffs: dict[str, _Handoff] = {}
        self._askers: OrderedDict[tuple[str, int], _Asker] = OrderedDict()
        self._questions_left = float(_QUESTIONS)
        self._questions_at = clocks.boot_time()
        participant.node.create_subscription(
            msg.Sealed, self._names.stranded_sources,
            participant.counted(self._take_question), qos.HANDOFF, raw=True,
        )  # fmt: skip

    def publish(self, command: PublishStateConfig) -> None:
        """Publish a handoff's phase; subscribe to its channel from the first phase to DONE."""
        channel = self._names.of_handoff(command.process, command.destination)
        handoff = self._handoffs.get(channel)
        if handoff is None:
            handoff = self._handoffs[channel] = self._join(channel, command)
        config = serialize_message(
            msg.StateConfig(
                protocol_version=PROTOCOL_VERSION, cluster=self._cluster, epoch=self._epoch,
                phase=int(command.phase), process=command.process, source=command.source,
                destination=command.destination, source_node=command.source_node,
                destination_node=command.destination_node, channel=channel,
                key=array("B", handoff.key), source_run=self._run_of(command, handoff),
            )
        )  # fmt: skip
        for receiver in handoff.receivers:
            self._configs.publish(receiver.seal(config))
        if command.phase is HandoffPhase.DONE:
            del self._handoffs[channel]
            self._participant.node.destroy_subscription(handoff.subscription)

    def _run_of(self, command: PublishStateConfig, handoff: _Handoff) -> int:
        """Return the number of the source's run; 0: it is not known."""
        asker = self._askers.get((command.process, command.source))
        return handoff.source_run or (0 if asker is None else asker.run)

    def _join(self, channel: str, command: PublishStateConfig) -> _Handoff:
        process, destination = command.process, command.destination
        key = None if self._keys is None else self._keys.of_handoff(process, destination)
        link = new_link(key, Direction.TO_PEER, Direction.TO_PEER)
        name = handoff_name(process, destination)
        reports = SealedTopic(link, name, msg.HandoffReport, channel)

        def take(data: bytes) -> None:
            report = reports.read(data)
            if report is not None and report.destination == destination:
                check_bounds(report)
                self._note_run(channel, report)
                self._take_report(process, report)

        subscription = reports.subscription(
            self._participant.node, qos.HANDOFF, self._participant.counted(take)
        )
        topic = self._names(names.STATE_CONFIG)
        both = (
            self._topic_of(process, one, msg.StateConfig, topic)
            for one in (command.source, destination)
        )
        receivers = [one for one in both if one is not None]
        return _Handoff(command.source, key or b"", receivers, subscription)

    def _topic_of(
        self, process: str, number: int, message_type: Any, topic: str
    ) -> SealedTopic | None:
        """Return a topic under the key of an instance; None: the instance has no key."""
        key = None if self._keys is None else self._keys.of_instance(process, number)
        if key is None and self._keys is not None:
            return None
        link = new_link(key, Direction.FROM_MASTER, Direction.TO_MASTER)
        return SealedTopic(link, instance_name(process, number), message_type, topic)

    def _note_run(self, channel: str, report: msg.HandoffReport) -> None:
        handoff = self._handoffs.get(channel)
        if handoff is not None and report.instance == handoff.source:
            handoff.source_run = report.run

    def _take_report(self, process: str, report: msg.HandoffReport) -> None:
        who = f"{process}#{report.instance} in a handoff"
        fault = version_refusal(report.protocol_version, who)
        if not fault and report.phase not in set(ReportPhase):
            fault = f"unknown phase {report.phase}"
        if fault:
            self._refuse("handoff", who, fault)
            return
        self._take(
            HandoffReported(
                process, report.destination, report.instance, ReportPhase(report.phase),
                report.sequence, report.message,
            )
        )  # fmt: skip

    def _take_question(self, data: bytes) -> None:
        """Pass on the question of a silent source, unless more come than sources can ask."""
        report = self._question_in(data)
        if report is None:
            return
        now = clocks.boot_time()
        new = (now - self._questions_at) * _QUESTIONS_PER_SECOND
        self._questions_left = min(float(_QUESTIONS), self._questions_left + new)
        self._questions_at = now
        silent = report.phase == ReportPhase.SILENT
        if silent and report.protocol_version == PROTOCOL_VERSION and self._questions_left >= 1.0:
            self._questions_left -= 1.0
            self._take(SourceStranded(report.instance, report.destination))

    def _question_in(self, data: bytes) -> Any:
        """Return the question of a silent source; None: it is not genuine."""
        envelope = decode(data)
        asker = None if envelope is None else named_instance(envelope.principal)
        if asker is None:
            return None
        known = self._askers.get(asker)
        topic = (
            known.topic
            if known is not None
            else self._topic_of(*asker, msg.HandoffReport, self._names.stranded_sources)
        )
        report = None if topic is None else topic.read(data)
        if topic is None or report is None or report.instance != asker[1]:
            return None
        self._askers[asker] = _Asker(topic, report.run)
        self._askers.move_to_end(asker)
        if len(self._askers) > _MOST_ASKERS:
            self._askers.popitem(last=False)
        return report
