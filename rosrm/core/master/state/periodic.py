"""State of the periodic checkpoints of running instances."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

from rosrm.core.master.commands import OrderId
from rosrm.core.master.outcomes import Rejected
from rosrm.core.master.state.backoff import Backoff


@dataclass(slots=True)
class Dumped:
    """The checkpoints of one instance.

    Attributes:
        process, host: names.
        strategy: name of the strategy that makes the checkpoints.
        discard: name of the executor that removes the images; None: there is none; `Rejected`: the
            strategy failed to name it.
        since: time of the last dump, or of the start of the wait for the first one.
        made: at least one checkpoint exists.
        size: size of the newest checkpoint in bytes.
        pause: seconds for which the newest dump paused the process.
        order: order of a dump without an answer yet; None: there is none.
        asked: incarnation of the slave that received the order.
        trouble: why the last dump failed; "": it did not.
        backoff: of failed dumps, then of the order to remove all images.
        removal: the newest order to remove all images; None: the instance has not ended.
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
    backoff: Backoff = field(default_factory=Backoff)
    removal: OrderId | None = None


@dataclass(slots=True)
class Periodic:
    """All periodic checkpoints, by the number of the instance.

    Attributes:
        reviewed_at: time of the last review.
    """

    of: dict[int, Dumped] = field(default_factory=dict)
    reviewed_at: float = -inf
