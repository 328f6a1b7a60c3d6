"""`rosrm logs`: finds the slave that holds a log, copies it, and follows it."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import typer

from rosrm.config.units import Quantity
from rosrm.errors import ConfigError, Refused

if TYPE_CHECKING:
    from rosrm.ros.client import LogPart, MasterClient

_CHUNK: Final = 256 * 1024
#: Seconds between two looks at a log that has nothing new.
PERIOD: Final = 0.3
#: States in which nothing more will be written anywhere.
_OVER: Final = frozenset({"finished", "failed", "cancelled"})


@dataclass(frozen=True)
class Holder:
    """Who holds the log of a process: its host and instance (0: the newest there)."""

    host: str
    number: int
    over: bool


def bytes_of(text: str) -> int | None:
    """The option --tail in bytes; None where it is not given. Raises `ConfigError`."""
    try:
        return int(Quantity("size", whole=True, above=True).parse(text)) if text else None
    except ValueError as error:
        raise ConfigError(f"--tail: {error}") from None


def find_holder(client: MasterClient, name: str, host: str) -> Holder:
    """Where the log of a process is; raises `Refused` where there can be none."""
    listed = client.list(processes=True, events=True, process=name, newest=100)
    row = next((row for row in listed.processes if row.name == name), None)
    over = row is None or row.state in _OVER
    if host:
        return Holder(host, row.number if row and row.host == host else 0, over)
    if row is not None and row.host:
        return Holder(row.host, row.number, over)
    last = next((event.host for event in reversed(listed.events) if event.host), "")
    if last:
        return Holder(last, 0, over)
    if row is None:
        raise Refused(f"there is no process {name!r}; `rosrm ps --all` lists them")
    raise Refused(f"{name} has not run yet: it is {row.state.replace('_', ' ')}. {row.reason}")


def copy_log(client: MasterClient, name: str, host: str, tail: int | None, *, follow: bool) -> None:
    """Copy a log to standard output.

    Args:
        client: of the master.
        name: of the process.
        host: that holds the log; "": where the process is or was last.
        tail: only so many bytes of its end; None: all.
        follow: go on as it grows, and on the host that the process moves to.
    """
    holder = find_holder(client, name, host)
    while True:
        _copy_instance(client, name, holder, tail, follow=follow)
        if not follow or host:
            return
        after = _next_holder(client, name, holder)
        if after is None:
            return
        typer.echo(f"--- {name} now runs on {after.host} ---", err=True)
        holder, tail = after, None


def _next_holder(client: MasterClient, name: str, before: Holder) -> Holder | None:
    """Where a process goes on after an instance has ended; None: nowhere."""
    while True:
        now = find_holder(client, name, "")
        if now.over:
            return None
        if now.number and (now.host, now.number) != (before.host, before.number):
            return now
        time.sleep(PERIOD)


def _copy_instance(
    client: MasterClient, name: str, holder: Holder, tail: int | None, *, follow: bool
) -> None:
    start = -tail if tail else 0
    part = _first_part(client, name, holder, start, follow=follow and not holder.over)
    while True:
        _write(part.content)
        before = part
        part = client.read_log(holder.host, name, holder.number, before.next_offset, _CHUNK)
        if part.generation != before.generation:
            part = client.read_log(holder.host, name, holder.number, 0, _CHUNK)
        elif not part.content:
            if part.ended or not follow:
                return
            time.sleep(PERIOD)


def _first_part(
    client: MasterClient, name: str, holder: Holder, start: int, *, follow: bool
) -> LogPart:
    """With `follow`, of an assigned process that its host is only about to start, too."""
    while True:
        try:
            return client.read_log(holder.host, name, holder.number, start, _CHUNK)
        except Refused as refusal:
            if not follow or refusal.code != "unknown" or _no_longer(client, name, holder):
                raise
            time.sleep(PERIOD)


def _no_longer(client: MasterClient, name: str, holder: Holder) -> bool:
    now = find_holder(client, name, "")
    return now.over or (now.host, now.number) != (holder.host, holder.number)


def _write(content: bytes) -> None:
    sys.stdout.buffer.write(content)
    sys.stdout.flush()


__all__ = ["Holder", "LogPart", "bytes_of", "copy_log", "find_holder"]
