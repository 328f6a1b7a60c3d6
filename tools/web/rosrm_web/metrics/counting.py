"""Counters and histograms of events, since the start of the process that counts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

from prometheus_client import CollectorRegistry, Counter, Histogram

from rosrm.model.event_kinds import EventKind
from rosrm_web.metrics import table

if TYPE_CHECKING:
    from rosrm.model.rows import EventRow

#: Highest number of strategies with a label of their own.
MOST_STRATEGIES: Final = 32
#: Highest number of processes whose waits and starts are timed at the same time.
MOST_TIMED: Final = 10_000
#: Label of strategies and kinds of events that have none of their own.
OTHER: Final = "other"
_BUCKETS: Final = (0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0)
_BLACKOUT_BUCKETS: Final = (0.0, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
_KINDS: Final = frozenset(kind.value for kind in EventKind)
_OUTCOMES: Final = {EventKind.MIGRATED.value: "moved", EventKind.STAYED.value: "stayed"}


class Spans:
    """Times from an event of a process to a later one.

    Args:
        begins: kinds of the first event.
        ends: kinds of the last event.
        drops: kinds after which no end is awaited.
    """

    def __init__(
        self, begins: Iterable[EventKind], ends: Iterable[EventKind], drops: Iterable[EventKind]
    ) -> None:
        self._begins, self._ends, self._drops = set(begins), set(ends), set(drops)
        self._begun: dict[str, float] = {}

    def end(self, event: EventRow) -> float | None:
        """Return the seconds of a span that an event ends; None: it ends none."""
        if event.kind in self._begins and len(self._begun) < MOST_TIMED:
            self._begun[event.process] = event.wall_time
        elif event.kind in self._drops:
            self._begun.pop(event.process, None)
        elif event.kind in self._ends and event.process in self._begun:
            return max(0.0, event.wall_time - self._begun.pop(event.process))
        return None


class EventMetrics:
    """Counts events.

    Attributes:
        registry: has the metrics of `table.COUNTED`.
    """

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._events = self._counter(table.EVENTS)
        for kind in EventKind:  # a series that begins with 1 has no increase
            self._events.labels(kind.value)
        self._migrations = self._counter(table.MIGRATIONS)
        self._migration_time = self._histogram(table.MIGRATION_TIME)
        self._blackout = self._histogram(table.BLACKOUT, _BLACKOUT_BUCKETS)
        self._strategies: set[str] = set()
        gone = (EventKind.CANCELLED, EventKind.FAILED, EventKind.PRUNED)
        queued = (EventKind.SUBMITTED, EventKind.QUEUED)
        runs = (EventKind.RUNNING, EventKind.READY)
        self._spans = (
            (self._histogram(table.WAIT), Spans(queued, [EventKind.ASSIGNED], gone)),
            (self._histogram(table.START), Spans([EventKind.ASSIGNED], runs, (*gone, *queued))),
        )

    def _counter(self, metric: table.Metric) -> Counter:
        return Counter(metric.name, metric.meaning, metric.labels, registry=self.registry)

    def _histogram(self, metric: table.Metric, buckets: tuple[float, ...] = _BUCKETS) -> Histogram:
        return Histogram(
            metric.name, metric.meaning, metric.labels, registry=self.registry, buckets=buckets
        )

    def count(self, events: Iterable[EventRow]) -> None:
        """Count new events, in their order."""
        for event in events:
            self._events.labels(event.kind if event.kind in _KINDS else OTHER).inc()
            if event.kind in _OUTCOMES:
                self._count_migration(event)
            for histogram, spans in self._spans:
                seconds = spans.end(event)
                if seconds is not None:
                    histogram.observe(seconds)

    def _count_migration(self, event: EventRow) -> None:
        strategy = str(event.facts.get("strategy") or OTHER)
        if len(self._strategies) >= MOST_STRATEGIES and strategy not in self._strategies:
            strategy = OTHER
        self._strategies.add(strategy)
        outcome = _OUTCOMES[event.kind]
        self._migrations.labels(strategy, outcome).inc()
        if outcome != "moved":
            return
        for fact, histogram in (("seconds", self._migration_time), ("blackout", self._blackout)):
            seconds = event.facts.get(fact)
            if isinstance(seconds, (int, float)):
                histogram.labels(strategy).observe(seconds)
