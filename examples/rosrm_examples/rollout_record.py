"""Instances of an application over time, from the events of a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Final

from rosrm import EventRow

#: Step of a plan from which on the destination owns the name, as events call it.
_COMMIT: Final = "the commit"
#: Kinds of events that end the owner of a name.
_ENDS: Final = ("backoff", "queued", "failed", "finished", "cancelled")


@dataclass
class Span:
    """The time of one instance, seconds by the master's clock.

    Attributes:
        version: of the application.
        begin: the master ordered its start.
        active: it owned the name of its process from then on; infinite: never.
        checked: the check of its health began; infinite: it was not checked.
        successor: another instance owned the name from then on; infinite: none.
        end: it had ended; infinite: it still runs.
        failed: it ended with an error.
    """

    process: str
    version: int
    begin: float
    active: float = inf
    checked: float = inf
    successor: float = inf
    end: float = inf
    failed: bool = False


@dataclass(frozen=True)
class Request:
    """A version that became the desired one.

    Attributes:
        at: seconds by the master's clock.
        returned: the master chose it, because the one before failed.
    """

    at: float
    version: int
    returned: bool


@dataclass
class Rollout:
    """The versions and the instances of one application.

    Attributes:
        requests: in order of time.
        spans: by number of the instance, in order of their starts.
        end: time of the last event.
    """

    requests: list[Request] = field(default_factory=list)
    spans: dict[int, Span] = field(default_factory=dict)
    end: float = 0.0

    def of(self, process: str) -> list[Span]:
        """Return the instances of a process, in order of their starts."""
        return [span for span in self.spans.values() if span.process == process]

    def version_at(self, time: float) -> int:
        """Return the version of the instance that owned a name last before a time; 0: none."""
        versions = [span.version for span in self.spans.values() if span.active <= time]
        return versions[-1] if versions else 0

    def healthy_until(self, span: Span, healthy_for: float) -> float:
        """Return the end of the check of an instance's health."""
        return min(span.checked + healthy_for, span.end)


def rollout_of(events: Sequence[EventRow], processes: Sequence[str]) -> Rollout:
    """Return the rollout of an application with these processes."""
    made = _Reader(processes)
    for event in events:
        made.read(event)
    return made.rollout


class _Reader:
    """Reader of events in their order."""

    def __init__(self, processes: Sequence[str]) -> None:
        self.rollout = Rollout()
        self._processes = processes
        self._owner: dict[str, int] = {}
        self._coming: dict[str, int] = {}
        self._reached = 0  # version that the application was at last

    def read(self, event: EventRow) -> None:
        self.rollout.end = event.elapsed
        if event.kind.startswith("application_"):
            self._read_version(event)
        elif event.process in self._processes:
            self._read_process(event)

    def _read_version(self, event: EventRow) -> None:
        version, requests = int(event.facts["version"]), self.rollout.requests
        if event.kind == "application_requested":
            requests.append(Request(event.elapsed, version, returned=False))
        elif event.kind == "application_returns":
            requests.append(Request(event.elapsed, self._reached, returned=True))
        elif event.kind == "application_applied":
            self._reached = version

    def _read_process(self, event: EventRow) -> None:
        name, at = event.process, event.elapsed
        owner = self.rollout.spans.get(self._owner.get(name, 0))
        if event.kind == "assigned":
            self._begin(event, int(event.facts["number"])).active = at
            self._owner[name] = int(event.facts["number"])
        elif event.kind == "migration_begun":
            self._coming[name] = int(event.facts["destination"])
            self._begin(event, self._coming[name])
        elif event.kind == "migration_step" and event.facts["step"] == _COMMIT and owner:
            owner.successor = at
            self._owner[name] = self._coming[name]
            self.rollout.spans[self._owner[name]].active = at
        elif event.kind in ("migrated", "ready", "running") and owner and self._reached:
            owner.checked = min(owner.checked, at)
        elif event.kind == "instance_ended":
            for span in self._others(name):
                span.end = min(span.end, at)
        elif event.kind in _ENDS and owner:
            owner.end = min(owner.end, at)
            owner.failed |= event.kind in ("backoff", "failed")

    def _begin(self, event: EventRow, number: int) -> Span:
        version = self.rollout.requests[-1].version
        self.rollout.spans[number] = Span(event.process, version, event.elapsed)
        return self.rollout.spans[number]

    def _others(self, name: str) -> Iterator[Span]:
        """Yield the instances of a process but its owner."""
        for number, span in self.rollout.spans.items():
            if span.process == name and number != self._owner.get(name):
                yield span
