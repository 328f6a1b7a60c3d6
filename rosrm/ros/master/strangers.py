"""Messages without a valid key: counted by topic, recorded at a bounded rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from rosrm import clocks
from rosrm.ros.master.refusals import Refuse
from rosrm.wording import counted, duration

#: Seconds between two records of messages on the same topic or service.
_RECORD_PERIOD: Final = 600.0
#: Seconds for which `rosrm status` shows them.
_SHOWN: Final = 3600.0


@dataclass(slots=True)
class _Count:
    total: int = 0
    unrecorded: int = 0
    last: float = 0.0
    recorded_at: float = -_RECORD_PERIOD


class Strangers:
    """Counts of messages of strangers, by the master's own topics and services, and by host.

    Args:
        refuse: called for each record.
    """

    def __init__(self, refuse: Refuse) -> None:
        self._refuse = refuse
        self._counts: dict[str, _Count] = {}

    def note(self, topic: str, number: int = 1) -> None:
        """Count messages on a topic or service, or on all topics of a host."""
        now = clocks.boot_time()
        count = self._counts.setdefault(topic, _Count())
        count.total += number
        count.unrecorded += number
        count.last = now
        if now - count.recorded_at >= _RECORD_PERIOD:
            messages = counted(count.unrecorded, "message", "messages")
            count.unrecorded, count.recorded_at = 0, now
            self._refuse(
                "stranger", f"a sender on {topic}",
                f"{messages} without a valid key on {topic}; nothing was done",
            )  # fmt: skip

    @property
    def total(self) -> int:
        """Return the number of all messages."""
        return sum(count.total for count in self._counts.values())

    def sentence(self) -> str:
        """Return a sentence about the messages of the last hour; "": there was none."""
        now = clocks.boot_time()
        shown = {name: one for name, one in self._counts.items() if now - one.last < _SHOWN}
        if not shown:
            return ""
        topic = max(shown, key=lambda name: shown[name].last)
        total = sum(one.total for one in shown.values())
        return (
            f"{counted(total, 'message', 'messages')} without a valid key refused, the last "
            f"{duration(now - shown[topic].last)} ago on {topic}"
        )
