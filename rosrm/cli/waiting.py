"""`--wait`: watches processes until there is nothing more to wait for."""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

import typer

from rosrm.config.units import Quantity
from rosrm.core.views import ProcessRow
from rosrm.errors import ConfigError
from rosrm.spelling import standing

if TYPE_CHECKING:
    from rosrm.ros.client import MasterClient

#: Seconds between two looks.
PERIOD: Final = 0.5

_FAILED: Final = frozenset({"failed", "cancelled", "stuck"})
#: Kinds of events by which a checkpoint or a restore ends; whether it was done.
_IMAGED: Final = {
    "checkpointed": True, "restored": True, "checkpoint_failed": False, "restore_failed": False,
    "cancelled": False,
}  # fmt: skip
_NOTEWORTHY: Final = _FAILED | {"set_aside", "unreachable"}


def longest(text: str) -> float:
    """A time-out from the command line, seconds; "" is none. Raises `ConfigError`."""
    try:
        return Quantity("duration", above=True).parse(text) if text else math.inf
    except ValueError as error:
        raise ConfigError(f"--timeout: {error}") from None


def wait_for(client: MasterClient, names: Sequence[str], longest: float) -> bool:
    """Watch until each job has ended and each service runs, saying what goes wrong on the way.

    Returns:
        Whether none of them failed and all were done in time.
    """
    deadline = time.monotonic() + longest
    said: dict[str, str] = {}
    while True:
        rows = {row.name: row for row in client.list(processes=True).processes}
        ours = [rows[name] for name in names if name in rows]
        _say_news(ours, said)
        waiting = [row for row in ours if not _is_done(row)]
        if not waiting or time.monotonic() >= deadline:
            _say_end(ours, waiting)
            return not waiting and all(row.state not in _FAILED for row in ours)
        time.sleep(PERIOD)


def wait_for_image(client: MasterClient, name: str, since: int) -> bool:
    """Watch until a checkpoint or a restore of a process has come to its end, and say how.

    Args:
        client: of the master.
        name: of the process.
        since: sequence of the newest event before that was asked for.

    Returns:
        Whether it was done.
    """
    said: dict[str, str] = {}
    while True:
        view = client.list(processes=True, events=True, process=name, after=since)
        for event in view.events:
            if event.kind in _IMAGED:
                typer.echo(event.message, err=not _IMAGED[event.kind])
                return _IMAGED[event.kind]
        _say_news([row for row in view.processes if row.name == name], said)
        time.sleep(PERIOD)


def _is_done(row: ProcessRow) -> bool:
    return row.state in _FAILED or row.state == ("finished" if row.kind == "job" else "running")


def _say_news(rows: Iterable[ProcessRow], said: dict[str, str]) -> None:
    for row in rows:
        if said.get(row.name) != row.state:
            said[row.name] = row.state
            if row.state in _NOTEWORTHY:
                why = f": {row.reason}" if row.reason else ""
                typer.echo(f"{row.name} {standing(row.state)}{why}", err=True)


def _say_end(rows: Sequence[ProcessRow], waiting: Sequence[ProcessRow]) -> None:
    counts = Counter(row.state.replace("_", " ") for row in rows)
    summary = ", ".join(f"{count} {state}" for state, count in sorted(counts.items()))
    typer.echo(summary or "all gone", file=sys.stdout)
    if waiting:
        some = ", ".join(row.name for row in waiting[:5])
        more = f" and {len(waiting) - 5} more" if len(waiting) > 5 else ""
        typer.echo(f"rosrm: the time is up; still waiting for {some}{more}", err=True)
