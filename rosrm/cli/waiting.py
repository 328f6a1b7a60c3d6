"""Output of `--wait`: progress and result of a wait."""

from __future__ import annotations

import queue
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Final, NoReturn, TypeVar

import typer

from rosrm import threads
from rosrm.cli.options import seconds_of
from rosrm.cli.output.plain import echo
from rosrm.client.waiting import UNTIL_ASKED, WaitResult
from rosrm.errors import NoMaster, RosrmError
from rosrm.model.rows import ProcessRow
from rosrm.wording import listed, standing, words

T = TypeVar("T")

#: Seconds for a look at files of this machine.
PATIENCE: Final = 10.0
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
        _say_time_is_up(result)
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
        _say_time_is_up(result)
    elif result.done or result.event:
        echo(result.message, err=not result.done)
    else:
        echo(f"rosrm: {result.message}", err=True)
    _exit_unless_done(result)


def _exit_unless_done(result: WaitResult) -> None:
    if not result:
        raise typer.Exit(1)


def _say_time_is_up(result: WaitResult) -> None:
    """Print what is still awaited, with the reason of each process that has one."""
    why = {row.name: f" ({row.reason})" for row in result.processes if row.reason}
    awaited = listed(f"{name}{why.get(name, '')}" for name in result.pending)
    echo(f"rosrm: --timeout has passed; still waiting for {awaited}", err=True)


def answered(call: Callable[[], T], what: str, seconds: float = PATIENCE) -> T:
    """Return the result of a call that a file system or the kernel may block.

    Args:
        call: stays in its thread if it does not return in time.
        what: subject of the message, e.g. "the search for a file".
        seconds: time-out.

    Raises:
        RosrmError: it has not returned in time.
    """
    outcomes: queue.SimpleQueue[Callable[[], T]] = queue.SimpleQueue()

    def run() -> None:
        try:
            result = call()
        except Exception as fault:  # noqa: BLE001 - raised again in the caller
            outcomes.put(partial(_raise, fault))
        else:
            outcomes.put(lambda: result)

    threads.start(run, what)
    try:
        outcome = outcomes.get(timeout=seconds)
    except queue.Empty:
        raise RosrmError(
            f"{what} has not ended within {seconds:g} s: the kernel, or a file system that does "
            "not answer, blocks it"
        ) from None
    return outcome()


def _raise(fault: Exception) -> NoReturn:
    raise fault
