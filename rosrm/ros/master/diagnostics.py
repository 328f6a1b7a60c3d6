"""Publisher of `/diagnostics`, the topic of diagnostic statuses in ROS."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import NamedTuple

from rosrm.model.diagnostics import Diagnostic
from rosrm.ros import names, qos
from rosrm.ros.participant import Participant
from rosrm.wording import sanitized, sendable

_log = logging.getLogger("rosrm.master")


class DiagnosticsTopic(NamedTuple):
    """Functions that publish statuses, and that return True if another node reads the topic."""

    publish: Callable[[Sequence[Diagnostic]], None]
    has_reader: Callable[[], bool]


def open_diagnostics(participant: Participant) -> DiagnosticsTopic | None:
    """Return the topic of the statuses; None: this ROS installation has no messages."""
    try:
        from diagnostic_msgs.msg import (  # noqa: PLC0415 - not in every ROS installation
            DiagnosticArray,
            DiagnosticStatus,
            KeyValue,
        )
    except ImportError as fault:
        _log.warning(
            "%s is not published: %s. Install the ROS package diagnostic_msgs, or set "
            "`diagnostics: false`", names.DIAGNOSTICS, fault,
        )  # fmt: skip
        return None
    node = participant.node
    publisher = node.create_publisher(DiagnosticArray, names.DIAGNOSTICS, qos.DIAGNOSTICS)

    def status_of(one: Diagnostic) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=bytes([one.level]), name=f"rosrm: {' '.join(one.subject)}",
            message=_text(one.message), hardware_id=one.host,
            values=[KeyValue(key=key, value=_text(text)) for key, text in one.values.items()],
        )  # fmt: skip

    def send(statuses: Sequence[Diagnostic]) -> None:
        message = DiagnosticArray(status=[status_of(one) for one in statuses])
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)

    def publish(statuses: Sequence[Diagnostic]) -> None:
        participant.guard.call(send, statuses)

    return DiagnosticsTopic(publish, lambda: publisher.get_subscription_count() > 0)


def _text(text: str) -> str:
    return sendable(sanitized(text))
