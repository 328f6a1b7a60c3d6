"""Known checkpoint images, and images to be removed."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

from rosrm.core.master.commands import OrderId


@dataclass(slots=True)
class UnwantedImage:
    """An image that is to be removed.

    Attributes:
        process: name of its process.
        host: name of the host that stores it.
        drop: the executor that removes it.
        numbers: of the instance that was dumped, and of those that were to be restored from it.
        order: of the removal; None: none is under way.
        ask_at: time of the next order to remove it.
    """

    process: str
    host: str
    drop: str
    numbers: tuple[int, ...]
    order: OrderId | None = None
    ask_at: float = -inf


@dataclass(slots=True)
class Images:
    """All images that the master knows.

    Attributes:
        of: names of the processes that are checkpointed.
        unwanted: by the number of the instance.
    """

    of: set[str] = field(default_factory=set)
    unwanted: dict[int, UnwantedImage] = field(default_factory=dict)
