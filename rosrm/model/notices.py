"""Notices: what event sinks pass on to other systems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from rosrm.model.codec import to_plain
from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow
from rosrm.model.values import EMPTY

#: Severity of a notice, by the names of ROS logs.
NoticeLevel = Literal["INFO", "WARN", "ERROR"]


@dataclass(frozen=True, slots=True)
class Notice:
    """An event of the cluster, or the beginning or end of an alert.

    Attributes:
        id: unique text; a notice that is sent again after a failure keeps it.
        wall_time: unix time of the event, or of the change of the alert, in seconds.
        kind: kind of the event, "alert_begins" or "alert_ends".
        message: one sentence.
        level: severity; "INFO" for the end of an alert.
        process: process that the notice is about; "": none.
        host: host that the notice is about; "": none.
        alert: name of the alert; "": the notice is an event.
        facts: particulars by name, in JSON types.
    """

    id: str
    wall_time: float
    kind: str
    message: str
    level: NoticeLevel = "INFO"
    process: str = ""
    host: str = ""
    alert: str = ""
    facts: Mapping[str, Any] = field(default_factory=lambda: EMPTY)

    def form(self) -> dict[str, Any]:
        """Return the notice as a JSON object, with the names of its attributes."""
        return dict(to_plain(self))


#: Kinds of events of a level other than "INFO".
_LEVELS: Final[Mapping[str, NoticeLevel]] = {
    **dict.fromkeys(
        (
            EventKind.FAILED, EventKind.OVERDUE, EventKind.GIVEN_UP, EventKind.FENCED,
            EventKind.APPLICATION_FAILED, EventKind.MODE_FAILED, EventKind.HOST_LOST,
            EventKind.JOURNAL_BEHIND, EventKind.MIGRATION_STUCK, EventKind.MIGRATION_FORGOTTEN,
        ),
        "ERROR",
    ),
    **dict.fromkeys(
        (
            EventKind.SET_ASIDE, EventKind.BACKOFF, EventKind.RUN_SKIPPED,
            EventKind.DEPENDANTS_LEFT, EventKind.SEPARATED, EventKind.PREEMPTED,
            EventKind.APPLICATION_RETURNS, EventKind.HOST_SUSPECT, EventKind.HOST_REFUSED,
            EventKind.READING_REFUSED, EventKind.OVER_LIMIT, EventKind.NOTHING_MOVES,
            EventKind.DEVICE_MISSING, EventKind.MIGRATION_STEP_FAILED, EventKind.MIGRATION_UNDONE,
            EventKind.STAYED, EventKind.TAKE_OVER, EventKind.DESTINATION_UNHEARD,
            EventKind.SOURCE_STRANDED, EventKind.STANDBY_LOST, EventKind.FAILED_OVER,
            EventKind.CHECKPOINT_FAILED, EventKind.RESTORE_FAILED, EventKind.IMAGE_LEFT,
            EventKind.PERIODIC_FAILED, EventKind.PLUGIN_FAILED, EventKind.STRATEGY_ABSENT,
            EventKind.PEER_REFUSED, EventKind.RELOAD_REFUSED, EventKind.JOURNAL_RECOVERED,
        ),
        "WARN",
    ),
}  # fmt: skip


def notice_of(event: EventRow) -> Notice:
    """Return the notice of an event."""
    return Notice(
        id=f"event-{event.sequence}-{event.wall_time:.6f}",
        wall_time=event.wall_time,
        kind=event.kind,
        message=event.message,
        level=_LEVELS.get(event.kind, "INFO"),
        process=event.process,
        host=event.host,
        facts=event.facts,
    )
