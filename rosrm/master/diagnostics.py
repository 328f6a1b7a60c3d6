"""Diagnostic statuses over time: all of them once a second, and each change of a level at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Final

from rosrm.core.master.diagnostics import diagnostics, of_subject
from rosrm.core.master.master_state import MasterState
from rosrm.model.diagnostics import Diagnostic, Level, Subject
from rosrm.model.records import Record

#: Seconds between two messages with all statuses; monitors take a silent publisher for stale.
_PERIOD: Final = 1.0


class DiagnosticsFeed:
    """Decides which statuses are published, and when.

    An event names the host and the process that may have changed, so a change costs no search. A
    change without an event, such as a usage near a limit, is published within a second. Nothing is
    computed while the topic has no reader; a new reader gets all statuses within a second.

    Args:
        state: state of the master's core; read-only here.
        master: name of the master.
        publish: sends statuses.
        has_reader: returns True if another node reads them.
    """

    def __init__(
        self, state: MasterState, master: str, publish: Callable[[Sequence[Diagnostic]], None],
        has_reader: Callable[[], bool],
    ) -> None:  # fmt: skip
        self._state = state
        self._master = master
        self._publish = publish
        self._has_reader = has_reader
        self._is_read = False
        self._levels: dict[Subject, Level] = {}
        self._noted: dict[Subject, None] = {}
        self._next = 0.0

    def note(self, records: Iterable[Record]) -> None:
        """Note the hosts and processes of events."""
        for record in records:
            if record.host:
                self._noted["host", record.host] = None
            if record.process:
                self._noted["process", record.process] = None

    def advance(self, now: float, core_now: float, trouble: str) -> None:
        """Publish what is due.

        Args:
            now: monotonic time.
            core_now: time of the core's clock.
            trouble: why the master accepts no new work; "": it does.
        """
        if now >= self._next:
            self._next = now + _PERIOD
            self._is_read = self._has_reader()
            if self._is_read:
                self._publish_all(core_now, trouble)
        elif self._noted and self._is_read:
            self._publish_changes(core_now)
        self._noted.clear()

    def _publish_all(self, core_now: float, trouble: str) -> None:
        found = diagnostics(self._state, core_now, self._master, trouble)
        levels = {one.subject: one.level for one in found}
        former = [
            of_subject(self._state, core_now, subject)
            for subject, level in self._levels.items()
            if level is not Level.OK and subject not in levels
        ]
        self._levels = levels
        self._publish([*found, *former])

    def _publish_changes(self, core_now: float) -> None:
        statuses = [of_subject(self._state, core_now, subject) for subject in self._noted]
        changed = [
            one for one in statuses if one.level is not self._levels.get(one.subject, Level.OK)
        ]
        self._levels.update({one.subject: one.level for one in changed})
        if changed:
            self._publish(changed)
