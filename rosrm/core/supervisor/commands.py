"""Commands of the supervisor's core to its server, in the imperative."""

from __future__ import annotations

from typing import NamedTuple

from rosrm.core.supervisor.rules import Key


class Spawn(NamedTuple):
    """Start the instance; `Spawned` or `SpawnFailed` follows."""

    instance: Key


class Unspawn(NamedTuple):
    """Cancel a spawn that has not begun; `SpawnFailed` follows, unless the spawn has begun."""

    instance: Key


class Signal(NamedTuple):
    """Send a signal to every process of the instance."""

    instance: Key
    number: int


class ReportStatus(NamedTuple):
    """Persist the status of the instance, then send it to the client."""

    instance: Key


class Drop(NamedTuple):
    """Remove the instance from the persisted state."""

    instance: Key


class Leave(NamedTuple):
    """End the supervisor, because every instance has ended or is stuck in the kernel."""


Command = Spawn | Unspawn | Signal | ReportStatus | Drop | Leave
