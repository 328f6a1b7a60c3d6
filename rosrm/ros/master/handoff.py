"""Handoffs in the master's endpoint: `state_config`, and the nodes' reports about it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

from rosrm.core.master.commands import PublishStateConfig
from rosrm.core.master.events import Event, HandoffReported, SourceStranded
from rosrm.model.plan import HandoffPhase, ReportPhase
from rosrm.ros import names, qos
from rosrm.ros.control import version_refusal
from rosrm.ros.master.refusals import Refuse
from rosrm.ros.participant import Participant
from rosrm.version import PROTOCOL_VERSION
from rosrm_msgs import msg

#: Most questions of silent sources that are answered at once, and a second. Each asks again.
_QUESTIONS: Final = 20
_QUESTIONS_PER_SECOND: Final = 5.0


class HandoffEndpoint:
    """Sends messages to the nodes of a handoff, and receives theirs until it is done.

    Args:
        cluster: the master's name.
        take: called with each event.
        refuse: called with the kind of message, its refused sender and the reason.
    """

    def __init__(
        self, participant: Participant, cluster: str, epoch: int, take: Callable[[Event], None],
        refuse: Refuse,
    ) -> None:  # fmt: skip
        self._participant = participant
        self._names = names.Names(participant.settings.namespace)
        self._cluster = cluster
        self._epoch = epoch
        self._take = take
        self._refuse = refuse
        self._configs = participant.node.create_publisher(
            msg.StateConfig, self._names(names.STATE_CONFIG), qos.STATE_CONFIG
        )
        self._channels: dict[str, Any] = {}
        self._questions_left = float(_QUESTIONS)
        self._questions_at = time.monotonic()
        participant.node.create_subscription(
            msg.HandoffReport, self._names.stranded_sources,
            participant.counted(self._take_question), qos.HANDOFF,
        )  # fmt: skip

    def publish(self, command: PublishStateConfig) -> None:
        """Publish a handoff's phase; subscribe to its channel from the first phase to DONE."""
        channel = self._names.of_handoff(command.process, command.destination)
        if command.phase is HandoffPhase.DONE:
            self._leave(channel)
        elif channel not in self._channels:
            self._join(channel, command.process, command.destination)
        self._configs.publish(
            msg.StateConfig(
                protocol_version=PROTOCOL_VERSION, cluster=self._cluster, epoch=self._epoch,
                phase=int(command.phase), process=command.process, source=command.source,
                destination=command.destination, source_node=command.source_node,
                destination_node=command.destination_node, channel=channel,
            )
        )  # fmt: skip

    def _join(self, channel: str, process: str, destination: int) -> None:
        def take(report: msg.HandoffReport) -> None:
            if report.destination == destination:
                self._take_report(process, report)

        self._channels[channel] = self._participant.node.create_subscription(
            msg.HandoffReport, channel, self._participant.counted(take), qos.HANDOFF
        )

    def _leave(self, channel: str) -> None:
        subscription = self._channels.pop(channel, None)
        if subscription is not None:
            self._participant.node.destroy_subscription(subscription)

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

    def _take_question(self, report: msg.HandoffReport) -> None:
        """Pass on the question of a silent source, unless more come than sources can ask."""
        now = time.monotonic()
        new = (now - self._questions_at) * _QUESTIONS_PER_SECOND
        self._questions_left = min(float(_QUESTIONS), self._questions_left + new)
        self._questions_at = now
        silent = report.phase == ReportPhase.SILENT
        if silent and report.protocol_version == PROTOCOL_VERSION and self._questions_left >= 1.0:
            self._questions_left -= 1.0
            self._take(SourceStranded(report.instance, report.destination))
