"""Waits of tests for what other processes do; each has a time-out and a text for its failure."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

#: Seconds allowed on a busy machine; no wait takes so long unless a test fails.
PATIENCE = 30.0
#: Seconds between two looks at a condition.
_PAUSE = 0.01

T = TypeVar("T")


def wait_until(
    condition: Callable[[], T],
    what: str,
    timeout: float = PATIENCE,
    *,
    seen: Callable[[], object] = lambda: "",
    pause: Callable[[float], object] = time.sleep,
) -> T:
    """Poll a condition until its result is true, and return that result.

    Args:
        condition: looked at without an event, e.g. a file of another process.
        what: the awaited state, for the message of the failure.
        timeout: seconds.
        seen: describes the actual state, for the message of the failure.
        pause: spends some seconds between two looks, e.g. by spinning a ROS node.
    """
    deadline = time.monotonic() + timeout
    while not (result := condition()):
        assert time.monotonic() < deadline, f"not within {timeout:g} s: {what} {seen()}"
        pause(_PAUSE)
    return result


def holds_for(
    seconds: float,
    condition: Callable[[], object],
    what: str,
    *,
    pause: Callable[[float], object] = time.sleep,
) -> None:
    """Check again and again, for some seconds, that a condition holds; arguments as above."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        assert condition(), f"{what} does not hold for {seconds:g} s"
        pause(5 * _PAUSE)


def quickest(attempt: Callable[[], object], within: float, attempts: int = 8) -> None:
    """Check that one of some attempts ends within some seconds: other work may delay the others."""
    times: list[float] = []
    while not times or (min(times) >= within and len(times) < attempts):
        began = time.monotonic()
        attempt()
        times.append(time.monotonic() - began)
    assert min(times) < within, times


def wait_gone(pid: int, timeout: float = PATIENCE) -> None:
    """Wait until a process has ended; a zombie has."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        poll = select.poll()
        poll.register(descriptor, select.POLLIN)
        assert poll.poll(timeout * 1000), f"{pid} did not end in {timeout:g} s: {command_of(pid)}"
    finally:
        os.close(descriptor)


def command_of(pid: int) -> str:
    """Return the command line of a process; "" if it has ended."""
    try:
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return ""
    return command.replace(b"\0", b" ").decode(errors="replace")


def all_commands() -> str:
    """Return the command lines of all processes of this machine."""
    return "\n".join(
        command_of(int(one.name)) for one in Path("/proc").iterdir() if one.name.isdigit()
    )
