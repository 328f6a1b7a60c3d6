"""The policies by which the supervisor restarts, stops and fences an instance."""

from __future__ import annotations

from typing import NamedTuple

#: Process name and number: what `InstanceId` holds.
Key = tuple[str, int]


class RestartRule(NamedTuple):
    """`rosrm.model.values.RestartPolicy`, without its weight."""

    when: str = "never"
    delay: float = 1.0
    max_delay: float = 30.0
    factor: float = 2.0
    attempts: int = 5
    window: float = 300.0


class StopRule(NamedTuple):
    """`rosrm.model.values.StopPolicy`, without its weight."""

    interrupt_grace: float = 5.0
    terminate_grace: float = 5.0


class FenceRule(NamedTuple):
    """`rosrm.model.values.Fence`, without its weight."""

    after: float
    grace: float
    alive: bool = False
