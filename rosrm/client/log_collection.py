"""Collection of logs: requests the output of all processes from the slaves, into an archive.

The collector requests the bytes after those that the archive has. It requests a log with new output
again after `every`, and a quiet log at longer and longer intervals.
"""

from __future__ import annotations

import errno
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rosrm import clocks
from rosrm.archive.layout import Source
from rosrm.client.event_feed import EventFeed
from rosrm.client.retrying import Notify
from rosrm.client.waiting import ENDED
from rosrm.errors import NoMaster, Refused

if TYPE_CHECKING:
    from rosrm.archive.writer import ArchiveWriter
    from rosrm.model.rows import EventRow, Listing, LogPart, ProcessRow
    from rosrm.ros.master_connection import MasterClient

#: Bytes of one request, and of one log before the next log has its turn.
PART: Final = 256 * 1024
TURN: Final = 4 * PART
#: Parts of one log before the next log has its turn, if the slave sends small ones.
_PARTS: Final = 16
#: Longest time (s) until a quiet log is asked for again, as a multiple of `every`.
_QUIET: Final = 15
#: Stored bytes that are compared with those of the host before reading continues.
_OVERLAP: Final = 64
_EVENTS: Final = 10_000
#: Newest instances of a process on one host that are collected; a slave keeps 5 by default.
_MOST_INSTANCES: Final = 1000
#: Seconds for which a host that did not answer is not asked; a request waits for 10 s.
_SILENT: Final = 60.0
_NEVER: Final = float("inf")


@dataclass
class _Log:
    """The logs of a process on a host.

    Attributes:
        due: monotonic time of the next request.
        wait: seconds from a request without new output to the next one.
        live: number of the instance that may write more; 0: none.
        numbers: of the instances whose logs the host has; (): unknown.
        complete: instances that have ended and are stored.
        compared: instances whose stored end was compared with the log of the host.
    """

    due: float = 0.0
    wait: float = 0.0
    live: int = 0
    numbers: Sequence[int] = ()
    complete: set[int] = field(default_factory=set)
    compared: set[int] = field(default_factory=set)


class LogCollector:
    """Collects until its caller stops: `look` once a second or so.

    Args:
        archive: takes the logs.
        notify: takes sentences about logs that cannot be collected.
        every: seconds between two requests for a log with new output.
        rate: bytes per second.
        stop: ends a look early.
    """

    def __init__(
        self, archive: ArchiveWriter, notify: Notify, *, every: float, rate: float,
        stop: threading.Event | None = None,
    ) -> None:  # fmt: skip
        self._archive, self._notify = archive, notify
        self._stop = stop or threading.Event()
        self._every, self._rate = every, rate
        self._logs: dict[tuple[str, str], _Log] = {}
        self._up: frozenset[str] = frozenset()
        self._feed = EventFeed(self._list, 0, _EVENTS)
        self._said: dict[tuple[str, str], str] = {}
        self._silent: dict[str, float] = {}

    def look(self, master: MasterClient) -> None:
        """Store the new output of all logs that are due.

        Raises:
            NoMaster: the master does not answer.
            OSError: the archive cannot be written. The next call continues where it stopped.
        """
        self._master = master
        self._take()
        try:
            try:
                self._collect_due(master)
            finally:  # a full disk may get room again only by the bounds
                self._archive.apply_limits()
        except FileNotFoundError:  # a user removed files
            self._archive.read_again()
            raise

    def _collect_due(self, master: MasterClient) -> None:
        for host, process in self._due():
            if self._stop.is_set():
                break
            if self._silent.get(host, 0.0) > clocks.boot_time():
                continue
            try:
                self._collect(master, host, process)
            except NoMaster as error:
                self._silent[host] = clocks.boot_time() + _SILENT
                self._say((host, ""), str(error))
                self._take()  # raises if the master does not answer
            except Refused as refusal:
                self._settle(host, process, refusal)
            except OSError as error:
                if error.errno != errno.ENAMETOOLONG:
                    raise
                self._settle(host, process, Refused("its name is too long for a file", "invalid"))
            else:
                for at in ((host, ""), (host, process)):
                    self._said.pop(at, None)

    # --- which logs ----------------------------------------------------------------------

    def _list(self, after: int, newest: int) -> Listing:
        newest = min(newest, _EVENTS)
        return self._master.list(
            hosts=True, processes=True, events=True, after=after, newest=newest
        )  # fmt: skip

    def _take(self) -> None:
        events = list(self._feed.new())
        listing = self._feed.listing
        up = frozenset(row.description.name for row in listing.hosts if row.state == "up")
        for at, log in list(self._logs.items()):
            log.live = 0
            if at[0] in up - self._up:  # the host may have lost its logs
                self._logs[at] = _Log()
        for host in up - self._up:
            self._silent.pop(host, None)
        self._up = up
        listed = {row.name for row in listing.processes}
        for row in listing.processes:
            self._note_row(row)
        for event in events:
            self._note_event(event)
        self._logs = {
            at: log for at, log in self._logs.items() if at[1] in listed or log.due < _NEVER
        }
        known = {(row.description.name, "") for row in listing.hosts} | self._logs.keys()
        self._said = {at: text for at, text in self._said.items() if at in known}

    def _note_row(self, row: ProcessRow) -> None:
        if not row.host or not row.number:
            return
        log = self._logs.setdefault((row.host, row.name), _Log())
        if row.state not in ENDED:
            log.live = row.number
            log.due = min(log.due, clocks.boot_time() + self._every * _QUIET)

    def _note_event(self, event: EventRow) -> None:
        for host in (event.host, event.facts.get("from", "")):
            if event.process and isinstance(host, str) and host:
                log = self._logs.setdefault((host, event.process), _Log())
                log.due, log.numbers = 0.0, ()

    def _due(self) -> Iterator[tuple[str, str]]:
        """Yield host and process of each log that is due, the longest waiting first."""
        now = clocks.boot_time()
        due = sorted((log.due, at) for at, log in self._logs.items() if log.due <= now)
        return iter([at for _, at in due if at[0] in self._up])

    def _settle(self, host: str, process: str, refusal: Refused) -> None:
        """Ask for a log that a slave or the master refuses only after another event."""
        log = self._logs[host, process]
        log.due, log.numbers = _NEVER, ()
        if refusal.code != "unknown":
            self._say((host, process), f"the log of {process} on {host}: {refusal}")

    def _say(self, at: tuple[str, str], text: str) -> None:
        """Pass on a sentence about a host, or a process on a host, once."""
        if self._said.get(at) != text:
            self._said[at] = text
            self._notify(text)

    # --- one log -------------------------------------------------------------------------

    def _collect(self, master: MasterClient, host: str, process: str) -> None:
        log = self._logs[host, process]
        if not log.numbers:
            found = master.read_log(host, process, 0, 0, 1)
            log.numbers = found.numbers or (found.number,)
        stored = 0
        for number in _newest(log.numbers):
            if number not in log.complete or number == log.live:
                stored += self._store_new(master, Source(host, process, number), log)
        newest = _newest(log.numbers)
        log.complete.intersection_update(newest)
        log.compared.intersection_update(newest)
        log.wait = (
            min(2 * log.wait, self._every * _QUIET) if log.wait and not stored else self._every
        )
        is_complete = not log.live and log.complete.issuperset(newest)
        wait = 0.0 if stored >= TURN else log.wait
        log.due = _NEVER if is_complete else clocks.boot_time() + wait

    def _store_new(self, master: MasterClient, source: Source, log: _Log) -> int:
        """Store new output of an instance, at most about `TURN` bytes; return their number."""
        archive, stored = self._archive, 0
        for _ in range(_PARTS):
            if stored >= TURN or self._stop.is_set():
                break
            position = archive.position(source)
            part = self._read(master, source, position, PART)
            end = min(part.offset, position)  # of the bytes that archive and host can both have
            is_compared = source.number in log.compared and end == position
            if end and not is_compared and not self._is_same(master, source, end):
                archive.begin_generation(source)
                continue
            log.numbers = part.numbers or log.numbers
            if end == position:
                log.compared.add(source.number)
                archive.add(source, part)
                stored += len(part.content)
            if part.ended:
                archive.close(source)
                log.complete.add(source.number)
            if part.ended or end < position or not part.content:
                break
            self._stop.wait(len(part.content) / self._rate)
        return stored

    def _is_same(self, master: MasterClient, source: Source, end: int) -> bool:
        """Return True if the archive has the bytes of the host before an offset, as far as known.

        A host may have fewer bytes than the archive: a power failure has lost its newest ones. It
        has other bytes if its state directory was removed and the number was given again.
        """
        begin, content = self._archive.newest_content(source)
        if end <= begin:
            return end == self._archive.position(source)
        at = max(begin, end - _OVERLAP)
        part = self._read(master, source, at, end - at)
        return part.offset >= end or content[part.offset - begin :].startswith(part.content)

    def _read(self, master: MasterClient, source: Source, offset: int, most: int) -> LogPart:
        """Return a part as the slave sends it; raises `Refused` if the answer is impossible."""
        host, process, number = source
        part = master.read_log(host, process, number, offset, most)
        ends = part.next_offset == part.offset + len(part.content)
        if part.number != number or not ends or len(part.content) > most:
            raise Refused(
                f"{host} sent an impossible part of the log of {process}#{number}", "invalid"
            )
        return part


def _newest(numbers: Sequence[int]) -> Sequence[int]:
    return sorted(set(numbers))[-_MOST_INSTANCES:]
