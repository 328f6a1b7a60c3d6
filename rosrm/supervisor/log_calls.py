"""The loop's side of the log files: a log folder without an answer delays only the starts.

A thread has the `LogKeeper`. Until a late folder answers, no log is opened, so no process starts.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial

from rosrm.core.supervisor.instance import Instance
from rosrm.core.supervisor.rules import Key
from rosrm.runtime.file_thread import Call, FileThread
from rosrm.supervisor import own_log, paths
from rosrm.supervisor.logs import BUSY, QUIET, LogKeeper, LogLimits, note_trace


class LogCalls:
    """Calls on the logs below one state directory.

    The number of queued calls is bounded, because each belongs to a log that was opened.

    Attributes:
        disk: the thread.
    """

    def __init__(self, state: str, limits: LogLimits, known: Mapping[Key, Instance]) -> None:
        self.disk = FileThread(paths.log_folder(state), report=own_log.write_fault)
        self._keeper = LogKeeper(state, limits, known)
        self._opened: dict[Key, int] = {}  # descriptors for the loop
        self._known: set[Key] = set()  # instances with something to release
        self._due: float | None = None
        self._look: Call[None] | None = None

    def limit(self, limits: LogLimits) -> None:
        """Change the limits of the logs."""
        self._keeper.limits = limits

    def prepare(self, instance: Key) -> None:
        """Open the log of an instance ahead of its start."""
        if not self.disk.is_late:
            self._known.add(instance)
            self.disk.tell(partial(self._keeper.prepare, instance))

    def open(self, instance: Key) -> int:
        """Open the log of a starting instance, see `LogKeeper.open`; `close` takes the descriptor.

        Raises:
            NoAnswer: the log is not open yet; the next call may return it.
            OSError: it cannot be opened.
        """
        self._known.add(instance)
        self.disk.ask(partial(self._open, instance))
        return self._opened.pop(instance)

    def _open(self, instance: Key) -> None:
        if instance not in self._opened:
            self._opened[instance] = self._keeper.open(instance)

    def close(self, log: int, stamps: str = "") -> None:
        """Close a log, which may wait for its disk; write the trace of a start before that."""

        def close() -> None:
            if stamps:
                note_trace(log, stamps)
            os.close(log)

        self.disk.tell(close)

    def note_adoption(self, instance: Key, pid: int) -> None:
        """Write into the log of an adopted process where its output goes."""
        self._known.add(instance)
        self.disk.tell(partial(self._keeper.note_adoption, instance, pid))

    def watch(self, instance: Key, now: float, started: int = 0) -> None:
        """Begin to check the log of a running instance, see `LogKeeper.watch`."""
        self._known.add(instance)
        self._due = now + BUSY
        self.disk.tell(partial(self._keeper.watch, instance, now, started))

    def release(self, instance: Key) -> None:
        """Check the log of an ended instance a last time, and stop watching it.

        Raises:
            OSError: the log cannot be checked or closed.
        """
        if instance in self._known:
            self._known.remove(instance)
            call = self.disk.begin(partial(self._release, instance))
            if self.disk.ends(call):
                call.result()

    def _release(self, instance: Key) -> None:
        log = self._opened.pop(instance, None)
        if log is not None:
            os.close(log)
        self._keeper.release(instance)

    def deadline(self) -> float | None:
        """Return the monotonic time of the next check; None: no process runs."""
        return self._due

    def look(self, now: float) -> None:
        """Check all logs if a check is due."""
        if self._due is None or now < self._due:
            return
        if self._look is None:
            self._look = self.disk.begin(partial(self._keeper.look, now))
        if not self.disk.ends(self._look):
            self._due = now + QUIET
            return
        look, self._look = self._look, None
        self._due = self._keeper.deadline()
        look.result()
