"""`--wait`: watches processes or a host until nothing that is awaited can change any more."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import typer

from rosrm.cli.patience import PERIOD, ask_until_answered
from rosrm.errors import ConfigError
from rosrm.extensions.units import Quantity
from rosrm.model.event_kinds import EventKind
from rosrm.model.rows import ProcessRow
from rosrm.wording import listed, standing

if TYPE_CHECKING:
    from rosrm.ros.client import MasterClient

#: Seconds for which a process is set aside before it counts as waiting for a host that may never
#: come: just after the start of a cluster its hosts are still registering.
SETTLED: Final = 5.0

#: Judges a process: "done", "failed", or "awaited".
Judge = Callable[[ProcessRow], str]
#: What makes one run of a process: number of the instance, pid, restarts.
Identity = tuple[int, int, int]

_OVER: Final = frozenset({"finished", "failed", "cancelled"})
#: States that only a request of a user ends.
_UNTIL_ASKED: Final = frozenset({"failed", "cancelled", "stuck", "checkpointed"})
#: Kinds of events by which a checkpoint, a restore or a migration ends; whether it was done.
_ENDINGS: Final[Mapping[str, bool]] = {
    EventKind.CHECKPOINTED: True, EventKind.RESTORED: True, EventKind.MIGRATED: True,
    EventKind.CHECKPOINT_FAILED: False, EventKind.RESTORE_FAILED: False, EventKind.STAYED: False,
    EventKind.CANCELLED: False, EventKind.MIGRATION_FORGOTTEN: False,
}  # fmt: skip
_NOTEWORTHY: Final = _UNTIL_ASKED | {"set_aside", "unreachable", "unknown"}


def longest(text: str) -> float:
    """A time-out from the command line, seconds; "" is none. Raises `ConfigError`."""
    try:
        return Quantity("duration", above=True).parse(text) if text else math.inf
    except ValueError as error:
        raise ConfigError(f"--timeout: {error}") from None


@contextmanager
def interruptible(what_follows: str) -> Iterator[None]:
    """Within, a Ctrl-C ends the waiting alone; a message to the user has what follows."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"rosrm: no longer waiting; {what_follows}", err=True)
        raise


# --- what is awaited --------------------------------------------------------------------------


def settled(row: ProcessRow) -> str:
    """Judge by the end of a job and by the running of a service."""
    if row.state in _UNTIL_ASKED:
        return "failed"
    if row.state == "finished":  # a service that has finished is not started again
        return "done" if row.kind == "job" else "failed"
    return "done" if row.kind != "job" and row.state == "running" else "awaited"


def over(row: ProcessRow) -> str:
    """Judge by the end of a process, whatever its cause."""
    return "done" if row.state in _OVER else "awaited"


def restarted(before: Mapping[str, Identity]) -> Judge:
    """Judge by another run than `before`, which holds the processes that had not ended then."""

    def judge(row: ProcessRow) -> str:
        if before.get(row.name) == identity(row) and row.state not in _UNTIL_ASKED | _OVER:
            return "awaited"
        return "done" if row.state == "running" else settled(row)

    return judge


def identity(row: ProcessRow) -> Identity:
    """Return the values that differ between two runs of a process."""
    return row.number, row.pid, row.restarts


# --- waiting ----------------------------------------------------------------------------------


def wait_for(
    client: MasterClient, names: Sequence[str], longest: float, judge: Judge = settled,
    *, missing: str = "failed",
) -> bool:  # fmt: skip
    """Watch processes until none of them is awaited, or none can change without a user.

    Args:
        client: of the master.
        names: of the processes.
        longest: seconds.
        judge: what is awaited of each.
        missing: verdict on a process that left the list before a look found it done.

    Returns:
        Whether all were done in time.
    """
    deadline = time.monotonic() + longest
    said: dict[str, str] = {}
    verdicts: dict[str, str] = {}
    while True:
        listed_now = ask_until_answered(lambda: client.list(processes=True), deadline)
        rows = {row.name: row for row in listed_now.processes}
        ours = [rows[name] for name in names if name in rows]
        verdicts.update((row.name, judge(row)) for row in ours)
        _say_news((row for row in ours if verdicts[row.name] != "done"), said)
        unseen = [
            name
            for name in names
            if name not in rows and "done" not in (verdicts.get(name), missing)
        ]
        awaited = [row for row in ours if verdicts[row.name] == "awaited"]
        stays = all(row.state == "set_aside" and row.since >= SETTLED for row in awaited)
        if stays or time.monotonic() >= deadline:
            failed = [row for row in ours if verdicts[row.name] == "failed"]
            _say_end(ours, awaited, failed, stays=stays)
            if unseen:
                typer.echo(
                    f"rosrm: no longer listed, and not seen to be done: {listed(unseen)} "
                    f"(`rosrm events --process NAME` shows what happened)",
                    err=True,
                )
            return not awaited and not failed and not unseen
        time.sleep(PERIOD)


def wait_for_ending(client: MasterClient, name: str, since: int, longest: float) -> bool:
    """Watch until a checkpoint, a restore or a migration of a process has ended, and say how.

    Args:
        client: of the master.
        name: of the process.
        since: sequence of the newest event before that was asked for.
        longest: seconds.

    Returns:
        Whether it was done in time.
    """
    said: dict[str, str] = {}

    def look() -> bool | Sequence[str]:
        view = client.list(processes=True, events=True, process=name, after=since)
        for event in view.events:
            if event.kind in _ENDINGS:
                typer.echo(event.message, err=not _ENDINGS[event.kind])
                return _ENDINGS[event.kind]
        ours = [row for row in view.processes if row.name == name]
        _say_news(ours, said)
        if not ours or ours[0].state in _OVER:
            state = standing(ours[0].state) if ours else "is no longer listed"
            typer.echo(f"rosrm: no longer waiting: {name} {state}", err=True)
            return False
        return [name]

    return _look_until(longest, look)


def wait_until_drained(client: MasterClient, host: str, since: int, longest: float) -> bool:
    """Watch until a host is drained, and say what has stayed there.

    Returns:
        Whether it was drained in time and nothing has stayed there.
    """

    def look() -> bool | Sequence[str]:
        view = client.list(hosts=True, processes=True, events=True, host=host, after=since)
        row = next((row for row in view.hosts if row.description.name == host), None)
        staying = [row for row in view.processes if row.host == host and row.state not in _OVER]
        if row is not None and row.drained:
            told = [event.message for event in view.events if event.kind == EventKind.HOST_DRAINED]
            typer.echo(told[-1] if told else f"{host} is drained", err=bool(staying))
            return not staying
        if row is None or not row.draining:
            typer.echo(f"rosrm: {host} is no longer draining", err=True)
            return False
        return [row.name for row in staying] or [host]

    return _look_until(longest, look)


def _look_until(longest: float, look: Callable[[], bool | Sequence[str]]) -> bool:
    """Return the outcome that `look` comes to; until then it returns the names still awaited."""
    deadline = time.monotonic() + longest
    while not isinstance(seen := ask_until_answered(look, deadline), bool):
        if time.monotonic() >= deadline:
            _say_time_is_up(seen)
            return False
        time.sleep(PERIOD)
    return seen


# --- messages ---------------------------------------------------------------------------------


def _say_news(rows: Iterable[ProcessRow], said: dict[str, str]) -> None:
    for row in rows:
        if said.get(row.name) != row.state:
            said[row.name] = row.state
            if row.state in _NOTEWORTHY:
                why = f": {row.reason}" if row.reason else ""
                typer.echo(f"{row.name} {standing(row.state)}{why}", err=True)


def _say_end(
    rows: Sequence[ProcessRow], awaited: Sequence[ProcessRow], failed: Sequence[ProcessRow],
    *, stays: bool,
) -> None:  # fmt: skip
    counts = Counter(row.state.replace("_", " ") for row in rows)
    summary = ", ".join(f"{count} {state}" for state, count in sorted(counts.items()))
    typer.echo(summary or "all processes were removed")
    ended = [row.name for row in failed if row.state == "finished"]
    if ended:
        typer.echo(
            f"rosrm: services that finished: {listed(ended)}; declare a program that is meant to "
            f"end as `kind: job`",
            err=True,
        )
    waited = [row.name for row in awaited]
    if waited and stays:
        typer.echo(
            f"rosrm: no longer waiting for {listed(waited)}: set aside until a host registers or "
            f"changes (`rosrm explain NAME` shows the requirements)",
            err=True,
        )
    elif waited:
        _say_time_is_up(waited)


def _say_time_is_up(awaited: Sequence[str]) -> None:
    typer.echo(f"rosrm: --timeout has passed; still waiting for {listed(awaited)}", err=True)
