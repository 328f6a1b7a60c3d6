"""Fetch of a process's snapshot from another host, before an instance starts on this host."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

from rosrm import clocks
from rosrm.model.values import Assignment
from rosrm.ros.slave.replication import NotSent, NotStored, ReplicationEndpoint
from rosrm.snapshots.format import Head, TransferPart

#: Seconds after which a process starts from the newest local snapshot, even if a fetch is running.
LONGEST: Final = 60.0


class Fetch:
    """Transfer of one snapshot to this host.

    Args:
        assignment: that waits for the snapshot.
        hosts: that hold a replica, the newest first.
        endpoint: sends requests to their slaves.
        here: the newest snapshot on this host; None: there is none.
        patience: seconds for the discovery of a slave, or its answer; then the next host is asked.
            On a busy machine discovery takes more than 3 s. The next host may have only the
            snapshot of an earlier instance, which ran on in a partition, and from which the
            process must not continue.
        take: writes a part, and calls back with None, or with the reason why it was not stored.
        ended: called once, with a message for the user.
    """

    def __init__(
        self, assignment: Assignment, hosts: tuple[str, ...], endpoint: ReplicationEndpoint, *,
        here: Head | None, patience: float,
        take: Callable[[TransferPart, Callable[[NotStored | None], None]], None],
        ended: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._assignment = assignment
        self._hosts = list(hosts)
        self._endpoint = endpoint
        self._here = here
        self._patience = patience
        self._take = take
        self._ended = ended
        self._has_ended = self._waits = False
        self._failures: list[str] = []
        self._wanted = TransferPart(assignment.spec.name, 0, 0, 0, 0, 0, b"")
        now = clocks.boot_time()
        self._deadline, self._host_by = now + LONGEST, now + self._patience

    def cancel(self) -> None:
        """Ask for no further part; `ended` is not called."""
        self._has_ended = True

    def leave_out(self, seconds: float) -> None:
        """Do not count the seconds of a suspend of this machine."""
        self._deadline += seconds
        self._host_by += seconds

    def advance(self, now: float) -> None:
        """Ask for the next part, or try the next host if this one does not answer."""
        if self._has_ended:
            return
        if now >= self._deadline:
            self._next_host(f"it takes longer than {LONGEST:g} s", now, last=True)
        elif not self._hosts:
            self._end("")
        elif not self._waits:
            host = self._hosts[0]
            if self._endpoint.finds_source(host, self._wanted.process, now):
                self._waits = True
                self._endpoint.ask(host, self._wanted, now, self._patience, self._answered)
            elif now >= self._host_by:
                self._next_host(f"its slave was not found within {self._patience:g} s", now)

    def _answered(self, part: TransferPart | NotSent) -> None:
        if self._has_ended:
            return
        now = clocks.boot_time()
        if isinstance(part, NotSent) and part.is_stale:
            self._waits, self._host_by = False, now + self._patience
        elif isinstance(part, NotSent):
            self._next_host(part.message, now)
        elif part.number < self._assignment.snapshots_from or not part.data:
            self._next_host("its snapshot is of an earlier process of that name", now)
        elif part.number > self._assignment.instance.number:
            self._next_host(f"its snapshot is of a later instance, {part.number}", now)
        elif part.offset == 0 and self._here is not None and self._here.age >= part.age:
            self._next_host("its snapshot is not newer than the one here", now)
        else:
            self._take(part, partial(self._taken, part))

    def _taken(self, part: TransferPart, refusal: NotStored | None) -> None:
        if self._has_ended:
            return
        now = clocks.boot_time()
        if refusal is not None:
            self._next_host(refusal.message, now)
        elif part.is_last:
            self._end(
                f"the state of {part.process}#{part.number}, cycle {part.sequence}, was fetched "
                f"from {self._hosts[0]} for {self._assignment.instance}"
            )
        else:
            self._wanted = part._replace(offset=part.offset + len(part.data), data=b"")
            self._waits = False
            self.advance(now)

    def _next_host(self, why: str, now: float, *, last: bool = False) -> None:
        self._failures.append(f"{self._hosts.pop(0)}: {why}" if self._hosts else why)
        self._wanted = TransferPart(self._assignment.spec.name, 0, 0, 0, 0, 0, b"")
        self._waits = False
        self._host_by = now + self._patience
        if last or not self._hosts:
            self._end("")
        else:
            self.advance(now)

    def _end(self, good: str) -> None:
        self._has_ended = True
        here = self._here
        start = "from nothing" if here is None else f"from cycle {here.sequence}, which is here"
        why = "; ".join(self._failures) or "no other host keeps one"
        self._ended(
            good or f"no newer state for {self._assignment.instance}, it starts {start}: {why}"
        )
