"""Commands of the supervisor's core to its server, in the imperative."""

from __future__ import annotations

from typing import NamedTuple

from rosrm.core.supervisor.rules import Key


class Spawn(NamedTuple):
    """Start the instance; answered by Spawned or SpawnFailed."""

    instance: Key


class Unspawn(NamedTuple):
    """Give up a spawn that was not tried yet; then answered by SpawnFailed."""

    instance: Key


class Signal(NamedTuple):
    """Send a signal to every process of the instance."""

    instance: Key
    number: int


class ReportStatus(NamedTuple):
    """Record the status of the instance, then send it to the client."""

    instance: Key


class Drop(NamedTuple):
    """Forget the instance durably."""

    instance: Key


class Leave(NamedTuple):
    """End the supervisor: every instance has ended (or cannot be ended)."""


Command = Spawn | Unspawn | Signal | ReportStatus | Drop | Leave
