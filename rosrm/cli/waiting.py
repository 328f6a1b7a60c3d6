"""Output of `--wait`: progress and result of a wait."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import typer

from rosrm.cli.options import seconds_of
from rosrm.cli.output.plain import echo
from rosrm.client.waiting import UNTIL_ASKED, WaitResult
from rosrm.errors import NoMaster
from rosrm.model.rows import ProcessRow
from rosrm.wording import listed, standing, words

_NOTEWORTHY: Final = UNTIL_ASKED | {"set_aside", "unreachable", "unknown"}


def longest(text: str) -> float | None:
    """Return the option --timeout in seconds, None for ""; raises `ConfigError`."""
    return seconds_of("--timeout", text) if text else None


@contextmanager
def interruptible(what_follows: str) -> Iterator[None]:
    """Return a context in which Ctrl-C ends only the wait; print what continues."""
    try:
        yield
    except KeyboardInterrupt:
        echo(f"rosrm: no longer waiting; {what_follows}", err=True)
        raise
    except NoMaster as error:
        raise NoMaster(f"--timeout has passed: {error}") from None


def show_change(row: ProcessRow) -> None:
    """Print the state of an awaited process if it needs the user's attention."""
    if row.state in _NOTEWORTHY:
        why = f": {row.reason}" if row.reason else ""
        echo(f"{row.name} {standing(row.state)}{why}", err=True)


def show_processes(result: WaitResult) -> None:
    """Print the result of a wait for processes; exit with 1 if they are not done."""
    counts = Counter(words(row.state) for row in result.processes)
    summary = ", ".join(f"{count} {state}" for state, count in sorted(counts.items()))
    echo(summary or "all processes were removed")
    states = {row.name: row.state for row in result.processes}
    ended = [name for name in result.failed if states[name] == "finished"]
    if ended:
        echo(
            f"rosrm: services that finished: {listed(ended)}; declare a program that is meant to "
            f"end as `kind: job`",
            err=True,
        )
    if result.pending and not result.timed_out:
        echo(
            f"rosrm: no longer waiting for {listed(result.pending)}: set aside until a host "
            f"registers or changes (`rosrm explain NAME` shows the requirements)",
            err=True,
        )
    elif result.pending:
        _say_time_is_up(result.pending)
    if result.missing:
        echo(
            f"rosrm: no longer listed, and not seen to be done: {listed(result.missing)} "
            f"(`rosrm events --process NAME` shows what happened)",
            err=True,
        )
    _exit_unless_done(result)


def show_end(result: WaitResult) -> None:
    """Print the result of a migration or drain; exit with 1 if it is not done."""
    if result.pending:
        _say_time_is_up(result.pending)
    elif result.done or result.event:
        echo(result.message, err=not result.done)
    else:
        echo(f"rosrm: {result.message}", err=True)
    _exit_unless_done(result)


def _exit_unless_done(result: WaitResult) -> None:
    if not result:
        raise typer.Exit(1)


def _say_time_is_up(awaited: Sequence[str]) -> None:
    echo(f"rosrm: --timeout has passed; still waiting for {listed(awaited)}", err=True)
