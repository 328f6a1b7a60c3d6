"""Values of metrics in a listing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Final, get_args

from rosrm.model.applications import ApplicationState
from rosrm.model.rows import HOST_STATES, PROCESS_STATES
from rosrm_web.metrics import table

if TYPE_CHECKING:
    from rosrm.model.rows import HostRow, Listing, ProcessRow
    from rosrm_web.metrics.table import Metric

#: Metric, values of its labels, value.
Sample = tuple["Metric", tuple[str, ...], float]

#: Highest number of processes with metrics of their own.
MOST_PROCESSES: Final = 2000
_OF_LOAD: Final = {
    "turn_s": table.TURN, "write_s": table.WRITE, "cpu_s": table.MASTER_CPU,
    "oldest_reading_s": table.OLDEST, "missed": table.MISSED, "decide_s": table.DECISION,
    "decisions": table.DECISIONS, "deciding_s": table.DECIDING, "dropped": table.DROPPED,
    "strangers": table.STRANGERS,
}  # fmt: skip
_ENDED: Final = frozenset({"finished", "failed", "cancelled"})


def samples(listing: Listing, seconds: float) -> Iterator[Sample]:
    """Return the values of a listing with hosts, processes, applications and failing plugins.

    Args:
        listing: from the master.
        seconds: in which the master answered.
    """
    yield table.UPTIME, (), listing.uptime
    yield table.ANSWER, (), seconds
    yield table.TROUBLE, (), float(bool(listing.trouble))
    yield table.SEQUENCE, (), float(listing.last_sequence)
    yield table.PLUGINS, (), float(len(listing.plugins))
    # States in which nothing is have a value, too, so that their series have no gaps.
    yield from _counts(table.HOSTS, HOST_STATES, (row.state for row in listing.hosts))
    yield from _counts(table.PROCESSES, PROCESS_STATES, (row.state for row in listing.processes))
    states = (row.state for row in listing.applications)
    yield from _counts(table.APPLICATIONS, get_args(ApplicationState), states)
    for host in listing.hosts:
        yield from _of_host(host)
    yield from _of_queue(listing.processes)
    yield from _of_processes(listing.processes)


def of_load(load: Mapping[str, float]) -> Iterator[Sample]:
    """Return the values of `Client.master_load`; none of them until its first message."""
    for name, metric in _OF_LOAD.items():
        if name in load:
            yield metric, (), float(load[name])


def _counts(metric: Metric, known: Iterable[str], states: Iterable[str]) -> Iterator[Sample]:
    counts = Counter(dict.fromkeys(known, 0))
    counts.update(states)
    for state, number in counts.items():
        yield metric, (state,), float(number)


def _of_host(row: HostRow) -> Iterator[Sample]:
    name = row.description.name
    yield table.HOST_UP, (name,), float(row.state == "up")
    yield table.HOST_CORDONED, (name,), float(row.cordoned or row.draining)
    yield table.HOST_AGE, (name,), row.reading_age
    yield table.HOST_PROCESSES, (name,), float(row.processes)
    for resource in row.resources:
        labels = (name, resource.name)
        if not resource.stale:
            yield table.USAGE, labels, resource.usage
        yield table.IN_FLIGHT, labels, resource.in_flight
        yield table.LIMIT, labels, resource.limit
        yield table.CAPACITY, labels, resource.capacity


def _of_queue(rows: Iterable[ProcessRow]) -> Iterator[Sample]:
    waiting = [row.since for row in rows if row.queue_position]
    yield table.QUEUE, (), float(len(waiting))
    yield table.QUEUE_AGE, (), max(waiting, default=0.0)


def _of_processes(rows: Iterable[ProcessRow]) -> Iterator[Sample]:
    live = sorted((row for row in rows if row.state not in _ENDED), key=lambda row: row.name)
    for row in live[:MOST_PROCESSES]:
        labels = (row.name, row.host)
        yield table.RESTARTS, labels, float(row.restarts)
        if row.pid and not row.stale:
            yield table.CPU, labels, row.cpu
            yield table.MEMORY, labels, float(row.memory)
    yield table.LEFT_OUT, (), float(max(0, len(live) - MOST_PROCESSES))
