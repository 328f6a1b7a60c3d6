"""Queries to the master that it answers at any time, also during a journal stall."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

from rosrm.core.master import listing
from rosrm.core.master.applications.listing import application_rows
from rosrm.core.master.master_state import MasterState
from rosrm.core.master.migration.host_explanation import host_explanation
from rosrm.core.master.modes.switching import mode_rows
from rosrm.core.master.state.hosts import Host
from rosrm.journal.sqlite import SqliteJournal
from rosrm.master.answer_size import short_applications, short_events, short_processes
from rosrm.master.disclosure import disclosed
from rosrm.model.applications import ApplicationRow
from rosrm.model.records import StoredRecord
from rosrm.model.requester import Requester
from rosrm.model.rows import HOST_MARK, EventRow, Listing, PluginRow, ProcessRow
from rosrm.model.values import LARGEST_NUMBER
from rosrm.wording import first_line

#: Events in an answer, if the request names no number, and at most.
_DEFAULT_EVENTS: Final = 1000
_MOST_EVENTS: Final = 10_000


class MasterQueries:
    """Answers to read-only requests.

    Args:
        master: name of the master.
        state: the state of the master's core.
        journal: holds the events.
        plugins: rows of `rosrm plugins` for the master's own plugins.
        uptime: returns the seconds since the master's start.
        core_now: returns the time of the core's clock.
        has_artifact: returns True if the contents with a digest and a size are stored.
        trouble: returns the reason why the master accepts no new work; "" if it accepts work.
    """

    def __init__(
        self, master: str, state: MasterState, journal: SqliteJournal, plugins: Sequence[PluginRow],
        *, uptime: Callable[[], float], core_now: Callable[[], float], trouble: Callable[[], str],
        has_artifact: Callable[[str, int], bool] = lambda *_: False,
    ) -> None:  # fmt: skip
        self._master = master
        self._state = state
        self._journal = journal
        self._plugins = list(plugins)
        self._uptime = uptime
        self._core_now = core_now
        self._trouble = trouble
        self.has_artifact = has_artifact

    def snapshot(self, request: Any, by: Requester) -> Listing:
        """Return the requested listings, as far as the requester may read them."""
        now = self._core_now()
        state = self._state
        return Listing(
            master=self._master,
            uptime=self._uptime(),
            last_sequence=self._journal.last_sequence,
            trouble=self._trouble(),
            hosts=listing.host_rows(state, now) if request.hosts else (),
            processes=short_processes(self._processes(request.process, now, by))
            if request.processes
            else (),
            plugins=self._plugin_rows(request) if request.plugins else (),
            events=short_events(self._events(request, by)) if request.events else (),
            applications=short_applications(self._applications(by)) if request.applications else (),
            modes=mode_rows(state) if request.modes else (),
        )

    def _processes(self, name: str, now: float, by: Requester) -> list[ProcessRow]:
        rows = []
        if not name:
            rows = listing.process_rows(self._state, now)
        elif name in self._state.processes:
            rows = [listing.process_row(self._state, self._state.processes[name], now)]
        return [
            row if by.may_act_on(row.owner) else replace(row, reason=first_line(row.reason))
            for row in rows
        ]

    def _applications(self, by: Requester) -> list[ApplicationRow]:
        return [
            row if by.may_act_on(row.owner) else replace(row, pending={}, reason="", versions=())
            for row in application_rows(self._state)
        ]

    def _events(self, request: Any, by: Requester) -> list[EventRow]:
        stored = self._journal.records(
            after=min(request.after_sequence, LARGEST_NUMBER), process=request.process,
            host=request.host, newest=min(request.max_events or _DEFAULT_EVENTS, _MOST_EVENTS),
        )  # fmt: skip
        return [_event_row(one, by) for one in stored]

    def _plugin_rows(self, request: Any) -> list[PluginRow]:
        if not request.failing:
            return self._all_plugins()
        rows = [row for row in self._own_plugins() if row.state == "failing"]
        return rows + [row for host in self._state.hosts.hosts for row in _failing_rows(host)]

    def _own_plugins(self) -> list[PluginRow]:
        failing, now = self._state.plugins.failing, self._core_now()
        return [
            replace(row, state="failing", reason=known.reason(now))
            if (known := failing.get((row.kind, row.name))) is not None
            else row
            for row in self._plugins
        ]

    def _all_plugins(self) -> list[PluginRow]:
        rows = self._own_plugins()
        for host in self._state.hosts.hosts:
            described = host.description
            rows += [
                PluginRow("probe", one.name, "", "selected", f"scope {one.scope}", host.name)
                for one in described.resources
                if ("probe", one.name) not in host.failing
            ]
            rows += _failing_rows(host)
            rows += [
                PluginRow("probe", name, "", "absent", reason, host.name)
                for name, reason in described.absent.items()
            ]
        return rows

    def explain(self, name: str, by: Requester) -> str | None:
        """Return the explanation of a process as JSON, or of a host; None if it is unknown.

        Args:
            name: of the process; of a host after "host:".
        """
        if name.startswith(HOST_MARK):
            host = host_explanation(self._state, name.removeprefix(HOST_MARK), self._core_now())
            plain = json.loads(json.dumps(host))
            return json.dumps(disclosed(plain, details=by.is_operator)) if host else None
        explanation = listing.explanation(self._state, name, self._core_now())
        if explanation is None:
            return None
        details, reason = by.may_act_on(explanation["owner"]), explanation["reason"]
        plain = json.loads(json.dumps(explanation, default=dict))
        shown = disclosed(plain, details=details)
        return json.dumps({**shown, "reason": reason if details else first_line(reason)})

    # --- for introductions ---------------------------------------------------------------

    def host_of(self, process: str, number: int) -> str | None:
        """Return the host of an instance; None: there is no such instance."""
        instance = self._state.instances.get(number)
        if instance is None or instance.id.process != process:
            return None
        return instance.host.name

    def first_readable_log(self, process: str, by: Requester) -> int | None:
        """Return the lowest number of an instance whose log a user may read; None: it may not.

        Only an operator may read the logs of a removed process, and of former owners of its name.
        """
        if by.is_operator:
            return 0
        known = self._state.processes.get(process)
        return None if known is None or not by.may_act_on(known.principal) else known.owned_from

    def has_held(self, process: str, host: str) -> bool:
        """Return True if an instance of a process runs on a host, or ended there last."""
        known = self._state.processes.get(process)
        if known is None:
            return False
        return host == known.ended_on or any(
            one.host.name == host for one in self._state.instances_of(known)
        )

    def number_of(self, host: str) -> int | None:
        """Return the number of a host; None: there is no host of that name."""
        known = self._state.hosts.by_name.get(host)
        return None if known is None else known.host_id


def _failing_rows(host: Host) -> list[PluginRow]:
    """Return the failing plugins of a host; a probe is named by the resource that it reads."""
    return [
        PluginRow(kind, name, "", "failing", known.error, host.name)
        for (kind, name), known in host.failing.items()
    ]


def _event_row(stored: StoredRecord, by: Requester) -> EventRow:
    record = stored.record
    details = by.may_act_on(record.facts.get("owner", ""))
    return EventRow(
        stored.sequence, stored.wall_time, stored.elapsed, record.kind, record.process,
        record.host, disclosed(record.message, details=details),
        disclosed(record.facts, details=details),
    )  # fmt: skip
