"""State of the periodic checkpoints of running instances."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Final

#: These orders have numbers of their own, because a recording that is replayed without the plugins
#: must give the other orders the same numbers.
BEFORE_FIRST: Final = 1 << 42


@dataclass(slots=True)
class Dumped:
    """The checkpoints of one instance.

    Attributes:
        process, host: names.
        strategy: name of the strategy that makes them.
        discard: the executor that removes its images; None: the strategy failed to name it.
        since: time of the last dump, or time since when the first is due.
        made: at least one exists.
        size: bytes of the newest.
        pause: seconds for which the newest dump paused the process.
        order: of the dump under way; 0: none is.
        asked: incarnation of the slave that received the order.
        trouble: why there is none, or no newer one.
    """

    process: str
    host: str
    strategy: str
    discard: str | None
    since: float
    made: bool = False
    size: int = 0
    pause: float = 0.0
    order: int = 0
    asked: int = 0
    trouble: str = ""


@dataclass(slots=True)
class Periodic:
    """All periodic checkpoints, by the number of the instance.

    Attributes:
        looked: time of the last review.
        last_order: number of the last order.
    """

    of: dict[int, Dumped] = field(default_factory=dict)
    looked: float = -inf
    last_order: int = BEFORE_FIRST
