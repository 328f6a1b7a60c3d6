"""`rosrm logs`: finds the slaves that hold the logs of processes, copies them, and follows them.

The numbers of instances ascend over all hosts, so that they order what a process wrote.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from heapq import merge
from operator import itemgetter
from typing import TYPE_CHECKING, Final

import typer

from rosrm.cli.connection import check_name
from rosrm.cli.output import formats
from rosrm.cli.output.log_lines import Piece, Stream, show
from rosrm.errors import ConfigError, NoMaster, Refused, RosrmError
from rosrm.extensions.units import Quantity
from rosrm.wording import listed, no_such, standing, standing_for

if TYPE_CHECKING:
    from rosrm.model.rows import HostRow, ProcessRow, Snapshot
    from rosrm.ros.client import LogPart, MasterClient

_CHUNK: Final = 256 * 1024
#: Seconds between two looks at logs that have nothing new.
PERIOD: Final = 0.3
#: States in which nothing more will be written anywhere.
_OVER: Final = frozenset({"finished", "failed", "cancelled"})
#: Offset behind all that is written while the log is read.
_NO_END: Final = sys.maxsize
#: Newest events by which the hosts of a process are found.
_EVENTS: Final = 200


@dataclass(frozen=True)
class Wanted:
    """Options of `rosrm logs`.

    Attributes:
        tail: the last lines only, so many; 0: all.
        since: unix time (s): only what was written then or later; 0.0: all.
        host: only what was written there; "": everywhere.
        follow: until the processes have ended.
    """

    tail: int = 0
    since: float = 0.0
    host: str = ""
    follow: bool = False


def since_of(text: str) -> float:
    """Return the option --since as unix time, 0.0 where it is not given; raises `ConfigError`."""
    try:
        ago = Quantity("duration", above=True).parse(text) if text else 0.0
    except ValueError as error:
        raise ConfigError(f"--since: {error}. Give a time span up to now, e.g. 10min") from None
    return time.time() - ago if ago else 0.0


def copy_logs(client: MasterClient, streams: Sequence[Stream], wanted: Wanted) -> None:
    """Copy the logs of processes to standard output by the times of their lines; follow all.

    A log that is out of reach is reported at once, and the others are copied.

    Raises:
        typer.Exit: one of them could not be copied.
    """
    silent: dict[str, str] = {}
    copies = [_Copy(client, stream, wanted, silent) for stream in streams]
    # `merge` takes the least of the next pieces: one without a time follows the one before it.
    show(merge(*map(_begin, copies), key=itemgetter(0)))
    if wanted.follow:
        _follow([copy for copy in copies if not copy.over])
    if exit_code := max(copy.exit_code for copy in copies):
        raise typer.Exit(exit_code)


def _begin(copy: _Copy) -> Iterator[Piece]:
    """Read what there is, in pieces."""
    try:
        for _ in copy.begin():
            yield from copy.stream.take()
    except RosrmError as error:
        copy.fail(error)
    if copy.over or not copy.wanted.follow:
        copy.stream.close()
    yield from copy.stream.take()


def _follow(copies: Sequence[_Copy]) -> None:
    """Copy what is new until all processes have ended."""
    while copies:
        news = False
        for copy in copies:
            try:
                news = copy.look() or news
            except RosrmError as error:
                copy.fail(error)
            if copy.over:
                copy.stream.close()
            show(copy.stream.take())
        copies = [copy for copy in copies if not copy.over]
        if copies and not news:
            time.sleep(PERIOD)


@dataclass
class _Copy:
    """The copy of the logs of one process.

    Attributes:
        client: asks master and slaves.
        stream: takes the bytes.
        wanted: options of the command.
        silent: hosts that did not answer, with the error; shared, so that each is asked once.
        over: nothing more comes.
        exit_code: of the error that ended the copy; 0: none.
    """

    client: MasterClient
    stream: Stream
    wanted: Wanted
    silent: dict[str, str]
    over: bool = False
    exit_code: int = 0
    _host: str = ""
    _number: int = 0
    _offset: int = 0
    _started: bool = False
    _hosts: Sequence[str] = ()
    _away: dict[str, str] = field(default_factory=dict)

    def fail(self, error: RosrmError) -> None:
        """Report that the log cannot be read any further."""
        self.over, self.exit_code = True, error.exit_code
        typer.echo(f"rosrm: {error}", err=True)

    def begin(self) -> Iterator[None]:
        """Copy what there is, one part at each step; raises `RosrmError`."""
        found = self._find()
        for host, first, end in self._chosen(found):
            self._started = self._started or any(pid for _, _, pid in first.marks)
            self._take(host, _up_to(end, first))
            yield
            while self._offset < end:
                part = self._read(host, first.number, self._offset)
                if not part.content:
                    break
                self._take(host, _up_to(end, part))
                yield
        if not self.stream.wrote:
            self._explain_nothing(found)

    def look(self) -> bool:
        """Copy what is new; return False if there was nothing."""
        part = self._read(self._host, self._number, self._offset) if self._host else None
        if part is not None and part.content:
            self._take(self._host, part)
            return True
        return (part is None or part.ended) and self._find_next()

    # --- one instance ------------------------------------------------------------------------

    def _chosen(self, found: Sequence[tuple[str, int]]) -> Iterable[tuple[str, LogPart, int]]:
        """Yield host and first part of each instance to be shown, the oldest first.

        The offset behind what is to be shown stands beside them.
        """
        left = self.wanted.tail
        if not left:
            for host, number in found:
                yield host, self._read(host, number, 0, since=self.wanted.since), _NO_END
            return
        chosen: list[tuple[str, LogPart, int]] = []
        for host, number in reversed(found):
            if left <= 0:
                break
            first, end, lines = self._last_lines(host, number, left)
            chosen.insert(0, (host, first, _NO_END if self.wanted.follow else end))
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
        self, host: str, number: int, offset: int, most: int = 0, *, tail: int = 0,
        since: float = 0.0,
    ) -> LogPart:  # fmt: skip
        name, most = self.stream.name, most or _CHUNK
        if host not in self.silent:
            try:
                return self.client.read_log(
                    host, name, number, offset, most, tail=tail, since=since
                )
            except NoMaster as error:
                self.silent[host] = str(error)
        raise NoMaster(f"{name}: {self.silent[host]}")

    def _take(self, host: str, part: LogPart) -> None:
        new = (host, part.number) != (self._host, self._number)
        whole = not (self.wanted.tail or self.wanted.since)
        expected = (0 if whole else part.offset) if new else self._offset
        if new:
            self.stream.enter(host)
        self.stream.write(part.content, part.offset, part.marks, part.offset - expected)
        self._host, self._number, self._offset = host, part.number, part.next_offset

    # --- where -------------------------------------------------------------------------------

    def _find(self) -> list[tuple[str, int]]:
        """Return host and number of every instance within reach, the oldest first."""
        name, row, hosts, events = self._ask()
        check_name("host", self.wanted.host, hosts)
        if self.wanted.host:
            names = [self.wanted.host]
        else:
            here = [row.host] if row is not None and row.host else []
            names = list(dict.fromkeys([*here, *(host for host in events if host)]))
        if not names and row is None:
            known = self.client.list(processes=True).processes
            raise Refused(no_such("process", [name], [row.name for row in known]), "unknown")
        owner = row.host if row is not None and not self.wanted.host else self.wanted.host
        self._hosts = names
        self._away = {host: away for host in names if (away := _why_away(hosts.get(host), host))}
        if owner in self._away:
            self._refuse(row, owner)
        found = []
        for host in names:
            if host not in self._away:
                found += [(host, number) for number in self._numbers(host, owner)]
        for away in self._away.values():
            typer.echo(f"rosrm: {name}: part of its log cannot be read: {away}", err=True)
        return sorted(found, key=lambda one: one[1])

    def _numbers(self, host: str, owner: str) -> Sequence[int]:
        """Return the numbers of the instances whose logs a host holds."""
        try:
            part = self._read(host, 0, 0, 1)
        except Refused as refusal:
            if refusal.code != "unknown":
                raise
            return ()
        except NoMaster:
            if host == owner:
                raise
            self._away[host] = self.silent[host]
            return ()
        return part.numbers or (part.number,)

    def _ask(self) -> tuple[str, ProcessRow | None, dict[str, HostRow], list[str]]:
        name = self.stream.name
        listed: Snapshot = self.client.list(
            hosts=True, processes=True, events=True, process=name, newest=_EVENTS
        )
        row = next((row for row in listed.processes if row.name == name), None)
        hosts = {row.description.name: row for row in listed.hosts}
        return name, row, hosts, _hosts_of(listed)

    def _refuse(self, row: ProcessRow | None, host: str) -> None:
        """Say at once that the newest part is out of reach, with what the master knows."""
        name, why = self.stream.name, f", and {self._away[host]}"
        known = ""
        if row is not None:
            known = f". {name} {standing_for(row.state, formats.duration(row.since))}"
        if row is not None and row.reason:
            known += f": {row.reason}"
            why = "" if row.reason.startswith(f"{host} is ") else why  # the reason says the same
        others = [f"`--host {other}`" for other in self._hosts if other not in self._away]
        older = f"; an older part may be read with {listed(others, 'or')}" if others else ""
        raise Refused(
            f"the log of {name} is on {host}{why}{known}. To read it, start the slave of {host} "
            f"again (`rosrm slave`){older}. `rosrm events --process {name}` shows what happened"
        )

    def _explain_nothing(self, found: Sequence[tuple[str, int]]) -> None:
        """Say why nothing is shown; raises `Refused` where no program was started."""
        name, row, _, _ = self._ask()
        if self.wanted.follow and row is not None and row.state not in _OVER:
            return
        where = f" on {self.wanted.host}" if self.wanted.host else ""
        if found and (self._started or self.wanted.since):
            since = " since then" if self.wanted.since else ""
            typer.echo(f"rosrm: {name} has written nothing{where}{since}", err=True)
            return
        state = "is no longer known to the master" if row is None else standing(row.state)
        reason = f": {row.reason}" if row is not None and row.reason else ""
        gone = "it was not started, or its log has been removed"
        raise Refused(f"{name} has no log{where}: {gone}. {name} {state}{reason}")

    def _find_next(self) -> bool:
        """Copy the beginning of the next instance; return False if there is none, or none yet."""
        _, row, _, _ = self._ask()
        if row is None or row.state in _OVER or self.wanted.host:
            self.over = True
            return False
        if not row.number or not row.host or (row.host, row.number) == (self._host, self._number):
            return False
        try:
            self._take(row.host, self._read(row.host, row.number, 0))
        except Refused as refusal:
            if refusal.code != "unknown":  # its host is about to begin the log
                raise
            return False
        return True


def _up_to(end: int, part: LogPart) -> LogPart:
    """Return a part without what lies behind an offset."""
    if part.next_offset <= end:
        return part
    return replace(part, content=part.content[: end - part.offset], next_offset=end)


def _hosts_of(listed: Snapshot) -> list[str]:
    """Return the hosts that the events of a process name, the newest first."""
    hosts: list[str] = []
    for event in reversed(listed.events):
        hosts += [event.host, str(event.facts.get("from", ""))]
    return hosts


def _why_away(row: HostRow | None, host: str) -> str:
    """Say why a host cannot be asked; "" if it can."""
    if row is None:
        return f"the master knows no host {host}"
    if row.state == "up":
        return ""
    if row.state == "left":
        return f"{host} has left: no slave runs there"
    silent = formats.duration(row.reading_age)
    if row.state == "detached":
        return f"{host} is detached: its slave was stopped {silent} ago"
    return f"{host} is {row.state}: the master received its last reading {silent} ago"
