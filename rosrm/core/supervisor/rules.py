"""Policies for the restart, stop and fence of an instance."""

from __future__ import annotations

from typing import Literal, NamedTuple

#: Process name and number, as in `InstanceId`.
Key = tuple[str, int]


class RestartRule(NamedTuple):
    """Lightweight copy of `rosrm.model.values.RestartPolicy`."""

    when: Literal["never", "on-failure", "always"] = "never"
    delay: float = 1.0
    max_delay: float = 30.0
    factor: float = 2.0
    attempts: int = 5
    window: float = 300.0


class StopRule(NamedTuple):
    """Lightweight copy of `rosrm.model.values.StopPolicy`."""

    interrupt_grace: float = 5.0
    terminate_grace: float = 5.0


class FenceRule(NamedTuple):
    """Lightweight copy of `rosrm.model.values.Fence`."""

    after: float
    grace: float
    alive: bool = False
