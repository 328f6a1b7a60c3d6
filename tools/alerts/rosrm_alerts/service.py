"""`rosrm alerts run`: alerts on a running cluster, and delivery of their notices."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Final

from rosrm import (
    Client,
    EventRow,
    HostRow,
    Listing,
    Notice,
    ProcessRow,
    clocks,
)
from rosrm.client.event_feed import EventFeed
from rosrm.errors import ConfigError, RosrmError, describe_fault
from rosrm.extensions.guarded_sink import GuardedSink
from rosrm.model.notices import notice_of
from rosrm_alerts.alerts_file import AlertsFile
from rosrm_alerts.conditions import (
    Above,
    Happens,
    HostLost,
    InState,
    SeenEvent,
    SeenHost,
    SeenProcess,
    SeenResource,
    Situation,
)
from rosrm_alerts.delivery import Delivery
from rosrm_alerts.file_forms import Forwarded
from rosrm_alerts.outbox import Outbox, OutboxError
from rosrm_alerts.watch import Change, Watch

#: Seconds between two listings of the cluster.
PERIOD: Final = 1.0
#: Seconds for the last deliveries at the end.
CLOSING: Final = 5.0
#: Most events in one listing; a longer absence leaves out the oldest.
_MOST_EVENTS: Final = 10_000

#: Maximum number of notices that wait in memory for the disk.
MOST_UNSTORED: Final = 10_000

_log = logging.getLogger("rosrm.alerts")


class AlertService:
    """Lists the cluster once a second until it is stopped.

    Args:
        file: checked contents of alerts.yaml.
        sinks: sink and batch size by the name in the file; the service closes them.
        outbox: where notices wait; the caller closes it.
        connect: returns a new client of the master; raises `NoMaster`.
    """

    def __init__(
        self, file: AlertsFile, sinks: Mapping[str, tuple[GuardedSink, int]], outbox: Outbox,
        connect: Callable[[], Client],
    ) -> None:  # fmt: skip
        self._file, self._outbox, self._connect = file, outbox, connect
        self._watch = Watch(file.alerts, outbox.active())
        position, last = outbox.position(), outbox.last_event()
        self._feed = EventFeed(self._list, position or 0, _MOST_EVENTS, [last] if last else ())
        self._is_first = position is None
        self._client: Client | None = None
        self._answers = True
        self._unstored: list[tuple[str, Notice]] = []
        self._trouble = ""  # why the last notices could not be stored
        self._deliveries = {
            name: Delivery(name, sink, outbox, batch) for name, (sink, batch) in sinks.items()
        }

    def run(self, stop: threading.Event) -> None:
        """Watch until `stop` is set, then deliver what waits, for some seconds."""
        with ExitStack() as closing:
            for delivery in self._deliveries.values():
                closing.callback(delivery.close, CLOSING)
            closing.callback(self._disconnect)
            while not stop.is_set():
                self._look()
                for delivery in self._deliveries.values():
                    delivery.look()
                stop.wait(PERIOD)

    def _look(self) -> None:
        events = self._ask()
        situation = None if events is None else situation_of(self._feed.listing)
        if events is None or self._is_first:  # what had happened before the first listing is old
            self._is_first = self._is_first and events is None
            events = ()
        observed = self._watch.observe(clocks.boot_time(), situation, map(_seen, events))
        wall = clocks.wall_time()  # for displays; a duration by it would end when the clock is set
        changes = [replace(change, time=wall) for change in observed]
        for change in changes:
            _log.info("alert %s %s: %s", change.alert.name, change.kind, change.message)
        notices = [
            *_forwarded(self._file.forwarded, events),
            *((sink, notice_of_change(one)) for one in changes for sink in one.alert.to),
        ]
        self._unstored += notices
        if notices or changes or events or self._trouble:
            self._store()

    def _store(self) -> None:
        """Store the notices; where the disk takes none, they wait here for the next look."""
        try:
            dropped = self._outbox.commit(
                self._unstored, self._feed.after, self._watch.active, self._feed.last
            )
        except OutboxError as error:
            if str(error) != self._trouble:
                _log.error("%s; the next attempt is in %g s", error, PERIOD)
            self._trouble = str(error)
            dropped = max(0, len(self._unstored) - MOST_UNSTORED)
            del self._unstored[:dropped]
        else:
            stored, self._unstored, self._trouble = self._unstored, [], ""
            for sink in {sink for sink, _ in stored}:
                self._deliveries[sink].notify()
        if dropped:
            _log.error("%d notices were dropped: too many wait", dropped)

    def _list(self, after: int, newest: int) -> Listing:
        """Ask for the listing of the cluster, with its events after a sequence."""
        conditions = [alert.condition for alert in self._file.alerts]
        self._client = self._client or self._connect()
        return self._client.list(
            hosts=any(isinstance(one, (Above, HostLost)) for one in conditions),
            processes=any(isinstance(one, (InState, Happens)) for one in conditions),
            events=True, after=after, newest=min(newest, _MOST_EVENTS),
        )  # fmt: skip

    def _ask(self) -> Sequence[EventRow] | None:
        """Return the events that have not been seen; None: the master does not answer."""
        try:
            events = tuple(self._feed.new())
        except ConfigError:
            raise
        except Exception as error:  # noqa: BLE001 - else no alert would tell that nothing answers
            if self._answers:
                known = isinstance(error, RosrmError)
                _log.warning("%s", error if known else describe_fault(error))
            self._answers = False
            return None
        if not self._answers:
            _log.info("the master answers again")
        self._answers = True
        return events

    def _disconnect(self) -> None:
        if self._client is not None:
            self._client.close()


def situation_of(listing: Listing) -> Situation:
    """Return the hosts and processes of a listing, as conditions see them."""
    return Situation(
        {row.description.name: _host(row) for row in listing.hosts},
        {row.name: _process(row) for row in listing.processes},
    )


def _host(row: HostRow) -> SeenHost:
    fresh = {one.name: SeenResource(one.usage, one.limit) for one in row.resources if not one.stale}
    return SeenHost(row.state, fresh)


def _process(row: ProcessRow) -> SeenProcess:
    return SeenProcess(row.state, row.application, row.reason)


def _seen(event: EventRow) -> SeenEvent:
    return SeenEvent(event.kind, event.process, event.host, event.message)


def _forwarded(
    rules: Iterable[Forwarded], events: Sequence[EventRow]
) -> Iterator[tuple[str, Notice]]:
    """Yield each event for each sink that gets it, once."""
    for event in events:
        fitting = [rule for rule in rules if not rule.kinds or event.kind in rule.kinds]
        for sink in dict.fromkeys(sink for rule in fitting for sink in rule.to):
            yield sink, notice_of(event)


def notice_of_change(change: Change) -> Notice:
    """Return the notice of an alert that begins or ends."""
    alert, of = change.alert, change.subject
    return Notice(
        id=f"alert-{alert.name}-{of}-{change.kind}-{change.time:.6f}",
        wall_time=change.time,
        kind=f"alert_{change.kind}",
        message=change.message,
        level=alert.level if change.kind == "begins" else "INFO",
        process=of.process,
        host=of.host,
        alert=alert.name,
    )
