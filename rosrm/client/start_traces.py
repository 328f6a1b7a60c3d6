"""Traces of starts: submissions with a trace, their stamps, and the table of hand-overs."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from rosrm import clocks
from rosrm.client.retrying import Notify, ask_until_answered, deadline_after
from rosrm.client.waiting import ENDED, UNTIL_ASKED
from rosrm.errors import Refused, RosrmError
from rosrm.model.start_trace import LINE, VARIABLE
from rosrm.wording import standing

if TYPE_CHECKING:
    from rosrm.model.rows import ProcessRow
    from rosrm.model.values import ProcessSpec
    from rosrm.ros.master_connection import MasterClient

#: The stamps of one start, as unix times in nanoseconds.
Trace = Mapping[str, int]

#: Stamps in the order of the hand-overs, with their descriptions.
STAMPS: Final[dict[str, str]] = {
    "client_sent": "client: sends the submission",
    "master_received": "master: has received it",
    "decided": "master: has decided",
    "journalled": "master: the decision is durable",
    "assignment_sent": "master: sends the assignment",
    "slave_received": "slave: has received it",
    "launch_sent": "slave: sends the order",
    "supervisor_received": "supervisor: has received it",
    "recorded": "supervisor: the start is durable",
    "process_started": "process: its own stamp",
}
#: Stamps beside that order: the process may run before them.
BESIDE: Final[dict[str, str]] = {
    "spawned": "supervisor: has spawned the process",
    "client_answered": "client: has received the answer",
}
_EVENTS: Final = STAMPS | BESIDE
#: Digits of a unix time in nanoseconds.
_DIGITS: Final = 19
#: Bytes of a log that one request reads.
_PART: Final = 1 << 16
#: Bytes at the beginning of a log that are searched: the process may write before its trace.
_BEGINNING: Final = 1 << 22
#: Seconds between two requests. The first follows after them, so that it delays no start.
_PERIOD: Final = 0.1
#: Seconds after its start for which the stamp of a process itself is awaited.
_OWN_STAMP: Final = 1.0


@dataclass(frozen=True, slots=True)
class HandOver:
    """One row of the table: medians over all traces.

    Attributes:
        stamp: name of the stamp.
        event: description of the stamp.
        step_ms: milliseconds since the stamp before; None: there is none, or one is missing.
        since_submit_ms: milliseconds since the client sent the submission; None: it is missing.
    """

    stamp: str
    event: str
    step_ms: float | None
    since_submit_ms: float | None


def hand_overs(traces: Sequence[Trace]) -> list[HandOver]:
    """Return the table of one or several starts."""
    rows, before = [], ""
    for stamp, event in _EVENTS.items():
        step = _median_ms(traces, before, stamp) if stamp in STAMPS else None
        rows.append(HandOver(stamp, event, step, _median_ms(traces, "client_sent", stamp)))
        before = stamp
    return rows


def _median_ms(traces: Iterable[Trace], first: str, last: str) -> float | None:
    found = [one[last] - one[first] for one in traces if first in one and last in one]
    return statistics.median(found) / 1e6 if found else None


def stamps_in_log(lines: Iterable[str]) -> dict[str, int]:
    """Return the stamps in the log of a traced process; {}: it has not started yet.

    The first line that is a unix time in nanoseconds, as `date +%s%N` prints it, is the stamp of
    the process itself.
    """
    stamps: dict[str, int] = {}
    own = 0
    for line in lines:
        if line.startswith(LINE) and not stamps:
            words = (word.partition("=") for word in line.removeprefix(LINE).split())
            # A repeated stamp is that of a repeated delivery, so the first one counts.
            for name, _, at in words:
                if name in _EVENTS and _is_time(at):
                    stamps.setdefault(name, int(at))
        elif not own and _is_time(line):
            own = int(line)
        if stamps and own:  # the rest of a long log need not be read
            break
    return {**stamps, "process_started": own} if stamps and own else stamps


def _is_time(text: str) -> bool:
    return len(text) == _DIGITS and text.isascii() and text.isdigit()


def submit_traced(
    master: MasterClient, specs: Sequence[ProcessSpec], *, timeout: float | None, notify: Notify
) -> dict[str, Trace]:
    """Submit processes, and return the trace of each start by the name of its process."""
    deadline = deadline_after(timeout)
    sent = clocks.wall_time_ns()
    mark = {VARIABLE: f"client_sent={sent}"}
    master.submit([replace(one, environment={**one.environment, **mark}) for one in specs])
    answered = clocks.wall_time_ns()
    readers = [_Reader(master, spec.name, sent, deadline, notify) for spec in specs]
    return {one.process: {**one.read(), "client_answered": answered} for one in readers}


@dataclass(frozen=True, slots=True)
class _Reader:
    """Reader of the trace of one process.

    Attributes:
        sent: stamp of the client, which tells the trace from that of an earlier instance.
        deadline: monotonic seconds.
        notify: takes a message when the master is silent.
    """

    master: MasterClient
    process: str
    sent: int
    deadline: float
    notify: Notify

    def read(self) -> Trace:
        """Wait for the start of the process, and return its stamps; raises `RosrmError`."""
        started = False
        while True:
            time.sleep(_OWN_STAMP if started else _PERIOD)
            row = self._row()
            stamps = self._in_log(row)
            if "process_started" in stamps or started:
                return stamps
            started = bool(stamps)
            # The supervisor writes the trace before it reports the pid.
            is_over = row.pid or row.state in ENDED | UNTIL_ASKED
            if not started and (is_over or clocks.boot_time() >= self.deadline):
                why = f": {row.reason}" if row.reason else ""
                raise RosrmError(
                    f"there is no trace of a start of {self.process}: it {standing(row.state)}{why}"
                )

    def _row(self) -> ProcessRow:
        view = ask_until_answered(
            lambda on_wait: self.master.list(
                processes=True, process=self.process, on_wait=on_wait
            ),
            self.notify, self.deadline,
        )  # fmt: skip
        for row in view.processes:
            if row.name == self.process:
                return row
        raise Refused(f"{self.process} is no longer known to the master", "unknown")

    def _in_log(self, row: ProcessRow) -> Trace:
        """Return the stamps in the log; {}: there is no log, or it has another trace."""
        lines = (line.decode(errors="replace") for line in self._lines(row))
        stamps = stamps_in_log(lines) if row.host else {}
        return stamps if stamps.get("client_sent") == self.sent else {}

    def _lines(self, row: ProcessRow) -> Iterator[bytes]:
        """Yield the lines at the beginning of the log; none if there is no log."""
        offset, rest = 0, b""
        while offset < _BEGINNING:
            try:
                part = self.master.read_log(row.host, self.process, row.number, offset, _PART)
            except Refused as refusal:
                if refusal.code != "unknown":  # its host has not created the log yet
                    raise
                return
            *lines, rest = (rest + part.content).split(b"\n")
            yield from lines
            offset = part.next_offset
            if len(part.content) < _PART:  # all that there is now
                break
        yield rest
