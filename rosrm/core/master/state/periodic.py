"""The periodic checkpoints of running instances."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from typing import Final

#: Numbers of the orders are apart from those of all else: a record that is replayed without the
#: plugins must not number its orders otherwise.
BEFORE_FIRST: Final = 1 << 42


@dataclass(slots=True)
class Dumped:
    """What is known of the checkpoints of one instance.

    Attributes:
        process, host: names.
        strategy: name of the strategy that makes them.
        discard: the executor that removes its images; None: the strategy failed to name it.
        since: time of the last one, or since when the first is due.
        made: there is one.
        size: its bytes.
        pause: seconds for which the process stood still.
        order: by which one is made just now; 0: none is.
        asked: incarnation of the slave that was ordered so.
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
    """All of them, by the number of the instance.

    Attributes:
        looked: time of the last look.
        last_order: that was given.
    """

    of: dict[int, Dumped] = field(default_factory=dict)
    looked: float = -inf
    last_order: int = BEFORE_FIRST
