"""Waits for states of processes and hosts, until they are reached or can no longer be."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

from rosrm import clocks
from rosrm.client.event_feed import EventFeed
from rosrm.client.retrying import PERIOD, Notify, ask_until_answered, deadline_after
from rosrm.model.applications import ApplicationRow
from rosrm.model.event_kinds import EventKind
from rosrm.model.modes import ModeRow
from rosrm.model.rows import EventRow, Listing, ProcessRow
from rosrm.wording import standing

if TYPE_CHECKING:
    from rosrm.ros.master_connection import MasterClient, OnWait

#: Seconds for which a process is set aside before it counts as waiting for a host that may never
#: come: just after the start of a cluster its hosts are still registering.
SETTLED: Final = 5.0

#: Awaited state of a process. "settled": a job has ended, a service runs; "ended": the process has
#: ended, whatever the cause.
Until = Literal["settled", "ended"]
#: Takes the row of an awaited process, first and with each change of its state.
OnChange = Callable[[ProcessRow], None]
_Verdict = Literal["done", "failed", "awaited"]
#: Identity of one run of a process: number of the instance, pid, restarts.
_Identity = tuple[int, int, int]

#: States of a process that only a restart ends.
ENDED: Final = frozenset({"finished", "failed", "cancelled"})
#: States that only a request of a user ends.
UNTIL_ASKED: Final = frozenset({"failed", "cancelled", "stuck", "checkpointed"})
#: Kinds of events by which a checkpoint, a restore or a migration ends; True: it succeeded.
_ENDINGS: Final[Mapping[str, bool]] = {
    EventKind.CHECKPOINTED: True, EventKind.RESTORED: True, EventKind.MIGRATED: True,
    EventKind.CHECKPOINT_FAILED: False, EventKind.RESTORE_FAILED: False, EventKind.STAYED: False,
    EventKind.CANCELLED: False, EventKind.MIGRATION_FORGOTTEN: False,
}  # fmt: skip


@dataclass(frozen=True)
class WaitResult:
    """Result of a wait; true if everything awaited has happened.

    Attributes:
        done: everything awaited has happened.
        timed_out: the time-out passed before.
        pending: names that are still awaited. Where no time-out passed, these processes are set
            aside, and only another host or a change of one can help.
        failed: names of the processes that can no longer reach the awaited state.
        missing: names that left the list of the master before they were seen done.
        processes: the last row of each process that is listed.
        event: the event that ended the wait, of a migration or a drain.
        message: result of a migration or a drain; "" after a time-out.
    """

    done: bool
    timed_out: bool = False
    pending: Sequence[str] = ()
    failed: Sequence[str] = ()
    missing: Sequence[str] = ()
    processes: Sequence[ProcessRow] = ()
    event: EventRow | None = None
    message: str = ""

    def __bool__(self) -> bool:
        """Return `done`."""
        return self.done


# --- processes --------------------------------------------------------------------------------


def wait_for_processes(
    master: MasterClient, names: Sequence[str], until: Until, *, timeout: float | None,
    previous: Iterable[ProcessRow] | None, on_change: OnChange, notify: Notify,
) -> WaitResult:  # fmt: skip
    """Watch processes until none of them is awaited, or none can change without a user.

    Args:
        master: to ask.
        names: of the processes.
        until: what is awaited of each.
        timeout: seconds; None: no limit.
        previous: rows from before a restart; each process, a job too, is then awaited until it runs
            in another run than its row there. None: there was no restart.
        on_change: takes rows that are not done, with each change of their states.
        notify: takes a message when the master is silent.
    """
    deadline = deadline_after(timeout)
    before = (
        None
        if previous is None
        else {row.name: _identity(row) for row in previous if row.state not in ENDED}
    )
    changes = _Changes(on_change)
    verdicts: dict[str, _Verdict] = {}
    while True:
        view = ask_until_answered(
            lambda on_wait: master.list(processes=True, on_wait=on_wait), notify, deadline
        )
        rows = {row.name: row for row in view.processes}
        ours = [rows[name] for name in names if name in rows]
        verdicts.update((row.name, _judge(row, until, before)) for row in ours)
        changes.report(row for row in ours if verdicts[row.name] != "done")
        awaited = [row for row in ours if verdicts[row.name] == "awaited"]
        stays = all(row.state == "set_aside" and row.since >= SETTLED for row in awaited)
        if stays or clocks.boot_time() >= deadline:
            failed = [row.name for row in ours if verdicts[row.name] == "failed"]
            # A process that is no longer listed does not run: that is what "ended" awaits.
            gone = () if until == "ended" else [name for name in names if name not in rows]
            missing = [name for name in gone if verdicts.get(name) != "done"]
            return WaitResult(
                done=not awaited and not failed and not missing, timed_out=not stays,
                pending=[row.name for row in awaited], failed=failed, missing=missing,
                processes=ours,
            )  # fmt: skip
        time.sleep(PERIOD)


def wait_for_applications(
    master: MasterClient, names: Sequence[str], *, timeout: float | None,
    on_change: Callable[[ApplicationRow], None], notify: Notify,
) -> Sequence[ApplicationRow]:  # fmt: skip
    """Watch applications until no process of them is to be changed; return the last rows.

    Args:
        master: to ask.
        names: of the applications.
        timeout: seconds; None: no limit.
        on_change: takes a row with each change of its pending processes.
        notify: takes a message when the master is silent.
    """

    def is_done(view: Listing) -> bool:
        rows = [row for row in view.applications if row.name in names]
        return not any(row.state in ("applying", "returning") for row in rows)

    view = _watch(master, is_done, names, timeout, on_change, notify)
    return [row for row in view.applications if row.name in names]


def wait_for_mode(
    master: MasterClient, *, timeout: float | None, on_change: Callable[[ApplicationRow], None],
    notify: Notify,
) -> Sequence[ModeRow]:  # fmt: skip
    """Watch the modes until no switch is under way; otherwise as `wait_for_applications`."""

    def is_done(view: Listing) -> bool:
        return not any(row.state == "switching" for row in view.modes)

    return _watch(master, is_done, None, timeout, on_change, notify).modes


def _watch(
    master: MasterClient, is_done: Callable[[Listing], bool], names: Collection[str] | None,
    timeout: float | None, on_change: Callable[[ApplicationRow], None], notify: Notify,
) -> Listing:  # fmt: skip
    """List applications and modes until something is done, and report changes of the former.

    Args:
        names: of the applications; None: all.
    """
    deadline = deadline_after(timeout)
    seen: dict[str, tuple[int, Mapping[str, str]]] = {}
    while True:
        view = ask_until_answered(
            lambda on_wait: master.list(applications=True, modes=True, on_wait=on_wait),
            notify, deadline,
        )  # fmt: skip
        for row in view.applications:
            if names is not None and row.name not in names:
                continue
            if row.pending and seen.get(row.name) != (row.version, row.pending):
                on_change(row)
            seen[row.name] = row.version, row.pending
        if is_done(view) or clocks.boot_time() >= deadline:
            return view
        time.sleep(PERIOD)


def _judge(
    row: ProcessRow, until: Until, before: Mapping[str, _Identity] | None
) -> _Verdict:  # fmt: skip
    if until == "ended":
        return "done" if row.state in ENDED else "awaited"
    if row.state in UNTIL_ASKED:
        return "failed"
    if row.state == "scheduled":  # between two runs
        return "failed" if row.exit_code else "done"
    if row.state == "finished":  # a service that has finished is not started again
        return "done" if row.kind == "job" else "failed"
    if row.state != "running":
        return "awaited"
    is_done = row.kind != "job" if before is None else before.get(row.name) != _identity(row)
    return "done" if is_done else "awaited"


def _identity(row: ProcessRow) -> _Identity:
    return row.number, row.pid, row.restarts


class _Changes:
    """Reports each state of a process once."""

    def __init__(self, on_change: OnChange) -> None:
        self._on_change = on_change
        self._reported: dict[str, str] = {}

    def report(self, rows: Iterable[ProcessRow]) -> None:
        for row in rows:
            if self._reported.get(row.name) != row.state:
                self._reported[row.name] = row.state
                self._on_change(row)


# --- migrations and drains --------------------------------------------------------------------


def wait_for_migration(
    master: MasterClient, name: str, *, after: int, timeout: float | None, on_change: OnChange,
    notify: Notify,
) -> WaitResult:  # fmt: skip
    """Watch until a checkpoint, a restore or a migration of a process has ended.

    Args:
        master: to ask.
        name: of the process.
        after: sequence of the newest event before the request.
        timeout: seconds; None: no limit.
        on_change: takes the row of the process with each change of its state.
        notify: takes a message when the master is silent.
    """
    changes, seen = _Changes(on_change), _Seen(master, after, lambda one: one.process == name)

    def look(on_wait: OnWait) -> WaitResult:
        view = seen.look(on_wait)
        for event in seen.events:
            if event.kind in _ENDINGS:
                return WaitResult(_ENDINGS[event.kind], event=event, message=event.message)
        ours = [row for row in view.processes if row.name == name]
        changes.report(ours)
        if not ours or ours[0].state in ENDED:
            state = standing(ours[0].state) if ours else "is no longer listed"
            return WaitResult(False, message=f"no longer waiting: {name} {state}")
        return WaitResult(False, pending=[name], processes=ours)

    return _look_until(look, timeout, notify)


def wait_for_drain(
    master: MasterClient, host: str, *, after: int, timeout: float | None, notify: Notify
) -> WaitResult:
    """Watch until a host is drained; done if no process has stayed there.

    The arguments are those of `wait_for_migration`.
    """
    seen = _Seen(master, after, lambda one: one.host == host)

    def look(on_wait: OnWait) -> WaitResult:
        view = seen.look(on_wait)
        row = next((row for row in view.hosts if row.description.name == host), None)
        staying = [row for row in view.processes if row.host == host and row.state not in ENDED]
        if row is not None and row.drained:
            drained = [event for event in seen.events if event.kind == EventKind.HOST_DRAINED]
            event = drained[-1] if drained else None
            message = event.message if event else f"{host} is drained"
            return WaitResult(not staying, processes=staying, event=event, message=message)
        if row is None or not row.draining:
            return WaitResult(False, message=f"{host} is no longer draining")
        return WaitResult(False, pending=[row.name for row in staying] or [host])

    return _look_until(look, timeout, notify)


class _Seen:
    """Hosts and processes of the cluster, and the selected events since a sequence.

    Attributes:
        events: the events, the oldest first.
    """

    def __init__(
        self, master: MasterClient, after: int, selects: Callable[[EventRow], bool]
    ) -> None:
        self._master, self._selects = master, selects
        self._on_wait: OnWait | None = None
        self._feed = EventFeed(self._list, after, 0)
        self.events: list[EventRow] = []

    def look(self, on_wait: OnWait) -> Listing:
        self._on_wait = on_wait
        self.events += filter(self._selects, self._feed.new())
        return self._feed.listing

    def _list(self, after: int, newest: int) -> Listing:
        return self._master.list(
            hosts=True, processes=True, events=True, after=after, newest=newest,
            on_wait=self._on_wait,
        )  # fmt: skip


def _look_until(
    look: Callable[[OnWait], WaitResult], timeout: float | None, notify: Notify
) -> WaitResult:
    """Return the first result of `look` without pending names, or the last one in time."""
    deadline = deadline_after(timeout)
    while (result := ask_until_answered(look, notify, deadline)).pending:
        if clocks.boot_time() >= deadline:
            return replace(result, timed_out=True)
        time.sleep(PERIOD)
    return result
