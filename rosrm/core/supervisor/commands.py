"""Commands of the supervisor's core to its server, in the imperative."""

from __future__ import annotations

from typing import NamedTuple

from rosrm.core.supervisor.rules import Key


class Spawn(NamedTuple):
    """Start it; answered by Spawned or SpawnFailed."""

    instance: Key


class Unspawn(NamedTuple):
    """Give up a spawn that was not tried yet; then answered by SpawnFailed."""

    instance: Key


class Signal(NamedTuple):
    """Send a signal to every process of it."""

    instance: Key
    number: int


class Tell(NamedTuple):
    """Record its status, then tell the client."""

    instance: Key


class Drop(NamedTuple):
    """Forget it durably."""

    instance: Key


class Leave(NamedTuple):
    """All has ended (or cannot be ended): the supervisor ends too."""


Command = Spawn | Unspawn | Signal | Tell | Drop | Leave
