"""Reader of process logs: finds, copies and follows them.

The slaves hold the logs. A log archive has copies, which are read for hosts that are gone, and for
instances whose logs the slave has removed. The numbers of instances increase over all hosts, so
they order the output of a process.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from rosrm.archive.reader import LogArchive
from rosrm.client.connecting import check_name
from rosrm.client.retrying import Notify
from rosrm.client.waiting import ENDED
from rosrm.errors import NoMaster, Refused
from rosrm.wording import duration, listed, local_time, no_such, standing, standing_for

if TYPE_CHECKING:
    from rosrm.model.rows import HostRow, Listing, LogPart, ProcessRow
    from rosrm.ros.master_connection import MasterClient

_PART: Final = 256 * 1024
#: Seconds between two polls of logs without new output.
PERIOD: Final = 0.3
#: Offset beyond any output that is written while the log is read.
_NO_END: Final = sys.maxsize
#: Newest events by which the hosts of a process are found.
_EVENTS: Final = 200


@dataclass(frozen=True)
class LogSelection:
    """Selects a part of a log.

    Attributes:
        tail: number of last lines; 0: all lines.
        since: unix time (s) of the oldest output; 0.0: all output.
        host: name of the host of the output; "": all hosts.
        follow: True: read until the process has ended.
    """

    tail: int = 0
    since: float = 0.0
    host: str = ""
    follow: bool = False


@dataclass(frozen=True, slots=True)
class LogChunk:
    """Consecutive bytes that one instance of a process wrote.

    Attributes:
        process: that wrote.
        host: on which it ran.
        number: of the instance.
        content: the bytes; b"": none yet, of an instance that is new.
        offset: of the content, from the first byte that the instance wrote.
        dropped: bytes before the content that the bound on logs removed.
        is_first: no chunk of this instance came before.
        marks: looks at the log: (unix time, offset, pid). Everything before the offset had been
            written by that time; a pid not 0 is that of a program whose output begins there.
    """

    process: str
    host: str
    number: int
    content: bytes
    offset: int
    dropped: int
    is_first: bool
    marks: Sequence[tuple[float, int, int]]


@dataclass
class LogReader:
    """Reads the log of one process: `read` what there is, then `poll` what is new.

    Attributes:
        master: asks master and slaves.
        process: that writes.
        selection: of the log.
        notify: takes messages about unreachable parts, and about a log without output.
        silent: hosts that did not answer, with the error; readers that share it ask each once.
        archive: of collected logs; None: there is none.
        at_end: no more output can follow.
    """

    master: MasterClient
    process: str
    selection: LogSelection
    notify: Notify
    silent: dict[str, str] = field(default_factory=dict)
    archive: LogArchive | None = None
    at_end: bool = False
    _host: str = ""
    _number: int = 0
    _offset: int = 0
    _wrote: bool = False
    _started: bool = False
    _hosts: Sequence[str] = ()
    _away: dict[str, str] = field(default_factory=dict)
    _archived: set[tuple[str, int]] = field(default_factory=set)

    def read(self) -> Iterator[LogChunk]:
        """Yield the existing output, the oldest first; raises `RosrmError`."""
        found = self._find()
        for host, first, end in self._chosen(found):
            self._started = self._started or any(pid for _, _, pid in first.marks)
            yield self._take(host, _up_to(end, first))
            while self._offset < end:
                part = self._read(host, first.number, self._offset)
                if not part.content:
                    break
                yield self._take(host, _up_to(end, part))
        if not self._wrote:
            self._explain_nothing(found)

    def poll(self) -> LogChunk | None:
        """Return new output, None if there is none; raises `RosrmError`."""
        part = self._read(self._host, self._number, self._offset) if self._host else None
        if part is not None and part.content:
            return self._take(self._host, part)
        return self._find_next() if part is None or part.ended else None

    # --- one instance ------------------------------------------------------------------------

    def _chosen(self, found: Sequence[tuple[str, int]]) -> Iterable[tuple[str, LogPart, int]]:
        """Yield host and first part of each instance to be shown, the oldest first.

        The offset behind what is to be shown stands beside them.
        """
        left = self.selection.tail
        if not left:
            for host, number in found:
                yield host, self._read(host, number, 0, since=self.selection.since), _NO_END
            return
        chosen: list[tuple[str, LogPart, int]] = []
        for host, number in reversed(found):
            if left <= 0:
                break
            first, end, lines = self._last_lines(host, number, left)
            chosen.insert(0, (host, first, _NO_END if self.selection.follow else end))
            left -= lines
        yield from chosen

    def _last_lines(self, host: str, number: int, most: int) -> tuple[LogPart, int, int]:
        """Return the part in which the last lines begin, the offset behind them, and their count.

        The log may grow between two reads: what is added after the last line is not counted.
        """
        first = part = self._read(host, number, 0, tail=most)
        lines, end, last = 0, first.offset, b"\n"
        while part.content:
            *ended, rest = part.content.split(b"\n", most - lines)
            lines, last, end = lines + len(ended), part.content[-1:], part.next_offset
            if lines == most:
                return first, end - len(rest), lines
            part = self._read(host, number, end)
        return first, end, lines + (last != b"\n")

    def _read(
        self, host: str, number: int, offset: int, most: int = _PART, *, tail: int = 0,
        since: float = 0.0,
    ) -> LogPart:  # fmt: skip
        if self.archive is not None and (host, number) in self._archived:
            return self.archive.read_log(
                host, self.process, number, offset, most, tail=tail, since=since
            )
        if host not in self.silent:
            try:
                return self.master.read_log(
                    host, self.process, number, offset, most, tail=tail, since=since
                )
            except NoMaster as error:
                self.silent[host] = str(error)
        raise NoMaster(f"{self.process}: {self.silent[host]}")

    def _take(self, host: str, part: LogPart) -> LogChunk:
        """Continue behind a part, and return it as a chunk."""
        new = (host, part.number) != (self._host, self._number)
        whole = not (self.selection.tail or self.selection.since)
        expected = (0 if whole else part.offset) if new else self._offset
        self._host, self._number, self._offset = host, part.number, part.next_offset
        self._wrote = self._wrote or bool(part.content)
        return LogChunk(
            self.process, host, part.number, part.content, part.offset, part.offset - expected,
            new, part.marks,
        )  # fmt: skip

    # --- where -------------------------------------------------------------------------------

    def _find(self) -> list[tuple[str, int]]:
        """Return host and number of every instance within reach, the oldest first."""
        row, hosts, events = self._ask()
        collected = self.archive.hosts_of(self.process) if self.archive is not None else ()
        check_name("host", self.selection.host, [*hosts, *collected])
        if self.selection.host:
            names = [self.selection.host]
        else:
            here = [row.host] if row is not None and row.host else []
            names = list(dict.fromkeys([*here, *filter(None, events), *collected]))
        if not names and row is None:
            known = self.master.list(processes=True).processes
            raise Refused(
                no_such("process", [self.process], [row.name for row in known]), "unknown"
            )
        owner = row.host if row is not None and not self.selection.host else self.selection.host
        self._hosts = names
        self._away = {
            host: away for host in names
            if (away := _why_away(hosts.get(host), host, is_listed=bool(hosts)))
        }  # fmt: skip
        if owner in self._away and owner not in collected:
            self._refuse(row, owner)
        found = []
        for host in names:
            if host not in self._away:
                must_answer = host == owner and host not in collected
                found += [(host, number) for number in self._numbers(host, must_answer)]
        for host in collected:
            found += self._find_collected(host, found)
        for host, away in self._away.items():
            if host not in collected:
                self.notify(f"{self.process}: part of its log cannot be read: {away}")
        return sorted(found, key=lambda one: one[1])

    def _find_collected(
        self, host: str, found: Sequence[tuple[str, int]]
    ) -> Sequence[tuple[str, int]]:
        """Return the instances on a host whose logs only the archive has."""
        assert self.archive is not None
        if self.selection.host not in {"", host}:
            return ()
        only = {(host, number) for number in self.archive.numbers(host, self.process)} - {*found}
        self._archived |= only
        if host in self._away:
            until = self.archive.collected_until(host, self.process)
            self.notify(
                f"{self.process}: {self._away[host]}. Its output there is read from "
                f"{self.archive.directory}, as collected until {local_time(until)}"
            )
        return sorted(only)

    def _numbers(self, host: str, must_answer: bool) -> Sequence[int]:
        """Return the numbers of the instances whose logs a host holds."""
        try:
            part = self._read(host, 0, 0, 1)
        except Refused as refusal:
            if refusal.code != "unknown":
                raise
            return ()
        except NoMaster:
            if must_answer:
                raise
            self._away[host] = self.silent[host]
            return ()
        return part.numbers or (part.number,)

    def _ask(self) -> tuple[ProcessRow | None, dict[str, HostRow], list[str]]:
        """Return the row of the process, the hosts by name, and the names of its former hosts."""
        listed: Listing = self.master.list(
            hosts=True, processes=True, events=True, process=self.process, newest=_EVENTS
        )
        row = next((row for row in listed.processes if row.name == self.process), None)
        hosts = {row.description.name: row for row in listed.hosts}
        return row, hosts, _hosts_of(listed)

    def _refuse(self, row: ProcessRow | None, host: str) -> None:
        """Say at once that the newest part is out of reach, with what the master knows."""
        name, why = self.process, f", and {self._away[host]}"
        known = ""
        if row is not None:
            known = f". {name} {standing_for(row.state, duration(row.since))}"
        if row is not None and row.reason:
            known += f": {row.reason}"
            why = "" if row.reason.startswith(f"{host} is ") else why  # same content
        others = [f"`--host {other}`" for other in self._hosts if other not in self._away]
        older = f"; an older part may be read with {listed(others, 'or')}" if others else ""
        collected = "" if self.archive else ", or read a log archive (`rosrm logs --archive DIR`)"
        raise Refused(
            f"the log of {name} is on {host}{why}{known}. To read it, start the slave of {host} "
            f"again (`rosrm slave`){collected}{older}. `rosrm events --process {name}` shows what "
            "happened"
        )

    def _explain_nothing(self, found: Sequence[tuple[str, int]]) -> None:
        """Say why nothing is shown; raises `Refused` where no program was started."""
        name, (row, _, _) = self.process, self._ask()
        if self.selection.follow and row is not None and row.state not in ENDED:
            return
        where = f" on {self.selection.host}" if self.selection.host else ""
        if found and (self._started or self.selection.since):
            since = " since then" if self.selection.since else ""
            self.notify(f"{name} has written nothing{where}{since}")
            return
        if self._away:
            away = "; ".join(self._away.values())
            raise Refused(f"no log of {name} is within reach{where}: {away}")
        state = "is no longer known to the master" if row is None else standing(row.state)
        reason = f": {row.reason}" if row is not None and row.reason else ""
        gone = "it was not started, or its log has been removed"
        raise Refused(f"{name} has no log{where}: {gone}. {name} {state}{reason}")

    def _find_next(self) -> LogChunk | None:
        """Return the beginning of the next instance; None if there is none, or none yet."""
        row, _, _ = self._ask()
        if row is None or row.state in ENDED or self.selection.host:
            self.at_end = True
            return None
        if not row.number or not row.host or (row.host, row.number) == (self._host, self._number):
            return None
        try:
            return self._take(row.host, self._read(row.host, row.number, 0))
        except Refused as refusal:
            if refusal.code != "unknown":  # its host has not created the log yet
                raise
            return None


def _up_to(end: int, part: LogPart) -> LogPart:
    """Return a part without what lies behind an offset."""
    if part.next_offset <= end:
        return part
    return replace(part, content=part.content[: end - part.offset], next_offset=end)


def _hosts_of(listed: Listing) -> list[str]:
    """Return the hosts that the events of a process name, the newest first."""
    hosts: list[str] = []
    for event in reversed(listed.events):
        hosts += [event.host, str(event.facts.get("from", ""))]
    return hosts


def _why_away(row: HostRow | None, host: str, *, is_listed: bool) -> str:
    """Return why a host cannot be asked; "" if it can."""
    if not is_listed:
        return f"no master lists {host}"
    if row is None:
        return f"the master knows no host {host}"
    if row.state == "up":
        return ""
    if row.state == "left":
        return f"{host} has left: no slave runs there"
    if row.state == "expected":
        return f"{host} has not reported since the master started"
    silent = duration(row.reading_age)
    if row.state == "detached":
        return f"{host} is detached: its slave was stopped {silent} ago"
    return f"{host} is {row.state}: the master received its last reading {silent} ago"
