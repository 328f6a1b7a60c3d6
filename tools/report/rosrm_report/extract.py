"""Extraction of a report from the events and readings of a run. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from rosrm.model.event_kinds import EventKind
from rosrm.model.notices import notice_of
from rosrm.model.rows import EventRow
from rosrm.timeline.processes import Histories
from rosrm.timeline.reading import FAILS, Timeline
from rosrm.timeline.values import Failure, HostSpan
from rosrm.wording import counted, sanitized
from rosrm_report.model import CloseDecision, Fault, HostFigures, Material, Readings, Report

#: Largest difference between two nearly equal scores, as a fraction of the larger one.
_CLOSE: Final = 0.1
#: Unix time after which no event can be, in the year 9999.
_LATEST: Final = 2.5e11

Timed = Sequence[tuple[float, EventRow]]


def report_of(material: Material, title: str = "") -> Report:
    """Return the report of a run; the failures have no log lines yet."""
    kept = [one for one in material.events if _is_timed(one)]
    timeline = Timeline()
    timed = [(timeline.take(event), event) for event in kept]
    readings = material.readings
    ends = [time for time, _ in timed[-1:]]
    end = max([*ends, *readings.times[-1:]] if readings else ends, default=0.0)
    histories = timeline.processes.histories(end)
    failures = tuple(timeline.failures)
    over = timeline.hosts.over_limit(end)
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
        gone=timeline.hosts.gone(end),
        over_limit=over,
        queue=tuple(histories.queue),
        readings=readings,
        events=len(timed),
    )  # fmt: skip


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


# --- faults ----------------------------------------------------------------------


def _faults(timed: Timed) -> Iterable[Fault]:
    started = 0
    for time, event in timed:
        level = notice_of(event).level
        if event.kind == EventKind.MASTER_STARTED:
            started += 1
            level = "WARN" if started > 1 else "INFO"
        if level != "INFO" and event.kind not in FAILS:
            message = sanitized(event.message, lines=True)
            yield Fault(time, level, event.kind, event.host, event.process, message)


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
