"""Beginning and end of alerts. Pure: times are arguments.

=========  ==================================================  =============================
state      observation                                         consequence
=========  ==================================================  =============================
absent     the condition holds                                 pending
pending    the condition does not hold                         absent
pending    the condition has held for `lasts`                  active; the alert begins
active     the condition does not hold                         absent; the alert ends
any        the condition is unknown, as while the master       unchanged
           does not answer, or without a fresh reading
=========  ==================================================  =============================

Each alert has these states for each host or process that its condition is about. A host or process
that is no longer listed is gone, so its alerts end.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from math import inf
from typing import Literal

from rosrm.wording import counted, duration
from rosrm_alerts.conditions import (
    Above,
    Alert,
    Condition,
    Happens,
    HostLost,
    InState,
    NoAnswer,
    SeenEvent,
    Situation,
)


@dataclass(frozen=True, slots=True, order=True)
class Subject:
    """The host or process that an alert is about; neither: the cluster."""

    host: str = ""
    process: str = ""

    def __str__(self) -> str:
        return self.process or self.host or "the cluster"


@dataclass(frozen=True, slots=True)
class Change:
    """An alert begins or ends.

    Attributes:
        time: time of the observation, in seconds.
        message: one sentence.
    """

    alert: Alert
    subject: Subject
    kind: Literal["begins", "ends"]
    time: float
    message: str


#: Name of an alert and the subject of one of its states.
Key = tuple[str, Subject]


class Watch:
    """The states of all alerts.

    Args:
        alerts: with unique names.
        active: alerts that are active already, with the time at which each began.
    """

    def __init__(self, alerts: Sequence[Alert], active: Mapping[Key, float] | None = None) -> None:
        self._alerts = alerts
        self._since: dict[Key, float] = {}
        names = {alert.name for alert in alerts}
        self._active = {key: at for key, at in (active or {}).items() if key[0] in names}
        self._since.update(self._active)
        self._times: dict[Key, deque[float]] = {}
        self._observed = -inf

    @property
    def active(self) -> Mapping[Key, float]:
        """Return the active alerts, with the time at which each began."""
        return dict(self._active)

    def next_change(self) -> float:
        """Return the earliest time at which an alert changes in an unchanged situation.

        An alert that is due but has not begun waits until its condition is known.
        """
        lasts = {alert.name: alert.lasts for alert in self._alerts}
        pending = (at + lasts[key[0]] for key, at in self._since.items() if key not in self._active)
        within = {
            alert.name: alert.condition.within
            for alert in self._alerts if isinstance(alert.condition, Happens)
        }  # fmt: skip
        expiring = (times[0] + within[key[0]] for key, times in self._times.items() if times)
        return min((at for at in (*pending, *expiring) if at > self._observed), default=inf)

    def observe(
        self, now: float, situation: Situation | None, events: Iterable[SeenEvent] = ()
    ) -> list[Change]:
        """Return the changes of alerts, in the order of the alerts.

        Args:
            now: time in seconds; never before that of an earlier call.
            situation: None: the master does not answer.
            events: events since the last call, the oldest first.
        """
        happened, self._observed = list(events), now
        return [
            change
            for alert in self._alerts
            for change in (
                self._counted(alert, alert.condition, now, situation, happened)
                if isinstance(alert.condition, Happens)
                else self._compared(alert, now, situation)
            )
        ]

    def _compared(self, alert: Alert, now: float, situation: Situation | None) -> Iterator[Change]:
        """Yield the changes of an alert whose condition is a state of the cluster."""
        holds = _holding(alert, situation)
        for key in [key for key in self._since if key[0] == alert.name and key[1] not in holds]:
            if _is_unknown(alert.condition, key[1], situation):
                continue
            del self._since[key]
            if self._active.pop(key, None) is not None:
                yield Change(alert, key[1], "ends", now, f"{_end(alert, key[1])}")
        for subject, text in holds.items():
            key = (alert.name, subject)
            since = self._since.setdefault(key, now)
            if key not in self._active and now - since >= alert.lasts:
                self._active[key] = now
                after = f" for {duration(alert.lasts)}" if alert.lasts else ""
                yield Change(alert, subject, "begins", now, f"{text}{after}")

    def _counted(
        self, alert: Alert, condition: Happens, now: float, situation: Situation | None,
        events: Sequence[SeenEvent],
    ) -> Iterator[Change]:  # fmt: skip
        """Yield the changes of an alert whose condition is a number of events."""
        for event in events:
            if not _matches(condition, event, situation):
                continue
            subject = Subject(process=event.process) if event.process else Subject(event.host)
            text = event.message or f"{event.kind} of {subject}"
            if condition.count == 1:
                yield Change(alert, subject, "begins", now, text)
                continue
            key = (alert.name, subject)
            times = self._times.setdefault(key, deque())
            times.append(now)
            self._drop_old(times, now, condition)
            if len(times) >= condition.count and key not in self._active:
                self._active[key] = now
                many = f"{counted(len(times), 'event')} within {duration(condition.within)}"
                yield Change(alert, subject, "begins", now, f"{many}, the last: {text}")
        for key in [key for key in self._active if key[0] == alert.name]:
            times = self._times.get(key, deque())
            self._drop_old(times, now, condition)
            if len(times) < condition.count:
                del self._active[key]
                yield Change(alert, key[1], "ends", now, _end(alert, key[1]))
        self._times = {key: times for key, times in self._times.items() if times}

    @staticmethod
    def _drop_old(times: deque[float], now: float, condition: Happens) -> None:
        while times and times[0] <= now - condition.within:
            times.popleft()


def _end(alert: Alert, subject: Subject) -> str:
    return f"the alert {alert.name} on {subject} has ended"


def _matches(condition: Happens, event: SeenEvent, situation: Situation | None) -> bool:
    if event.kind not in condition.kinds:
        return False
    process = situation.processes.get(event.process) if situation is not None else None
    application = process.application if process is not None else ""
    named = (
        (event.process, condition.process),
        (event.host, condition.host),
        (application, condition.application),
    )
    return all(fnmatchcase(name, pattern) for name, pattern in named)


def _holding(alert: Alert, situation: Situation | None) -> dict[Subject, str]:
    """Return the subjects for which a condition holds now, each with a sentence."""
    condition = alert.condition
    if isinstance(condition, NoAnswer):
        return {Subject(): "the master does not answer"} if situation is None else {}
    if situation is None:
        return {}
    if isinstance(condition, HostLost):
        return {
            Subject(host=name): f"the host {name} is lost"
            for name, host in situation.hosts.items()
            if host.state == "lost" and fnmatchcase(name, condition.host)
        }
    if isinstance(condition, Above):
        return dict(_above(condition, situation))
    if isinstance(condition, InState):
        return {
            Subject(process=name): f"{name} is {seen.state}"
            + (f" ({seen.reason})" if seen.reason else "")
            for name, seen in situation.processes.items()
            if seen.state in condition.states
            and fnmatchcase(name, condition.process)
            and fnmatchcase(seen.application, condition.application)
        }
    return {}


def _is_unknown(condition: Condition, subject: Subject, situation: Situation | None) -> bool:
    """Return True if a condition is unknown for a host or process."""
    if isinstance(condition, NoAnswer):
        return False
    if situation is None:
        return True
    host, process = situation.hosts.get(subject.host), situation.processes.get(subject.process)
    if isinstance(condition, Above):
        return host is not None and condition.resource not in host.resources
    if isinstance(condition, HostLost):
        return host is not None and host.state == "expected"
    return process is not None and process.state == "unknown"


def _above(condition: Above, situation: Situation) -> Iterator[tuple[Subject, str]]:
    for name, host in situation.hosts.items():
        seen = host.resources.get(condition.resource)
        if seen is None or not fnmatchcase(name, condition.host):
            continue
        limit = seen.limit if condition.limit is None else condition.limit
        if seen.usage > limit:
            text = f"{condition.resource} of {name} is at {seen.usage:.0%}, above {limit:.0%}"
            yield Subject(host=name), text
