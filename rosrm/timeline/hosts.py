"""Times in which hosts were gone, or over a limit, from the events."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow
from rosrm.timeline.values import HostSpan

_GONE: Final = {
    EventKind.HOST_LOST: "lost", EventKind.HOST_LEFT: "left", EventKind.HOST_DETACHED: "detached",
}  # fmt: skip
_BACK: Final = frozenset({EventKind.HOST_BACK, EventKind.HOST_REGISTERED})


class HostTimes:
    """Times of all hosts; events come in order."""

    def __init__(self) -> None:
        self._gone: list[HostSpan] = []
        self._gone_since: dict[str, tuple[float, str]] = {}
        self._over: list[HostSpan] = []
        self._over_since: dict[str, dict[str, float]] = {}

    def take(self, time: float, event: EventRow) -> None:
        """Read the next event."""
        kind, host = event.kind, event.host
        if kind in _GONE:
            self._gone_since.setdefault(host, (time, _GONE[EventKind(kind)]))
        elif kind in _BACK and host in self._gone_since:
            begin, what = self._gone_since.pop(host)
            self._gone.append(HostSpan(host, what, begin, time))
        if kind == EventKind.OVER_LIMIT:
            resource = str(event.facts.get("resource", ""))
            self._over_since.setdefault(host, {}).setdefault(resource, time)
        elif kind == EventKind.UNDER_LIMIT or kind in _GONE:
            self._over += self._ending(host, self._over_since.pop(host, {}), time)

    def gone(self, end: float) -> tuple[HostSpan, ...]:
        """Return the times in which hosts were lost, left or detached; `end`: of the newest."""
        since = self._gone_since.items()
        return (*self._gone, *(HostSpan(host, what, at, end) for host, (at, what) in since))

    def over_limit(self, end: float) -> tuple[HostSpan, ...]:
        """Return the times in which hosts were over a limit; `end`: of the newest."""
        since = self._over_since.items()
        return (*self._over, *(one for host, at in since for one in self._ending(host, at, end)))

    @staticmethod
    def _ending(host: str, since: dict[str, float], time: float) -> Iterator[HostSpan]:
        """Yield the times over limits of a host, as far as they begin before their end."""
        return (HostSpan(host, resource, begin, time) for resource, begin in since.items())
