"""Run of `rosrm up`: start, submission, one line for each event that matters, end."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Final

import typer

from rosrm.cli.output.plain import echo
from rosrm.cli.output.tables import event_line
from rosrm.cli.process import INTERRUPTED
from rosrm.cli.up.cluster import UpCluster
from rosrm.client.waiting import ENDED
from rosrm.errors import NoMaster
from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow
from rosrm.model.values import ProcessSpec
from rosrm.wording import amount, counted, listed

#: Seconds between two polls of events and parts.
_PERIOD: Final = 0.3
#: Number of events in one listing that leaves out none, as in `List.srv`.
_ALL_NEW: Final = 2**32 - 1
_UNITS: Final = {"memory": "B", "disk": "B", "cpu": "core"}
#: Kinds of events that are shown: starts and ends of processes, moves, and problems.
_SHOWN: Final = frozenset({
    EventKind.READY, EventKind.RUNNING, EventKind.REACHABLE, EventKind.BACKOFF, EventKind.FINISHED,
    EventKind.FAILED, EventKind.CANCELLED, EventKind.OVERDUE, EventKind.WAITS, EventKind.SET_ASIDE,
    EventKind.FENCED, EventKind.GIVEN_UP, EventKind.SEPARATED, EventKind.PREEMPTED,
    EventKind.HOST_REFUSED, EventKind.HOST_SUSPECT, EventKind.HOST_BACK, EventKind.HOST_LOST,
    EventKind.HOST_LEFT, EventKind.HOST_DETACHED, EventKind.READING_REFUSED, EventKind.OVER_LIMIT,
    EventKind.UNDER_LIMIT, EventKind.NOTHING_MOVES, EventKind.DEVICE_MISSING,
    EventKind.DEVICE_FOUND, EventKind.MIGRATION_STUCK, EventKind.MIGRATED, EventKind.STAYED,
    EventKind.FAILED_OVER, EventKind.STANDBY_READY, EventKind.STANDBY_LOST, EventKind.CHECKPOINTED,
    EventKind.CHECKPOINT_FAILED, EventKind.RESTORED, EventKind.RESTORE_FAILED,
    EventKind.PEER_REFUSED, EventKind.JOURNAL_BACK, EventKind.JOURNAL_BEHIND,
    EventKind.SETTINGS_RELOADED, EventKind.RELOAD_REFUSED, EventKind.PLUGIN_FAILED,
    EventKind.PLUGIN_WORKS,
})  # fmt: skip


class _Stopped(BaseException):
    """A signal asks for the end of the cluster."""


class _Hurried(BaseException):
    """A second signal asks for the end at once."""


def serve(cluster: UpCluster, specs: Sequence[ProcessSpec]) -> None:
    """Start a cluster, submit processes, and show events until a signal; then end the cluster.

    Raises:
        typer.Exit: a second signal has killed the cluster.
        RosrmError: a part was refused or has ended, or the processes were refused.
    """
    with _signals():
        try:
            try:
                _run(cluster, specs)
            except _Stopped:
                _say("ending: the processes stop first; Ctrl-C again kills everything at once")
            finally:
                cluster.end()
        except _Hurried:
            cluster.kill()
            _say("killed all processes, and every part of rosrm")
            raise typer.Exit(INTERRUPTED) from None
    _say("ended; nothing runs any more")


@contextmanager
def _signals() -> Iterator[None]:
    """Turn the first signal into `_Stopped`, the second into `_Hurried`, and ignore others."""
    left: list[type[BaseException]] = [_Stopped, _Hurried]

    def handle(_number: int, _frame: FrameType | None) -> None:
        if left:
            raise left.pop(0)

    ending = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, handle) for number in ending}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(cluster: UpCluster, specs: Sequence[ProcessSpec]) -> None:
    cluster.start()
    _say(_ready(cluster))
    after = cluster.client.list().last_sequence
    _submit(cluster, specs)
    while True:
        cluster.check_parts()
        for event in _new_events(cluster, after):
            after = event.sequence
            if event.kind in _SHOWN:
                _print(event_line(event))
        cluster.client.spin(_PERIOD)


def _ready(cluster: UpCluster) -> str:
    budget = listed(
        f"{amount(size, _UNITS[name])} of {name}" if name != "cpu" else amount(size, "core")
        for name, size in cluster.hosts[0].budget.items()
    )
    each = "each with" if len(cluster.hosts) > 1 else "with"
    names = listed(host.host for host in cluster.hosts)
    return (
        f"ready: {names}, {each} {budget}; {cluster.ros.describe()}\n"
        f"`rosrm ps` in another terminal lists the processes; Ctrl-C here ends everything"
    )


def _submit(cluster: UpCluster, specs: Sequence[ProcessSpec]) -> None:
    """Submit processes, except those that a kept state directory has already."""
    if not specs:
        return
    rows = cluster.client.list(processes=True).processes
    known = {row.name for row in rows if row.state not in ENDED}
    new = [spec for spec in specs if spec.name not in known]
    if len(new) < len(specs):
        _say(f"{counted(len(specs) - len(new), 'process', 'processes')} queued or running already")
    if new:
        _say(cluster.client.submit(new))


def _new_events(cluster: UpCluster, after: int) -> Sequence[EventRow]:
    try:
        return cluster.client.list(events=True, after=after, newest=_ALL_NEW).events
    except NoMaster as error:
        cluster.check_parts()  # the error of a master that has ended says more
        _say(str(error))
        return ()


def _say(text: str) -> None:
    """Print a line of this command with the time, as a line of an event has it."""
    now = time.strftime("%H:%M:%S")
    _print(f"{now}  " + text.replace("\n", f"\n{'':{len(now) + 2}}"))


def _print(text: str) -> None:
    with suppress(OSError):  # a closed terminal must not prevent the end
        echo(text)
