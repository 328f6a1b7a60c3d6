"""Extraction of a report from the events and readings of a run. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from rosrm.model.event_kinds import EventKind
from rosrm.model.notices import notice_of
from rosrm.model.rows import EventRow
from rosrm.wording import counted, sanitized
from rosrm_report.histories import Histories, histories_of, whole
from rosrm_report.model import (
    CloseDecision,
    Failure,
    Fault,
    HostFigures,
    HostSpan,
    Material,
    Readings,
    Report,
)

#: Largest difference between two nearly equal scores, as a fraction of the larger one.
_CLOSE: Final = 0.1
#: Unix time after which no event can be, in the year 9999.
_LATEST: Final = 2.5e11
_FAILS: Final = frozenset({EventKind.FAILED, EventKind.BACKOFF})
_GONE: Final = {
    EventKind.HOST_LOST: "lost", EventKind.HOST_LEFT: "left", EventKind.HOST_DETACHED: "detached",
}  # fmt: skip
_BACK: Final = frozenset({EventKind.HOST_BACK, EventKind.HOST_REGISTERED})

Timed = Sequence[tuple[float, EventRow]]


def report_of(material: Material, title: str = "") -> Report:
    """Return the report of a run; the failures have no log lines yet."""
    kept = [one for one in material.events if _is_timed(one)]
    timed = timed_events(kept)
    readings = material.readings
    ends = [time for time, _ in timed[-1:]]
    end = max([*ends, *readings.times[-1:]] if readings else ends, default=0.0)
    histories = histories_of(timed, end)
    failures = tuple(_failures(timed))
    over = _over_limit(timed, end)
    return Report(
        title=title or f"Run of {material.name}",
        source=material.name,
        began=kept[0].wall_time if kept else 0.0,
        length=end,
        notes=(*material.notes, *_gaps(kept, material)),
        outcomes=histories.outcomes,
        hosts=tuple(_host_figures(timed, histories, failures, over, readings)),
        placements=tuple(histories.placements),
        moves=tuple(histories.moves),
        waits=tuple(histories.waits),
        starts=tuple(histories.starts),
        close_decisions=tuple(_close_decisions(timed)),
        failures=failures,
        faults=tuple(_faults(timed)),
        gone=_gone(timed, end),
        over_limit=over,
        queue=tuple(histories.queue),
        readings=readings,
        events=len(timed),
    )  # fmt: skip


def timed_events(events: Sequence[EventRow]) -> Timed:
    """Return events with their seconds since the first one.

    Within a run of a master its monotonic clock counts, and unix time between two runs.
    """
    timed: list[tuple[float, EventRow]] = []
    offset, before = 0.0, None
    for event in events:
        if before is None:
            offset = -event.elapsed
        elif event.kind == EventKind.MASTER_STARTED or event.elapsed < before.elapsed:
            pause = max(0.0, event.wall_time - before.wall_time)
            offset = timed[-1][0] + pause - event.elapsed
        timed.append((event.elapsed + offset, event))
        before = event
    return timed


def _is_timed(event: EventRow) -> bool:
    """Return True if the times of an event are possible; those of a damaged one may not be."""
    return 0.0 <= event.wall_time < _LATEST and 0.0 <= event.elapsed < _LATEST


def _gaps(events: Sequence[EventRow], material: Material) -> Iterable[str]:
    """Return sentences on missing parts of a run."""
    damaged = len(material.events) - len(events)
    if damaged:
        yield f"{counted(damaged, 'event')} with impossible times left out."
    if not events:
        yield "No events: nothing is known about this run."
    elif events[0].sequence > 1:
        yield (
            f"The journal no longer has the first {counted(events[0].sequence - 1, 'event')}: "
            f"the report begins after those."
        )
    if material.readings is None:
        yield "The source has no readings, so the usage of the hosts is not shown."


# --- failures and faults ----------------------------------------------------------------------


def _failures(timed: Timed) -> Iterable[Failure]:
    numbers: dict[str, int] = {}
    for time, event in timed:
        if event.process and "number" in event.facts:
            numbers[event.process] = whole(event, "number")
        elif event.kind == EventKind.MIGRATION_BEGUN:
            numbers[event.process] = whole(event, "destination")
        if event.kind in _FAILS:
            number = numbers.get(event.process, 0)
            restarts = event.kind == EventKind.BACKOFF
            message = sanitized(event.message, lines=True)
            yield Failure(time, event.process, event.host, number, message, restarts)


def _faults(timed: Timed) -> Iterable[Fault]:
    started = 0
    for time, event in timed:
        level = notice_of(event).level
        if event.kind == EventKind.MASTER_STARTED:
            started += 1
            level = "WARN" if started > 1 else "INFO"
        if level != "INFO" and event.kind not in _FAILS:
            message = sanitized(event.message, lines=True)
            yield Fault(time, level, event.kind, event.host, event.process, message)


def _gone(timed: Timed, end: float) -> tuple[HostSpan, ...]:
    since: dict[str, tuple[float, str]] = {}
    spans = []
    for time, event in timed:
        if event.kind in _GONE:
            since.setdefault(event.host, (time, _GONE[EventKind(event.kind)]))
        elif event.kind in _BACK and event.host in since:
            begin, what = since.pop(event.host)
            spans.append(HostSpan(event.host, what, begin, time))
    spans += [HostSpan(host, what, begin, end) for host, (begin, what) in since.items()]
    return tuple(spans)


def _over_limit(timed: Timed, end: float) -> tuple[HostSpan, ...]:
    since: dict[str, dict[str, float]] = {}
    spans = []
    for time, event in timed:
        if event.kind == EventKind.OVER_LIMIT:
            resource = str(event.facts.get("resource", ""))
            since.setdefault(event.host, {}).setdefault(resource, time)
        elif event.kind == EventKind.UNDER_LIMIT or event.kind in _GONE:
            for resource, begin in since.pop(event.host, {}).items():
                spans.append(HostSpan(event.host, resource, begin, time))
    for host, resources in since.items():
        spans += [HostSpan(host, resource, begin, end) for resource, begin in resources.items()]
    return tuple(spans)


# --- decisions and hosts ----------------------------------------------------------------------


def _close_decisions(timed: Timed) -> Iterable[CloseDecision]:
    for time, event in timed:
        scores = _scores(event) if event.kind == EventKind.ASSIGNED else {}
        chosen = scores.pop(event.host, None)
        if chosen is None or not scores:
            continue
        name, score = min(scores.items(), key=lambda one: one[1])
        if abs(score - chosen) <= _CLOSE * max(abs(score), abs(chosen)):
            yield CloseDecision(time, event.process, event.host, chosen, name, score)


def _scores(event: EventRow) -> dict[str, float]:
    """Return the score of each host that could take the process."""
    decision = event.facts.get("decision")
    hosts = decision.get("hosts") if isinstance(decision, Mapping) else None
    named = [one for one in hosts if isinstance(one, Mapping)] if isinstance(hosts, list) else []
    return {
        str(one.get("name")): float(one["score"])
        for one in named
        if isinstance(one.get("score"), float | int)
    }


def _host_figures(
    timed: Timed, histories: Histories, failures: Sequence[Failure], over: Sequence[HostSpan],
    readings: Readings | None,
) -> Iterable[HostFigures]:  # fmt: skip
    assigned = Counter(event.host for _, event in timed if event.kind == EventKind.ASSIGNED)
    moved = [move for move in histories.moves if move.done and not move.within]
    away, to = Counter(one.source for one in moved), Counter(one.destination for one in moved)
    failed = Counter(one.host for one in failures)
    usage = readings.usage if readings is not None else {}
    for host in sorted({event.host for _, event in timed} - {""}):
        seconds = sum(one.end - one.begin for one in over if one.host == host)
        peaks = {
            resource: max((v for v in hosts.get(host, ()) if v is not None), default=0.0)
            for resource, hosts in usage.items()
        }
        yield HostFigures(host, assigned[host], away[host], to[host], failed[host], seconds, peaks)
