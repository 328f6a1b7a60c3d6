"""Run of `rosrm up`: start, submission, one line for each event that matters, end."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Final

import typer

from rosrm.cli.output.plain import echo
from rosrm.cli.output.tables import event_line
from rosrm.cli.process import INTERRUPTED
from rosrm.cli.up.cluster import UpCluster
from rosrm.client.event_feed import EventFeed
from rosrm.client.waiting import ENDED
from rosrm.errors import ConfigError, NoMaster, Refused, RosrmError
from rosrm.model.applications import Target
from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import EventRow, Listing
from rosrm.model.values import ProcessSpec
from rosrm.ros.spec_digests import digest_of
from rosrm.runtime.dispositions import handled
from rosrm.runtime.durable import replace_durably
from rosrm.wording import amount, counted, first_line, listed, reason_of

if TYPE_CHECKING:
    from typing_extensions import Self

#: Seconds between two polls of events and parts.
_PERIOD: Final = 0.3
#: Number of events in one listing that leaves out none, as in `List.srv`.
_ALL_NEW: Final = 2**32 - 1
#: File of the digests of submitted specs in the state directory: a changed job runs again.
_RECORD: Final = "submitted.json"
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
    EventKind.PLUGIN_WORKS, EventKind.APPLICATION_APPLIED, EventKind.APPLICATION_FAILED,
    EventKind.APPLICATION_RETURNS, EventKind.APPLICATION_CANCELLED, EventKind.MODE_BEGINS,
    EventKind.MODE_REACHED, EventKind.MODE_FAILED,
})  # fmt: skip


class _Stopped(BaseException):
    """A signal asks for the end of the cluster."""


class _Hurried(BaseException):
    """A second signal asks for the end at once."""


def serve(cluster: UpCluster, work: Sequence[Target]) -> None:
    """Start a cluster, start work, and show events until a signal; then end the cluster.

    Args:
        work: applications, and processes of none.

    Raises:
        typer.Exit: a second signal has killed the cluster.
        RosrmError: a part was refused or has ended, or the work was refused.
    """
    with _Signals() as signals:
        try:
            try:
                _run(cluster, work)
            except _Stopped:
                _say("ending: the processes stop first; Ctrl-C again kills everything at once")
            except RosrmError as error:
                _say(f"ending everything: {first_line(str(error))}")
                raise
            finally:
                signals.hurry_next()
                cluster.end()
        except _Hurried:
            cluster.kill()
            _say("killed all processes, and every part of rosrm")
            raise typer.Exit(INTERRUPTED) from None
    _say("ended; nothing runs any more")


class _Signals:
    """Turns a first signal into `_Stopped`, a further one into `_Hurried`, and ignores others."""

    def __init__(self) -> None:
        self._next: list[type[BaseException]] = [_Stopped, _Hurried]

    def __enter__(self) -> Self:
        ending = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        self._handled = handled(ending, self._handle)
        self._handled.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._handled.__exit__(None, None, None)

    def hurry_next(self) -> None:
        """Turn the next signal into `_Hurried`, because the end has begun."""
        self._next = [one for one in self._next if one is not _Stopped]

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        if self._next:
            raise self._next.pop(0)


def _run(cluster: UpCluster, work: Sequence[Target]) -> None:
    cluster.start()
    _say(_ready(cluster))
    feed = EventFeed(partial(_events, cluster), cluster.client.list().last_sequence, _ALL_NEW)
    work = [replace(one, specs=tuple(_sent(cluster, one.specs))) for one in work]
    _submit(cluster, [spec for one in work if not one.application for spec in one.specs])
    applications = [one for one in work if one.application]
    if applications:
        _say(cluster.client.apply(applications).message)
    while True:
        cluster.check_parts()
        for event in _new_events(cluster, feed):
            if event.kind in _SHOWN:
                _print(event_line(event))
        cluster.client.spin(_PERIOD)


def _ready(cluster: UpCluster) -> str:
    shares = cluster.hosts[0].budget
    budget = listed(
        _share(name, shares[name]) for name in ("memory", "cpu", "disk") if name in shares
    )
    each = "each with" if len(cluster.hosts) > 1 else "with"
    names = listed(host.host for host in cluster.hosts)
    return (
        f"ready: {names}, {each} {budget}; {cluster.ros.describe()}\n"
        f"`rosrm ps` in another terminal lists the processes; Ctrl-C here ends everything"
    )


def _share(resource: str, size: float) -> str:
    if resource == "cpu":
        return f"{size:.3g} {'core' if size == 1.0 else 'cores'}"
    return f"{amount(size, 'B')} of {resource}"


def _sent(cluster: UpCluster, specs: Sequence[ProcessSpec]) -> Sequence[ProcessSpec]:
    """Send the contents of artifacts to the master; return the specs with the digests."""
    if not any(one.source for spec in specs for one in spec.artifacts):
        return specs
    from rosrm.client.artifacts import send_artifacts  # noqa: PLC0415 - only for artifacts

    return send_artifacts(cluster.client, specs, _say)


def _submit(cluster: UpCluster, specs: Sequence[ProcessSpec]) -> None:
    """Submit processes, except those that a kept state directory has already."""
    if not specs:
        return
    rows = cluster.client.list(processes=True).processes
    alive = {row.name for row in rows if row.state not in ENDED}
    finished = {row.name for row in rows if row.state == "finished" and row.kind == "job"}
    record = cluster.directory / _RECORD
    former = _read_record(record)
    digests = {spec.name: digest_of(spec) for spec in specs}
    done = {name for name in finished if former.get(name, "") == digests.get(name)}
    new = [spec for spec in specs if spec.name not in alive | done]
    for names, what in ((alive, "queued or running already"), (done, "finished already")):
        if known := names & digests.keys():
            _say(f"{counted(len(known), 'process', 'processes')} {what}")
    if new:
        _say(cluster.client.submit(new))
        content = json.dumps(former | {spec.name: digests[spec.name] for spec in new})
        try:
            replace_durably(str(record), content.encode())
        except OSError as error:  # the processes run, and finished jobs may run again
            _say(
                f"{record} cannot be written: {reason_of(error)}; jobs that finish now run again "
                f"at the next `rosrm up`"
            )


def _read_record(path: Path) -> dict[str, str]:
    """Return the digests of the specs that were submitted last; {}: none are known."""
    try:
        return dict(json.loads(path.read_bytes()))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(
            f"{path}: {reason_of(error)}; remove the file, and finished jobs run again"
        ) from None


def _events(cluster: UpCluster, after: int, newest: int) -> Listing:
    return cluster.client.list(events=True, after=after, newest=newest)


def _new_events(cluster: UpCluster, feed: EventFeed) -> Sequence[EventRow]:
    try:
        return list(feed.new())
    except (NoMaster, Refused) as error:  # the request is valid, so any refusal may pass
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
