"""State of the periodic checkpoints of running instances."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

from rosrm.core.master.commands import OrderId
from rosrm.core.master.outcomes import Rejected


@dataclass(slots=True)
class Dumped:
    """The checkpoints of one instance.

    Attributes:
        process, host: names.
        strategy: name of the strategy that makes them.
        discard: the executor that removes its images; None: none does; `Rejected`: the strategy
            failed to name it.
        since: time of the last dump, or time since when the first is due.
        made: at least one exists.
        size: bytes of the newest.
        pause: seconds for which the newest dump paused the process.
        order: of the dump under way; None: none is.
        asked: incarnation of the slave that received the order.
        trouble: why there is none, or no newer one.
    """

    process: str
    host: str
    strategy: str
    discard: str | Rejected | None
    since: float
    made: bool = False
    size: int = 0
    pause: float = 0.0
    order: OrderId | None = None
    asked: int = 0
    trouble: str = ""


@dataclass(slots=True)
class Periodic:
    """All periodic checkpoints, by the number of the instance.

    Attributes:
        reviewed_at: time of the last review.
    """

    of: dict[int, Dumped] = field(default_factory=dict)
    reviewed_at: float = -inf
